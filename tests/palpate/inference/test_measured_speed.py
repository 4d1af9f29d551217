"""The measured speed in verdicts, and the range of trained speeds in manifests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.answer.slide import SpeedRange
from palpate.bundle.bundle import Bundle
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from tests.factories.toy_bundle import sweep_of, told


def slid(speed: float = 2.0, material: str = "plastic rough", **more: Any) -> Sweep:
    """A sweep at a multiple of 30 mm/s, towards row 4."""
    world = replace(skin.LEVEL_BLIND, speed=speed)
    window = skin.window(material, skin.Placement(), np.random.default_rng(5), world)
    return sweep_of(window, **more)


def trained(of: Bundle, **changes: Any) -> Bundle:
    """A bundle that was trained at 28 to 33 mm/s, and judges no disturbance."""
    changes |= {"speeds": SpeedRange(28.0, 33.0), "disturbances": None}
    return replace(of, manifest=replace(of.manifest, **changes))


def box(of: Bundle, **rule: Any) -> Classifier:
    return Classifier(of, VirtualClock(), replace(UNTIL_NEW_OBJECT, **rule))


def concluded(it: Classifier, sweep: Sweep, probabilities: np.ndarray) -> Verdict:
    """The verdict of a box whose network gives these probabilities."""
    return it.verdict(it.judged(sweep, told(it, probabilities)))


def test_a_verdict_has_the_measured_slide_or_no_such_fields(default_bundle):
    """Beside the speed of START; without pitch, at rest, early or refused none."""
    for speed in (1.0, 2.0):
        v = box(default_bundle)(slid(speed, speed_mm_s=99.0))
        assert v.measured_mm_s == pytest.approx(30 * speed, rel=0.03)
        assert (v.direction, v.speed_mm_s) == ("rows+", 99.0)
        assert v.as_dict()["measured_mm_s"] == v.measured_mm_s
    bare = replace(default_bundle.manifest, contact=None, displacement=None)
    resting = skin.sweep("wood", skin.Placement(), np.random.default_rng(1), rest_s=2, slide_s=0.1)
    half = slid(share=0.5)
    cut = Frames(*(getattr(half.frames, name)[:750] for name in ("t_ns", "seq", "taxels")))
    found = [
        box(replace(default_bundle, manifest=bare))(slid()),
        box(default_bundle)(sweep_of(resting[:1500])),
        concluded(box(default_bundle), replace(half, frames=cut), np.eye(6)[0]),
        box(default_bundle)(replace(slid(), status=Status.GAP)),
    ]
    assert [v.as_dict().keys() & {"measured_mm_s", "direction"} for v in found] == [set()] * 4


def test_a_uncertain_answer_reports_a_speed_outside_of_training(default_bundle):
    """Unsure, undecided and unknown; before the other findings, after a displacement."""
    # Probabilities of a model that gives no number: the sweep is unknown
    nothing = np.full(6, np.nan)
    no_number = "the model gives no number"
    fast = "slid at 60 mm/s, trained 28 to 33"
    probable = np.array([0.9, 0.1, 0, 0, 0, 0])
    unsure = box(trained(default_bundle), min_probability=0.95)
    undecided = box(trained(default_bundle), min_probability=0.95, max_sweeps=1)
    found = [
        concluded(unsure, slid(), probable),
        concluded(undecided, slid(), probable),
        concluded(unsure, slid(), nothing),
    ]
    assert [(v.status, v.detail) for v in found] == [
        (Status.UNSURE, fast),
        (Status.UNDECIDED, fast),
        (Status.UNKNOWN, f"{fast}; {no_number}"),
    ]
    place = default_bundle.manifest.contact
    assert place
    far = replace(place, rows_mm=(0.0,), cols_mm=(0.0,))
    v = concluded(box(trained(default_bundle, contact=far)), slid(), nothing)
    assert v.detail == f"{v.displacement}; {fast}; {no_number}"
    assert v.displacement.startswith("moved")


def test_other_answers_do_not_report_it(default_bundle):
    """An answer that is ok, a speed of training, a bundle without the range."""

    def untrained(of: Bundle) -> Bundle:
        """A bundle that does not state its speeds."""
        return replace(of, manifest=replace(of.manifest, speeds=None, disturbances=None))

    sure, probable = np.eye(6)[0], np.array([0.9, 0.1, 0, 0, 0, 0])
    found = [
        concluded(box(trained(default_bundle)), slid(), sure),
        concluded(box(trained(default_bundle), min_probability=0.95), slid(1.0), probable),
        concluded(box(untrained(default_bundle), min_probability=0.95), slid(), probable),
    ]
    assert [v.detail for v in found] == [""] * 3
    assert [v.status for v in found] == [Status.OK, Status.UNSURE, Status.UNSURE]
    assert all(v.measured_mm_s for v in found)
