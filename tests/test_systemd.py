"""The unit under a real systemd, in a container: start, notify, watchdog, restart, crash loop, stop, rights.

The skin is simulated, in real time. PALPATE_SYSTEMD=1 makes what this needs (see nspawn.py) and insists on it; without,
what is not there is skipped.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator

import nspawn
import pytest
from machines import Missing

CABLE = """
import os, sys, time
from appliance.__main__ import main
from appliance.sim import usb
class Cable(usb.RigBackend):
    # plugged in while /run/skin is there; its bus hangs while /run/hang is
    def _touch(self, what=""):
        while os.path.exists("/run/hang"):
            time.sleep(0.01)
        self.plug() if os.path.exists("/run/skin") else self.unplug()
        super()._touch(what)
usb.RigBackend = Cable
sys.exit(main())
"""
SIM = "ExecStart=\nExecStart=/opt/palpate/bin/palpate run --sim skin\n"
CABLED = "ExecStart=\nExecStart=/opt/palpate/bin/python /opt/palpate/cable.py run --sim skin\n"
SITE = "/etc/palpate/palpate.toml"
STREAMS = r"skin streaming\. Sweeps answered: \d+"
WAIT_S = 30
"""Longest wait for what should take a second or two: other work may be going on here."""


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[nspawn.Machine]:
    """A machine that has booted, nothing of the box on it but its locked dependencies."""
    insist = os.environ.get("PALPATE_SYSTEMD") == "1"
    parcel, folder = tmp_path_factory.mktemp("parcel"), tmp_path_factory.mktemp("machine")
    try:
        nspawn.check()
        if not insist and not nspawn.folder().exists():
            raise Missing(
                "no Debian for a container here; run python tests/nspawn.py (90 s, 370 MB in ~/.cache/palpate)"
            )
        nspawn.pack(parcel, tmp_path_factory.mktemp("source"))
        booted = nspawn.Machine(nspawn.set_up(), parcel, folder / "nspawn.log")
    except Missing as e:
        if insist:
            raise
        pytest.skip(str(e))
    with booted:
        yield booted


@pytest.fixture(scope="session")
def before(machine: nspawn.Machine) -> list[bool]:
    """Whether user and folders were there; then the box is installed."""
    tests = (("id", "palpate"), ("test", "-e", "/etc/palpate"), ("test", "-e", "/var/lib/palpate"))
    there = [machine.run(*one).returncode == 0 for one in tests]
    machine.install()
    machine.put("/opt/palpate/cable.py", CABLE)
    return there


class Service:
    """palpate.service on the machine."""

    def __init__(self, machine: nspawn.Machine) -> None:
        self.machine = machine
        self._begin = time.time()

    def configure(self, text: str) -> None:
        """Add lines to [Service] by a drop-in."""
        self.machine.put("/run/systemd/system/palpate.service.d/test.conf", f"[Service]\n{text}\n")
        self.machine.get("systemctl", "daemon-reload")

    def start(self, text: str = SIM) -> int:
        """Start it with a drop-in, wait until it is active; the number of its process."""
        self.configure(text)
        self.machine.get("systemctl", "start", "palpate")
        return int(self["MainPID"])

    def __getitem__(self, name: str) -> str:
        return self.machine.get("systemctl", "show", "palpate", "--value", "-p", name)

    def until(self, name: str, wanted: str) -> None:
        """Wait for a property to be `wanted`, a regular expression."""
        end = time.monotonic() + WAIT_S
        while not re.fullmatch(wanted, value := self[name]):
            assert time.monotonic() < end, f"{name} stays {value!r}: {self.journal()}"
            time.sleep(0.2)

    def kill(self, signal: str) -> None:
        """Send a signal to the process itself, as nobody who stops a service would."""
        self.machine.get("systemctl", "kill", "--kill-whom=main", f"--signal={signal}", "palpate")

    def journal(self, *more: str) -> list[str]:
        """What the service and systemd about it have written to the journal since the test began."""
        about = ("-u", "palpate", "-o", "cat", f"--since=@{self._begin:.6f}", *more)
        return self.machine.get("journalctl", "-q", *about).splitlines()

    def told(self) -> list[str]:
        """The journal without systemd's words and without sentences: what the program tells a person."""
        return [line for line in self.journal("_SYSTEMD_UNIT=palpate.service") if not line.startswith("$PPLP")]


@pytest.fixture
def service(machine: nspawn.Machine, before: list[bool]) -> Iterator[Service]:
    """The installed service, stopped; stopped again and as it was delivered after the test."""
    yield Service(machine)
    machine.run("rm", "-rf", "/run/systemd/system/palpate.service.d", SITE, "/run/skin", "/run/hang")
    machine.get("systemctl", "daemon-reload")
    machine.get("systemctl", "stop", "palpate")
    machine.run("systemctl", "reset-failed", "palpate")


