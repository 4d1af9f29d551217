"""Units under attack have room within their limits, and their networks are closed."""

import re
import subprocess
from collections.abc import Iterator

import pytest

from tests.factories.install_scripts import run_here
from tests.systemd.nspawn import PLACES, SITE, STREAMS, WAIT_S, Machine, Service

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

PYTHON = "/opt/palpate/bin/python"
PAGE, MODBUS, TCP = "palpate-watch", "palpate-bridge@modbus", "palpate-bridge@tcp"
PORTS = {PAGE: 8137, MODBUS: 1502, TCP: 1503}
CROWD = """
import json, os, socket, sys, time
where, pid, many = json.loads(sys.argv[1]), sys.argv[2], int(sys.argv[3])
crowd = []
for _ in range(many):
    one = socket.socket(socket.AF_UNIX if isinstance(where, str) else socket.AF_INET)
    one.settimeout(2)
    try:
        one.connect(where if isinstance(where, str) else tuple(where))
    except OSError:
        continue
    crowd.append(one)
time.sleep(1)
status = dict(line.split(":", 1) for line in open(f"/proc/{pid}/status"))
print(len(crowd), len(os.listdir(f"/proc/{pid}/fd")), int(status["Threads"]))
"""
REACH = """
import socket, sys
own, port = sys.argv[1], int(sys.argv[2])
try:
    socket.create_connection((own, port), timeout=3, source_address=(own, 0)).close()
except TimeoutError:
    print("nothing")
else:
    print("reached")
"""


def limit(machine: Machine, unit: str, name: str) -> int:
    return int(machine.shown(unit, name))


@pytest.fixture
def open_units(machine: Machine, service: Service) -> Iterator[Machine]:
    """Service, page and bridges at work. Page and bridges listen on all addresses."""
    machine.get("sh", "-ec", run_here("import page_secrets; print(page_secrets.make())"))
    machine.put(
        SITE,
        "".join(f'[{part}]\naddress = "0.0.0.0"\n' for part in ("watch", "bridge"))
        + '[serial]\nport = "/run/palpate-tcp/line"\n',
    )
    service.start()
    service.until("StatusText", STREAMS)
    machine.get("systemctl", "start", *PORTS)
    for port in PORTS.values():
        up = f"import socket; socket.create_connection(('127.0.0.1', {port}), 1).close()"
        tries = f'for i in $(seq {2 * WAIT_S}); do {PYTHON} -c "{up}" && exit; sleep 0.5; done'
        machine.run("sh", "-c", f"({tries}) 2>/dev/null; exit 1")
    yield machine
    machine.get("systemctl", "stop", *PORTS)


@pytest.mark.parametrize("unit", ["palpate", PAGE, MODBUS, TCP])
def test_a_crowd_leaves_room_within_the_limits(open_units: Machine, unit: str):
    """300 connections: files and threads below the unit's limits, and it goes on."""
    pid = open_units.shown(unit, "MainPID")
    files, tasks = limit(open_units, unit, "LimitNOFILE"), limit(open_units, unit, "TasksMax")
    limits = open_units.get("cat", f"/proc/{pid}/limits")
    assert re.search(rf"(?m)^Max open files +{files} +{files} ", limits)
    where = f'["127.0.0.1", {PORTS[unit]}]' if unit in PORTS else '"/run/palpate/feed.sock"'
    crowd, opened, threads = map(
        int, open_units.get(PYTHON, "-c", CROWD, where, pid, "300").split()
    )
    print(unit, crowd, opened, files, threads, tasks)
    assert crowd > 10
    assert opened < files
    assert threads < tasks
    assert open_units.shown(unit, "MainPID") == pid


@pytest.mark.parametrize("unit", PORTS)
def test_public_addresses_reach_nothing(open_units: Machine, unit: str):
    """A private address reaches page and bridges; another does not, although they listen there."""
    net = ("nsenter", "-t", open_units.first, "-n", "ip", "addr")
    for address in ("10.9.9.9/32", "203.0.113.9/32"):
        subprocess.run([*net, "replace", address, "dev", "lo"], check=True, timeout=120)
    port = str(PORTS[unit])
    assert open_units.get(PYTHON, "-c", REACH, "10.9.9.9", port) == "reached"
    assert open_units.get(PYTHON, "-c", REACH, "203.0.113.9", port) == "nothing"


def test_the_unit_of_teaching_is_sound_and_limited(machine: Machine, before: list[bool]):
    """systemd reports no problem; limits and addresses are those of its page and its loop."""
    done = machine.run("systemd-analyze", "verify", PLACES["palpate-teach.service"])
    assert (done.returncode, done.stderr) == (0, "")
    assert limit(machine, "palpate-teach", "TasksMax") == 64
    assert limit(machine, "palpate-teach", "LimitNOFILE") == 512
    (denied, allowed) = (
        machine.shown("palpate-teach", name) for name in ("IPAddressDeny", "IPAddressAllow")
    )
    assert "0.0.0.0/0" in denied
    assert "192.168.0.0/16" in allowed


def test_a_box_that_has_to_be_taught_shows_its_page(machine: Machine, service: Service):
    """In the service's place, which is back after it."""
    dropin = "/run/systemd/system/palpate-teach.service.d/test.conf"
    service.start()
    for end, after in (
        ("sleep 3600", "stop palpate-teach"),
        ("exit 78", "is-active palpate-teach"),
    ):
        machine.put(dropin, f"[Service]\nExecStart=\nExecStart=/bin/sh -c '{end}'\n")
        machine.get("systemctl", "daemon-reload")
        began = service["InvocationID"]
        machine.put("/run/palpate/untaught", "")
        if "sleep" in end:
            service.until("ActiveState", "inactive")
            assert machine.get("systemctl", "is-active", "palpate-teach") == "active"
        service.until("InvocationID", f"(?!{began}).+") if "exit" in end else None
        machine.run("systemctl", *after.split())
        service.until("ActiveState", "active")
        assert service["InvocationID"] != began
        assert machine.run("test", "-e", "/run/palpate/untaught").returncode == 1
        assert "trigger source" not in machine.get("journalctl", "-q", "--no-pager", "-b")
    machine.get("rm", "-r", dropin)
    machine.get("systemctl", "daemon-reload")
