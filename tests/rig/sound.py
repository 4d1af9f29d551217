"""Checks around a fault, with the box's log: it recovers, and names no other material."""

from collections.abc import Iterable, Iterator

import numpy as np

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core.clock import SystemClock
from palpate.core.types import Frames, Status, Sweep
from palpate.inference.classifier import Classifier
from palpate.sim import rig, skin
from tests.rig.cell import Cell, Touch

FIELDS = (
    *("time", "state", "sweeping", "answered", "received", "lost", "garbage", "enumerations"),
    *("dropped", "bundle", "source"),
)
"""The first fields of a state sentence (PROTOCOL.md, part 2)."""
LATE = {
    *("gap", "short", "long", "no-start", "no-stop", "edges-lost", "sensor-lost", "not-ready"),
    *("unsure", "unknown"),
}
"""Answers to good sweeps while the guest is busy with something else: frames or edges reach the box
late, and the window is shifted. None names a wrong material."""
OPEN_NS = 1_000_000_000
"""Longest delay between a start edge and the open sweep."""
SHIFTS = -4, 0, 4
TRIES = 6


def known(acts: Iterable[rig.Act]) -> Iterator[rig.Act]:
    """Acts that the default bundle classifies right, also if shifted by some frames."""
    model, window = bundle.load(bundle.DEFAULT), skin.FORMAT.window
    alone = Classifier(model, SystemClock())
    for act in acts:
        first = (act.start + act.stop - window) // 2
        verdicts = []
        for shift in SHIFTS:
            taxels = act.frames[first + shift :][:window]
            frames = Frames(np.arange(window), np.arange(window), taxels)
            verdicts.append(alone(Sweep(1, 0, 1, Status.OK, frames)))
        if all((v.status, v.label) == (Status.OK, act.label) for v in verdicts):
            yield act


def not_wrong(touch: Touch, answer: Answer) -> str:
    """The status of an answer. Raises AssertionError for another material."""
    assert answer.label in ("", touch.act.label), f"{touch.act.label} was answered {answer}"
    return answer.status


def check_recovers(cell: Cell) -> None:
    """READY by itself, then a right sweep. Raises AssertionError otherwise."""
    received = []
    for _ in range(TRIES):
        cell.until_ready()
        touch, answer = cell.sweep()
        received.append(not_wrong(touch, answer))
        if answer.status == "ok":
            return
        assert answer.status in LATE, f"a sound sweep was answered {answer}"
    raise AssertionError(
        f"{TRIES} sound sweeps were answered {received}; the box says: {cell.journal()}"
    )


def state(cell: Cell) -> dict[str, str]:
    """The first fields of a state sentence, at present."""
    received = cell.serial.ask("$PPLP,STATE", 30).split("*")[0].split(",")[4:]
    return dict(zip(FIELDS, received[: len(FIELDS)], strict=True))


def until_state(cell: Cell, wanted: str) -> None:
    """Wait until the skin is in a state. Raises AssertionError if it does not get there."""
    cell.until(lambda: state(cell)["state"] == wanted, 30, f"never {wanted}")


def begin(cell: Cell) -> tuple[Touch, int]:
    """Open a sweep, again if the box was busy; the sweep and the number of lines before."""
    for _ in range(TRIES):
        since = len(cell.serial.heard)
        touch = cell.touch()
        cell.begun(touch)
        cell.clock.sleep_until(touch.start_ns)
        while cell.clock.now_ns() < touch.start_ns + OPEN_NS:
            if state(cell)["sweeping"] == "1":
                return touch, since
        let_go(cell)
        cell.until_ready()
    raise AssertionError(f"{TRIES} start edges opened no sweep; the box says: {cell.journal()}")


def let_go(cell: Cell) -> None:
    """The robot ends a sweep that was answered early: its remaining edges are cancelled."""
    for name in ("START", "STOP"):
        cell.lines.forget(name, 0)
        cell.lines.set(name, False)


def only_answer(cell: Cell, since: int) -> Answer:
    """The only answer since line `since`. Raises AssertionError for a second one."""
    first = cell.answer(since)
    end = cell.clock.now_s() + 0.3
    while cell.clock.now_s() < end:
        assert len(cell.answers(since)) == 1, cell.answers(since)
        cell.wait(0.02)
    return first
