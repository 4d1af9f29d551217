"""Sweeps without GPIO lines: commands, the space bar of a real terminal, the clock."""

from __future__ import annotations

import os
import pty
import termios
import tty
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from palpate.core.config import TriggerConfig
from palpate.core.errors import ApplianceError, ConfigError, PortError
from palpate.core.sentences import MAX_LINE, sentence
from palpate.core.types import Edge, EdgeKind, Status, Verdict
from palpate.io.lineless_triggers import CommandTrigger, KeyTrigger, TimedTrigger
from palpate.sim import devices, rig, skin
from tests.factories.simulated_box import SECOND, idle_devices, tubes

START, STOP = EdgeKind.START, EdgeKind.STOP


def kinds(edges: list[Edge]) -> list[EdgeKind]:
    """The kinds of edges."""
    return [edge.kind for edge in edges]


def answer(sweep: int) -> Verdict:
    """An answer to this sweep."""
    return Verdict(sweep, 0, Status.LONG, "", 0, 0, np.empty(0), 0, 0, 0, "")


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """A terminal: the person's end, and the end for programs."""
    far, near = pty.openpty()
    yield far, near
    for end in (far, near):
        try:
            os.close(end)
        except OSError:
            continue


def test_a_command_is_an_edge_at_the_time_of_its_arrival():
    """START and STOP come once, in their order, with the time at which they were carried out."""
    clock = rig.VirtualClock(5)
    trigger = CommandTrigger(clock)
    assert trigger.commands["START"]("") == []
    clock.sleep_until(9)
    trigger.commands["STOP"]("")
    assert trigger.edges(20) == [Edge(START, 5), Edge(STOP, 9)]
    assert trigger.edges(30) == []
    assert (trigger.blind, trigger.about["mode"]) == (False, "serial")


@pytest.mark.parametrize(
    ("text", "speed_mm_s", "force_n"),
    [
        ("", None, None),
        (",", None, None),
        ("30", 30.0, None),
        ("30.25,1.5", 30.25, 1.5),
        (",.5", None, 0.5),
        ("30.,", 30.0, None),
        ("30 1.5", 30.0, 1.5),
        ("10000,1000", 10_000.0, 1_000.0),
    ],
)
def test_start_may_have_speed_and_force(text, speed_mm_s, force_n):
    """They are in the start edge, each may be empty; a person may type a space for the comma."""
    trigger = CommandTrigger(rig.VirtualClock(5))
    trigger.commands["START"](text)
    assert trigger.edges(20) == [Edge(START, 5, speed_mm_s, force_n)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0", "speed '0'"),
        ("-3,1.5", "speed '-3'"),
        ("3O", "speed '3O'"),
        ("1e3", "speed '1e3'"),
        ("nan", "speed 'nan'"),
        ("10000.1", "speed '10000.1'"),
        ("30,inf", "force 'inf'"),
        (",1000.1", "force '1000.1'"),
        ("9" * 110, "speed '999999999999'"),
        ("\\" * 110, "speed '"),
        ("1,2,3", "3 values"),
    ],
)
def test_a_bad_speed_or_force_starts_nothing(text, message):
    """The error quotes the value, has its advice, and fits into a sentence to its end."""
    trigger = CommandTrigger(rig.VirtualClock(5))
    with pytest.raises(ApplianceError) as refused:
        trigger.commands["START"](text)
    assert str(refused.value).startswith(message)
    assert trigger.edges(20) == []
    line = sentence("ANS", "START", "error", refused.value)
    assert len(line) <= MAX_LINE
    assert b"or leave it empty*" in line or b"a force in N*" in line


