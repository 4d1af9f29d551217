"""Trigger lines on a real kernel: edges of no correct robot get one answer each."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from palpate.client.answers import Answer
from tests.rig.cell import Cell, Touch
from tests.rig.notes import Count, Note
from tests.rig.sound import check_recovers, let_go, not_wrong

OTHER_WIRING = """
[trigger]
mode = "one-line"
start = "START"
new_object = "STOP"
glitch_us = 20000
[output]
ready = "READY"
fault = "FAULT"
result_valid = "RESULT-VALID"
busy = "CLASS-0"
decided = "CLASS-1"
[classifier]
early = true
conflict = "fuse"
[sweep]
max_duration_s = 4.0
[serial]
port = "/dev/palpate-robot"
"""
BUSY, DECIDED = "CLASS-0", "CLASS-1"
SECOND = 1_000_000_000
PULSE_NS = 500_000_000
"""After so long the robot's own pulse is over: both edges of a glitch within it would be an end of
it."""
MANY = 10_000
"""Of so many interrupts more than the kernel's 1024 events stay, however many are joined."""
HALT_S = 60
"""Less than the watchdog's time in the guest; a machine that is busy gets so many edges to the
guest in no less."""
LOST_EDGES = 15
"""Of a state sentence: the edges that the kernel dropped (PROTOCOL.md, part 2)."""
WIDTHS_S = (0.0005, 0.001, 0.002, 0.005)


def pulse(cell: Cell, name: str, width_s: float = 0.1) -> None:
    """A pulse of `width_s`, or a little longer; then as long a pause."""
    for level in (True, False):
        cell.lines.set(name, level)
        cell.wait(width_s)


def glitch(cell: Cell, name: str) -> None:
    """The shortest pulse there is: both edges before the guest can look."""
    cell.lines.run_through([(name, True), (name, False)])


def answers(cell: Cell, since: int, n: int) -> list[Answer]:
    """The first `n` answers of the lines from number `since` on, when they are there."""
    cell.until(lambda: len(cell.answers(since)) >= n, 30, f"not {n} answers")
    return cell.answers(since)[:n]


def statuses(cell: Cell, since: int, n: int) -> list[str]:
    """What they say."""
    return [answer.status for answer in answers(cell, since, n)]


def interrupts(cell: Cell) -> int:
    """Edges that the guest's kernel has noticed on all inputs."""
    count = "awk '/palpate/ {n += $2 + $3} END {print n}' /proc/interrupts"
    return int(cell.machine.out(count))


@contextmanager
def halted(cell: Cell) -> Iterator[None]:
    """The program stands still meanwhile; the kernel does not."""
    pid = cell.machine.out("systemctl show -P MainPID palpate")
    cell.machine.run(f"kill -STOP {pid}", check=True)
    try:
        yield
    finally:
        cell.machine.run(f"kill -CONT {pid}", check=True)


def toggle(cell: Cell, name: str, edges: int) -> None:
    """So many edges, as fast as they go one by one."""
    for i in range(edges):
        cell.lines.set(name, i % 2 == 0)


def test_glitches(cell: Cell, count: Count, note: Note) -> None:
    """Pulses too short for the kernel are nothing; longer ones an edge or nothing."""
    since, times = len(cell.serial.heard), count(20, 500)
    for _ in range(times):
        for name in ("START", "STOP"):
            glitch(cell, name)
            cell.wait(0.01)
    cell.wait(0.2)
    assert cell.answers(since) == []
    note("glitch, both edges in one interrupt", "nothing", 2 * times)
    for width_s in WIDTHS_S:
        since = len(cell.serial.heard)
        for _ in range(times):
            pulse(cell, "START", width_s)
        pulse(cell, "STOP")
        cell.serial.wait_for("$PPLP,STA,", 5, len(cell.serial.heard))
        seen = Counter(answer.status for answer in cell.answers(since))
        assert seen.keys() <= {"no-stop", "short", "no-start"}, seen
        starts = seen["no-stop"] + seen["short"]
        assert starts <= times
        note(
            f"pulse of {1000 * width_s:g} ms",
            f"{starts} starts, {times - starts} times nothing",
            times,
        )


