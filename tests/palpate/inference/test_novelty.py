"""Distances of known and unknown materials, with and without displacement, on a bundle that can be
computed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.core.types import Status, Sweep
from palpate.inference.classifier import Classifier, softmax
from palpate.inference.novelty import KEPT
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle


def elsewhere(z1: float, z2: float, number: int = 1, object: int = 0) -> Sweep:
    """A sweep of the toy bundle with a displaced contact: the second row has less load."""
    sweep = toy_bundle.sweep(z1, z2, number, object)
    sweep.frames.taxels[:, 1] -= 80
    return sweep


@pytest.fixture
def displaced_box(tmp_path: Path) -> Classifier:
    """The toy bundle with a rule for displacement."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays())
    it = toy_bundle.load(
        tmp_path / "toy",
        arrays=arrays,
        displacement=toy_bundle.DISPLACEMENT,
        contact=toy_bundle.IN_PLACE,
    )
    return Classifier(it, VirtualClock(), max_sweeps=2)


def test_a_material_has_its_own_shape(displaced_box: Classifier):
    """In the second direction "a" scatters twice as far as "b": it is known at a distance of 5.5,
    and "b" is not."""
    assert displaced_box(toy_bundle.sweep(0, -5.5)).label == "a"
    assert displaced_box(toy_bundle.sweep(0, -6.5)).status is Status.UNKNOWN
    assert displaced_box(toy_bundle.sweep(6, -2.5)).label == "b"
    assert displaced_box(toy_bundle.sweep(6, -3.5)).status is Status.UNKNOWN


def test_a_displacement_makes_no_material_unknown(displaced_box: Classifier):
    """For displaced contacts the first direction has a tenth of the weight, and the limit is
    another. So a sweep may be unknown without displacement and known with it, and the reverse."""
    assert displaced_box(toy_bundle.sweep(-3.5, 0)).status is Status.UNKNOWN
    v = displaced_box(elsewhere(-3.5, 0))
    assert (v.status, v.label) == (Status.OK, "a")
    assert v.displacement
    assert displaced_box(toy_bundle.sweep(0, -2.5)).label == "a"
    v = displaced_box(elsewhere(0, -2.5))
    assert v.status is Status.UNKNOWN
    assert v.detail.endswith("; squared distance 6.26 from a, limit 4")
    assert v.displacement


def test_a_displaced_sweep_needs_its_own_probability(displaced_box: Classifier):
    """Its logits are divided by the rule's temperature, and below the rule's probability it is
    unsure. A second sweep of the object decides, or `max_sweeps` ends the object."""
    z = (2.2, 0.0)  # logits of "a" and "b" are (0, 6 * 2.2 - 18) / 2 = (0, -2.4), in place
    assert displaced_box(toy_bundle.sweep(*z)).probability == pytest.approx(
        1 / (1 + np.exp(-2.4) + np.exp(-9)), abs=1e-3
    )
    first, second = (
        displaced_box(elsewhere(*z, 2, object=1)),
        displaced_box(elsewhere(*z, 3, object=1)),
    )
    p = 1 / (1 + np.exp(-2.4 / 3) + np.exp(-9 / 3))
    assert (first.status, first.label, first.probability) == (
        Status.UNSURE,
        "a",
        pytest.approx(p, abs=1e-3),
    )
    assert (second.status, second.fused) == (Status.OK, 2)
    least = Classifier(displaced_box.bundle, VirtualClock(), min_probability=0.99)
    assert least(elsewhere(*z, 4)).status is Status.UNSURE


def test_without_a_rule_a_displaced_sweep_is_classified_as_any(tmp_path: Path):
    """A bundle with contact positions alone, like older bundles: the sweep is marked, and the usual
    distances apply."""
    it = Classifier(toy_bundle.load(tmp_path / "toy", contact=toy_bundle.IN_PLACE), VirtualClock())
    v = it(elsewhere(-3.5, 0))
    assert v.status is Status.UNKNOWN
    assert v.displacement
    assert it(elsewhere(0, -2.5)).label == "a"


def test_enrolled_labels_are_compared_where_the_skin_is(tmp_path: Path):
    """After an enrolment logits are computed from means, and for displaced contacts from the means
    of displaced sweeps."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays(), sweeps=np.array([0, 0, 2]))
    made = toy_bundle.load(
        tmp_path / "toy",
        arrays=arrays,
        labels=2,
        displacement=toy_bundle.DISPLACEMENT,
        contact=toy_bundle.IN_PLACE,
    )
    it = Classifier(made, VirtualClock())
    v = it(elsewhere(-3.5, 0))
    away = np.array([-0.35, 0]) - arrays["moved_means"]
    extra = arrays["bias"] + (toy_bundle.MEANS**2).sum(1) / 2
    logits = (
        (extra - (away**2).sum(1) / 2)
        / toy_bundle.KNOWN.temperature
        / toy_bundle.DISPLACEMENT.temperature
    )
    assert v.scores == pytest.approx(softmax(logits), abs=1e-3)


def test_an_unknown_material_that_comes_again_is_noticed(displaced_box: Classifier):
    """A sweep as near to an earlier unknown one as two of one material names it, the nearest if
    there are several. A known sweep between them changes nothing; a third material is like none."""

    def said(z1: float, z2: float, number: int) -> str:
        verdict = displaced_box(toy_bundle.sweep(z1, z2, number))
        assert verdict.status is Status.UNKNOWN
        return verdict.detail

    assert "as sweep" not in said(-4, 0, 1)
    assert displaced_box(toy_bundle.sweep(0, 0, 2)).label == "a"
    assert "as sweep" not in said(0, -9, 3)
    assert said(-4.5, 0.5, 4).endswith("limit 9; as sweep 1")
    assert said(0.5, -8.5, 5).endswith("; as sweep 3")


def test_only_the_latest_unknown_sweeps_are_kept(displaced_box: Classifier):
    """After as many others as are remembered, the first is forgotten."""
    displaced_box(toy_bundle.sweep(-9, 0, 1))
    for number in range(KEPT):
        displaced_box(toy_bundle.sweep(0, -9 - 6 * number, number + 2))
    assert "as sweep" not in displaced_box(toy_bundle.sweep(-9, 0, 99)).detail
    assert displaced_box(toy_bundle.sweep(-9, 0, 100)).detail.endswith("as sweep 99")
