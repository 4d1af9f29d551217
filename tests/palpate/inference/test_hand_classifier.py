"""The answer of a hand from the answers of its fingers, with a bundle whose probabilities are known
by arithmetic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle.bundle import Bundle
from palpate.core.errors import ConfigError
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier
from palpate.inference.hand_classifier import HandClassifier
from palpate.inference.objects import ObjectRule, fuse
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

A, C, NEAR_A, NEAR_B, FAR = (0.0, 0.0), (0.0, 6.0), (2.8, -1.0), (3.2, -1.0), (40.0, 40.0)
"""Embeddings of a sure "a" and "c", an "a" and a "b" that are hardly sure, and of an unknown
material."""
Embedding = tuple[float, float]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path_factory.mktemp("toy"))


def hand(
    left: Bundle, right: Bundle, min_probability: float = 0, rule: ObjectRule | None = None
) -> HandClassifier:
    """A hand of two fingers."""
    clock = VirtualClock()
    fingers = {
        name: Classifier(bundle, clock, "none", min_probability)
        for name, bundle in (("left", left), ("right", right))
    }
    return HandClassifier(fingers, clock, str, "product", rule or ObjectRule())


def sweep(*embeddings: Embedding | None, number: int = 1, object: int = 0) -> Sweep:
    """A sweep in which each finger feels one of `embeddings`; None: its skin was lost."""
    fingers = []
    for finger, z in zip(("left", "right"), embeddings, strict=True):
        own = toy_bundle.sweep(*(z or A), number, object)
        if z is None:
            none = Frames.empty(toy_bundle.FORMAT)
            own = replace(own, status=Status.SENSOR_LOST, frames=none)
        fingers.append(replace(own, finger=finger))
    whole = replace(fingers[0], finger=None, frames=Frames.empty(toy_bundle.FORMAT))
    return replace(whole, status=Status.OK, fingers=tuple(fingers))


def statuses(verdict: Verdict) -> list[str]:
    """The statuses of the fingers, then of the hand."""
    return [str(v.status) for v in (*verdict.fingers, verdict)]


def reversed_labels(bundle: Bundle) -> Bundle:
    """The same model, whose first output is now "c" and whose last is "a"."""
    labels = bundle.manifest.labels[::-1]
    return replace(bundle, manifest=replace(bundle.manifest, labels=labels))


def test_fingers_that_doubt_are_sure_together(toy: Bundle):
    """Two fingers with "a" at .65 are unsure; together it has .77."""
    verdict = hand(toy, toy, 0.7)(sweep(NEAR_A, NEAR_A))
    assert statuses(verdict) == ["unsure", "unsure", "ok"]
    product = fuse([v.own for v in verdict.fingers], "product")
    assert verdict.probability == product[0] > 0.7 > verdict.fingers[0].probability
    assert verdict.label == "a"
    assert verdict.detail == ""


def test_fingers_that_contradict_each_other_are_unsure_together(toy: Bundle):
    """A sure finger and one that leans the other way: the product says less than the first."""
    verdict = hand(toy, toy, 0.7)(sweep(NEAR_A, NEAR_B))
    assert [v.label for v in verdict.fingers] == ["a", "b"]
    assert statuses(verdict) == ["unsure", "unsure", "unsure"]


def test_probabilities_are_fused_by_label(toy: Bundle):
    """The second bundle has the same labels in another order, and another id: its last output is
    "a". The hand has an id of its own then."""
    other = replace(reversed_labels(toy), id="ffffffff")
    it = hand(toy, other)
    verdict = it(sweep(A, C))
    assert [v.label for v in verdict.fingers] == ["a", "a"]
    assert (verdict.label, verdict.status) == ("a", "ok")
    assert verdict.probability > 0.99
    assert it.model == verdict.bundle not in (toy.id, other.id)
    assert len(it.model) == len(toy.id)
    assert hand(toy, toy).model == toy.id


def test_other_labels_are_refused(toy: Bundle):
    """The message names the finger and the labels that are not common."""
    other = replace(toy, manifest=replace(toy.manifest, labels=("a", "b", "x")))
    with pytest.raises(ConfigError, match=r"skins.right has other labels .*\(c, x\).*train"):
        hand(toy, other)


def test_an_unknown_material_under_one_finger_is_unknown(toy: Bundle):
    """The label of the other finger would be a guess."""
    verdict = hand(toy, toy)(sweep(A, FAR))
    assert statuses(verdict) == ["ok", "unknown", "unknown"]
    assert (verdict.label, len(verdict.scores)) == ("", 0)
    assert verdict.detail == "right unknown"
    assert verdict.degraded == ""


def test_a_lost_finger_is_named(toy: Bundle):
    """It is left out; a hand without any finger has the status of the fault."""
    verdict = hand(toy, toy)(sweep(None, A))
    assert statuses(verdict) == ["sensor-lost", "ok", "ok"]
    assert verdict.degraded == verdict.detail == "left sensor-lost"
    assert statuses(hand(toy, toy)(sweep(None, None)))[-1] == "sensor-lost"


def test_a_displaced_finger_is_named(tmp_path: Path):
    """With its own temperature and least probability, as with one skin."""
    moved = toy_bundle.load(
        tmp_path / "moved",
        arrays=toy_bundle.means() | toy_bundle.displaced_arrays(),
        displacement=toy_bundle.DISPLACEMENT,
        contact=replace(toy_bundle.IN_PLACE, limit_mm=0.05),
    )
    verdict = hand(moved, moved)(sweep(A, (6.0, 0.0)))
    left, right = verdict.fingers
    assert left.displacement == ""
    assert right.displacement.startswith("moved ")
    assert verdict.displacement == f"right {right.displacement}"
    assert verdict.detail.startswith(f"right {right.displacement}")


def test_a_sweep_that_contradicts_its_object_is_refused(toy: Bundle):
    """By the rule of the settings, over the fused probabilities of the fingers."""
    it = hand(toy, toy, rule=ObjectRule(5, "refuse", 0))
    one = it(sweep(A, A, number=1, object=1))
    two = it(sweep(C, C, number=2, object=1))
    three = it(sweep(A, A, number=3, object=1))
    assert [str(v.status) for v in (one, two, three)] == ["ok", "conflict", "ok"]
    assert two.detail == "another object: c after a"
    assert (three.fused, three.after) == (2, 2)
    assert len(two.scores) == 0
    assert int(two.own.argmax()) == 2


def test_the_last_sweep_of_an_object_is_final(toy: Bundle):
    """After `max_sweeps` sweeps below the probability the answer is `undecided`."""
    it = hand(toy, toy, 0.99, ObjectRule(2, "new", 0))
    found = [it(sweep(NEAR_A, NEAR_B, number=n, object=1)) for n in (1, 2)]
    assert [str(v.status) for v in found] == ["unsure", "undecided"]


def test_each_finger_finds_its_own_broken_taxels(toy: Bundle):
    """Frames of a finger reach its classifier alone, and `degraded` names the finger."""
    clock = VirtualClock()
    fingers = {name: Classifier(toy, clock, "none") for name in ("left", "right")}
    it = HandClassifier(fingers, clock, lambda: "left absent", "product", ObjectRule())
    heard: list[str] = []
    for name, own in fingers.items():
        own.frames = lambda frames, name=name: heard.append(name)
    n = np.arange(2)
    it.frames(Frames(n, n, np.zeros((2, 2, 2), np.int16), "right"))
    assert heard == ["right"]
    assert it.degraded == "left absent"


def test_a_verdict_of_a_hand_for_json(toy: Bundle):
    """The fingers are objects in it; a verdict of one skin has neither field."""
    verdict = hand(toy, toy)(sweep(A, A))
    shown = verdict.as_dict()
    assert [of["finger"] for of in shown["fingers"]] == ["left", "right"]
    assert "finger" not in shown
    assert isinstance(shown["fingers"][0]["scores"], list)
    assert "scores" not in verdict.as_dict(arrays=False)["fingers"][0]
    alone = Classifier(toy, VirtualClock())(toy_bundle.sweep(*A)).as_dict()
    assert not alone.keys() & {"finger", "fingers"}


def test_bundles_of_different_forms(toy: Bundle, tmp_path: Path):
    """A skin with three axes beside one with one: the tare of each has its own shape."""
    axes = toy_bundle.load(tmp_path / "axes", format=toy_bundle.THREE_AXES)
    it = hand(toy, axes)
    counts = np.arange(4 + 12)[None].repeat(3, 0)
    assert it.set_tare(counts) == "left largest 3.0 raw counts and right largest 15.0 raw counts"
    assert it.describe()[-1] == f"{toy.format} and {axes.format}".replace(",", "")
    right = replace(toy_bundle.sweep(*A, format=toy_bundle.THREE_AXES), finger="right")
    left = replace(toy_bundle.sweep(*A), finger="left")
    it = hand(toy, axes)
    verdict = it(replace(left, finger=None, fingers=(left, right)))
    assert (verdict.label, verdict.status) == ("a", "ok")