def test_a_robot_sweeps_over_its_serial_line(rigged):
    """The whole box with START, STOP and NEW as commands; no input line is used."""
    simulated = idle_devices()
    box = rigged(simulated, sets=("trigger.mode=serial",))
    held = {name for request in simulated.gpio.requests for name in request.names.values()}
    assert held.isdisjoint({devices.START, devices.STOP, devices.NEW_OBJECT})
    box.seconds(0.5)
    assert ",STOP,ok*" in box.ask("$PPLP,STOP")
    box.seconds(0.5)
    assert ",START,ok*" in box.ask("PPLP START")
    begun_ns = simulated.clock.now_ns()
    box.seconds(2.5)
    assert ",STOP,ok*" in box.ask("$PPLP,STOP")
    box.seconds(0.5)
    assert ",NEW,ok*" in box.ask("$PPLP,NEW")
    box.ask("$PPLP,START")
    box.seconds(1)
    box.ask("$PPLP,STOP")
    box.seconds(0.1)
    assert [sweep.status for sweep in box.kept] == [Status.NO_START, Status.OK, Status.SHORT]
    assert abs(box.kept[1].start_ns - begun_ns) < 0.1 * SECOND
    assert [sweep.object for sweep in box.kept] == [0, 0, 1]
    assert box.box.circumstances()["trigger"]["mode"] == "serial"
    assert [sweep.speed_mm_s for sweep in box.kept] == [None, None, None]


def test_the_space_bar_starts_and_stops(terminal):
    """Each press counts once, whatever else is typed, and a message confirms each."""
    far, near = terminal
    said: list[str] = []
    clock = rig.VirtualClock(7)
    with closing(KeyTrigger(near, clock, said.append)) as trigger:
        assert trigger.edges(8) == []
        os.write(far, b"x \x04")
        assert trigger.edges(8) == [Edge(START, 7)]
        os.write(far, b"  ")
        assert kinds(trigger.edges(9)) == [STOP, START]
        assert trigger.edges(10) == []
    assert [line.split(":")[0] for line in said[1:]] == ["start", "stop", "start"]
    assert "Ctrl-C" in said[0]


def test_after_an_answer_the_space_bar_starts(terminal):
    """A sweep that was answered `long` is over; a late answer to an older one changes nothing."""
    far, near = terminal
    with closing(KeyTrigger(near, rig.VirtualClock(), lambda line: None)) as trigger:
        os.write(far, b" ")
        assert kinds(trigger.edges(1)) == [START]
        trigger.answered(answer(1))
        os.write(far, b" ")
        assert kinds(trigger.edges(2)) == [START]
        trigger.answered(answer(1))
        os.write(far, b" ")
        assert kinds(trigger.edges(3)) == [STOP]


def test_the_terminal_is_restored(terminal):
    """Keys come at once, unseen, and none but Ctrl-C ends the program; then all is as before."""
    _, near = terminal
    tty.setcbreak(near)  # some settings that are not the default
    before = termios.tcgetattr(near)
    before[3] |= termios.ECHO
    termios.tcsetattr(near, termios.TCSANOW, before)
    before = termios.tcgetattr(near)
    with closing(KeyTrigger(near, rig.VirtualClock(), lambda line: None)):
        inside = termios.tcgetattr(near)
        assert not inside[3] & (termios.ECHO | termios.ICANON)
        assert inside[3] & termios.ISIG
        assert inside[6][termios.VINTR] == b"\x03"
        assert inside[6][termios.VQUIT] == inside[6][termios.VSUSP] == b"\0"
    assert termios.tcgetattr(near) == before


def test_a_terminal_that_is_gone_ends_it(terminal):
    """A PortError, not a loop for ever; closing does not fail."""
    far, near = terminal
    with closing(KeyTrigger(near, rig.VirtualClock(), lambda line: None)) as trigger:
        os.close(far)
        with pytest.raises(PortError, match="closed"):
            trigger.edges(1)


def timed(every_s: float = 5.0, sweep_s: float = 3.0) -> tuple[TimedTrigger, list[str]]:
    """A trigger by the clock, and its messages."""
    said: list[str] = []
    config = TriggerConfig(mode="timed", every_s=every_s, sweep_s=sweep_s)
    trigger = TimedTrigger(config, rig.VirtualClock(0), said.append)
    trigger.held = False
    return trigger, said


