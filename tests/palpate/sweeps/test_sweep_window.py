"""SweepCutter: every trigger gets one answer, and the window is the sweep's middle."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core.config import SweepConfig
from palpate.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Status, Sweep, SweepFormat
from palpate.sim import skin
from palpate.sweeps.frame_ring import MAX_GAP, FrameRing
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories.simulated_box import SECOND, numbered

FMT = skin.FORMAT
START, STOP = EdgeKind.START, EdgeKind.STOP


def t_ns(frame: float) -> int:
    """The time at which a frame is taken."""
    return 10 * SECOND + round(frame * FMT.period_ns)


def frames(
    first: int, n: int, drop: tuple[int, ...] = (), epoch: int = 0, format: SweepFormat = FMT
) -> Frames:
    """Frames `first` to `first + n` without those in `drop`."""
    seq = np.array([i for i in range(first, first + n) if i not in drop])
    at_ns = 10 * SECOND + np.rint(seq * format.period_ns).astype(np.int64)
    return Frames(at_ns, seq + (epoch << EPOCH_BITS), numbered(first + n, format)[seq])


class Bench:
    """A SweepCutter with its own time."""

    def __init__(self, format: SweepFormat = FMT, **settings: Any) -> None:
        self.recorder = SweepCutter(format, SweepConfig(**settings))
        self.now = 10 * SECOND

    def put(self, some: Frames) -> None:
        """Frames arrive 0.2 ms after the last of them was taken."""
        self.now = max(self.now, int(some.t_ns[-1]) + 200_000)
        self.recorder.put(some, self.now)

    def edge(self, kind: EdgeKind, frame: float, ready: bool = True, **slide: float) -> None:
        """An edge at a frame's time."""
        self.now = max(self.now, t_ns(frame))
        self.recorder.trigger([Edge(kind, t_ns(frame), **slide)], ready, self.now)

    def done(self, after_s: float = 0) -> list[Sweep]:
        """The answers that are due some time later."""
        self.now += round(after_s * SECOND)
        return self.recorder.finished(self.now)

    def steps(self, steps: int = 9) -> list[Sweep]:
        """The open sweep at the steps that were reached."""
        return list(self.recorder.so_far(steps, self.now))


def sweep_of(some: Frames, start: float = 500, stop: float = 2750, format: Any = FMT) -> Sweep:
    """The sweep between two edges, three seconds by default."""
    bench = Bench(format)
    bench.put(some)
    bench.edge(START, start)
    bench.edge(STOP, stop)
    (sweep,) = bench.done()
    return sweep


