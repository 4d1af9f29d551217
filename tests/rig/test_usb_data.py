"""A skin with invalid data or wrong replies: the answers say so, others are right."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from palpate.core.clock import Clock
from palpate.io import packets
from tests.rig.cell import Cell
from tests.rig.notes import HOW, Count, Note
from tests.rig.sound import begin, check_recovers, not_wrong, only_answer, state, until_state

Mangle = Callable[[bytes], bytes]

SECOND = 1_000_000_000
COUNTS = 1 << 32
ALL = 1 << 30


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of some transfers from `begin_s` after the start edge on, and the answers that the
    sweep may get.

    make: a new mangle for one sweep. counter: a field of the state sentence that increases.
    """

    make: Callable[[], Mangle]
    begin_s: float
    transfers: int
    statuses: frozenset[str]
    counter: str = ""


def changed(change: Callable[[packets.Packet], tuple[int, int]]) -> Callable[[], Mangle]:
    """Packets with number and time as `change` gives them; the CRC is right."""

    def mangle(data: bytes) -> bytes:
        packet = packets.unpack(data).packets[0]
        seq, t_us = change(packet)
        return packets.pack(seq % COUNTS, t_us % COUNTS, packet.taxels, packet.flags)

    return lambda: mangle


def mirrored(pace: int) -> Callable[[], Mangle]:
    """The board's clock at `pace` times its own: -1 is backwards, 0 stands still."""

    def make() -> Mangle:
        first: list[int] = []

        def change(packet: packets.Packet) -> tuple[int, int]:
            first[:] = first or [packet.t_us]
            return packet.seq, first[0] + pace * (packet.t_us - first[0])

        return changed(change)()

    return make


def noise() -> Mangle:
    """Bytes that mean nothing, with a magic here and there."""
    rng = np.random.default_rng(5)
    return lambda data: packets.MAGIC + rng.bytes(len(data) - 2)


def babble() -> Mangle:
    """One transfer of more than was asked for."""
    once = [bytes(100_000)]
    return lambda data: once.pop() if once else data


def stale(fresh: bool) -> Callable[[], Mangle]:
    """Packets from a moment ago again: with the fresh ones, or in their place."""

    def make() -> Mangle:
        old: list[bytes] = []

        def mangle(data: bytes) -> bytes:
            old[:] = old or [data]
            return old[0] + data + old[0] if fresh else old[0]

        return mangle

    return make


HARMED, LOST, UNHARMED = frozenset({"gap"}), frozenset({"sensor-lost"}), frozenset({"ok"})
FAULTS = {
    "garbage in the window": Fault(noise, 1.3, 16, HARMED, "garbage"),
    "garbage before the window": Fault(noise, 0.0, 8, UNHARMED, "garbage"),
    "more bytes than were asked for": Fault(babble, 1.3, 1, HARMED, "lost"),
    "frames from the past beside the fresh ones": Fault(stale(True), 0.3, 100, UNHARMED),
    "nothing but frames from the past": Fault(stale(False), 1.0, 60, LOST, "enumerations"),
    "count 10,000 ahead": Fault(
        changed(lambda p: (p.seq + 10_000, p.t_us)), 1.3, 4, LOST, "enumerations"
    ),
    "count 200,000 back": Fault(changed(lambda p: (p.seq - 200_000, p.t_us)), 1.3, 4, LOST),
    "clock 1 s ahead": Fault(
        changed(lambda p: (p.seq, p.t_us + 1_000_000)), 1.3, 4, LOST, "enumerations"
    ),
    "clock 1 s back": Fault(
        changed(lambda p: (p.seq, p.t_us - 1_000_000)), 1.3, ALL, LOST, "enumerations"
    ),
    "clock runs backwards": Fault(mirrored(-1), 1.3, ALL, LOST, "enumerations"),
    "clock stands still": Fault(mirrored(0), 1.3, ALL, LOST, "enumerations"),
    "clock at twice its pace": Fault(mirrored(2), 1.3, ALL, LOST, "enumerations"),
}
QUICK = "garbage in the window", "clock 1 s ahead"


