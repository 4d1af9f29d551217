"""The unit under a real systemd: start, watchdog, restart, exit codes, stop, journal."""

import json
import re
import time

import pytest

from tests.rig.emulated_machines import ROOT
from tests.systemd import nspawn
from tests.systemd.nspawn import (
    CABLED,
    NOBODY,
    PALPATE,
    SIM,
    SITE,
    STREAMS,
    WAIT_S,
    Machine,
    Service,
)

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # systemd in a container

START_S = 8
"""Time to start, and by how much each sign of life extends it: more than a busy machine needs to
import the packages."""


def test_the_tools_of_systemd_make_what_the_service_needs(machine: Machine, before: list[bool]):
    """User, groups, folders, owners, modes; a second run changes nothing."""
    assert before == [False, False, False]
    for _ in range(2):
        groups = machine.get("id", "-nG", "palpate").split()
        assert sorted(groups) == ["dialout", "gpio", "palpate", "plugdev"]
        entry = machine.get("getent", "passwd", "palpate")
        assert entry.endswith(":/var/lib/palpate:/usr/sbin/nologin")
        assert len(machine.get("getent", "group", "gpio", "dialout", "plugdev").splitlines()) == 3
        own = [f"/var/lib/palpate{folder}" for folder in ("", "/incoming", "/bundles")]
        folders = machine.get("stat", "-c", "%n %U:%G %a", "/etc/palpate", *own).splitlines()
        assert folders == [
            "/etc/palpate root:root 755",
            *(f"{folder} palpate:palpate 750" for folder in own),
        ]
        machine.get("systemd-sysusers")
        machine.get("systemd-tmpfiles", "--create", nspawn.PLACES["palpate.tmpfiles"])


def test_the_unit_is_sound_and_hardened(machine: Machine, before: list[bool]):
    """No problem for systemd, times as meant, exposure at most 1.5 of 10."""
    machine.check_unit("palpate.service")
    shown = dict(
        line.split("=", 1) for line in machine.get("systemctl", "show", "palpate").splitlines()
    )
    wanted = {"Type": "notify", "NotifyAccess": "main", "Restart": "always", "RestartUSec": "2s"}
    wanted |= {"TimeoutStartUSec": "1min", "TimeoutStopUSec": "10s", "StartLimitIntervalUSec": "0"}
    assert {name: shown[name] for name in wanted} == wanted


def test_the_udev_rules_are_sound(machine: Machine, before: list[bool]):
    """udev reads them without a warning: it knows each key, operator and group."""
    rules = "70-palpate.rules"
    machine.put(f"/etc/udev/rules.d/{rules}", (ROOT / "firmware_config" / rules).read_text())
    output = machine.run("udevadm", "test", "/sys/class/mem/null").stderr
    assert f"Reading rules file: /etc/udev/rules.d/{rules}" in output
    assert f"{rules}:" not in output


def test_the_boot_does_not_wait_for_a_skin(machine: Machine, service: Service):
    """multi-user.target wants the service, and is reached without it."""
    machine.get("systemctl", "enable", "palpate")
    try:
        assert "palpate.service" in machine.get(
            "systemctl", "show", "multi-user.target", "-p", "Wants"
        )
        machine.get("systemctl", "stop", "multi-user.target")
        service.configure(CABLED)
        machine.get("systemctl", "start", "multi-user.target")
        assert service["ActiveState"] == "activating"
    finally:
        machine.get("systemctl", "disable", "palpate")


def test_it_is_active_with_the_first_frames_of_its_skin(machine: Machine, service: Service):
    """Without a skin it says why it starts; with one it is active, and stays so."""
    service.configure(CABLED + f"TimeoutStartSec={START_S}\nWatchdogSec={START_S}")
    machine.get("systemctl", "start", "--no-block", "palpate")
    service.until("StatusText", r"skin absent: no skin 1209:7ac7 on USB .* answered: \d")
    time.sleep(2.1 * START_S)
    assert (service["ActiveState"], service["NRestarts"]) == ("activating", "0")
    machine.put("/run/skin", "")
    service.until("ActiveState", "active")
    service.until("StatusText", STREAMS)
    machine.get("rm", "/run/skin")
    service.until("StatusText", "skin absent.*")
    assert (service["ActiveState"], service["NRestarts"]) == ("active", "0")
    machine.put("/run/skin", "")
    service.until("StatusText", STREAMS)
    skin = [line for line in service.log_lines() if line.startswith("skin: ")]
    assert [line.split(" (")[0].split(";")[0] for line in skin] == [
        "skin: no skin 1209:7ac7 on USB",
        "skin: streaming",
        "skin: the skin was unplugged",
        "skin: no skin 1209:7ac7 on USB",
        "skin: streaming",
    ]


