"""Early answers need a known material, and a contact that is not displaced too far."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle, Early
from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep
from palpate.inference.classifier import Classifier
from palpate.inference.early_exit import EarlyExit
from palpate.inference.novelty import EarlyDistances
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

OUTPUTS = ("logits", "embedding", "early", "early_embedding")
RULE = Early((0.6, 0.6, 0.6), 2, (4.0, 4.0, 4.0))


def toy(folder: Path, early: Early = RULE, **more: Any) -> Bundle:
    """The toy bundle with early answers after a quarter, a half and three quarters."""
    arrays = more.pop("arrays", toy_bundle.means(**toy_bundle.early_arrays()))
    given = {"outputs": OUTPUTS, "early": early, "arrays": arrays} | more
    return bundle.load(toy_bundle.put(folder / "toy", toy_bundle.files(**given)))


def half(z1: float, z2: float) -> Sweep:
    """The first half of a sweep with this embedding."""
    whole = toy_bundle.sweep(z1, z2)
    frames = replace(whole.frames, taxels=whole.frames.taxels[:10])
    return replace(whole, frames=frames, share=0.5)


def test_no_early_answer_for_an_unknown_material(tmp_path: Path):
    """At a squared distance of 9 from "b" its head is certain, and so is an early answer without
    limits; with limits the rest of the sweep is needed."""
    early = EarlyExit(Classifier(toy(tmp_path), VirtualClock()))
    near, far = early(half(6, 1.5)), early(half(6, -3))
    assert near
    assert (near.status, near.label) == (Status.OK, "b")
    assert far is None
    bare = toy(tmp_path, replace(RULE, limits=()))
    assert bare.classes
    assert bare.classes.early is None
    unchecked = EarlyExit(Classifier(bare, VirtualClock()))(half(6, -3))
    assert unchecked
    assert unchecked.label == "b"


def test_the_material_is_known_at_each_step_that_must_agree(tmp_path: Path):
    """The first of two steps lies beyond its limit."""
    early = EarlyExit(
        Classifier(toy(tmp_path, replace(RULE, limits=(1.0, 4.0, 4.0))), VirtualClock())
    )
    assert early(half(6, 1.5)) is None
    assert early(half(6, 0.5))


def test_distances_have_the_shape_of_each_step():
    """In the second step the second direction counts half."""
    shapes = np.stack([np.eye(2), np.diag([1, 0.5])]).astype(np.float16)
    classes = bundle.EarlyClasses(np.tile(toy_bundle.MEANS, (2, 1, 1)), shapes)
    distances = EarlyDistances(classes, (4.0, 4.0))
    z = np.array([[0, -3], [0, -3]])
    assert distances.nearest(z).tolist() == [9, 2.25]
    assert distances.known(z).tolist() == [False, True]
    assert distances.known(z[:1]).tolist() == [False]


def test_an_embedding_that_is_no_number_is_unknown():
    """Distances that are not numbers lie within no limit."""
    classes = bundle.EarlyClasses(*toy_bundle.early_arrays().values())
    known = EarlyDistances(classes, (4.0,) * 3).known(np.full((3, 2), np.nan))
    assert not known.any()


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"arrays": toy_bundle.means()}, "early_means"),
        ({"arrays": toy_bundle.means(**toy_bundle.early_arrays(2))}, "early_means float32 .2, 3"),
        (
            {"arrays": toy_bundle.means(**toy_bundle.early_arrays() | {"early_shapes": np.eye(2)})},
            "early_shapes float64",
        ),
        (
            {"outputs": ("logits", "embedding", "early")},
            "the manifest needs early, early_embedding",
        ),
        ({"steps": 4}, "early"),
    ],
)
def test_a_bundle_with_incomplete_checks_is_refused(tmp_path: Path, more: dict, why: str):
    """Without the means of unfinished sweeps, with those of other steps or of another type, or with
    a model that does not give the embeddings of as many steps."""
    with pytest.raises(BundleError, match=why):
        toy(tmp_path, **more)


@pytest.mark.parametrize("limits", [(4.0,), (4.0, 0.0, 4.0), (4.0, "4", 4.0)])
def test_limits_out_of_range_are_refused(limits: tuple):
    """Too few limits, 0, and text."""
    with pytest.raises(BundleError, match=r"early.limits .* one for each step"):
        Early((0.6, 0.6, 0.6), 2, limits)


def test_limits_need_the_limit_of_whole_sweeps(tmp_path: Path):
    """A bundle without `known` has no embedding."""
    with pytest.raises(BundleError, match=r"`early.limits` without `known`"):
        toy(tmp_path, known=None)


def displaced(folder: Path, farthest_mm: float | None) -> Classifier:
    rule = replace(toy_bundle.DISPLACEMENT, farthest_mm=farthest_mm)
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays(), **toy_bundle.early_arrays())
    made = toy(folder, arrays=arrays, displacement=rule, contact=toy_bundle.IN_PLACE)
    return Classifier(made, VirtualClock())


def elsewhere(sweep: Sweep) -> Sweep:
    """The sweep with the contact on the first row, half a taxel from the middle."""
    sweep.frames.taxels[:, 1] -= 80
    return sweep


def test_a_contact_is_named_up_to_the_farthest_displacement(tmp_path: Path):
    """It lies 0.3 mm from its position in training. Beyond the limit the answer is `unknown` with
    the direction, and no early answer is given."""
    for farthest_mm, status in ((None, Status.OK), (0.5, Status.OK), (0.3, Status.UNKNOWN)):
        box = displaced(tmp_path, farthest_mm)
        verdict = box(elsewhere(toy_bundle.sweep(0, 0)))
        assert verdict.status is status
        assert verdict.displacement.startswith("moved 0.")
        early = EarlyExit(box)(elsewhere(half(0, 0)))
        assert (early is not None) == (status is Status.OK)
    assert verdict.detail == f"{verdict.displacement}; named up to 0.3 mm"
    assert box(toy_bundle.sweep(0, 0)).status is Status.OK


def test_the_farthest_displacement_is_a_length():
    """0 is out of range."""
    with pytest.raises(BundleError, match=r"moved.farthest_mm 0 must be a number above 0"):
        replace(toy_bundle.DISPLACEMENT, farthest_mm=0)