class Cable:
    """The mangle of one sweep: `left` transfers are still to be harmed, none before `begin_ns`."""

    def __init__(self, fault: Fault, clock: Clock, begin_ns: int) -> None:
        self.left = fault.transfers
        self._harm, self._clock, self._begin_ns = fault.make(), clock, begin_ns

    def __call__(self, data: bytes) -> bytes:
        """A transfer, harmed or not."""
        if not self.left or self._clock.now_ns() < self._begin_ns:
            return data
        self.left -= 1
        return self._harm(data)


@pytest.mark.parametrize("what", FAULTS if HOW == "full" else QUICK)
def test_data_that_cannot_be_right(cell: Cell, count: Count, note: Note, what: str):
    """One answer that says so, none wrong; beside the window it has no effect."""
    n = count(1, 3)
    fault, outcomes = FAULTS[what], Counter[str]()
    for _ in range(n):
        had = int(state(cell)[fault.counter]) if fault.counter else 0
        touch, since = begin(cell)
        cell.cable.mangle = cable = Cable(
            fault, cell.clock, touch.start_ns + round(fault.begin_s * SECOND)
        )
        status = not_wrong(touch, cell.answer(since))
        cell.clock.sleep_until(touch.stop_ns + SECOND // 2)
        assert len(cell.answers(since)) == 1
        assert cable.left < fault.transfers, "nothing was harmed"
        cell.cable.mangle = bytes
        outcomes[status] += 1
        assert status in fault.statuses | {"gap"}, status
        if fault.counter:
            assert int(state(cell)[fault.counter]) > had
        cell.until_ready()
    if HOW == "full":
        check_recovers(cell)
    note(what, f"{dict(outcomes)}; back each time", n)


@pytest.mark.parametrize("what", ["halted", "silent"] if HOW == "full" else ["halted"])
def test_a_skin_that_stops_sending(cell: Cell, count: Count, note: Note, what: str):
    """Silent or stalled in mid sweep: that is lost, then it starts without a replug."""
    n = count(1, 3)
    for _ in range(n):
        touch, since = begin(cell)
        cell.clock.sleep_until(touch.start_ns + SECOND)
        setattr(cell.cable, what, True)
        assert not_wrong(touch, only_answer(cell, since)) == "sensor-lost"
        cell.cable.silent = False
        cell.clock.sleep_until(touch.stop_ns + SECOND // 2)
        assert len(cell.answers(since)) == 1
        check_recovers(cell)
        assert not cell.cable.halted
    note(f"skin {what} while streaming", "sensor-lost; started again by itself", n)


def test_a_skin_that_does_not_answer(cell: Cell, count: Count, note: Note):
    """Unanswered, refused or late: never READY, an edge is answered, it ends."""
    fates = {
        "deaf": lambda: setattr(cell.cable, "deaf", True),
        "stalls each request": lambda: setattr(cell.cable.board, "request", lambda number: None),
        "answers after 0.7 s": lambda: setattr(cell.cable, "slow_s", 0.7),
    }
    for what, spoil in list(fates.items())[: count(1, len(fates))]:
        request = cell.cable.board.request
        cell.cable.do(spoil)
        cell.cable.do(lambda: setattr(cell.cable.board, "running", False))
        assert cell.lines.wait("FAULT", True, 30)
        until_state(cell, "lost")
        since = len(cell.serial.heard)
        cell.lines.set("START", True)
        assert cell.answer(since).status == "not-ready"
        cell.lines.set("START", False)
        cell.cable.board.request = request
        cell.cable.deaf, cell.cable.slow_s = False, 0.0
        cell.until_ready()
        note(f"skin {what}", "lost, start edge not-ready; taken up by itself once it answers", 1)


def test_a_skin_that_answers_slowly(cell: Cell, count: Count, note: Note):
    """Late, but within what PROTOCOL.md allows: a sound skin."""
    cell.unplug()
    cell.cable.slow_s = count(1, 25) / 100
    cell.plug()
    check_recovers(cell)
    note(f"skin answers after {cell.cable.slow_s} s", "taken up", 1)