SCRIPTS = {
    "one frame less than the window": """frames 0 3000; start 500; stop 1999; due short;
        start 500; stop 2000; due ok""",
    "a gap outside of the window": "frames 0 600; frames 800 2200; start 500; stop 2750; due ok",
    "frames that never come": """frames 0 2000; start 500; stop 2750; wait 0.4; due; wait 0.2;
        due gap""",
    "no frames at all": "start 0; stop 2000; wait 1; due gap",
    "start without stop": """frames 0 3000; start 100; due; wait 6.2; due long; stop 6000; wait 1;
        due; frames 7000 3000; start 7100; stop 9400; due ok""",
    "longer than the limit": """frames 0 4600; start 0; stop 4500; due ok; start 0; stop 4501;
        due long""",
    "stop without start": "stop 100; due no-start",
    "double start": "frames 0 3000; start 100; start 600; due no-stop; stop 2600; due ok",
    "not ready": "blind 100; due not-ready; stop 2500; wait 1; due",
    "lost edges": """start 100; lost 200; due edges-lost; stop 2500; wait 1; due; lost 2600;
        due edges-lost""",
    "another enumeration": """frames 0 1000; start 500; again 1500 1000; due sensor-lost;
        stop 2750; wait 1; due""",
    "two sweeps in flight": """frames 0 1700; start 0; stop 2000; start 2010; due;
        frames 1700 2900; stop 4400; due ok ok""",
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_trigger_is_answered_once(name):
    """In their order, when due, numbered from 1."""
    bench, answers = Bench(late_ms=500, max_duration_s=6), []
    for step in SCRIPTS[name].split(";"):
        what, *words = step.split()
        if what == "due":
            due = bench.done()
            assert [str(sweep.status) for sweep in due] == words
            answers += due
            continue
        numbers = [float(word) for word in words]
        if what in ("frames", "again"):
            bench.put(frames(*map(int, numbers), epoch=int(what == "again")))
        elif what == "wait":
            bench.now += round(numbers[0] * SECOND)
        else:
            kind = EdgeKind.LOST if what == "lost" else STOP if what == "stop" else START
            bench.edge(kind, *numbers, ready=what != "blind")
    assert [sweep.id for sweep in answers] == list(range(1, len(answers) + 1))
    assert not bench.recorder.sweeping


def test_the_middle_window_is_whole_on_every_axis():
    """Frames 875 to 2374 of 500 to 2750; a missing one lies between its neighbours."""
    sweep = sweep_of(frames(0, 3000))
    assert (sweep.status, sweep.lost) == (Status.OK, 0)
    assert (sweep.frames.seq == np.arange(875, 2375)).all()
    assert (sweep.frames.taxels == numbered(3000)[875:2375]).all()
    odd = SweepFormat(4, 4, 750.0, 101, "uint8")
    sweep = sweep_of(frames(0, 400, format=odd), 100, 300, odd)
    assert (len(sweep.frames), sweep.frames.seq[50]) == (101, 200)
    format = SweepFormat(2, 2, 750.0, 100, "int16", 3)
    whole = frames(0, 400, format=format)
    slopes = np.arange(400)[:, None, None, None] * np.array([-4, 2, 10])
    whole.taxels[:] = slopes + np.arange(4).reshape(2, 2, 1)
    kept = [np.delete(x, [200, 201], axis=0) for x in (whole.t_ns, whole.seq, whole.taxels)]
    sweep = sweep_of(Frames(*kept), 100, 300, format)
    assert (sweep.status, sweep.lost) == (Status.OK, 2)
    np.testing.assert_array_equal(sweep.frames.taxels, whole.taxels[150:250])


@given(start=st.integers(100, 1000), length=st.integers(1500, 1900), offset=st.floats(-0.45, 0.45))
def test_window_lies_in_the_middle_to_the_frame(start, length, offset):
    """For any sweep, the window's middle is the sweep's to one frame, whatever the edges' phase."""
    sweep = sweep_of(frames(0, 3000), start + offset, start + length + offset)
    middle = (sweep.frames.seq[0] + sweep.frames.seq[-1]) / 2
    assert abs(middle - (start + length / 2)) <= 1


@pytest.mark.parametrize(
    "drop", [(1000,), (1000, 1001), (875,), (875, 876), (2373, 2374), (900, 905, 906, 2000)]
)
def test_short_gaps_are_interpolated_and_counted(drop):
    """One or two frames, also at the window's ends."""
    sweep = sweep_of(frames(0, 3000, drop))
    assert (sweep.status, sweep.lost) == (Status.OK, len(drop))
    assert sweep.filled is not None
    assert [sweep.frames.seq[i] for i in sweep.filled] == sorted(drop)
    whole = numbered(3000).astype(float)
    for frame in drop:
        low = max(f for f in range(frame - 3, frame) if f not in drop)
        high = min(f for f in range(frame + 1, frame + 4) if f not in drop)
        want = whole[low] + (whole[high] - whole[low]) * (frame - low) / (high - low)
        assert np.abs(sweep.frames.taxels[frame - 875] - want).max() <= 0.5
        assert abs(sweep.frames.t_ns[frame - 875] - t_ns(frame)) < 2


@pytest.mark.parametrize("first", [873, 875, 1500, 2372, 2374])
def test_wider_gaps_are_not_interpolated(first):
    """Three in a row, wholly or partly in the window: `gap`."""
    sweep = sweep_of(frames(0, 3000, tuple(range(first, first + MAX_GAP + 1))))
    assert (sweep.status, len(sweep.frames)) == (Status.GAP, 0)
    assert 0 < sweep.lost <= MAX_GAP + 1


def test_frames_that_come_after_the_stop_edge_are_waited_for():
    """The window's last frames are late: `complete_ns` is the time at which they come."""
    bench = Bench()
    bench.put(frames(0, 2000))
    bench.edge(START, 500)
    bench.edge(STOP, 2750)
    assert bench.done() == []
    assert bench.recorder.sweeping
    bench.put(frames(2000, 1000))
    (sweep,) = bench.done()
    assert (sweep.status, sweep.complete_ns) == (Status.OK, bench.now)


@pytest.mark.parametrize("ready", [False, True])
def test_a_start_with_lost_edges_gets_one_answer(ready):
    """Both come in one turn, with the trigger blind already or not: the sweep is answered once."""
    bench = Bench()
    edges = [Edge(START, t_ns(100)), Edge(EdgeKind.LOST, t_ns(101))]
    bench.recorder.trigger(edges, ready, bench.now)
    want = Status.EDGES_LOST if ready else Status.NOT_READY
    assert [sweep.status for sweep in bench.done()] == [want]


def test_the_ring_overwrites_only_old_frames():
    """After many turns a window is right, and its first frame has its neighbour before it."""
    bench = Bench(max_duration_s=4)
    for first in range(0, 30_000, 750):
        bench.put(frames(first, 750))
    bench.edge(START, 27_000)
    bench.edge(STOP, 29_000)
    (sweep,) = bench.done()
    assert (sweep.frames.seq == np.arange(27_250, 28_750)).all()
    assert (sweep.frames.taxels == numbered(30_000)[27_250:28_750]).all()
    ring = FrameRing(FMT, seconds=1)
    ring.put(frames(0, round(FMT.rate_hz) + FMT.window + 2 * MAX_GAP, drop=(MAX_GAP,)))
    window, missing = ring.window(MAX_GAP, FMT.window)
    assert (len(window), missing) == (FMT.window, (0,))


def test_objects_are_counted_and_the_latest_is_complete():
    """NEW OBJECT numbers later sweeps; the newest frames, or None where one is missing."""
    bench = Bench()
    assert bench.recorder.latest(10) is None
    bench.put(frames(0, 100))
    assert (bench.recorder.latest(10) == numbered(100)[90:]).all()
    bench.put(frames(101, 3))
    assert bench.recorder.latest(10) is None
    bench = Bench()
    bench.put(frames(0, 3000))
    for begin in (0, 700):
        bench.edge(START, begin)
        bench.edge(EdgeKind.NEW_OBJECT, begin + 5)
        bench.edge(STOP, begin + 1600)
    assert [s.object for s in bench.done()] == [0, 1]


@pytest.mark.parametrize("packet", [1, 6, 40, 1000])
def test_an_open_sweep_so_far(packet):
    """Nine steps from `lead_ms` on, each once, however frames come."""
    bench, seen = Bench(lead_ms=400), []
    bench.put(frames(0, 510))
    assert bench.steps() == []
    bench.edge(START, 500)
    for first in range(510, 2600, packet):
        bench.put(frames(first, packet))
        seen += [(sweep, bench.now) for sweep in bench.steps()]
    assert [s.share for s, _ in seen] == [d / 10 for d in range(1, 10)]
    for d, (s, now) in enumerate(seen, 1):
        last = 800 + 150 * d
        assert (s.frames.taxels == numbered(3000)[800:last]).all()
        assert (s.frames.seq[0], s.start_ns, s.stop_ns) == (800, t_ns(500), t_ns(last - 1))
        assert s.complete_ns == now
    bench.edge(STOP, 2750)
    bench.put(frames(2600, 400))
    assert bench.steps() == []
    assert [sweep.status for sweep in bench.done()] == [Status.OK]


def test_a_sweep_has_the_speed_and_force_of_its_start_edge():
    """While it is open and finished, with a window or without; the next sweep has its own."""
    bench = Bench()
    bench.put(frames(0, 1500))
    bench.edge(START, 500, speed_mm_s=30.0)
    bench.edge(START, 600, speed_mm_s=60.0, force_n=1.5)
    (early, *_) = bench.steps()
    bench.put(frames(1500, 1500))
    bench.edge(STOP, 2750)
    bench.edge(START, 2760)
    bench.edge(STOP, 2770)
    bench.edge(STOP, 2780)
    found = [(s.status, s.speed_mm_s, s.force_n) for s in (early, *bench.done())]
    assert found == [
        (Status.OK, 60.0, 1.5),
        (Status.NO_STOP, 30.0, None),
        (Status.OK, 60.0, 1.5),
        (Status.SHORT, None, None),
        (Status.NO_START, None, None),
    ]


def test_steps_divide_any_window_and_end_at_a_gap():
    """Ten frames in three steps; three missing end them, two are interpolated."""
    format = SweepFormat(4, 4, 750.0, 10, "uint8")
    bench = Bench(format, lead_ms=0)
    bench.edge(START, 0)
    bench.put(frames(0, 7, format=format))
    assert [len(s.frames) for s in bench.steps(3)] == [3, 5]
    bench.put(frames(7, 1, format=format))
    assert [len(s.frames) for s in bench.steps(3)] == [8]
    bench = Bench(lead_ms=0)
    bench.edge(START, 0)
    bench.put(frames(0, 1000, (148, 149, 400, 401, 402)))
    seen = bench.steps()
    assert [(len(s.frames), s.lost) for s in seen] == [(150, 2), (300, 2)]
    assert abs(int(seen[0].frames.t_ns[-1]) - t_ns(149)) < 2
    bench.put(frames(1000, 600))
    assert bench.steps() == []


def test_a_sweep_that_is_settled_has_had_its_answer():
    """No further step, no answer to the stop edge or to any later fault."""
    bench = Bench(lead_ms=0)
    bench.put(frames(0, 400))
    bench.edge(START, 0)
    for _ in bench.recorder.so_far(9, bench.now):
        bench.recorder.settle()
    assert not bench.recorder.sweeping
    bench.put(frames(400, 400))
    assert bench.steps() == []
    assert not bench.recorder.interrupt(Status.ABORTED, bench.now)
    assert bench.done(60) == []
    bench.edge(STOP, 3000)
    assert bench.done(1) == []


def test_steps_wait_for_the_previous_answer_and_for_the_same_skin():
    """Not after a gap or a replug."""
    bench = Bench(lead_ms=0)
    bench.put(frames(0, 1700))
    bench.edge(START, 0)
    bench.edge(STOP, 2000)
    bench.edge(START, 2010)
    bench.put(frames(2000, 400))
    assert bench.steps() == []
    assert [sweep.status for sweep in bench.done()] == [Status.GAP]
    assert [len(s.frames) for s in bench.steps()] == [150, 300]
    bench.put(frames(2400, 500, epoch=1))
    assert bench.steps() == []
    assert [sweep.status for sweep in bench.done()] == [Status.SENSOR_LOST]
    bench.edge(START, 2800)
    bench.put(frames(2900, 100, epoch=1))
    assert [int(s.frames.seq[0]) - (1 << EPOCH_BITS) for s in bench.steps()] == [2800]


EDGES = st.tuples(
    st.sampled_from(list(EdgeKind)), st.booleans(), st.integers(1, 3000), st.integers(0, 8)
)


@pytest.mark.slow
@given(st.lists(EDGES, max_size=30))
def test_every_start_gets_exactly_one_answer(script):
    """For any edges, with some sweeps settled at a step."""
    bench = Bench(max_duration_s=5, lead_ms=0)
    frame = starts = 0
    answers: list[Sweep] = []
    for kind, ready, step, settled in script:
        frame += step
        bench.put(frames(frame - 1, 1) if settled == 0 else frames(frame - step, step))
        for sweep in bench.recorder.so_far(4, bench.now):
            if sweep.share * 5 > settled > 0:
                bench.recorder.settle()
                answers.append(sweep)
        bench.edge(kind, frame, ready)
        starts += kind is START
        answers += bench.done()
    answers += bench.done(10)
    numbers = [s.id for s in answers]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))
    assert len(numbers) >= starts
    assert not bench.recorder.sweeping