def test_second_start_and_glitches_in_a_sweep(cell: Cell, count: Count, note: Note) -> None:
    """A start edge in an open sweep: `no-stop`, and the new sweep is right."""
    outcomes: Counter[str] = Counter()
    for _ in range(count(1, 10)):
        cell.until_ready()
        since = len(cell.serial.heard)
        pulse(cell, "START")
        assert cell.lines.wait("READY", False, 5)
        touch = cell.touch()
        first = cell.answer(since)
        assert first.status == "no-stop"
        cell.clock.sleep_until(touch.start_ns + PULSE_NS)
        glitches = 0
        while cell.clock.now_ns() < touch.stop_ns - PULSE_NS:
            glitch(cell, "START")
            glitch(cell, "STOP")
            glitches += 2
            cell.wait(0.05)
        _, second = answers(cell, since, 2)
        outcomes[not_wrong(touch, second)] += 1
    assert outcomes["ok"], outcomes
    note(
        "start edge while a sweep is open, glitches in the next",
        f"no-stop, then {dict(outcomes)}",
        outcomes.total(),
    )


def test_stop_without_start(cell: Cell, note: Note) -> None:
    """A stop edge alone is `no-start`, as is each sweep while START is stuck."""
    since = len(cell.serial.heard)
    pulse(cell, "STOP")
    assert statuses(cell, since, 1) == ["no-start"]
    cell.lines.set("START", True)
    assert cell.lines.wait("READY", False, 5)
    for _ in range(3):
        pulse(cell, "STOP")
    assert statuses(cell, since, 4)[1:] == ["short", "no-start", "no-start"]
    cell.lines.set("START", False)
    cell.wait(0.1)
    assert len(cell.answers(since)) == 4
    note("stop without start, START stuck low or high", "no-start", 3)


def test_stop_is_stuck(cell: Cell, count: Count, note: Note) -> None:
    """STOP stuck: a sweep is `long` after sweep.max_duration_s, the next is right."""
    levels = [False, True][: count(0, 2)]
    if not levels:
        pytest.skip("twelve seconds each; in the full run")
    for level in levels:
        let_go(cell)
        cell.wait(0.1)
        since = len(cell.serial.heard)
        cell.lines.set("STOP", level)
        answers(cell, since, int(level))
        pulse(cell, "START")
        assert statuses(cell, since, level + 1)[level:] == ["long"]
        assert cell.lines.wait("READY", True, 5)
        cell.lines.set("STOP", False)
        check_recovers(cell)
    note("STOP stuck, low and high", "long, then right", len(levels))


def test_storm(cell: Cell, note: Note) -> None:
    """10,000 edges on START: starts or joined ones; no verdict, then a right sweep."""
    since = len(cell.serial.heard)
    toggle(cell, "START", 10_000)
    cell.wait(0.1)
    pulse(cell, "STOP")
    cell.until_ready(15)
    cell.serial.wait_for("$PPLP,STA,", 5, len(cell.serial.heard))
    seen = Counter(answer.status for answer in cell.answers(since))
    assert seen.keys() <= {"no-stop", "short", "no-start", "edges-lost", "not-ready"}, seen
    check_recovers(cell)
    results = ", ".join(f"{n} {status}" for status, n in seen.most_common())
    note("storm of 10,000 edges", f"{results or 'nothing'}; then a right verdict", 1)


