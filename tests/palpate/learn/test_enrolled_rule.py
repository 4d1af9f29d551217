"""The network decides among trained labels, distances between these and enrolled ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.objects import EnrolledLabels, softmax
from palpate.answer.unknown import ClassDistances
from palpate.bundle.bundle import Bundle
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment, materials
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

LABELS = ("a", "b", "c", "felt")
FELT = np.stack([toy_bundle.window(9, 0.5), toy_bundle.window(9, -0.5)])
RULE = EnrolledLabels(np.array([False, False, True]), 0.6)


@pytest.fixture
def new(tmp_path: Path) -> Bundle:
    """The toy bundle with felt at (9, 0)."""
    return enrolment.enrol(toy_bundle.load(tmp_path / "toy"), "felt", FELT).bundle


def distances(new: Bundle, least: float | None) -> ClassDistances:
    """The distances of a bundle with this rule."""
    assert new.classes
    return ClassDistances(new.classes, replace(toy_bundle.KNOWN, enrolled=least), LABELS)


def test_the_network_divides_what_the_distances_leave(new):
    """The others share the rest as the network says."""
    rng, means = np.random.default_rng(0), distances(new, 0.6)
    z, network = rng.normal(3, 3, (20, 2)), rng.normal(0, 5, (20, 3))
    p = softmax(means.joined(network, z))
    own = softmax(means.logits(means.distances(z)))
    assert p[:, 3] == pytest.approx(own[:, 3], rel=1e-4)
    want = own[:, :3].sum(axis=1, keepdims=True) * softmax(network)
    assert p[:, :3] == pytest.approx(want, rel=1e-4, abs=1e-9)
    assert np.abs(p[:, :3] - own[:, :3]).max() > 0.5


def test_without_enrolled_labels_the_network_answers_alone(tmp_path):
    """Its logits keep their bits, or a rule's temperature."""
    classes = toy_bundle.load(tmp_path / "toy").classes
    assert classes
    network, z = np.float32([1, 2, 3.3]), np.float32([4, 5])
    plain = ClassDistances(classes, replace(toy_bundle.KNOWN, enrolled=0.6), LABELS[:3])
    assert plain.joined(network, z).tobytes() == network.tobytes()
    moved = ClassDistances(classes, toy_bundle.KNOWN, LABELS[:3], toy_bundle.DISPLACEMENT)
    assert moved.joined(network, z).tobytes() == (network / 3.0).tobytes()


def test_golden_sweeps_of_new_materials_need_not_agree(tmp_path):
    """Neither knows them; for trained ones it is a fault."""
    arrays = toy_bundle.means(means=np.float32([[0, 0], [6, 0], [0, 6]]))
    old = toy_bundle.load(tmp_path / "toy", arrays=arrays)
    assert old.classes
    turned = replace(old.classes, means=np.float32([[0, 0], [6, 0], [-1, 6]]))
    old = replace(old, classes=turned)
    made = enrolment.enrol(old, "felt", np.stack([toy_bundle.window(7, 7.4)]))
    it = Classifier(made.bundle, VirtualClock())
    network, z = it.outputs(made.bundle.golden[-1], "logits", "embedding")
    assert it._means
    assert network.argmax() != it._means.logits(it._means.distances(z))[:3].argmax()
    it.self_test()


@pytest.mark.parametrize(
    ("p", "want"),
    [
        ([0.3, 0.1, 0.6], [0.3, 0.1, 0.6]),
        ([0.3, 0.2, 0.5], [0.6, 0.4, 0]),
        ([0, 0, 1], [0, 0, 1]),
        ([0.5, 0.5, 0], [0.5, 0.5, 0]),
    ],
)
def test_an_enrolled_label_needs_its_least_probability(p, want):
    """Below it the trained labels are as without it, so none of their answers becomes unsure."""
    assert RULE.decided(np.array(p)) == pytest.approx(want)
    assert RULE.decided(np.array([p, p])) == pytest.approx(np.array([want, want]))


def test_two_enrolled_labels_need_it_together():
    """A sweep between two enrolled labels is not given to a trained one."""
    both = replace(RULE, which=np.array([False, True, True]))
    assert both.decided(np.array([0.3, 0.3, 0.4])) == pytest.approx([0.3, 0.3, 0.4])
    assert both.decided(np.array([0.5, 0.25, 0.25])) == pytest.approx([1, 0, 0])


