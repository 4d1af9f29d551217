"""Distances of known and unknown materials, on a bundle that can be computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.disturbance import Allowance, Disturbances
from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.answer.unknown import KEPT, EarlyClasses, EarlyDistances
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.config import UNTIL_NEW_OBJECT, ClassifierConfig
from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep, SweepFormat, Verdict
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.learn import enrolment
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

DISPLACED = {"displacement": toy_bundle.DISPLACEMENT, "contact": toy_bundle.IN_PLACE}
CHANGES = np.float16([[[0, -20], [0, -20], [0, -40]], [[0, 0], [0, 0], [0, 0]]])
"""Lost frames move the second direction, "c" twice as far; hum moves nothing."""
ALLOWED = Disturbances((Allowance("lost", 0.0, 0.25, 2.0), Allowance("hum", 0.0, 3.0, 1.0)), 4.0)
RULE = Early((0.6, 0.6, 0.6), 2, (4.0, 4.0, 4.0))
WIDE = replace(toy_bundle.KNOWN, strict=4.0, loose=25.0)
HUMMING = SweepFormat(2, 2, 750.0, 1500, "int16")
HUM = 5 * np.sin(2 * np.pi * 50 * np.arange(1500)[:, None, None] / 750)


def elsewhere(sweep: Sweep) -> Sweep:
    """The sweep with a displaced contact: the second row has less load."""
    sweep.frames.taxels[:, 1] -= 80
    return sweep


def away(z1: float, z2: float, number: int = 1, object: int = 0) -> Sweep:
    return elsewhere(toy_bundle.sweep(z1, z2, number, object))


def half(z1: float, z2: float) -> Sweep:
    """The first half of a sweep with this embedding."""
    whole = toy_bundle.sweep(z1, z2)
    frames = replace(whole.frames, taxels=whole.frames.taxels[:10])
    return replace(whole, frames=frames, share=0.5)


def lost(z1: float, z2: float, frames: int = 4) -> Sweep:
    return replace(toy_bundle.sweep(z1, z2), lost=frames)


def answer(of: Bundle, sweep: Sweep) -> Verdict:
    return Classifier(of, VirtualClock())(sweep)


@pytest.fixture
def displaced_box(tmp_path: Path) -> Classifier:
    """The toy bundle with a rule for displacement."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays())
    made = toy_bundle.load(tmp_path / "toy", arrays=arrays, **DISPLACED)
    return Classifier(made, VirtualClock(), replace(UNTIL_NEW_OBJECT, max_sweeps=2))


def test_a_material_has_its_own_shape(displaced_box):
    """ "a" scatters twice as far: it is known at a distance of 5.5, "b" is not."""
    places = [(0, -5.5), (0, -6.5), (6, -2.5), (6, -3.5)]
    assert [displaced_box(toy_bundle.sweep(*z)).label for z in places] == ["a", "", "b", ""]
    assert displaced_box(toy_bundle.sweep(6, -3.5)).status is Status.UNKNOWN


def test_a_displacement_makes_no_material_unknown(displaced_box, tmp_path):
    """For displaced contacts the first direction has a tenth of the weight, and the limit is
    another: a sweep may be unknown without displacement and known with it, and the reverse. Without
    a rule the sweep is marked, and the usual distances apply."""
    assert displaced_box(toy_bundle.sweep(-3.5, 0)).status is Status.UNKNOWN
    v = displaced_box(away(-3.5, 0))
    assert (v.status, v.label, bool(v.displacement)) == (Status.OK, "a", True)
    assert displaced_box(toy_bundle.sweep(0, -2.5)).label == "a"
    v = displaced_box(away(0, -2.5))
    assert (v.status, bool(v.displacement)) == (Status.UNKNOWN, True)
    assert v.detail.endswith(" 6.26 from a, limit 4")
    bare = toy_bundle.load(tmp_path / "bare", contact=toy_bundle.IN_PLACE)
    v = answer(bare, away(-3.5, 0))
    assert (v.status, bool(v.displacement)) == (Status.UNKNOWN, True)
    assert answer(bare, away(0, -2.5)).label == "a"


