"""SweepCutter: every trigger gets one answer, and the window is the middle of the sweep to the
frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core.config import SweepConfig
from palpate.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Status, Sweep, SweepFormat
from palpate.sim import skin
from palpate.sweeps.frame_ring import MAX_GAP
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories.simulated_box import SECOND, numbered

FMT = skin.FORMAT
PERIOD = FMT.period_ns


def t_ns(frame: float) -> int:
    """The time at which a frame is taken."""
    return 10 * SECOND + round(frame * PERIOD)


def frames(
    first: int, n: int, drop: tuple[int, ...] = (), epoch: int = 0, format: SweepFormat = FMT
) -> Frames:
    """Frames `first` to `first + n` without those in `drop`."""
    seq = np.array([i for i in range(first, first + n) if i not in drop])
    taxels = numbered(first + n, format)[seq]
    return Frames(
        10 * SECOND + np.rint(seq * format.period_ns).astype(np.int64),
        seq + (epoch << EPOCH_BITS),
        taxels,
    )


class Bench:
    """A SweepCutter with its own time."""

    def __init__(self, format: SweepFormat = FMT, **settings) -> None:
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


def sweep_of(drop: tuple[int, ...] = (), start: int = 500, stop: int = 2750) -> Sweep:
    """A three-second sweep with some missing frames."""
    bench = Bench()
    bench.put(frames(0, 3000, drop))
    bench.edge(EdgeKind.START, start)
    bench.edge(EdgeKind.STOP, stop)
    (sweep,) = bench.done()
    return sweep


def test_middle_window():
    """Start at frame 500, stop at 2750: the window is frames 875 to 2374, unchanged."""
    sweep = sweep_of()
    assert sweep.status is Status.OK
    assert (sweep.frames.seq == np.arange(875, 2375)).all()
    assert (sweep.frames.taxels == numbered(3000)[875:2375]).all()
    assert sweep.lost == 0


@given(start=st.integers(100, 1000), length=st.integers(1500, 1900), offset=st.floats(-0.45, 0.45))
def test_window_lies_in_the_middle_to_the_frame(start: int, length: int, offset: float):
    """For any sweep, the window's middle is the sweep's to one frame, whatever the edges' phase."""
    bench = Bench()
    bench.put(frames(0, 3000))
    bench.edge(EdgeKind.START, start + offset)
    bench.edge(EdgeKind.STOP, start + length + offset)
    (sweep,) = bench.done()
    middle = (sweep.frames.seq[0] + sweep.frames.seq[-1]) / 2
    assert abs(middle - (start + length / 2)) <= 1


def test_odd_window():
    """A window of an odd number of frames has one frame in its middle."""
    format = SweepFormat(4, 4, 750.0, 101, "uint8")
    bench = Bench(format)
    bench.put(frames(0, 400, format=format))
    bench.edge(EdgeKind.START, 100)
    bench.edge(EdgeKind.STOP, 300)
    (sweep,) = bench.done()
    assert sweep.frames.seq[50] == 200
    assert len(sweep.frames) == 101


def test_every_axis_is_interpolated():
    """A missing frame of a skin with three axes lies between its neighbours on each of them."""
    format = SweepFormat(2, 2, 750.0, 100, "int16", 3)
    bench = Bench(format)
    whole = frames(0, 400, format=format)
    whole.taxels[:] = np.arange(400)[:, None, None, None] * np.array([-4, 2, 10]) + np.arange(
        4
    ).reshape(2, 2, 1)
    bench.put(
        Frames(*(np.delete(x, [200, 201], axis=0) for x in (whole.t_ns, whole.seq, whole.taxels)))
    )
    bench.edge(EdgeKind.START, 100)
    bench.edge(EdgeKind.STOP, 300)
    (sweep,) = bench.done()
    assert (sweep.status, sweep.lost) == (Status.OK, 2)
    np.testing.assert_array_equal(sweep.frames.taxels, whole.taxels[150:250])


@pytest.mark.parametrize(
    "drop", [(1000,), (1000, 1001), (875,), (875, 876), (2373, 2374), (900, 905, 906, 2000)]
)
def test_short_gaps_are_interpolated_and_counted(drop: tuple[int, ...]):
    """One or two missing frames, also at the window's ends: filled on the line between neighbours,
    counted as lost."""
    sweep = sweep_of(drop)
    assert sweep.status is Status.OK
    assert sweep.lost == len(drop)
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
def test_wider_gaps_are_not_interpolated(first: int):
    """Three frames in a row that are missing, wholly or partly in the window, make the status
    `gap`, without frames."""
    sweep = sweep_of(tuple(range(first, first + MAX_GAP + 1)))
    assert sweep.status is Status.GAP
    assert len(sweep.frames) == 0
    assert 0 < sweep.lost <= MAX_GAP + 1