def test_no_rule_and_no_enrolled_label_change_nothing():
    """Bit for bit, and what is not a number stays so."""
    p = np.array([0.2, 0.3, 0.5000001])
    for rule in (replace(RULE, least=0.0), replace(RULE, which=np.zeros(3, bool))):
        assert rule.decided(p).tobytes() == p.tobytes()
    assert np.isnan(RULE.decided(np.full(3, np.nan))).all()


def near_b(new: Bundle, p: float) -> tuple[float, float]:
    """The first embedding from b to felt, in steps of a count, where felt has this probability."""
    means = distances(new, 0.6)
    for step in range(31):
        z = 6 + step / 10, 0.0
        if softmax(means.logits(means.distances(np.array(z))))[3] >= p:
            return z
    raise AssertionError(p)


@pytest.mark.parametrize(("fusion", "fused"), [("product", "felt"), ("none", ""), ("vote", "")])
def test_sweeps_that_are_not_enough_are_enough_together(new, fusion, fused):
    """By the product; with votes each counts for its label."""
    z = near_b(new, 0.6)
    it = Classifier(new, VirtualClock(), replace(UNTIL_NEW_OBJECT, fuse=fusion))
    verdicts = [it(toy_bundle.sweep(*z, number=n, object=1)) for n in (1, 2, 3)]
    alone = verdicts[0]
    assert alone.label == "b"
    assert alone.scores[3] == 0
    assert alone.scores.sum() == pytest.approx(1)
    assert alone.own[3] == pytest.approx(0.63, abs=0.03)
    assert (verdicts[2].label == "felt") == (fused == "felt")
    if fused:
        assert verdicts[2].status is Status.OK
        assert verdicts[2].probability == pytest.approx(verdicts[2].scores[3])
        assert verdicts[2].probability > enrolment.LEAST


def test_a_displaced_contact_is_named_by_the_same_rule(tmp_path):
    """By displaced sweeps' distances and temperature."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays())
    rules = {"displacement": toy_bundle.DISPLACEMENT, "contact": toy_bundle.IN_PLACE}
    old = toy_bundle.load(tmp_path / "toy", arrays=arrays, **rules)
    new = enrolment.enrol(old, "felt", np.stack([toy_bundle.window(0, -3)])).bundle
    it = Classifier(new, VirtualClock())
    sweep = toy_bundle.sweep(0, -1.6)
    sweep.frames.taxels[:, 1] -= 80  # less load in the second row
    assert it(toy_bundle.sweep(0, -1.6)).displacement is None
    verdict = it(sweep)
    assert verdict.displacement
    means = ClassDistances(
        new.classes, new.manifest.known, new.manifest.labels, toy_bundle.DISPLACEMENT
    )
    network, z = it.outputs(sweep.frames.taxels, "logits", "embedding")
    by_means = softmax(means.logits(means.distances(z)) / 3.0)
    assert 0.2 < by_means[3] < enrolment.LEAST
    assert verdict.own[3] == pytest.approx(by_means[3], rel=1e-4)
    assert verdict.scores == pytest.approx([*softmax(network / 3.0), 0], rel=1e-4)


def test_left_out_sweeps_are_answered_as_the_box_would(new, tmp_path):
    """Between b and felt it is b: felt needs its probability."""
    old, near = toy_bundle.load(tmp_path / "old"), toy_bundle.window(*near_b(new, 0.55))
    sweeps = np.stack([*FELT, *FELT, near])
    many = {"felt": sweeps}
    found = materials.left_out(old, many, materials.NewSweeps(many, {"felt": [*"12345"]}))
    answers = [found.materials[k] for k in found.named.argmax(axis=1)]
    for i, one in enumerate(sweeps):
        without = enrolment.enrol(old, "felt", np.delete(sweeps, i, axis=0)).bundle
        box = Classifier(without, VirtualClock())
        verdict = box(toy_bundle.sweep_of(one))
        assert answers[i] == verdict.label
        assert found.chances[i] == pytest.approx(verdict.own, abs=1e-6)
    assert answers == ["felt"] * 4 + ["b"]
    assert found.chances[4].argmax() == 3