def test_a_displaced_sweep_needs_its_own_probability(displaced_box):
    """By the rule's temperature and limit; a second sweep or `max_sweeps` decides."""
    z = (2.2, 0.0)  # logits of "a" and "b" are (0, 6 * 2.2 - 18) / 2 = (0, -2.4), in place
    p, q = (1 / (1 + np.exp(-2.4 / t) + np.exp(-9 / t)) for t in (1, 3))
    assert displaced_box(toy_bundle.sweep(*z)).probability == pytest.approx(p, abs=1e-3)
    first, second = (displaced_box(away(*z, number, object=1)) for number in (2, 3))
    assert (first.status, first.label) == (Status.UNSURE, "a")
    assert first.probability == pytest.approx(q, abs=1e-3)
    assert (second.status, second.fused) == (Status.OK, 2)
    least = Classifier(
        displaced_box.bundle, VirtualClock(), replace(UNTIL_NEW_OBJECT, min_probability=0.99)
    )
    assert least(away(*z, 4)).status is Status.UNSURE


def test_enrolled_labels_are_compared_where_the_skin_is(tmp_path):
    """Their means are moved to displaced sweeps."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays(), sweeps=np.array([0, 0, 2]))
    made = toy_bundle.load(tmp_path / "toy", arrays=arrays, labels=2, **DISPLACED)
    far = ((np.array([-0.35, 0]) - arrays["displaced_means"]) ** 2).sum(1) / 2
    extra = arrays["bias"] + (toy_bundle.MEANS**2).sum(1) / 2
    logits = (extra - far) / toy_bundle.KNOWN.temperature / toy_bundle.DISPLACEMENT.temperature
    scores = answer(made, away(-3.5, 0)).scores
    assert scores[2] == pytest.approx(softmax(logits)[2], abs=1e-3)


def test_an_unknown_material_that_comes_again_is_noticed(displaced_box):
    """A sweep as near to an earlier unknown one as two of one material names it, the nearest if
    there are several. A known sweep between them changes nothing; a third material is like none."""

    def said(z1: float, z2: float, number: int) -> str:
        verdict = displaced_box(toy_bundle.sweep(z1, z2, number))
        assert verdict.status is Status.UNKNOWN
        return verdict.detail.partition("as sweep ")[2]

    assert said(-4, 0, 1) == ""
    assert displaced_box(toy_bundle.sweep(0, 0, 2)).label == "a"
    assert said(0, -9, 3) == ""
    assert said(-4.5, 0.5, 4) == "1"
    assert said(0.5, -8.5, 5) == "3"
    for number in range(6, KEPT + 6):
        displaced_box(toy_bundle.sweep(0, -15 - 6 * number, number))
    assert said(-4, 0, 98) == ""  # the first was forgotten after as many others
    assert said(-4, 0, 99) == "98"


def disturbed(tmp_path: Path, allowed: Disturbances = ALLOWED, **more: Any) -> Bundle:
    arrays = toy_bundle.means(**{"changes": CHANGES} | more.pop("arrays", {}))
    return toy_bundle.load(tmp_path / "toy", arrays=arrays, disturbances=allowed, **more)


def test_means_and_limits_move_with_the_disturbance(tmp_path):
    """A fifth of the frames lost moves "a" by 4, and the limit from 9 to 12.6. A sweep there is
    unknown without that loss. More than was tried is unknown even on a mean, with the reason."""
    given = disturbed(tmp_path)
    assert answer(given, toy_bundle.sweep(0, -4)).status is Status.UNKNOWN
    assert [answer(given, lost(*z)).label for z in ((0, -4), (3.4, -4))] == ["a", "b"]
    for z in ((0, 4), (0, -8)):
        far = answer(given, lost(*z))
        assert far.status is Status.UNKNOWN
        assert "limit 12.6" in far.detail
    beyond = answer(given, lost(0, 0, 6))
    assert (beyond.status, beyond.label) == (Status.UNKNOWN, "")
    assert "frames" in beyond.detail
    bare = toy_bundle.load(tmp_path / "bare", known=None, disturbances=ALLOWED)
    assert answer(bare, lost(0, 0, 6)).label == "a"  # without means nothing is allowed


def test_a_disturbance_ends_no_object(tmp_path):
    """Though it widens the limit, and with it what counts as far, to seven times."""
    arrays = {"changes": np.zeros((1, 3, 2), np.float16)}
    wide = Disturbances((Allowance("lost", 0.0, 0.25, 30.0),), 4.0)
    it = Classifier(disturbed(tmp_path, wide, arrays=arrays), VirtualClock(), ClassifierConfig())
    first, second = toy_bundle.sweep(0, 0, 1, 1), replace(lost(0, 0), id=2, object=1)
    assert [it(first).fused, it(second).fused] == [1, 2]


def test_a_disturbed_sweep_is_doubtful_within_its_own_limits(tmp_path):
    """They are 1.4 times as far with a fifth of the frames lost."""
    arrays, known = {"changes": np.zeros((2, 3, 2), np.float16)}, WIDE
    given = disturbed(tmp_path, arrays=arrays, known=known)

    def joined(first: Sweep, second: Sweep) -> str:
        it = Classifier(given, VirtualClock())
        it(replace(first, object=1))
        return it(replace(second, id=2, object=1)).label

    assert joined(toy_bundle.sweep(0, -4.4), toy_bundle.sweep(0, -2.2)) == ""
    assert joined(toy_bundle.sweep(0, -4.4), lost(0, -2.2)) == "a"
    assert joined(toy_bundle.sweep(0, -2.8), lost(0, -3.4)) == "a"
    assert joined(toy_bundle.sweep(0, -2.8), toy_bundle.sweep(0, -3.4)) == ""


def test_displaced_sweeps_are_allowed_the_same(tmp_path):
    """In the turned embedding of displaced contacts."""
    place = {"contact": replace(toy_bundle.IN_PLACE, limit_mm=0.001)}
    given = disturbed(tmp_path, arrays=toy_bundle.displaced_arrays(), **DISPLACED | place)
    verdict = answer(given, toy_bundle.sweep(1, -4))
    assert (verdict.status, bool(verdict.displacement)) == (Status.UNKNOWN, True)
    assert answer(given, lost(1, -4)).status is not Status.UNKNOWN


def test_an_enrolled_label_moves_as_the_others_do_on_average(tmp_path):
    """By 5.3 with a fifth of the frames lost."""
    sweeps = np.stack([toy_bundle.window(20, 20)] * 5)
    now = enrolment.enrol(disturbed(tmp_path), "new", sweeps).bundle
    assert answer(now, toy_bundle.sweep(20, 20)).label == "new"
    assert answer(now, toy_bundle.sweep(20, 14.7)).status is Status.UNKNOWN
    assert answer(now, lost(20, 14.7)).label == "new"


def test_hum_is_removed_and_said(tmp_path):
    """A sweep with hum gets the answer of a sweep without it, unless the bundle removes none."""
    given, clean = disturbed(tmp_path, format=HUMMING), toy_bundle.sweep(6, 0, format=HUMMING)
    noisy = np.rint(clean.frames.taxels + HUM).astype(np.int16)
    humming = replace(clean, frames=replace(clean.frames, taxels=noisy))
    verdict = answer(given, humming)
    assert (verdict.label, "5.1 counts" in verdict.detail) == ("b", True)
    assert answer(given, clean).detail == ""
    kept = answer(disturbed(tmp_path, replace(ALLOWED, hum=None), format=HUMMING), humming)
    assert (kept.label, kept.detail) == ("b", "")


def test_a_material_is_enrolled_without_hum(tmp_path):
    """Sweeps with hum and without it give the same mean, like they give the same answer."""
    given = disturbed(tmp_path, format=HUMMING)
    clean = np.stack([toy_bundle.window(20, 20, HUMMING)] * 3)
    sets = clean, np.rint(clean + HUM).astype(np.int16)
    plain, cleaned = (enrolment.enrol(given, "new", of).bundle for of in sets)
    assert plain.classes
    assert cleaned.classes
    assert cleaned.classes.means[-1] == pytest.approx(plain.classes.means[-1], abs=0.01)
    assert cleaned.golden[-1] == pytest.approx(plain.golden[-1], abs=1)


@pytest.mark.parametrize("changes", [CHANGES[:1], CHANGES[:, :2], CHANGES[:, :, :1]])
def test_changes_of_another_shape_are_refused(tmp_path, changes):
    """A row for each allowance, a column for each trained label."""
    with pytest.raises(BundleError, match="float16"):
        disturbed(tmp_path, arrays={"changes": changes})


def early_toy(folder: Path, early: Early = RULE, **more: Any) -> Bundle:
    """The toy bundle with early answers after a quarter, a half and three quarters."""
    outputs = ("logits", "embedding", "early", "early_embedding")
    arrays = toy_bundle.means(**toy_bundle.early_arrays())
    given = {"outputs": outputs, "early": early, "arrays": arrays} | more
    return bundle.load(toy_bundle.put(folder / "toy", toy_bundle.files(**given)))


def exit_of(of: Bundle) -> EarlyExit:
    return EarlyExit(Classifier(of, VirtualClock()))


def test_no_early_answer_for_an_unknown_material(tmp_path):
    """At a squared distance of 9 from "b" its head is certain, and so is an early answer without
    limits; with limits the rest of the sweep is needed. Each step that must agree has its limit."""
    early = exit_of(early_toy(tmp_path))
    near = early(half(6, 1.5))
    assert near
    assert (near.status, near.label) == (Status.OK, "b")
    assert early(half(6, -3)) is None
    bare = early_toy(tmp_path, replace(RULE, limits=()))
    assert bare.classes
    assert bare.classes.early is None
    unchecked = exit_of(bare)(half(6, -3))
    assert unchecked
    assert unchecked.label == "b"
    early = exit_of(early_toy(tmp_path, replace(RULE, limits=(1.0, 4.0, 4.0))))
    assert early(half(6, 1.5)) is None
    assert early(half(6, 0.5))


def test_distances_have_the_shape_of_each_step():
    """The second direction may count half; NaN lies within no limit."""
    shapes = np.stack([np.eye(2), np.diag([1, 0.5])]).astype(np.float16)
    classes = EarlyClasses(np.tile(toy_bundle.MEANS, (2, 1, 1)), shapes)
    distances = EarlyDistances(classes, (4.0, 4.0))
    z = np.array([[0, -3], [0, -3]])
    assert distances.nearest(z).tolist() == [9, 2.25]
    assert distances.known(z).tolist() == [False, True]
    assert distances.known(z[:1]).tolist() == [False]
    assert not distances.known(np.full((2, 2), np.nan)).any()


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"arrays": toy_bundle.means()}, "early_means"),
        ({"arrays": toy_bundle.means(**toy_bundle.early_arrays(2))}, "early_means float32 .2"),
        (
            {"arrays": toy_bundle.means(**toy_bundle.early_arrays() | {"early_shapes": np.eye(2)})},
            "early_shapes float64",
        ),
        ({"outputs": ("logits", "embedding", "early")}, "early_embedding"),
        ({"steps": 4}, "early"),
        ({"known": None}, "without `known`"),
    ],
)
def test_a_bundle_with_incomplete_checks_is_refused(tmp_path, more, why):
    """Without the means of unfinished sweeps, with those of other steps or of another type, with a
    model that does not give the embeddings of as many steps, or without `known`."""
    with pytest.raises(BundleError, match=why):
        early_toy(tmp_path, **more)


@pytest.mark.parametrize(
    ("farthest_mm", "status"), [(None, Status.OK), (0.5, Status.OK), (0.3, Status.UNKNOWN)]
)
def test_a_contact_is_named_up_to_the_farthest_displacement(tmp_path, farthest_mm, status):
    """Beyond it `unknown` with the direction, and nothing early."""
    rule = replace(toy_bundle.DISPLACEMENT, farthest_mm=farthest_mm)
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays(), **toy_bundle.early_arrays())
    made = early_toy(tmp_path, arrays=arrays, **DISPLACED | {"displacement": rule})
    verdict = answer(made, away(0, 0))
    assert verdict.status is status
    assert verdict.displacement.startswith("moved 0.")
    assert (exit_of(made)(elsewhere(half(0, 0))) is not None) == (status is Status.OK)
    assert ("up to 0.3" in verdict.detail) == (status is Status.UNKNOWN)
    assert answer(made, toy_bundle.sweep(0, 0)).status is Status.OK
