"""A finger that rests in a part of the window gets the status `no-slide`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle, Early
from appliance.core.errors import BundleError
from appliance.core.types import Status, Sweep
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import EarlyExit
from appliance.signal.vibration import SlideLimits
from appliance.sim.rig import VirtualClock
from tests.factories import toy_bundle

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


def test_a_rest_is_answered_no_slide(toy: Bundle):
    """The detail names the tenths. The sweep is not fused, and the next one is answered."""
    box = Classifier(toy, VirtualClock(), max_sweeps=3)
    verdict = box(replace(resting(0, 0, 10, 14), object=1))
    assert (verdict.status, verdict.label) == (Status.NO_SLIDE, "")
    assert verdict.detail == "hardly any vibration in part 6 7 of 10, less than a gives"
    after = box(replace(toy_bundle.sweep(0, 0), object=1))
    assert (after.status, after.fused) == (Status.OK, 1)


def test_without_a_limit_nothing_is_checked(toy: Bundle):
    """For a label without one, and for an older bundle."""
    assert Classifier(toy, VirtualClock())(resting(0, 6, 10, 14)).label == "c"
    older = replace(toy, manifest=replace(toy.manifest, sliding=None))
    assert Classifier(older, VirtualClock())(resting(0, 0, 10, 14)).label == "a"


def test_no_early_answer_to_a_finger_that_rests(toy: Bundle):
    """It rests in the second tenth of the window; half of the window has come."""
    early = EarlyExit(Classifier(toy, VirtualClock()))

    def half(sweep: Sweep) -> Sweep:
        frames = replace(sweep.frames, taxels=sweep.frames.taxels[:10])
        return replace(sweep, frames=frames, share=0.5)

    assert early(half(toy_bundle.sweep(0, 0)))
    assert early(half(resting(0, 0, 2, 4))) is None


def test_more_limits_than_labels_are_refused(toy: Bundle):
    """Four limits for three labels."""
    with pytest.raises(BundleError, match="4 limits in `sliding` for 3 labels"):
        replace(toy.manifest, sliding=SlideLimits((LEAST,) * 4))


def test_the_manifest_keeps_the_limits(toy: Bundle):
    """And leaves them out where there are none, so that older bundles keep their bytes."""
    manifest = toy.manifest
    assert bundle.Manifest.parse(manifest.json()) == manifest
    assert b"sliding" not in replace(manifest, sliding=None).json()
