"""Sweeps in recordings without a bundle: `recorded`, or a fault that the raw counts show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.slide_check import SlideFinding
from palpate.core.errors import ApplianceError
from palpate.core.types import Status, Sweep, SweepFormat, Verdict
from palpate.sim import devices, rig, skin
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_check import NO_CONTACT_YET, SlidesBefore, SweepCheck
from tests.factories.simulated_box import Rigged, tubes
from tests.factories.simulated_box import played as played_acts
from tests.factories.toy_bundle import frames_of, sweep_of

RATE = round(skin.FORMAT.rate_hz)
Make = Callable[..., Rigged]


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


def lifted(seconds: float = 1) -> np.ndarray:
    """The skin without a finger."""
    return skin.idle(round(seconds * RATE), np.random.default_rng(1))


def recording(rigged: Make, *acts: rig.Act) -> Rigged:
    """A box that records and plays these sweeps."""
    return rigged(played_acts(acts), commands={})


def stream(check: SweepCheck, *parts: np.ndarray, epoch: int = 0) -> None:
    """The stream of the skin has these frames."""
    for part in parts:
        check.frames(frames_of(part, epoch))


def test_good_sweeps_are_recorded(rigged):
    """The answer has no label, bundle or class code, and the robot gets RESULT VALID."""
    simulated = tubes(1, 6)
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
        (lifted(3), Status.NO_CONTACT, "raw counts"),
        (slide(77), Status.STUCK_TAXEL, "taxel 2.2"),
        (slide(0), Status.DEAD_TAXEL, "taxel 2.2"),
        (slide(255), Status.SATURATED, "taxel 2.2"),
    ],
    ids=["lifted", "stuck", "dead", "saturated"],
)
def test_a_faulty_skin_is_seen(rigged, frames, status, detail):
    """Faults are detected after a good sweep, which shows the skin with and without contact."""
    box = recording(rigged, played(slide()), played(frames))
    first, second = box.until(lambda: box.box.answered == 2)
    assert (first.status, second.status) == (Status.RECORDED, status)
    assert detail in second.detail


def test_short_sweeps_and_impossible_readings_are_no_good_sweeps(rigged):
    """Faults of the trigger come first; dead-taxel before the skin is known, too."""
    box = recording(rigged, played(slide()[:RATE]))
    assert [v.status for v in box.until(lambda: box.box.answered == 1)] == [Status.SHORT]
    format = SweepFormat(4, 4, 100.0, 50, "float32")
    taxels = np.random.default_rng(0).normal(100, 3, (50, 4, 4)).astype(np.float32)
    check = SweepCheck(format, rig.VirtualClock())
    assert check(sweep_of(taxels)).status is Status.RECORDED
    taxels[30, 2, 1] = 1e20
    verdict = check(sweep_of(taxels))
    assert (verdict.status, verdict.detail) == (Status.DEAD_TAXEL, "taxel 3.2")


@pytest.mark.parametrize("tare", [False, True])
def test_contact_that_cannot_be_judged_is_said(rigged, tare):
    """Until TARE, or a touch, makes it certain."""
    box = recording(rigged, rig.Act(lifted(12), 3 * RATE, 6 * RATE, ""))
    box.seconds(1)
    if tare:
        assert "largest 0." in box.ask("$PPLP,TARE")
    (verdict,) = box.until(lambda: box.box.answered == 1)
    assert verdict.status is (Status.NO_CONTACT if tare else Status.RECORDED)
    assert ("contact" in verdict.detail) is not tare
    assert (box.box.circumstances()["unloaded"] is None) is not tare


def test_commands_that_need_a_bundle_and_another_skin(rigged):
    """ID gives the format, TEST has nothing to test; a new skin is measured anew."""
    box = recording(rigged, played(slide()))
    box.seconds(0.5)
    said = box.ask("$PPLP,ID")
    assert "1500,palpate-sim" in said
    assert "TEST,error," in box.ask("$PPLP,TEST")
    with pytest.raises(ApplianceError, match="palpate"):
        SweepCheck(skin.FORMAT, rig.VirtualClock()).test()
    check = SweepCheck(skin.FORMAT, rig.VirtualClock())
    stream(check, lifted(), slide())
    assert check.about()["unloaded"] is not None
    stream(check, slide(), epoch=1)
    assert check.about()["unloaded"] is None
    assert "checked" in check(sweep_of(slide()[:1500])).detail


@pytest.mark.parametrize("level", [0, 77, 255])
def test_a_skin_on_which_no_taxel_changes_is_no_good_sweep(level: int):
    """A loose cable; one that moves is enough."""
    check = SweepCheck(skin.FORMAT, rig.VirtualClock())
    taxels = np.full((1500, 4, 4), level, np.uint8)
    stream(check, taxels)
    verdict = check(sweep_of(taxels))
    assert (verdict.status, "cable" in verdict.detail) == (Status.STUCK_TAXEL, True)
    taxels[700, 2, 1] ^= 1
    assert check(sweep_of(taxels)).status is Status.RECORDED


def test_while_the_box_is_taught_a_sweep_must_be_a_slide():
    """By the given check, after faults of the skin."""
    off, on = lifted(), slide()
    one = np.tile(off[:1], (1500, 1, 1))
    one[:, 2, 1] = on[:1500].max(axis=(1, 2))
    resting, sliding, broken = on[:1500], on[100:1600], slide(0)[:1500]

    def answers(judged: SlideFinding | None, *, teaching: bool) -> list[tuple[Status, str]]:
        def slides(sweep: Sweep) -> SlideFinding:
            return judged if sweep.frames.taxels is resting else SlideFinding()

        given = slides if judged else None
        check = SweepCheck(skin.FORMAT, rig.VirtualClock(), given, teaching=teaching)
        stream(check, off, on)
        verdicts = [check(sweep_of(taxels)) for taxels in (one, resting, sliding, broken)]
        return [(v.status, v.detail) for v in verdicts]

    dead = (Status.DEAD_TAXEL, "taxel 2.2")
    good, doubt = (Status.RECORDED, ""), SlideFinding("it rests", certain=False)
    alone = (Status.NO_SLIDE, "only taxel 3.2 is loaded")
    refused = (Status.NO_SLIDE, "it rests")
    assert answers(None, teaching=False) == [good] * 3 + [dead]
    assert answers(doubt, teaching=True) == [alone, refused, good, dead]
    assert answers(doubt, teaching=False) == [good, (Status.RECORDED, "it rests"), good, dead]
    sure = SlideFinding("it rests")
    assert answers(sure, teaching=False) == [good, refused, good, dead]


def test_a_recording_compares_the_vibration_with_sweeps_before_of_the_material(tmp_path):
    """From the fourth on, the three before it too; until then it says that it does not. Sweeps of
    an earlier run count, discarded ones and other materials do not."""

    class RecordingBox:
        """A recording of a skin of two taxels, whose slides show no pattern."""

        format = SweepFormat(1, 2, 100.0, 200, "uint8")

        def __init__(self, folder: Path) -> None:
            self.clock, self._rng, self._id = rig.VirtualClock(), np.random.default_rng(3), 0
            self.session = RecordingSession(
                folder, self.format, Labels(), self.clock, lambda line: 0
            )
            self.check = SweepCheck(
                self.format, self.clock, SlidesBefore(self.format, self.session)
            )

        def sweep(self, material: str, deviation: float = 12) -> Verdict:
            """Record a sweep that vibrates so."""
            self.session.commands["MATERIAL"](material)
            counts = self._rng.normal(100, deviation, (200, 1, 2))
            self._id += 1
            sweep = replace(
                sweep_of(np.rint(counts).astype(np.uint8)),
                id=self._id,
                start_ns=self.clock.now_ns(),
            )
            verdict = self.check(sweep)
            self.session.sweep(sweep, verdict, {})
            return verdict

    box = RecordingBox(tmp_path)
    box.sweep("oak", 1)
    box.session.commands["DISCARD"]("")
    first = [box.sweep("oak", deviation) for deviation in (12, 1, 12, 12)]
    assert [v.status for v in first] == [Status.RECORDED] * 4
    assert ["rest not checked" in v.detail for v in first] == [True] * 3 + [False]
    assert "sweep 3 " in first[3].detail
    assert "rests" in first[3].detail
    resting, smooth = box.sweep("oak", 1), box.sweep("felt", 1)
    assert (resting.status, "rests" in resting.detail) == (Status.NO_SLIDE, True)
    assert smooth.status is Status.RECORDED
    assert box.session.materials() == {"oak": 4, "felt": 1}
    box.session.close()
    again = RecordingBox(tmp_path)
    assert (again.sweep("oak", 1).status, again.sweep("oak").detail) == (
        Status.NO_SLIDE,
        NO_CONTACT_YET,
    )
    again.session.close()