def test_the_tools_of_systemd_make_what_the_service_needs(machine: nspawn.Machine, before: list[bool]):
    """User, groups and folders, with owners and modes; none of it was there before, and twice is as good as once."""
    assert before == [False, False, False]
    for _ in range(2):
        assert set(machine.get("id", "-nG", "palpate").split()) == {"palpate"}
        assert machine.get("getent", "passwd", "palpate").endswith(":/var/lib/palpate:/usr/sbin/nologin")
        assert len(machine.get("getent", "group", "gpio", "dialout", "plugdev").splitlines()) == 3
        folders = machine.get("stat", "-c", "%n %U:%G %a", "/etc/palpate", "/var/lib/palpate")
        assert folders == "/etc/palpate root:root 755\n/var/lib/palpate palpate:palpate 750"
        machine.get("systemd-sysusers")
        machine.get("systemd-tmpfiles", "--create", nspawn.PLACES["palpate.tmpfiles"])


def test_the_unit_is_sound_and_hardened(machine: nspawn.Machine, before: list[bool]):
    """systemd finds nothing to complain about and knows its times; the exposure is 1.5 of 10 at most."""
    done = machine.run("systemd-analyze", "verify", nspawn.PLACES["palpate.service"])
    assert (done.returncode, done.stderr) == (0, "")
    shown = dict(line.split("=", 1) for line in machine.get("systemctl", "show", "palpate").splitlines())
    wanted = {"Type": "notify", "NotifyAccess": "main", "Restart": "always", "RestartUSec": "2s"}
    wanted |= {"TimeoutStartUSec": "1min", "TimeoutStopUSec": "10s", "StartLimitIntervalUSec": "0"}
    assert {name: shown[name] for name in wanted} == wanted
    done = machine.run("systemd-analyze", "security", "--threshold=15", "palpate")
    print(done.stdout.splitlines()[-1])
    assert done.returncode == 0, done.stdout


def test_the_boot_does_not_wait_for_a_skin(machine: nspawn.Machine, service: Service):
    """multi-user.target wants the service, and is reached without it."""
    machine.get("systemctl", "enable", "palpate")
    try:
        assert "palpate.service" in machine.get("systemctl", "show", "multi-user.target", "-p", "Wants")
        machine.get("systemctl", "stop", "multi-user.target")
        service.configure(CABLED)
        machine.get("systemctl", "start", "multi-user.target")
        assert service["ActiveState"] == "activating"
    finally:
        machine.get("systemctl", "disable", "palpate")


def test_it_is_active_with_the_first_frames_of_its_skin(machine: nspawn.Machine, service: Service):
    """Without a skin it is starting for as long as that takes, and says why; with one active, and stays so without it."""
    service.configure(CABLED + "TimeoutStartSec=2\nWatchdogSec=2")
    machine.get("systemctl", "start", "--no-block", "palpate")
    absent = r"skin absent: no skin 1209:7ac7 on USB .* check cable, power and udev rule\. Sweeps answered: \d"
    service.until("StatusText", absent)
    time.sleep(4.5)  # more than twice its time to start
    assert (service["ActiveState"], service["NRestarts"]) == ("activating", "0")
    machine.put("/run/skin", "")
    service.until("ActiveState", "active")
    service.until("StatusText", STREAMS)
    machine.get("rm", "/run/skin")
    service.until("StatusText", "skin absent.*")
    assert (service["ActiveState"], service["NRestarts"]) == ("active", "0")
    machine.put("/run/skin", "")
    service.until("StatusText", STREAMS)
    assert [line.split(" (")[0].split(";")[0] for line in service.told()] == [
        "palpate: skin: no skin 1209:7ac7 on USB",
        "palpate: serial: open",
        "palpate: skin: streaming",
        "palpate: skin: the skin was unplugged",
        "palpate: skin: no skin 1209:7ac7 on USB",
        "palpate: skin: streaming",
    ]


def test_a_start_that_hangs_is_begun_again(machine: nspawn.Machine, service: Service):
    """Before READY no watchdog looks; but a start that takes no turns any more runs out of time."""
    service.configure(CABLED + "TimeoutStartSec=2\nWatchdogSec=2\nRestartSec=100ms")
    machine.get("systemctl", "start", "--no-block", "palpate")
    service.until("StatusText", "skin absent.*")
    service.kill("SIGSTOP")
    service.until("NRestarts", "1")
    assert any("start operation timed out" in line for line in service.journal())


def test_a_process_that_stands_still_is_killed_and_started_again(service: Service):
    """SIGSTOP: the watchdog finds it within its time; the service comes back by itself and answers on."""
    first = service.start(SIM + "WatchdogSec=3")
    begin = time.monotonic()
    service.kill("SIGSTOP")
    service.until("NRestarts", "1")
    print(f"stopped to started again {time.monotonic() - begin:.1f} s: watchdog 3, RestartSec 2")
    service.until("ActiveState", "active")
    assert int(service["MainPID"]) not in (0, first)
    assert sum("Watchdog timeout (limit 3s)" in line for line in service.journal()) == 1
    service.until("StatusText", STREAMS)


