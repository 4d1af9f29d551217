"""The bridges' unit under a real systemd: off at first, hardened, with feed and line."""

import json
import re
from collections.abc import Iterator

import pytest

from tests.systemd.nspawn import NOBODY, SITE, STREAMS, Machine, Service

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

TCP, MODBUS = "palpate-bridge@tcp", "palpate-bridge@modbus"
LINE = "/run/palpate-tcp/line"
ASK_TCP = """
import json, sys
from palpate.client.box import Palpate
from palpate.core.errors import CommandRefused
with Palpate("socket://127.0.0.1:1503", timeout_s=30) as box:
    box.wait_ready(30)  # what is said before the box has opened the line is lost
    found = {"labels": list(box.labels()), "state": box.state().skin}
    try:
        found["start"] = box.start()
    except CommandRefused as e:
        found["start"] = str(e)
    print(json.dumps(found))
"""
ASK_MODBUS = """
import socket, struct, sys, time
def asked():
    with socket.create_connection(("127.0.0.1", 1502), timeout=20) as s:
        s.sendall(bytes.fromhex("0001000000060104") + struct.pack(">HH", 0, 5))
        return struct.unpack(">5H", s.recv(300)[9:])
end = time.monotonic() + 20
while time.monotonic() < end:
    try:
        if asked()[2] == int(sys.argv[1]):
            break
    except OSError:
        pass
    time.sleep(0.1)
print(*asked())
"""


def ask(machine: Machine, program: str, *args: str) -> str:
    """The output of a program on the machine."""
    return machine.get("/opt/palpate/bin/python", "-c", program, *args)


@pytest.fixture
def bridges(machine: Machine, service: Service) -> Iterator[Service]:
    """The service, stopped; both bridges are stopped after the test."""
    yield service
    machine.get("systemctl", "stop", TCP, MODBUS)
    machine.run("systemctl", "reset-failed", TCP, MODBUS)


def test_the_unit_is_sound_hardened_and_off(machine: Machine, before: list[bool]):
    """No problem for systemd, exposure at most 1.5 of 10; neither bridge is enabled."""
    machine.check_unit("palpate-bridge@.service")
    for unit in (TCP, MODBUS):
        assert machine.run("systemctl", "is-enabled", unit).stdout.strip() == "disabled"


def test_modbus_reads_the_feed_and_outlives_the_service(machine: Machine, bridges: Service):
    """The skin's state as a user of its own; without the service 0, and it goes on."""
    bridges.start()
    bridges.until("StatusText", STREAMS)
    machine.get("systemctl", "start", MODBUS)
    pid = machine.shown(MODBUS, "MainPID")
    assert ask(machine, ASK_MODBUS, "1").split()[2] == "1"
    assert machine.get("stat", "-c", "%U", f"/proc/{pid}") == "palpate-bridge"
    machine.get("systemctl", "stop", "palpate")
    assert ask(machine, ASK_MODBUS, "0").split()[2] == "0"
    machine.get("systemctl", "start", "palpate")
    assert ask(machine, ASK_MODBUS, "1").split()[2] == "1"
    assert machine.shown(MODBUS, "MainPID") == pid


def test_the_line_over_tcp(machine: Machine, bridges: Service):
    """The box opens it, commands need a setting; killed ones meet again."""
    settings = f'[serial]\nport = "{LINE}"\n[trigger]\nmode = "serial"\n'
    machine.put(SITE, settings)
    bridges.start()
    machine.get("systemctl", "start", TCP)
    machine.until(f"test -L {LINE}")
    found = json.loads(ask(machine, ASK_TCP))
    assert found["state"] == "streaming"
    assert len(found["labels"]) > 1
    assert "read-only" in found["start"]
    others = machine.run(*NOBODY, "sh", "-c", f": <>{LINE}")
    assert "Permission denied" in others.stderr
    machine.get("systemctl", "kill", "--signal=KILL", TCP)
    machine.until(f"systemctl is-active -q {TCP}")
    assert json.loads(ask(machine, ASK_TCP))["state"] == "streaming"
    bridges.kill("KILL")
    assert json.loads(ask(machine, ASK_TCP))["state"] == "streaming"
    machine.put(SITE, settings + "[bridge]\nallow_writes = true\n")
    machine.get("systemctl", "restart", TCP)
    machine.until(f"test -L {LINE}")
    assert json.loads(ask(machine, ASK_TCP))["start"] is None


def test_settings_that_cannot_be_used(machine: Machine, bridges: Service):
    """No serial line for the bridge: exit 78, no restart; the journal names the setting."""
    machine.put(SITE, '[serial]\nport = "/dev/ttyAMA0"\n')
    machine.get("systemctl", "start", TCP)
    machine.until(f"systemctl is-failed -q {TCP}")
    assert machine.shown(TCP, "ExecMainStatus") == "78"
    assert f'set serial.port = "{LINE}"' in machine.get("journalctl", "-q", "-u", TCP, "-o", "cat")


def test_what_it_cannot_do(machine: Machine, bridges: Service):
    """It has no capability, and cannot read the files of the service."""
    bridges.start()
    machine.get("systemctl", "start", MODBUS)
    ask(machine, ASK_MODBUS, "1")
    pid = machine.shown(MODBUS, "MainPID")
    assert re.search(r"(?m)^CapBnd:\t0+$", machine.get("cat", f"/proc/{pid}/status"))
    inside = machine.as_user(pid, "palpate-bridge", "ls", "/var/lib/palpate")
    assert inside.returncode != 0
    assert "Permission denied" in inside.stderr
