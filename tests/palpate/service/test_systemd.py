"""The box as a service of systemd: the messages to the service manager and their times."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.core.observer import Health, Observer
from palpate.service.systemd import Notifier
from palpate.sim import devices, rig
from tests.factories.simulated_box import SECOND, OnSweep, idle_devices, tubes

WATCHDOG = {"WATCHDOG_USEC": "10000000"}
STREAMING = "skin streaming. Sweeps answered: "


class ManagerSocket:
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
def socket_end(request: pytest.FixtureRequest, tmp_path: Path):
    """A socket with a path in the file system, and an abstract socket."""
    socket_end = ManagerSocket(
        str(tmp_path / "notify") if request.param == "path" else f"@palpate-test-{os.getpid()}"
    )
    yield socket_end
    socket_end.socket.close()


def notifier(socket_end: ManagerSocket, **more: str) -> tuple[Notifier, rig.VirtualClock]:
    """A notifier that sends to `socket_end`, and its clock."""
    clock = rig.VirtualClock()
    return Notifier(clock, {"NOTIFY_SOCKET": socket_end.address, **more}), clock


def state(streams: bool, text: str) -> Any:
    """The part of a Health that a notifier uses."""
    return SimpleNamespace(streams=streams, text=text)


def test_only_what_is_new_is_sent(socket_end):
    """STATUS at changes, READY once, STOPPING at the end."""
    sender, _ = notifier(socket_end)
    for ready, text in ((False, "absent"), (True, "fine"), (False, "no"), (True, "no")):
        sender.turn(state(ready, text))
        sender.turn(state(ready, text))
    sender.stopping()
    sent = [["STATUS=absent"], ["STATUS=fine", "READY=1"], ["STATUS=no"], ["STOPPING=1"]]
    assert socket_end.heard() == sent


def test_the_watchdog_is_fed_by_turns_alone(socket_end):
    """At most each second of its ten; silent without turns."""
    sender, clock = notifier(socket_end, **WATCHDOG, WATCHDOG_PID=str(os.getpid()))
    sender.turn(state(True, "fine"))
    assert socket_end.heard() == [["STATUS=fine", "READY=1", "WATCHDOG=1"]]
    fed = []
    for _ in range(400):
        clock.sleep_until(clock.now_ns() + SECOND // 100)
        sender.turn(state(True, "fine"))
        fed += socket_end.heard()
    assert fed == [["WATCHDOG=1"]] * 4
    clock.sleep_until(clock.now_ns() + 100 * SECOND)
    assert socket_end.heard() == []


def test_turns_without_a_skin_keep_the_start_alive(socket_end):
    """Until READY each feeding moves its end on."""
    sender, clock = notifier(socket_end, **WATCHDOG)
    for ready in (False, False, True, True):
        sender.turn(state(ready, ""))
        clock.sleep_until(clock.now_ns() + SECOND)
    later = ["WATCHDOG=1", "EXTEND_TIMEOUT_USEC=10000000"]
    assert socket_end.heard() == [later, later, ["READY=1", "WATCHDOG=1"], ["WATCHDOG=1"]]


def test_text_of_a_device_is_no_message(socket_end):
    """Line breaks begin none; bytes that are not text are sent."""
    sender, _ = notifier(socket_end)
    sender.turn(state(False, "skin absent: no\nREADY=1\r\nMAINPID=1 \udcff"))
    assert socket_end.heard() == [["STATUS=skin absent: no READY=1 MAINPID=1 ?"]]


def test_a_socket_that_is_gone_costs_nothing(socket_end, tmp_path):
    """The box goes on; unsent messages are sent later."""
    sender, _ = notifier(socket_end)
    socket_end.socket.close()
    Path(socket_end.address).unlink(missing_ok=True)
    sender.turn(state(True, "fine"))
    socket_end.open()
    sender.turn(state(True, "fine"))
    assert socket_end.heard() == [["STATUS=fine", "READY=1"]]
    for i in range(100_000):
        sender.turn(state(True, str(i)))
        if sender._status != str(i):
            break
    else:
        pytest.fail("the queue never filled")
    socket_end.heard()
    sender.turn(state(True, "again"))
    assert socket_end.heard() == [["STATUS=again"]]


TEXTS = ["10s", "-5", "1e6", "\u0663", "9" * 5000, "0x10", " "]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({}, 0),
        (WATCHDOG | {"WATCHDOG_PID": "1"}, 0),
        *(({"WATCHDOG_USEC": text}, 1) for text in TEXTS),
    ],
)
def test_no_watchdog_or_another_s_is_not_fed(socket_end, more, told, logged):
    """Unset or not ours; a text in place of a number is logged."""
    sender, clock = notifier(socket_end, **more)
    for _ in range(3):
        sender.turn(state(True, "fine"))
        clock.sleep_until(clock.now_ns() + 100 * SECOND)
    assert socket_end.heard() == [["STATUS=fine", "READY=1"]]
    assert len(logged) == told


class TurnLog(Observer):
    """Notes the turns that differ, the end, and what else happens, in order."""

    def __init__(self) -> None:
        self.notes: list[tuple[bool, str] | str] = []
        self.turns = 0

    def turn(self, health: Health) -> None:
        """Note it."""
        self.turns += 1
        if not self.notes or self.notes[-1] != (health.streams, health.text):
            self.notes.append((health.streams, health.text))

    def stopping(self) -> None:
        """Note it."""
        self.notes.append("stopping")


def test_a_box_is_ready_with_the_first_frames_of_its_skin(rigged):
    """Until then the status names the missing part."""
    turn_log, simulated = TurnLog(), idle_devices()
    simulated.backend.unplug()
    box = rigged(simulated, observers=[turn_log])
    box.seconds(2)
    ((ready, status),) = turn_log.notes
    assert not ready
    assert re.match("skin absent: .*1209:7ac7", status)
    simulated.backend.plug()
    box.seconds(1)
    assert turn_log.notes[-1] == (True, f"{STREAMING}0")
    box.pulse(devices.STOP, 0.1)
    box.seconds(1)
    assert turn_log.notes[-1] == (True, f"{STREAMING}1")
    simulated.backend.unplug()
    box.seconds(0.1)
    ready, status = turn_log.notes[-1]
    assert (ready, status[:10]) == (False, "skin lost:")


def test_a_turn_ends_after_everything_in_it(rigged):
    """None for the turn that hangs at the disk."""
    turn_log = TurnLog()

    def hang(sweep: object, verdict: object) -> None:
        raise KeyboardInterrupt  # other errors of an observer do not end the loop

    simulated = tubes(1, 1)
    box = rigged(simulated, observers=[OnSweep(hang), turn_log])
    turns = 0
    with suppress(KeyboardInterrupt):
        while True:
            box.box.step()
            turns += 1
    assert box.box.answered == 1
    assert turn_log.turns == turns > 100


def test_stopping_is_sent_before_the_last_answer(rigged):
    """An open sweep is answered after systemd has been notified."""
    turn_log = TurnLog()
    note = OnSweep(lambda sweep, verdict: turn_log.notes.append(str(sweep.status)))
    box = rigged(idle_devices(), observers=[turn_log, note])
    box.pulse(devices.START, 0.2)
    end = box.simulated.clock.now_ns() + SECOND
    box.box.run(lambda: box.simulated.clock.now_ns() > end)
    assert turn_log.notes[-2:] == ["stopping", "aborted"]


@pytest.mark.slow
def test_the_command_notifies_systemd(tmp_path):
    """`palpate run`: status, READY, watchdog, STOPPING on SIGTERM."""
    socket_end = ManagerSocket(str(tmp_path / "notify"))
    socket_end.socket.settimeout(30)
    env = os.environ | {"NOTIFY_SOCKET": socket_end.address, "WATCHDOG_USEC": "100000"}
    received: list[str] = []
    command = [sys.executable, "-m", "palpate", "run", "--sim", "skin"]
    with subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL) as run:
        try:
            while received.count("WATCHDOG=1") < 20:
                received += socket_end.socket.recv(4096).decode().split("\n")
            run.send_signal(signal.SIGTERM)
            while received[-1] != "STOPPING=1":
                received += socket_end.socket.recv(4096).decode().split("\n")
            assert run.wait(timeout=60) == 0
        finally:
            run.kill()
    socket_end.socket.close()
    assert received[0].startswith("STATUS=skin ")
    assert received.count("READY=1") == 1
    assert any("streaming" in line for line in received)
