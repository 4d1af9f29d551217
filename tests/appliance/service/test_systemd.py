"""The box as a service of systemd: what the service manager gets and when, and the log lines of verdicts."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.core.errors import ConfigError
from appliance.core.health import Health
from appliance.core.observer import Observer
from appliance.service.systemd import Notifier
from appliance.sim import devices, rig, script, skin
from tests.factories.simulated_box import SECOND, OnSweep, Rigged, idle_world

WATCHDOG = {"WATCHDOG_USEC": "10000000"}


class Ear:
    """systemd's end of the socket. address: as NOTIFY_SOCKET names it."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.open()

    def open(self) -> None:
        """Listen."""
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + self.address[1:] if self.address.startswith("@") else self.address)
        self.socket.setblocking(False)

    def heard(self) -> list[list[str]]:
        """The messages since the last call, each as its lines."""
        found = []
        with suppress(BlockingIOError):
            while True:
                found.append(self.socket.recv(4096).decode().split("\n"))
        return found


@pytest.fixture(params=["path", "abstract"])
def ear(request: pytest.FixtureRequest, tmp_path: Path):
    """A socket with a place in the file system, and one without."""
    ear = Ear(str(tmp_path / "notify") if request.param == "path" else f"@palpate-test-{os.getpid()}")
    yield ear
    ear.socket.close()


def told(ear: Ear, **more: str) -> tuple[Notifier, rig.VirtualClock]:
    """A manager that speaks to `ear`, and its clock."""
    clock = rig.VirtualClock()
    return Notifier(clock, {"NOTIFY_SOCKET": ear.address, **more}), clock


def how(streams: bool, text: str) -> Any:
    """As much of a Health as a manager looks at."""
    return SimpleNamespace(streams=streams, text=text)


def test_it_says_what_is_new_and_no_more(ear: Ear):
    """STATUS when it changes, READY once, even where the skin is lost later; STOPPING at the end."""
    manager, _ = told(ear)
    for ready, status in [
        (False, "skin absent"),
        (False, "skin absent"),
        (True, "fine"),
        (True, "fine"),
        (False, "no"),
        (True, "no"),
    ]:
        manager.turn(how(ready, status))
    manager.stopping()
    assert ear.heard() == [["STATUS=skin absent"], ["STATUS=fine", "READY=1"], ["STATUS=no"], ["STOPPING=1"]]


