"""HandCutter: one trigger, and a window of each finger's own frames."""

from __future__ import annotations

import numpy as np

from palpate.core.config import SweepConfig
from palpate.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Sweep, SweepFormat
from palpate.sweeps.hand_window import HandCutter
from tests.factories.simulated_box import SECOND, numbered

FAST = SweepFormat(2, 3, 1000.0, 1000, "uint8")
SLOW = SweepFormat(4, 1, 100.0, 150, "int16")
FORMATS = {"left": FAST, "right": SLOW}


class HandBench:
    """A HandCutter of a fast and a slow skin, with its own time. away: fingers whose skins do not
    stream."""

    def __init__(self) -> None:
        self.away: set[str] = set()
        streams = {finger: lambda f=finger: f not in self.away for finger in FORMATS}
        self.cutter = HandCutter(FORMATS, SweepConfig(), streams)

    def put(self, finger: str, from_s: float, to_s: float, epoch: int = 0) -> None:
        """The frames of a finger between two times."""
        format = FORMATS[finger]
        first, end = round(from_s * format.rate_hz), round(to_s * format.rate_hz)
        seq = np.arange(first, end)
        t_ns = np.rint(seq * format.period_ns).astype(np.int64)
        taxels = numbered(end, format)[first:]
        frames = Frames(t_ns, seq + (epoch << EPOCH_BITS), taxels, finger)
        self.cutter.put(frames, round(to_s * SECOND))

    def edge(self, kind: EdgeKind, at_s: float) -> None:
        """An edge."""
        at = round(at_s * SECOND)
        self.cutter.trigger([Edge(kind, at)], True, at)

    def swept(self, from_s: float = 1, to_s: float = 4) -> None:
        """Both edges of a sweep."""
        self.edge(EdgeKind.START, from_s)
        self.edge(EdgeKind.STOP, to_s)

    def done(self, now_s: float) -> list[Sweep]:
        """The sweeps that are finished then."""
        return self.cutter.finished(round(now_s * SECOND))


def statuses(sweep: Sweep) -> list[str]:
    """The statuses of the fingers, then of the hand."""
    return [str(s.status) for s in (*(sweep.fingers or ()), sweep)]


def test_each_finger_has_the_middle_in_its_own_frames():
    """Of a sweep from 1 to 4 s: 1000 frames at 1000 Hz and 150 at 100 Hz around 2.5 s."""
    bench = HandBench()
    for finger in FORMATS:
        bench.put(finger, 0, 4)
    bench.swept()
    (sweep,) = bench.done(4)
    left, right = sweep.fingers
    assert statuses(sweep) == ["ok", "ok", "ok"]
    assert (left.finger, right.finger, sweep.finger) == ("left", "right", None)
    assert (left.frames.seq == np.arange(2000, 3000)).all()
    assert (right.frames.seq == np.arange(175, 325)).all()
    assert (right.frames.taxels == numbered(400, SLOW)[175:325]).all()
    assert len(sweep.frames) == 0


def test_a_sweep_is_answered_once_all_fingers_have_it():
    """The frames of the slow finger come later; after the longest wait it is `gap`."""
    bench = HandBench()
    bench.put("left", 0, 4)
    bench.put("right", 0, 3)
    bench.swept()
    assert bench.done(4.4) == []
    bench.put("right", 3, 3.5)
    (sweep,) = bench.done(4.4)
    assert statuses(sweep) == ["ok", "ok", "ok"]
    bench.put("left", 4, 8)
    bench.swept(5, 8)
    assert bench.done(8.4) == []
    (sweep,) = bench.done(8.6)
    assert statuses(sweep) == ["ok", "gap", "ok"]


def test_the_longest_window_decides_what_is_short():
    """The slow finger needs 1.5 s, and so the hand."""
    bench = HandBench()
    for finger in FORMATS:
        bench.put(finger, 0, 4)
    bench.swept(1, 2.4)
    bench.swept(2.4, 3.9)
    short, whole = bench.done(4)
    assert statuses(short) == ["short", "short", "short"]
    assert statuses(whole) == ["ok", "ok", "ok"]


def test_a_finger_that_was_away_during_the_sweep_has_lost_it():
    """Away at the start, in the middle, or plugged in again meanwhile; not the next sweep."""
    for away in ((0.5, 1.5), (2, 2.1), (3.8, 3.9)):
        bench = HandBench()
        bench.put("right", 0, away[0])
        bench.edge(EdgeKind.START, 1)
        bench.away = {"right"}
        bench.put("left", 0, away[1])
        bench.away = set()
        bench.put("left", away[1], 4)
        bench.put("right", away[1], 4, epoch=1)
        bench.edge(EdgeKind.STOP, 4)
        (sweep,) = bench.done(4.6)
        assert statuses(sweep) == ["ok", "sensor-lost", "ok"]
        bench.put("left", 4, 8)
        bench.put("right", 4, 8, epoch=1)
        bench.swept(5, 8)
        (sweep,) = bench.done(8)
        assert statuses(sweep) == ["ok", "ok", "ok"]


def test_a_board_that_restarts_in_the_sweep_costs_its_finger():
    """Its frames before and after belong to two enumerations."""
    bench = HandBench()
    bench.put("left", 0, 4)
    bench.put("right", 0, 2)
    bench.edge(EdgeKind.START, 1)
    bench.put("right", 2, 4, epoch=1)
    bench.edge(EdgeKind.STOP, 4)
    (sweep,) = bench.done(4.6)
    assert statuses(sweep) == ["ok", "sensor-lost", "ok"]


def test_lost_edges_are_answered_once_for_all_fingers():
    """Also if one finger had lost the sweep before: the fingers keep the same numbers."""
    bench = HandBench()
    bench.away = {"right"}
    bench.put("left", 0, 2)
    bench.edge(EdgeKind.START, 1)
    bench.edge(EdgeKind.LOST, 2)
    (sweep,) = bench.done(2)
    assert statuses(sweep) == ["edges-lost", "edges-lost", "edges-lost"]
    assert [s.id for s in sweep.fingers] == [1, 1]


def test_the_newest_frames_of_all_fingers_side_by_side():
    """For a tare: 6 counts of the one and 4 of the other; none while a finger is away."""
    bench = HandBench()
    bench.put("left", 0, 1)
    assert bench.cutter.latest(3) is None
    bench.put("right", 0, 1)
    newest = bench.cutter.latest(3)
    assert newest.shape == (3, 10)
    assert (newest[:, :6] == numbered(1000, FAST)[-3:].reshape(3, 6)).all()
    assert (newest[:, 6:] == numbered(100, SLOW)[-3:].reshape(3, 4)).all()
    bench.away = {"right"}
    assert bench.cutter.latest(3) is None


def test_lost_frames_are_counted_over_the_fingers():
    """One interpolated frame of each finger's window."""
    bench = HandBench()
    for finger, format in FORMATS.items():
        bench.put(finger, 0, 2.5)
        bench.put(finger, 2.5 + 1 / format.rate_hz, 4)
    bench.swept()
    (sweep,) = bench.done(4)
    assert sweep.lost == 2
    assert [s.lost for s in sweep.fingers] == [1, 1]