def test_a_turn_that_hangs_is_found_and_named(machine: nspawn.Machine, service: Service):
    """A bus that never comes back: killed by the watchdog, and the journal says where it hung."""
    machine.put("/run/skin", "")
    service.start(CABLED + "WatchdogSec=3\nRestartSec=100ms")
    machine.put("/run/hang", "")
    service.until("NRestarts", "1")
    machine.get("rm", "/run/hang")
    service.until("ActiveState", "active")
    said = service.journal()
    assert "Fatal Python error: Aborted" in said
    assert any("sensor.py" in line and line.endswith(" in read") for line in said)


@pytest.mark.parametrize("signal", ["SIGKILL", "SIGSEGV"])
def test_a_killed_process_is_started_again(machine: nspawn.Machine, service: Service, signal: str):
    """However it dies, two seconds later it is there again; in between its lines, of the same settings, are lowered."""
    machine.put(SITE, "[output]\nready = 'GPIO23'\n")  # the simulated skin has lines of its own and ignores it
    first = service.start()
    service.kill(signal)
    service.until("NRestarts", "1")
    service.until("ActiveState", "active")
    assert int(service["MainPID"]) not in (0, first)
    assert sum("Main process exited, code=killed, status=" in line for line in service.journal()) == 1
    lowered = [line for line in service.told() if line.startswith("palpate: outputs may not be low:")]
    assert [line.split(": ")[2].split(";")[0] for line in lowered] == ["this machine has no /dev/gpiochip*"]


def test_a_crash_loop_is_slow_endless_and_ends_when_mended(machine: nspawn.Machine, service: Service):
    """Broken settings: named once at each start, never given up, at most one start in two seconds; mended, it runs."""
    service.start()
    machine.put(SITE, "[sweep]\nlongest_s = 'for ever'\n")
    service.kill("SIGKILL")
    begin = time.monotonic()
    service.until("NRestarts", "3")
    took_s = time.monotonic() - begin
    print(f"three starts in {took_s:.1f} s")
    assert took_s > 4
    named = [line for line in service.told() if line.startswith(f"palpate: {SITE}: sweep.longest_s = 'for ever'")]
    assert len(named) in (2, 3)
    machine.get("rm", SITE)
    service.until("ActiveState", "active")


def test_a_stop_answers_the_open_sweep(machine: nspawn.Machine, service: Service):
    """The sweep that is open is answered `aborted`, and the program ends by itself and well in time."""
    service.start()
    end = time.monotonic() + WAIT_S
    while True:  # a sweep lasts three seconds and a state comes each second: this one has just begun
        kinds = [line.split(",") for line in service.journal() if line.startswith("$PPLP")]
        if len(kinds) > 1 and kinds[-2][1] == "RES" and kinds[-1][1] == "STA" and kinds[-1][4] == "1":
            break
        assert time.monotonic() < end, kinds
        time.sleep(0.1)
    service.until("StatusText", f"skin streaming. Sweeps answered: {kinds[-2][2]}")
    begin = time.monotonic()
    machine.get("systemctl", "stop", "palpate")
    assert time.monotonic() - begin < 10
    assert "palpate.service: Deactivated successfully." in service.journal()
    results = [line.split(",") for line in service.journal() if line.startswith("$PPLP,RES,")]
    assert results[-1][4] == "aborted"
    assert [r[2] for r in results] == [str(i + 1) for i in range(len(results))]
    assert service.told() == ["palpate: skin: streaming", "palpate: serial: open"]


def test_status_says_how_it_is(machine: nspawn.Machine, service: Service):
    """A person who asks `systemctl status` reads it in words; the watchdog looks, ten seconds long."""
    service.start()
    assert service["WatchdogUSec"] == "10s"
    service.until("StatusText", STREAMS)
    shown = machine.run("systemctl", "status", "--no-pager", "palpate").stdout
    assert 'Status: "skin streaming. Sweeps answered: ' in shown
    assert "active (running)" in shown


def test_it_is_nobody_in_particular(machine: nspawn.Machine, service: Service):
    """Not root, no capability, no new privileges, system calls filtered; /etc/palpate can be read and not written."""
    pid = service.start()
    status = dict(re.findall(r"^(\w+):\t(.*)$", machine.get("cat", f"/proc/{pid}/status"), re.MULTILINE))
    uid = machine.get("id", "-u", "palpate")
    assert set(status["Uid"].split()) == {uid} != {"0"}
    assert {int(status[name], 16) for name in ("CapPrm", "CapEff", "CapBnd", "CapAmb")} == {0}
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    machine.put(SITE, "")
    as_it = ("nsenter", "-t", str(pid), "-m", "setpriv", "--reuid=palpate", "--regid=palpate", "--clear-groups")
    assert machine.run(*as_it, "cat", SITE).returncode == 0
    for path in (SITE, "/etc/palpate/new", "/opt/palpate/new", "/root/new"):
        assert machine.run(*as_it, "touch", path).returncode != 0
        assert "Read-only" in machine.run("nsenter", "-t", str(pid), "-m", "touch", path).stderr  # not even root could
    machine.get(*as_it, "touch", "/var/lib/palpate/new")