def test_the_watchdog_is_fed_by_turns_alone(ear: Ear):
    """At the first turn, then at most each second of its ten; a box that takes no turn is silent."""
    manager, clock = told(ear, **WATCHDOG, WATCHDOG_PID=str(os.getpid()))
    manager.turn(how(True, "fine"))
    assert ear.heard() == [["STATUS=fine", "READY=1", "WATCHDOG=1"]]
    fed = []
    for _ in range(400):
        clock.sleep_until(clock.now_ns() + SECOND // 100)
        manager.turn(how(True, "fine"))
        fed += ear.heard()
    assert fed == [["WATCHDOG=1"]] * 4
    clock.sleep_until(clock.now_ns() + 100 * SECOND)
    assert ear.heard() == []


def test_turns_without_a_skin_keep_the_start_alive(ear: Ear):
    """Until READY each feeding moves the end of the start on, by the watchdog's time; none after it."""
    manager, clock = told(ear, **WATCHDOG)
    for ready in (False, False, True, True):
        manager.turn(how(ready, ""))
        clock.sleep_until(clock.now_ns() + SECOND)
    later = ["WATCHDOG=1", "EXTEND_TIMEOUT_USEC=10000000"]
    assert ear.heard() == [later, later, ["READY=1", "WATCHDOG=1"], ["WATCHDOG=1"]]


@pytest.mark.parametrize("more", [{}, WATCHDOG | {"WATCHDOG_PID": "1"}])
def test_no_watchdog_or_another_s_is_not_fed(ear: Ear, more: dict[str, str]):
    """WATCHDOG_USEC unset, or WATCHDOG_PID not ours."""
    manager, clock = told(ear, **more)
    for _ in range(3):
        manager.turn(how(True, "fine"))
        clock.sleep_until(clock.now_ns() + 100 * SECOND)
    assert ear.heard() == [["STATUS=fine", "READY=1"]]


def test_what_a_device_says_of_itself_is_not_obeyed(ear: Ear):
    """A line break in a status would begin another message; what is no text is sent all the same."""
    manager, _ = told(ear)
    manager.turn(how(False, "skin absent: no\nREADY=1\r\nMAINPID=1 \udcff"))
    assert ear.heard() == [["STATUS=skin absent: no READY=1 MAINPID=1 ?"]]


def test_without_a_socket_nothing_is_said(monkeypatch: pytest.MonkeyPatch):
    """Started by hand: no socket is even made."""
    monkeypatch.delattr(socket, "socket")
    manager = Notifier(rig.VirtualClock(), WATCHDOG)
    manager.turn(how(True, "fine"))
    manager.stopping()


def test_a_socket_that_is_gone_costs_nothing(ear: Ear, tmp_path: Path):
    """Nobody listens, or nobody reads: the box goes on, and what was not taken is said when somebody does."""
    manager, _ = told(ear)
    ear.socket.close()
    Path(ear.address).unlink(missing_ok=True)
    manager.turn(how(True, "fine"))
    ear.open()
    manager.turn(how(True, "fine"))
    assert ear.heard() == [["STATUS=fine", "READY=1"]]
    for i in range(100_000):
        manager.turn(how(True, str(i)))
        if manager._status != str(i):
            break
    else:
        pytest.fail("the queue never filled")
    ear.heard()
    manager.turn(how(True, "again"))
    assert ear.heard() == [["STATUS=again"]]


def test_a_watchdog_that_is_no_number_is_named():
    """Only a person can have set it."""
    with pytest.raises(ConfigError, match="WATCHDOG_USEC=10s is no number"):
        Notifier(rig.VirtualClock(), {"WATCHDOG_USEC": "10s"})


class Pulse(Observer):
    """Notes what the box tells, and what else happens, in order."""

    def __init__(self) -> None:
        self.notes: list[tuple[bool, str] | str] = []
        self.turns = 0

    def turn(self, health: Health) -> None:
        """As the protocol's."""
        self.turns += 1
        if not self.notes or self.notes[-1] != (health.streams, health.text):
            self.notes.append((health.streams, health.text))

    def stopping(self) -> None:
        """As the protocol's."""
        self.notes.append("stopping")


def test_a_box_is_ready_with_the_first_frames_of_its_skin(rigged: Callable[..., Rigged]):
    """Without a skin it says what it waits for; then it streams, and says how many sweeps it has answered."""
    pulse, world = Pulse(), idle_world()
    world.backend.unplug()
    box = rigged(world, observers=[pulse])
    box.seconds(2)
    ((ready, status),) = pulse.notes
    assert not ready
    assert status.startswith("skin absent: no skin 1209:7ac7 on USB")
    assert status.endswith("check cable, power and udev rule. Sweeps answered: 0")
    world.backend.plug()
    box.seconds(1)
    assert pulse.notes[-1] == (True, "skin streaming. Sweeps answered: 0")
    box.pulse(devices.STOP, 0.1)
    box.seconds(1)
    assert pulse.notes[-1] == (True, "skin streaming. Sweeps answered: 1")
    world.backend.unplug()
    box.seconds(0.1)
    assert pulse.notes[-1][0] is False
    assert pulse.notes[-1][1].startswith("skin lost: the skin was unplugged")


def test_a_skin_that_starts_but_sends_nothing_is_not_ready(rigged: Callable[..., Rigged]):
    """It counts as streaming until it is found silent, but nothing of it has ever come."""
    pulse, world = Pulse(), idle_world()
    world.backend.mangle = lambda data: b""
    rigged(world, observers=[pulse]).seconds(3)
    said = {status.split(" for ")[0] for _, status in pulse.notes}
    assert said == {"skin streaming. Sweeps answered: 0", "skin silent: the skin is there but sent no frame"}
    assert not any(ready for ready, _ in pulse.notes)


def test_a_turn_ends_after_everything_in_it(rigged: Callable[..., Rigged]):
    """One pulse for each whole turn: none for the one that hangs after its sentence, at the disk."""
    pulse = Pulse()

    def hang(sweep: object, verdict: object) -> None:
        raise TimeoutError

    world = devices.build(skin.FORMAT, script.tubes(1, 1), rig.VirtualClock(), "sim")
    box = rigged(world, observers=[OnSweep(hang), pulse])
    turns = 0
    with suppress(TimeoutError):
        while True:
            box.box.step()
            turns += 1
    assert box.box.answered == 1
    assert pulse.turns == turns > 100


def test_stopping_is_told_before_the_last_answer(rigged: Callable[..., Rigged]):
    """What is open is answered while the manager knows already."""
    pulse = Pulse()
    box = rigged(idle_world(), observers=[pulse, OnSweep(lambda sweep, verdict: pulse.notes.append(str(sweep.status)))])
    box.pulse(devices.START, 0.2)
    end = box.world.clock.now_ns() + SECOND
    box.box.run(lambda: box.world.clock.now_ns() > end)
    assert pulse.notes[-2:] == ["stopping", "aborted"]


def test_the_command_tells_its_manager(tmp_path: Path):
    """`palpate run` under a manager: its first words, READY once, fed while it runs, STOPPING on SIGTERM."""
    ear = Ear(str(tmp_path / "notify"))
    ear.socket.settimeout(30)
    env = os.environ | {"NOTIFY_SOCKET": ear.address, "WATCHDOG_USEC": "100000"}
    said: list[str] = []
    command = [sys.executable, "-m", "appliance", "run", "--sim", "skin"]
    with subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL) as run:
        try:
            while said.count("WATCHDOG=1") < 20:
                said += ear.socket.recv(4096).decode().split("\n")
            run.send_signal(signal.SIGTERM)
            while said[-1] != "STOPPING=1":
                said += ear.socket.recv(4096).decode().split("\n")
            assert run.wait(timeout=5) == 0
        finally:
            run.kill()
    ear.socket.close()
    assert said[0].startswith("STATUS=skin ")
    assert said.count("READY=1") == 1
    assert "STATUS=skin streaming. Sweeps answered: 0" in said