def test_gap_outside_the_window_does_not_matter():
    """Frames that the network does not need may be missing."""
    assert sweep_of(tuple(range(600, 800))).status is Status.OK


def test_frames_that_come_after_the_stop_edge_are_waited_for():
    """The window's last frames are late: no answer until they come; `complete_ns` is the time at
    which they do."""
    bench = Bench()
    bench.put(frames(0, 2000))
    bench.edge(EdgeKind.START, 500)
    bench.edge(EdgeKind.STOP, 2750)
    assert bench.done() == []
    assert bench.recorder.sweeping
    bench.put(frames(2000, 1000))
    (sweep,) = bench.done()
    assert sweep.status is Status.OK
    assert sweep.complete_ns == bench.now


def test_frames_that_never_come():
    """After `late_ms` the sweep is answered `gap`."""
    bench = Bench(late_ms=500)
    bench.put(frames(0, 2000))
    bench.edge(EdgeKind.START, 500)
    bench.edge(EdgeKind.STOP, 2750)
    assert bench.done(0.4) == []
    (sweep,) = bench.done(0.2)
    assert sweep.status is Status.GAP


def test_no_frames_at_all():
    """Edges on a skin that never sent a frame: `gap`."""
    bench = Bench()
    bench.edge(EdgeKind.START, 0)
    bench.edge(EdgeKind.STOP, 2000)
    (sweep,) = bench.done(1)
    assert (sweep.status, sweep.lost) == (Status.GAP, 1500)


def one(bench: Bench, after_s: float = 0) -> Status:
    """The one answer that is due."""
    (sweep,) = bench.done(after_s)
    return sweep.status


def test_short():
    """A sweep that is one frame shorter than the window is refused, a sweep of the window's length
    is not."""
    bench = Bench()
    bench.put(frames(0, 3000))
    bench.edge(EdgeKind.START, 500)
    bench.edge(EdgeKind.STOP, 1999)
    assert one(bench) is Status.SHORT
    bench.edge(EdgeKind.START, 500)
    bench.edge(EdgeKind.STOP, 2000)
    assert one(bench) is Status.OK


def test_start_without_stop():
    """No stop edge within `max_duration_s`: `long`, once; the late stop edge gives no answer, the
    next sweep is cut as usual."""
    bench = Bench(max_duration_s=4)
    bench.put(frames(0, 3000))
    bench.edge(EdgeKind.START, 100)
    assert bench.done() == []
    assert one(bench, 4.2) is Status.LONG
    bench.edge(EdgeKind.STOP, 4000)
    assert bench.done(1) == []
    bench.put(frames(5000, 3000))
    bench.edge(EdgeKind.START, 5100)
    bench.edge(EdgeKind.STOP, 7400)
    assert one(bench) is Status.OK


def test_longer_than_the_limit():
    """Both edges come at once, but lie too far apart: `long`."""
    bench = Bench(max_duration_s=3)
    bench.put(frames(0, 3000))
    bench.edge(EdgeKind.START, 0)
    bench.recorder.trigger([Edge(EdgeKind.STOP, t_ns(2999))], True, bench.now)
    assert one(bench) is Status.LONG


def test_stop_without_start():
    """A lone stop edge is answered."""
    bench = Bench()
    bench.edge(EdgeKind.STOP, 100)
    assert one(bench) is Status.NO_START


def test_double_start():
    """The first sweep is answered `no-stop`, the second goes on."""
    bench = Bench()
    bench.put(frames(0, 3000))
    bench.edge(EdgeKind.START, 100)
    bench.edge(EdgeKind.START, 600)
    first = bench.done()
    bench.edge(EdgeKind.STOP, 2600)
    second = bench.done()
    assert [(s.id, s.status) for s in first + second] == [(1, Status.NO_STOP), (2, Status.OK)]
    assert second[0].frames.seq[0] == 850


def test_not_ready():
    """A start edge is answered at once if the box is not ready. Its stop edge gives no second
    answer."""
    bench = Bench()
    bench.edge(EdgeKind.START, 100, ready=False)
    assert one(bench) is Status.NOT_READY
    assert not bench.recorder.sweeping
    bench.edge(EdgeKind.STOP, 2500)
    assert bench.done(1) == []


def test_lost_edges():
    """Edges dropped by the kernel end the open sweep. Without an open sweep the loss is answered,
    too."""
    bench = Bench()
    bench.edge(EdgeKind.START, 100)
    bench.edge(EdgeKind.LOST, 200)
    assert one(bench) is Status.EDGES_LOST
    bench.edge(EdgeKind.STOP, 2500)
    assert bench.done(1) == []
    bench.edge(EdgeKind.LOST, 2600)
    assert one(bench) is Status.EDGES_LOST