def test_a_start_that_hangs_is_begun_again(machine: Machine, service: Service):
    """Before READY the watchdog does not run, but a start whose loop hangs times out."""
    service.configure(
        CABLED + f"TimeoutStartSec={START_S}\nWatchdogSec={START_S}\nRestartSec=100ms"
    )
    machine.get("systemctl", "start", "--no-block", "palpate")
    service.until("StatusText", "skin absent.*")
    service.kill("SIGSTOP")
    service.until("NRestarts", "1")
    assert any("timed out" in line for line in service.journal())


def test_a_process_that_stands_still_is_killed_and_started_again(service: Service):
    """SIGSTOP: the watchdog finds it in time; the service restarts and answers."""
    first = service.start(SIM + "WatchdogSec=3")
    begin = time.monotonic()
    service.kill("SIGSTOP")
    service.until("NRestarts", "1")
    print(f"stopped to started again {time.monotonic() - begin:.1f} s: watchdog 3, RestartSec 2")
    service.until("ActiveState", "active")
    assert int(service["MainPID"]) not in (0, first)
    assert sum("Watchdog timeout (limit 3s)" in line for line in service.journal()) == 1
    service.until("StatusText", STREAMS)


def test_a_turn_that_hangs_is_found_and_named(machine: Machine, service: Service):
    """A read that never returns: the watchdog kills it, the journal shows where."""
    machine.put("/run/skin", "")
    service.start(CABLED + "WatchdogSec=3\nRestartSec=100ms")
    machine.put("/run/hang", "")
    service.until("NRestarts", "1")
    machine.get("rm", "/run/hang")
    service.until("ActiveState", "active")
    journal = service.journal()
    assert any(line.endswith("error: Aborted") for line in journal)
    assert any("sensor.py" in line and line.endswith(" in read") for line in journal)


@pytest.mark.parametrize("signal", ["SIGKILL", "SIGSEGV"])
def test_a_killed_process_is_started_again(machine: Machine, service: Service, signal: str):
    """Two seconds after any death; meanwhile the settings' lines are low."""
    # the simulated skin has lines of its own and ignores it
    machine.put(SITE, "[output]\nready = 'GPIO23'\n")
    first = service.start()
    service.kill(signal)
    service.until("NRestarts", "1")
    service.until("ActiveState", "active")
    assert int(service["MainPID"]) not in (0, first)
    assert sum("exited, code=killed, status=" in line for line in service.journal()) == 1
    (lowered,) = [line for line in service.log_lines() if "be low" in line]
    assert "/dev/gpiochip*" in lowered


def test_settings_that_cannot_be_used_end_it(machine: Machine, service: Service):
    """Exit 78 with one reason and no restart; once corrected it starts."""
    service.start()
    machine.put(SITE, "[sweep]\nmax_duration_s = 'for ever'\n")
    service.kill("SIGKILL")
    service.until("ActiveState", "failed")
    time.sleep(2.5)  # longer than RestartSec
    ended = [service[name] for name in ("NRestarts", "ExecMainStatus", "SubState")]
    assert ended == ["1", "78", "failed"]
    named = f"palpate: {SITE}: sweep.max_duration_s = 'for ever'"
    assert sum(line.startswith(named) for line in service.log_lines()) == 1
    machine.get("rm", SITE)
    machine.get("systemctl", "start", "palpate")
    service.until("StatusText", STREAMS)


def test_hardware_that_is_not_there_is_looked_for_again(machine: Machine, service: Service):
    """Exit 69: a start and a line every two seconds until there is a GPIO chip."""
    machine.put(SITE, "[trigger]\nstart = 'GPIO17'\nstop = 'GPIO27'\n")
    service.configure("")
    machine.get("systemctl", "start", "--no-block", "palpate")
    begin = time.monotonic()
    service.until("NRestarts", "3")
    took_s = time.monotonic() - begin
    print(f"three starts in {took_s:.1f} s")
    assert took_s > 4
    assert service["ExecMainStatus"] in ("0", "69")
    assert sum("no /dev/gpiochip*" in line for line in service.log_lines()) in (3, 4)


def test_a_stop_answers_the_open_sweep(machine: Machine, service: Service):
    """The open sweep is answered `aborted`, and systemd does not have to kill the program."""
    service.start()
    end = time.monotonic() + WAIT_S
    while not (status := service.status()).get("sweeping") or not status["answered"]:
        assert time.monotonic() < end, status
    machine.get("systemctl", "stop", "palpate")
    assert "palpate.service: Deactivated successfully." in service.journal()
    answers = service.answers()
    numbers = [line.split(":")[0] for line in answers]
    assert numbers == [f"sweep {i + 1}" for i in range(len(answers))]
    assert "aborted" in answers[-1]