def test_many_edges_in_one_turn(cell: Cell, note: Note) -> None:
    """Answered in order; of more than the kernel holds `edges-lost`; then all is well."""
    since = len(cell.serial.heard)
    with halted(cell):
        pulse(cell, "START")
        pulse(cell, "STOP")
    assert statuses(cell, since, 1) == ["short"]
    note("start and stop in one turn", "short", 1)
    since, dropped = len(cell.serial.heard), int(cell.state()[LOST_EDGES])
    with halted(cell):
        pulse(cell, "START")
        begun, end = interrupts(cell), cell.clock.now_s() + HALT_S
        while interrupts(cell) < begun + MANY and cell.clock.now_s() < end:
            toggle(cell, "STOP", 1000)
    cell.until_ready(20)
    assert int(cell.state()[LOST_EDGES]) > dropped
    outcomes = [answer.status for answer in cell.answers(since)]
    # the skin may have gone stale while the program stood still; either way the single start edge
    # has one answer
    assert outcomes in (["edges-lost"], ["not-ready"])
    check_recovers(cell)
    note("event queue overrun", f"{', '.join(outcomes)}; then a right verdict", 1)


def one_line_sweep(cell: Cell) -> tuple[Touch, int]:
    """A whole sweep of a robot with one line, and the last line heard before."""
    since = len(cell.serial.heard)
    touch = cell.touch(start=False, stop=False)
    cell.begun(touch)
    cell.lines.drive("START", True, touch.start_ns)
    cell.lines.drive("START", False, touch.stop_ns)
    return touch, since


def test_other_wiring(cell: Cell, count: Count, note: Note) -> None:
    """One-line mode, NEW OBJECT, BUSY and DECIDED on the same chip; a line that is high at start-up
    makes no sweep.

    A storm, here of bursts, raises FAULT until it is over, and a line that stays high is `long`.
    The last test of this guest: the wiring stays.
    """
    since = len(cell.serial.heard)
    cell.lines.set("START", True)
    assert cell.lines.wait("READY", False, 20)
    cell.machine.put("/etc/palpate/palpate.toml", OTHER_WIRING.encode())
    cell.machine.run("systemctl restart --no-block palpate", check=True)
    assert statuses(cell, since, 1) == ["aborted"]
    since = len(cell.serial.heard)
    cell.until_ready()
    cell.lines.set("START", False)
    assert statuses(cell, since, 1) == ["no-start"]
    pulse(cell, "STOP")  # NEW OBJECT
    results = []
    for _ in range(2):
        begun = len(cell.lines.log)
        touch, since = one_line_sweep(cell)
        results += [(touch, *answers(cell, since, 1))]
        assert cell.lines.wait("READY", True, 10)
        cell.clock.sleep_until(touch.stop_ns + SECOND // 3)
        seen = [(name, level) for _, name, level in cell.lines.log[begun:]]
        assert (
            seen.index((BUSY, True)) < seen.index((DECIDED, True))
            if results[-1][1].share < 1
            else (BUSY, True) in seen
        )
        assert seen.index((BUSY, False)) > seen.index((BUSY, True))
    assert [answer.fused for _, answer in results] == [1, 2]
    assert not_wrong(*results[0]) == "ok"
    note(
        "one-line mode, NEW OBJECT, BUSY, DECIDED, high at start-up",
        "work; no-start for the fall",
        2,
    )

    since, begun = len(cell.serial.heard), len(cell.lines.log)
    toggle(cell, "START", count(2500, 10_000))
    # a host that stops in between makes sweeps of a storm's first edges
    cell.until(lambda: cell.answers(since)[-1:] != [], 30, "no answer to a storm")
    seen = [answer.status for answer in cell.answers(since)]
    assert seen[-1] == "edges-lost"
    assert {*seen} <= {"edges-lost", "short", "no-start"}
    assert ("FAULT", True) in [(name, level) for _, name, level in cell.lines.log[begun:]]
    assert cell.lines.wait("FAULT", False, 10)
    cell.until_ready()
    note(
        f"storm of {count(2500, 10_000)} edges in one burst",
        "FAULT and edges-lost; READY by itself",
        1,
    )
    since = len(cell.serial.heard)
    cell.lines.set("START", True)
    assert statuses(cell, since, 1) == ["long"]
    cell.lines.set("START", False)
    note("START stuck high in one-line mode", "long", 1)