@pytest.mark.parametrize("ready", [False, True])
def test_a_start_beside_lost_edges_gets_one_answer(ready: bool):
    """Both come in one turn, with the trigger blind already or not: the sweep is answered once."""
    bench = Bench()
    edges = [Edge(EdgeKind.START, t_ns(100)), Edge(EdgeKind.LOST, t_ns(101))]
    bench.recorder.trigger(edges, ready, bench.now)
    assert one(bench) is (Status.EDGES_LOST if ready else Status.NOT_READY)


def test_new_enumeration_cuts_the_sweep():
    """Frames of a skin that was plugged in again end the sweep that began before, at once."""
    bench = Bench()
    bench.put(frames(0, 1000))
    bench.edge(EdgeKind.START, 500)
    bench.put(frames(1500, 1000, epoch=1))
    assert one(bench) is Status.SENSOR_LOST
    bench.edge(EdgeKind.STOP, 2750)
    assert bench.done(1) == []


def test_two_sweeps_in_flight_keep_their_order():
    """A second sweep starts before the frames of the first have arrived: both are answered, in
    order."""
    bench = Bench()
    bench.put(frames(0, 1700))
    bench.edge(EdgeKind.START, 0)
    bench.edge(EdgeKind.STOP, 2000)
    bench.edge(EdgeKind.START, 2010)
    assert bench.done() == []
    bench.put(frames(1700, 2900))
    bench.edge(EdgeKind.STOP, 4400)
    assert [(s.id, s.status) for s in bench.done()] == [(1, Status.OK), (2, Status.OK)]


def test_objects_are_counted():
    """NEW OBJECT numbers the sweeps that start after it."""
    bench = Bench()
    bench.put(frames(0, 3000))
    seen = []
    for begin in (0, 700):
        bench.edge(EdgeKind.START, begin)
        bench.edge(EdgeKind.NEW_OBJECT, begin + 5)
        bench.edge(EdgeKind.STOP, begin + 1600)
        seen += [s.object for s in bench.done()]
    assert seen == [0, 1]


def test_the_ring_overwrites_only_old_frames():
    """After many turns of the ring a window is still cut correctly. An overwritten window is a
    `gap`."""
    bench = Bench(max_duration_s=4)
    for first in range(0, 30_000, 750):
        bench.put(frames(first, 750))
    bench.edge(EdgeKind.START, 27_000)
    bench.edge(EdgeKind.STOP, 29_000)
    (sweep,) = bench.done()
    assert (sweep.frames.seq == np.arange(27_250, 28_750)).all()
    assert (sweep.frames.taxels == numbered(30_000)[27_250:28_750]).all()


def test_latest_is_complete_or_none():
    """The newest frames, or None if a frame is missing."""
    bench = Bench()
    assert bench.recorder.latest(10) is None
    bench.put(frames(0, 100))
    assert (bench.recorder.latest(10) == numbered(100)[90:]).all()
    bench.put(frames(101, 3))
    assert bench.recorder.latest(10) is None


def steps_of(bench: Bench, steps: int = 9) -> list[Sweep]:
    """The open sweep at the steps that were reached."""
    return list(bench.recorder.so_far(steps, bench.now))


@pytest.mark.parametrize("packet", [1, 6, 40, 1000])
def test_an_open_sweep_so_far(packet: int):
    """Nine steps of 150 frames, counted from `lead_ms` after the start edge, each once, however the
    frames come."""
    bench = Bench(lead_ms=400)
    bench.put(frames(0, 510))
    assert steps_of(bench) == []
    bench.edge(EdgeKind.START, 500)
    seen = []
    for first in range(510, 2600, packet):
        bench.put(frames(first, packet))
        for sweep in steps_of(bench):
            assert sweep.complete_ns == bench.now
            seen.append(sweep)
    assert [(len(s.frames), s.share) for s in seen] == [(150 * d, d / 10) for d in range(1, 10)]
    for s in seen:
        assert (s.frames.seq[0], s.start_ns, s.stop_ns) == (
            800,
            t_ns(500),
            t_ns(800 + len(s.frames) - 1),
        )
        assert (s.frames.taxels == numbered(3000)[800 : 800 + len(s.frames)]).all()
    bench.edge(EdgeKind.STOP, 2750)
    bench.put(frames(2600, 400))
    assert steps_of(bench) == []
    assert one(bench) is Status.OK


