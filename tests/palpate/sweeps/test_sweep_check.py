"""Sweeps in recordings without a bundle: `recorded`, or a fault that the raw counts show."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.core.errors import ApplianceError
from palpate.core.types import EPOCH_BITS, Frames, Status, Sweep, SweepFormat, Verdict
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.sweep_check import SweepCheck
from tests.factories.simulated_box import Rigged

RATE = round(skin.FORMAT.rate_hz)


def played(frames: np.ndarray) -> rig.Act:
    """A sweep over `frames` [2250, 4, 4] between half seconds of a lifted finger."""
    off = skin.idle(RATE // 2, np.random.default_rng(0))
    return rig.Act(np.concatenate([off, frames, off]), len(off), len(off) + len(frames), "")


def slide(level: int | None = None) -> np.ndarray:
    """Three seconds on a rough tube. level: of one broken taxel in the middle."""
    place = skin.placements("T-LAB", 1)[0]
    frames = skin.sweep(
        "plastic rough", place, np.random.default_rng(3), rest_s=0, slide_s=3, after_s=0
    )
    if level is not None:
        frames[:, 1, 1] = level
    return frames


def recording(rigged: Callable[..., Rigged], *acts: rig.Act) -> Rigged:
    """A box that records and plays these sweeps."""
    simulated = devices.build(skin.FORMAT, acts, rig.VirtualClock(), "sim")
    return rigged(simulated, commands={})


def test_good_sweeps_are_recorded(rigged: Callable[..., Rigged]):
    """The answer has no label, bundle or class code, and the robot gets RESULT VALID."""
    simulated = devices.build(skin.FORMAT, script.tubes(1, 6), rig.VirtualClock(), "sim")
    box = rigged(simulated, commands={})
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    assert [v.status for v in verdicts] == [Status.RECORDED] * 6
    assert {(v.label, v.bundle, v.fused, v.detail) for v in verdicts} == {("", "", 0, "")}
    assert all(",recorded,,0.000,0.000,0,0," in line for line in box.heard if ",RES," in line)
    written = simulated.gpio.written
    assert not any(level for _, name, level in written if name in devices.BITS)
    assert [level for _, name, level in written if name == devices.RESULT_VALID].count(True) == 6


@pytest.mark.parametrize(
    ("frames", "status", "detail"),
    [
        (skin.idle(3 * RATE, np.random.default_rng(1)), Status.NO_CONTACT, "raw counts"),
        (slide(77), Status.STUCK_TAXEL, "taxel 2.2"),
        (slide(0), Status.DEAD_TAXEL, "taxel 2.2"),
        (slide(255), Status.SATURATED, "taxel 2.2"),
    ],
    ids=["lifted", "stuck", "dead", "saturated"],
)
def test_a_faulty_skin_is_seen(
    rigged: Callable[..., Rigged], frames: np.ndarray, status: Status, detail: str
):
    """Faults are detected after a good sweep, which shows the skin with and without contact."""
    box = recording(rigged, played(slide()), played(frames))
    first, second = box.until(lambda: box.box.answered == 2)
    assert (first.status, second.status) == (Status.RECORDED, status)
    assert detail in second.detail


def test_what_the_window_lacks_is_answered_as_ever(rigged: Callable[..., Rigged]):
    """Gaps, short sweeps and lost skins keep their status."""
    box = recording(rigged, played(slide()[:RATE]))
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert verdict.status is Status.SHORT


def test_contact_that_cannot_be_judged_is_said(rigged: Callable[..., Rigged]):
    """If the finger never touched the skin, sweeps are recorded, and the answer says that contact
    was not checked."""
    off = skin.idle(8 * RATE, np.random.default_rng(1))
    box = recording(rigged, rig.Act(off, RATE, 4 * RATE, ""))
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert verdict.status is Status.RECORDED
    assert "contact not checked" in verdict.detail
    assert box.box.circumstances()["unloaded"] is None


def test_a_tare_makes_it_certain(rigged: Callable[..., Rigged]):
    """TARE says that nothing touches the skin now."""
    off = skin.idle(12 * RATE, np.random.default_rng(1))
    box = recording(rigged, rig.Act(off, 3 * RATE, 6 * RATE, ""))
    box.seconds(1)
    assert ",TARE,ok,largest 0." in box.ask("$PPLP,TARE")
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert verdict.status is Status.NO_CONTACT


def test_commands_that_need_a_bundle(rigged: Callable[..., Rigged]):
    """ID says that sweeps are recorded, and gives the skin's format. TEST says that there is
    nothing to test."""
    box = recording(rigged, played(slide()))
    box.seconds(0.5)
    assert "ID,ok,recording,,,4x4 uint8 at 750 Hz  window 1500,palpate-sim SIM0001" in box.ask(
        "$PPLP,ID"
    )
    assert "TEST,error,no bundle is used" in box.ask("$PPLP,TEST")
    with pytest.raises(ApplianceError, match="palpate check"):
        SweepCheck(skin.FORMAT, rig.VirtualClock()).test()


def test_another_skin_is_judged_by_itself():
    """After a new enumeration the unloaded skin is measured anew."""
    check = SweepCheck(skin.FORMAT, rig.VirtualClock())
    off, on = skin.idle(RATE, np.random.default_rng(1)), slide()
    for epoch in (0, 1):
        for part in (off, on) if epoch == 0 else (on,):
            n = np.arange(len(part))
            check.frames(Frames(n, n + (epoch << EPOCH_BITS), part))
        certain = check.about()["unloaded"] is not None
        assert certain == (epoch == 0)
    n = np.arange(1500)
    assert "not checked" in check(Sweep(1, 0, 0, Status.OK, Frames(n, n, on[:1500]))).detail


def test_an_impossible_reading_is_no_good_sweep():
    """Before the unloaded skin is known, too: the answer is dead-taxel instead of recorded."""
    format = SweepFormat(4, 4, 100.0, 50, "float32")
    taxels = np.random.default_rng(0).normal(100, 3, (50, 4, 4)).astype(np.float32)
    check = SweepCheck(format, rig.VirtualClock())
    t_ns = np.arange(50) * format.period_ns

    def answered() -> Verdict:
        frames = Frames(t_ns.astype(np.int64), np.arange(50), taxels)
        return check(Sweep(1, 0, int(t_ns[-1]), Status.OK, frames))

    assert answered().status is Status.RECORDED
    taxels[30, 2, 1] = 1e20
    assert (answered().status, answered().detail) == (Status.DEAD_TAXEL, "taxel 3.2")


def test_while_the_box_is_taught_a_sweep_must_be_a_slide():
    """One loaded taxel is named; what else a slide is, the given check says. A fault of the skin
    comes first, and without a check everything is recorded."""
    off, on = skin.idle(RATE, np.random.default_rng(1)), slide()
    n = np.arange(1500)
    one = np.tile(off[:1], (1500, 1, 1))
    one[:, 2, 1] = on[:1500].max(axis=(1, 2))
    broken = slide(0)[:1500]
    answers = {}
    resting = on[:1500]
    for given in (None, lambda taxels: "no slide: it rests" if taxels is resting else ""):
        check = SweepCheck(skin.FORMAT, rig.VirtualClock(), given)
        for part in (off, on):
            seq = np.arange(len(part))
            check.frames(Frames(seq, seq, part))
        answers[given] = [
            (v.status, v.detail)
            for taxels in (one, resting, on[100:1600], broken)
            for v in [check(Sweep(1, 0, 0, Status.OK, Frames(n, n, taxels)))]
        ]
    accepting, refusing = answers.values()
    assert accepting[:3] == [(Status.RECORDED, "")] * 3
    assert refusing[0] == (Status.NO_SLIDE, "only taxel 3.2 is loaded")
    assert refusing[1:3] == [(Status.NO_SLIDE, "no slide: it rests"), (Status.RECORDED, "")]
    assert refusing[3] == accepting[3] == (Status.DEAD_TAXEL, "taxel 2.2")
