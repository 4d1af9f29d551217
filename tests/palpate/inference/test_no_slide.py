"""A finger that rests in a part of the window gets the status `no-slide`."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.disturbance import Allowance, Disturbances
from palpate.answer.early import Early
from palpate.answer.slide import NO_PATTERN, SlideLimits
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.bundle.manifest import Manifest
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.types import Frames, Status, Sweep
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle
from tests.factories.toy_bundle import sweep_of

LEAST = math.log(1 / 200)
"""Half of the vibration of "a", whose counts swing by 1 around 100."""


@pytest.fixture
def toy(tmp_path: Path) -> Bundle:
    """The toy with limits for two of its three labels, and early answers."""
    outputs = ("logits", "embedding", "early")
    made = toy_bundle.load(tmp_path / "toy", outputs=outputs, early=Early((0.6,) * 3, 1))
    limits = SlideLimits((LEAST, LEAST))
    return replace(made, manifest=replace(made.manifest, sliding=limits))


def resting(z1: float, z2: float, begin: int, end: int) -> Sweep:
    """A sweep whose counts do not change between two frames, of 20."""
    sweep = toy_bundle.sweep(z1, z2)
    taxels = sweep.frames.taxels
    taxels[begin:end] = taxels[begin]
    return sweep


def test_a_rest_is_answered_no_slide(toy):
    """The detail names the tenths. The sweep is not fused, and the next one is answered."""
    box = Classifier(toy, VirtualClock(), replace(UNTIL_NEW_OBJECT, max_sweeps=3))
    verdict = box(replace(resting(0, 0, 10, 14), object=1))
    assert (verdict.status, verdict.label) == (Status.NO_SLIDE, "")
    assert re.search(r" 6 7 of 10, .* a ", verdict.detail)
    after = box(replace(toy_bundle.sweep(0, 0), object=1))
    assert (after.status, after.fused) == (Status.OK, 1)


def test_a_load_beyond_training_counts_as_that_of_training(toy):
    """Counts around 100 that swing by 1 vibrate too little, but not for a load of 75."""
    total = math.log(100 * toy.format.rows * toy.format.cols)
    load = Allowance("load", total - 0.3, total + 0.5, 1.0)
    assert toy.classes
    changes = np.zeros((1, *toy.classes.means.shape), np.float16)
    limits = SlideLimits((math.log(1 / 80),) * 2)
    strict = replace(toy, manifest=replace(toy.manifest, sliding=limits))
    assert Classifier(strict, VirtualClock())(toy_bundle.sweep(0, 0)).status is Status.NO_SLIDE
    for start, status in ((total - 0.3, Status.OK), (total - 0.1, Status.NO_SLIDE)):
        allowed = Disturbances((replace(load, start=start),))
        manifest = replace(strict.manifest, disturbances=allowed)
        pressed = replace(strict, manifest=manifest, classes=replace(toy.classes, changes=changes))
        assert Classifier(pressed, VirtualClock())(toy_bundle.sweep(0, 0)).status is status


def test_without_a_limit_nothing_is_checked(toy):
    """For a label without one, and for an older bundle."""
    assert Classifier(toy, VirtualClock())(resting(0, 6, 10, 14)).label == "c"
    older = replace(toy, manifest=replace(toy.manifest, sliding=None))
    assert Classifier(older, VirtualClock())(resting(0, 0, 10, 14)).label == "a"


@pytest.mark.parametrize("whole", [True, False])
def test_no_early_answer_to_a_finger_that_rests(toy, whole):
    """It rests in the second tenth of the window; half of the window has come. Limits of few sweeps
    are for unfinished windows alone."""
    limits = replace(toy.manifest.sliding, whole=whole)
    box = Classifier(replace(toy, manifest=replace(toy.manifest, sliding=limits)), VirtualClock())
    early = EarlyExit(box)
    answered = Status.NO_SLIDE if whole else Status.OK
    assert box(resting(0, 0, 2, 4)).status is answered

    def half(sweep: Sweep) -> Sweep:
        f = sweep.frames
        return replace(sweep, frames=Frames(f.t_ns[:10], f.seq[:10], f.taxels[:10]), share=0.5)

    assert early(half(toy_bundle.sweep(0, 0)))
    assert early(half(resting(0, 0, 2, 4))) is None


@pytest.fixture(scope="module")
def packaged() -> Bundle:
    """The packaged bundle, whose training sweeps all show a pattern that passes."""
    made = bundle.load(bundle.DEFAULT)
    assert made.manifest.sliding
    assert made.manifest.sliding.pattern
    return made


def mixed(number: int) -> tuple[Sweep, Sweep]:
    """A slide over foam, and its spectra and loads without a pattern that passes."""
    rng = np.random.default_rng(number)
    places = skin.placements("T-REAL", number)
    slides = [skin.window("foam", places[0], rng, skin.LEVEL_BLIND) for _ in range(16)]
    own = np.stack([slides[i].reshape(-1, 16)[:, i] for i in range(16)], axis=1)
    return sweep_of(slides[0]), sweep_of(own.reshape(slides[0].shape))


def any_material(made: Bundle, pattern: float | None) -> Classifier:
    """A classifier to which no material is unknown, with this limit of patterns."""
    m = made.manifest
    assert m.known
    assert m.sliding
    known, sliding = replace(m.known, balanced=1e9, loose=1e9), replace(m.sliding, pattern=pattern)
    manifest = replace(m, known=known, sliding=sliding)
    return Classifier(replace(made, manifest=manifest), VirtualClock(), slides=False)


def test_a_whole_window_without_a_pattern_is_no_slide(packaged):
    """Without the limit it has a label; `slides` is checked, too."""
    assert packaged.manifest.sliding
    box = any_material(packaged, packaged.manifest.sliding.pattern)
    unlimited = any_material(packaged, None)
    for number in range(5):
        slide, own = mixed(number)
        assert (box(slide).label, box(slide).measured_mm_s) == ("foam", None)
        assert unlimited(own).label
        verdict = box(own)
        assert (verdict.status, verdict.label) == (Status.NO_SLIDE, "")
        assert verdict.detail.startswith(NO_PATTERN)


def test_an_early_answer_needs_a_pattern_too(packaged):
    """Of a slide four tenths are; of a mixed window only without the limit."""

    def sure(made: Bundle) -> Manifest:
        """The manifest of a bundle that answers early whatever the material is."""
        m = made.manifest
        return replace(m, early=replace(m.early, least=(0.01,) * 9, agree=1, limits=(1e9,) * 9))

    early, unlimited = (
        EarlyExit(any_material(replace(packaged, manifest=sure(packaged)), pattern))
        for pattern in (packaged.manifest.sliding.pattern, None)
    )
    for number in range(3):
        slide, own = (
            replace(sweep_of(one.frames.taxels[:600]), share=0.4) for one in mixed(number)
        )
        assert early(slide).label == unlimited(slide).label == "foam"
        assert early(own) is None
        assert unlimited(own).label