def test_a_sweep_has_the_speed_and_force_of_its_start_edge():
    """While it is open and finished, with a window or without; the next sweep has its own."""
    bench = Bench()
    bench.put(frames(0, 1500))
    bench.edge(EdgeKind.START, 500, speed_mm_s=30.0)
    bench.edge(EdgeKind.START, 600, speed_mm_s=60.0, force_n=1.5)
    (early, *_) = steps_of(bench)
    bench.put(frames(1500, 1500))
    bench.edge(EdgeKind.STOP, 2750)
    bench.edge(EdgeKind.START, 2760)
    bench.edge(EdgeKind.STOP, 2770)
    bench.edge(EdgeKind.STOP, 2780)
    found = [(s.status, s.speed_mm_s, s.force_n) for s in (early, *bench.done())]
    assert found == [
        (Status.OK, 60.0, 1.5),
        (Status.NO_STOP, 30.0, None),
        (Status.OK, 60.0, 1.5),
        (Status.SHORT, None, None),
        (Status.NO_START, None, None),
    ]


def test_steps_of_a_window_that_does_not_divide():
    """Ten frames in three steps: 3, 5 and 8 of them, so that no head lacks a frame of its step."""
    format = SweepFormat(4, 4, 750.0, 10, "uint8")
    bench = Bench(format, lead_ms=0)
    bench.edge(EdgeKind.START, 0)
    bench.put(frames(0, 7, format=format))
    assert [len(s.frames) for s in steps_of(bench, 3)] == [3, 5]
    bench.put(frames(7, 1, format=format))
    assert [len(s.frames) for s in steps_of(bench, 3)] == [8]


def test_no_step_lies_beyond_a_gap():
    """Three missing frames end the steps, also later ones; two are interpolated, from both
    sides."""
    bench = Bench(lead_ms=0)
    bench.edge(EdgeKind.START, 0)
    bench.put(frames(0, 1000, (148, 149, 400, 401, 402)))
    seen = steps_of(bench)
    assert [(len(s.frames), s.lost) for s in seen] == [(150, 2), (300, 2)]
    assert abs(int(seen[0].frames.t_ns[-1]) - t_ns(149)) < 2
    bench.put(frames(1000, 600))
    assert steps_of(bench) == []


def test_a_sweep_that_is_settled_has_had_its_answer():
    """No further step, no answer to the stop edge or to any later fault."""
    bench = Bench(lead_ms=0)
    bench.put(frames(0, 400))
    bench.edge(EdgeKind.START, 0)
    for _ in bench.recorder.so_far(9, bench.now):
        bench.recorder.settle()
    assert not bench.recorder.sweeping
    bench.put(frames(400, 400))
    assert steps_of(bench) == []
    assert not bench.recorder.interrupt(Status.ABORTED, bench.now)
    assert bench.done(60) == []
    bench.edge(EdgeKind.STOP, 3000)
    assert bench.done(1) == []


def test_a_sweep_whose_answer_is_still_to_come_goes_first():
    """The previous sweep waits for frames after a gap: the open sweep has no step before the
    previous sweep is answered."""
    bench = Bench(lead_ms=0)
    bench.put(frames(0, 1700))
    bench.edge(EdgeKind.START, 0)
    bench.edge(EdgeKind.STOP, 2000)
    bench.edge(EdgeKind.START, 2010)
    bench.put(frames(2000, 400))
    assert steps_of(bench) == []
    assert one(bench) is Status.GAP
    assert [len(s.frames) for s in steps_of(bench)] == [150, 300]


def test_steps_begin_with_a_new_enumeration():
    """Frames of a skin that was plugged in again do not belong to the sweep that was open
    before."""
    bench = Bench(lead_ms=0)
    bench.put(frames(0, 100))
    bench.edge(EdgeKind.START, 0)
    bench.put(frames(100, 500, epoch=1))
    assert steps_of(bench) == []
    assert one(bench) is Status.SENSOR_LOST
    bench.edge(EdgeKind.START, 500)
    bench.put(frames(600, 100, epoch=1))
    assert [int(s.frames.seq[0]) - (1 << EPOCH_BITS) for s in steps_of(bench)] == [500]


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.sampled_from(list(EdgeKind)), st.booleans(), st.integers(1, 3000), st.integers(0, 8)
        ),
        max_size=30,
    )
)
def test_every_start_gets_exactly_one_answer(script):
    """For any edges in any order, with some sweeps settled at a step: each number is answered
    once."""
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
        starts += kind is EdgeKind.START
        answers += bench.done()
    answers += bench.done(10)
    numbers = [s.id for s in answers]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))
    assert len(numbers) >= starts
    assert not bench.recorder.sweeping