def test_the_clock_starts_and_stops():
    """A sweep every 5 s: edges have the time at which they were due, however late they are asked
    for, and the last three seconds before a start are counted. A program that was stopped for a
    minute makes up no sweep of that minute."""
    trigger, said = timed()
    edges = [edge for t in range(0, 13 * SECOND, SECOND // 7) for edge in trigger.edges(t)]
    due_s = {2: START, 5: STOP, 7: START, 10: STOP, 12: START}
    assert edges == [Edge(kind, at * SECOND) for at, kind in due_s.items()]
    countdown = ["start in 2 s", "start in 1 s", "start: slide for 3 s", "stop"]
    assert said == [*countdown, *countdown, *countdown[:3]]
    trigger, said = timed(60, 3)
    for t in range(0, 57 * SECOND + 1, SECOND // 4):
        trigger.edges(t)
    assert said == ["start in 3 s", *countdown[:3]]
    trigger, _ = timed()
    assert trigger.edges(0) == []
    assert trigger.edges(60 * SECOND) == [Edge(START, 60 * SECOND)]


def test_it_says_when_the_next_edge_is_due():
    """For the countdown of a page; while it is held, only for a sweep that has begun."""
    trigger, _ = timed()
    due = []
    for t, held in ((0, False), (1, True), (2, False), (4, False), (5, True), (7, True), (8, True)):
        trigger.held = held
        trigger.edges(t * SECOND)
        due.append(trigger.due_ns / SECOND)
    assert due == [2, 0, 3, 6, 6, 8, 0]


def test_no_sweep_is_started_while_it_is_held():
    """Pause and countdown begin again after it; a sweep that has begun is stopped in time."""
    trigger, said = timed()
    trigger.held = True
    assert trigger.edges(9 * SECOND) == []
    trigger.held = False
    assert trigger.edges(10 * SECOND) == []
    assert trigger.edges(11 * SECOND) == [Edge(START, 11 * SECOND)]
    trigger.held = True
    assert trigger.edges(14 * SECOND) == [Edge(STOP, 14 * SECOND)]
    assert trigger.edges(60 * SECOND) == []
    assert said == ["start in 1 s", "start: slide for 3 s", "stop"]


def test_nobody_slides_for_a_skin_that_is_away(rigged):
    """The skin is waited for at the start and after a plug; no sweep is `not-ready`."""
    simulated = idle_devices()
    simulated.backend.unplug()
    box = rigged(simulated, sets=("trigger.mode=timed", "trigger.every_s=4"))
    box.seconds(10)
    assert box.kept == []
    simulated.backend.plug()
    box.seconds(6)
    simulated.backend.unplug()
    box.seconds(10)
    assert [s.status for s in box.kept] == [Status.OK, Status.SENSOR_LOST]


def test_sweeps_by_the_clock_are_answered(rigged):
    """The whole box: windows are cut from the middle of timed sweeps."""
    simulated = idle_devices()
    box = rigged(simulated, sets=("trigger.mode=timed", "trigger.every_s=4"))
    box.seconds(10)
    assert [(s.stop_ns - s.start_ns, s.status) for s in box.kept] == [(3 * SECOND, Status.OK)] * 2
    middle = (box.kept[0].start_ns + box.kept[0].stop_ns) / 2
    assert abs(box.kept[0].frames.t_ns[[0, -1]].mean() - middle) < 2 * skin.FORMAT.period_ns


@pytest.mark.parametrize(
    ("sets", "hint"),
    [
        (("trigger.mode=timed", "trigger.sweep_s=1"), "window of 2 s"),
        (("trigger.mode=timed", "trigger.sweep_s=6"), "leaves no pause"),
        (("trigger.mode=timed", "trigger.sweep_s=3", "trigger.every_s=3"), "leaves no pause"),
        (("trigger.mode=key",), "needs a terminal"),
    ],
)
def test_a_box_that_could_not_sweep_does_not_start(rigged, sets, hint, monkeypatch):
    """Settings with which every sweep would fail, and no standard input, are refused."""
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(ConfigError, match=hint):
        rigged(sets=sets)
    with open("/dev/null") as null, pytest.raises(ConfigError, match="terminal"):
        KeyTrigger(null.fileno(), rig.VirtualClock(), lambda line: None)


@pytest.mark.parametrize("name", ["START", "STOP"])
def test_commands_of_another_trigger_are_refused(rigged, name):
    """With lines, START and STOP are answered by an error that names the setting."""
    box = rigged(tubes(1, 1))
    box.seconds(0.5)
    answer = box.ask(f"$PPLP,{name}")
    assert f",{name},error," in answer
    assert "trigger.mode" in answer
