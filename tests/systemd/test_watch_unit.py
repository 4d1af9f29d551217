"""The page's unit under a real systemd: off at first, hardened, with TLS and token."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.factories.install_scripts import run_here
from tests.systemd.nspawn import NOBODY, SITE, STREAMS, Machine, Service

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

UNIT = "palpate-watch"
ASK = """
import json, socket, ssl, sys, time, urllib.request
end = time.monotonic() + 20
while socket.socket().connect_ex(("127.0.0.1", 8137)) and time.monotonic() < end:
    time.sleep(0.1)
trusts = ssl.create_default_context(cafile="/etc/palpate/watch/certificate.pem")
token = open("/etc/palpate/watch/token-look").read().strip()
key = {"Authorization": f"Bearer {token}"}
request = urllib.request.Request("https://127.0.0.1:8137/events", headers=key)
with urllib.request.urlopen(request, context=trusts, timeout=20) as answer:
    found = {}
    absent = lambda: sys.argv[1:] and found.get("box", {}).get("there") is False
    while "verdict" not in found and not absent():
        name, _, text = answer.readline().decode().strip().partition(": ")
        if name == "event":
            event = text
        elif name == "data":
            found[event] = json.loads(text)
print(json.dumps(found))
"""


def asked(page: Machine, *away: str) -> dict[str, Any]:
    """The events up to a verdict, or until the box is away."""
    return json.loads(page.get("/opt/palpate/bin/python", "-c", ASK, *away))


@pytest.fixture
def page(machine: Machine, service: Service) -> Iterator[Machine]:
    """The machine with the page on the network, beside the running service."""
    machine.get("sh", "-ec", run_here("import page_secrets; print(page_secrets.make())"))
    machine.put(SITE, '[watch]\naddress = "0.0.0.0"\n')
    service.start()
    service.until("StatusText", STREAMS)
    machine.get("systemctl", "start", UNIT)
    yield machine
    machine.get("systemctl", "stop", UNIT)


def test_the_unit_is_sound_hardened_and_off(machine: Machine, before: list[bool]):
    """No problem for systemd, exposure at most 1.5 of 10; not enabled."""
    machine.check_unit(f"{UNIT}.service")
    assert machine.run("systemctl", "is-enabled", UNIT).stdout.strip() == "disabled"


def test_the_page_is_served_with_the_token_of_the_install(page: Machine):
    """Over TLS: the box's name, state and verdicts come through."""
    found = asked(page)
    assert found["hello"]["source"] == "sim"
    assert found["box"] == {"there": True, "why": ""}
    assert found["verdict"]["scores"]
    assert page.get("systemctl", "is-active", UNIT) == "active"


def test_it_goes_on_without_the_service(page: Machine, service: Service):
    """A stop shows, and the page is live again after the next start."""
    before = page.shown(UNIT, "MainPID")
    page.get("systemctl", "stop", "palpate")
    assert asked(page, "away")["box"]["there"] is False
    page.get("systemctl", "start", "palpate")
    assert asked(page)["box"]["there"] is True
    assert page.shown(UNIT, "MainPID") == before


def test_the_token_is_for_root_and_the_page_alone(page: Machine):
    """Nobody else reads token, key or feed; the page reads no file of the service."""
    for name in ("token-look", "token-teach", "key.pem", "certificate.pem"):
        path = f"/etc/palpate/watch/{name}"
        assert page.get("stat", "-c", "%U:%G %a", path) == "root:palpate-watch 640"
        assert page.run(*NOBODY, "cat", path).returncode != 0
    pid = page.shown(UNIT, "MainPID")
    assert page.get("stat", "-c", "%U", f"/proc/{pid}") == UNIT
    inside = page.as_user(pid, UNIT, "ls", "/var/lib/palpate")
    assert inside.returncode != 0
    assert "Permission denied" in inside.stderr


def test_without_a_token_it_does_not_start_on_the_network(machine: Machine, service: Service):
    """Exit 78, no restart; the journal names the file and the command that makes it."""
    machine.run("rm", "-rf", "/etc/palpate/watch")
    machine.put(SITE, '[watch]\naddress = "0.0.0.0"\n')
    machine.get("systemctl", "start", UNIT)
    machine.until(f"systemctl is-failed -q {UNIT}")
    assert machine.shown(UNIT, "ExecMainStatus") == "78"
    journal = machine.get("journalctl", "-q", "-u", UNIT, "-o", "cat")
    assert "/etc/palpate/watch/token" in journal
    assert "make install" in journal
    machine.get("systemctl", "reset-failed", UNIT)