def test_the_journal_has_one_line_an_event(machine: Machine, service: Service):
    """Skin and sweeps, no sentences, nothing periodic; a lost skin is a warning."""
    machine.put("/run/skin", "")
    service.start(CABLED)
    end = time.monotonic() + WAIT_S
    while len(service.answers()) < 2:
        assert time.monotonic() < end, service.log_lines()
        time.sleep(0.2)
    machine.get("rm", "/run/skin")
    service.until("StatusText", "skin absent.*")
    lines = service.log_lines()
    assert [line for line in lines if not line.startswith(("sweep ", "skin: "))] == []
    assert lines[0] == "skin: streaming"
    assert re.fullmatch(r"sweep 1: [a-z ]+, [0-9.]+ % \([0-9.]+ ms\)", service.answers()[0])
    warned = service.log_lines("-p", "warning")
    assert warned[-1].startswith("skin: no skin 1209:7ac7 on USB")
    assert not [line for line in warned if " % (" in line]


def test_every_user_may_ask_how_it_is(machine: Machine, service: Service):
    """`palpate status` unprivileged: running, skin away (69), stopped (1)."""
    ask = (*NOBODY, PALPATE, "status")
    machine.put("/run/skin", "")
    pid = service.start(CABLED)
    service.until("StatusText", STREAMS)
    done = machine.run(*ask)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.match(
        rf"running for \d+ s \(process {pid}, palpate [0-9.]+, source sim\)\nskin +streaming",
        done.stdout,
    )
    assert service.status()["pid"] == pid
    machine.get("rm", "/run/skin")
    service.until("StatusText", "skin absent.*")
    time.sleep(0.2)
    done = machine.run(*ask)
    assert done.returncode == 69
    assert "check cable" in done.stdout
    machine.get("systemctl", "stop", "palpate")
    done = machine.run(*ask, "--json")
    assert (done.returncode, json.loads(done.stdout)["running"]) == (1, False)


def test_systemctl_says_how_it_is(machine: Machine, service: Service):
    """`systemctl status` shows it in words; the watchdog is armed with ten seconds."""
    service.start()
    assert service["WatchdogUSec"] == "10s"
    service.until("StatusText", STREAMS)
    shown = machine.run("systemctl", "status", "--no-pager", "palpate").stdout
    assert 'Status: "skin streaming. Sweeps answered: ' in shown
    assert "active (running)" in shown


def test_it_is_nobody_in_particular(machine: Machine, service: Service):
    """Not root, no capability, filtered calls; /etc/palpate is read-only."""
    pid = service.start()
    status = dict(
        re.findall(r"^(\w+):\t(.*)$", machine.get("cat", f"/proc/{pid}/status"), re.MULTILINE)
    )
    uid = machine.get("id", "-u", "palpate")
    assert set(status["Uid"].split()) == {uid} != {"0"}
    assert {int(status[name], 16) for name in ("CapPrm", "CapEff", "CapBnd", "CapAmb")} == {0}
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    machine.put(SITE, "")
    assert machine.as_user(pid, "palpate", "cat", SITE).returncode == 0
    for path in (SITE, "/etc/palpate/new", "/opt/palpate/new", "/root/new"):
        assert machine.as_user(pid, "palpate", "touch", path).returncode != 0
        # not even root could
        assert "Read-only" in machine.run("nsenter", "-t", str(pid), "-m", "touch", path).stderr
    assert machine.as_user(pid, "palpate", "touch", "/var/lib/palpate/new").returncode == 0


def test_what_it_can_write_it_cannot_execute(machine: Machine, service: Service):
    """Nothing in folders that it writes; Python, ssh-keygen and libusb it has."""
    pid = service.start()
    as_palpate = ("nsenter", "-t", str(pid), "-m", "--")
    for folder in ("/var/lib/palpate", "/run/palpate", "/tmp", "/var/tmp", "/dev/shm"):
        machine.get(*as_palpate, "cp", "/bin/true", f"{folder}/own")
        assert machine.run(*as_palpate, f"{folder}/own").stderr.endswith("Permission denied\n"), (
            folder
        )
        machine.get(*as_palpate, "rm", f"{folder}/own")
    assert "ssh-keygen" in machine.run(*as_palpate, "ssh-keygen", "-Y", "help").stderr
    look = "import usb.backend.libusb1 as b; print(b.get_backend().lib)"
    assert "libusb" in machine.get(*as_palpate, "/opt/palpate/bin/python", "-c", look)
