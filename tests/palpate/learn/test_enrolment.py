"""Enrolment: a label is added by arithmetic; the new bundle is complete or absent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.answer.unknown import ClassDistances, Classes
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.errors import BundleError, FormatError
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

FELT = [(7.0, 8.0), (8.0, 9.0), (6.5, 7.5), (7.5, 8.5), (6.0, 7.0)]
"""Embeddings of five sweeps; their mean is (7, 8), (6.5, 7.5) and (7.5, 8.5) are the next to it."""


@pytest.fixture
def old(tmp_path: Path) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path / "old")


def counts(*at: tuple[float, float]) -> np.ndarray:
    """Windows [n, T, R, C] with these embeddings."""
    return np.stack([toy_bundle.window(*z) for z in at])


def test_a_label_is_added_by_arithmetic(old):
    """Mean, bias, count, version, golden sweeps, `made`; the old rows unchanged."""
    new = enrolment.enrol(old, "felt", counts(*FELT))
    assert new.warnings == ()
    c, m = new.bundle.classes, new.bundle.manifest
    assert c is not None
    assert c.means[:3].tolist() == toy_bundle.MEANS.tolist()
    assert c.means[3] == pytest.approx([7, 8], abs=1e-5)
    assert c.bias[3] == pytest.approx(-(49 + 64) / 2 + 2 / 10, abs=1e-4)
    assert (c.sweeps.tolist(), c.spread.tolist()) == ([0, 0, 0, 5], [1, 1, 1, 1])
    assert (m.labels, m.version) == (("a", "b", "c", "felt"), "1+felt")
    assert m.known == replace(toy_bundle.KNOWN, enrolled=enrolment.LEAST)
    assert (m.figures, m.early) == ({}, None)
    assert m.made == {"seed": 1, "enrolled": {"felt": 5}}
    assert new.bundle.enrolled == {"felt": 5}
    assert new.bundle.golden[:2].tolist() == old.golden.tolist()
    assert new.bundle.golden_logits.shape == (3, 4)
    files = toy_bundle.files()
    assert enrolment.files(files, new, None) == files | {bundle.ENROLMENT: new.file}


def test_a_label_for_a_skin_with_axes(tmp_path):
    """As with one axis. Sweeps without the axes are refused with the format."""
    old = toy_bundle.load(tmp_path / "old", format=toy_bundle.THREE_AXES)
    sweeps = np.stack([toy_bundle.window(*z, format=toy_bundle.THREE_AXES) for z in FELT])
    new = enrolment.enrol(old, "felt", sweeps)
    files = enrolment.files(toy_bundle.files(format=toy_bundle.THREE_AXES), new, None)
    toy_bundle.put(tmp_path / "new", files)
    it = Classifier(bundle.load(tmp_path / "new"), VirtualClock())
    assert it(toy_bundle.sweep(7, 8, format=toy_bundle.THREE_AXES)).label == "felt"
    for wrong in (sweeps[..., 2], sweeps[0], sweeps[:0]):
        with pytest.raises(FormatError, match="2x2x3"):
            enrolment.enrol(old, "felt", wrong)


def test_the_new_bundle_runs(old, tmp_path):
    """Read again it equals `enrol`'s, passes its self-test, and gives all labels."""
    new = enrolment.enrol(old, "felt", counts(*FELT))
    toy_bundle.put(tmp_path / "new", enrolment.files(toy_bundle.files(), new, None))
    read = bundle.load(tmp_path / "new")
    assert (read.id, read.manifest) == (new.bundle.id, new.bundle.manifest)
    for name in ("golden", "golden_logits"):
        assert getattr(read, name).tolist() == getattr(new.bundle, name).tolist()
    it = Classifier(read, VirtualClock())
    assert it.self_test() < 1e-5
    assert [it(toy_bundle.sweep(*z)).label for z in [(7, 8), (0, 0), (6, 0), (0, 6)]] == [
        "felt",
        "a",
        "b",
        "c",
    ]
    assert Classifier(old, VirtualClock())(toy_bundle.sweep(7, 8)).status is Status.UNKNOWN
    assert it(toy_bundle.sweep(-30, 0)).status is Status.UNKNOWN


def test_a_label_has_the_spread_and_the_median_of_its_sweeps(old):
    """With an assumed sweep: (2 + 4 * 9) / (2 * 4); the golden sweep is the median one."""
    new = enrolment.enrol(old, "felt", counts((23, 20), (17, 20), (20, 23), (20, 17)))
    assert new.bundle.classes is not None
    assert new.bundle.classes.spread[3] == pytest.approx(38 / 8, abs=1e-4)
    it = Classifier(new.bundle, VirtualClock())
    edge = np.sqrt(9 * 38 / 8 * 5 / 4)
    assert it(toy_bundle.sweep(20 + edge - 0.1, 20)).label == "felt"
    assert it(toy_bundle.sweep(20 + edge + 0.1, 20)).status is Status.UNKNOWN
    near = [(3.0, 5.0), (3.0, 5.5), (4.0, 8.0), (3.2, 6.0), (0.5, 6.0)]
    new = enrolment.enrol(old, "felt", counts(*near))
    it = Classifier(new.bundle, VirtualClock())
    scores = [it(toy_bundle.sweep(*z)) for z in near]
    assert scores[4].label == "c"
    mine = sorted((s.probability, i) for i, s in enumerate(scores[:4]))
    assert new.bundle.golden[2].tolist() == toy_bundle.window(*near[mine[2][1]]).tolist()


def test_one_sweep_is_enough_and_labels_add_up(old):
    """With one sweep the mean is that sweep; a second label is added to the first."""
    first = enrolment.enrol(old, "felt", counts((7, 8)))
    assert first.warnings == ()
    second = enrolment.enrol(first.bundle, "cork", counts((-8, 0), (-9, 0))).bundle
    assert second.enrolled == {"felt": 1, "cork": 2}
    assert second.manifest.labels == ("a", "b", "c", "felt", "cork")
    assert second.manifest.version == "1+felt+cork"
    assert second.manifest.made["enrolled"] == {"felt": 1, "cork": 2}
    it = Classifier(second, VirtualClock())
    assert it.self_test() < 1e-5
    assert [it(toy_bundle.sweep(*z)).label for z in [(7, 8), (-8.5, 0), (0, 0)]] == [
        "felt",
        "cork",
        "a",
    ]


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_the_limit_keeps_as_many_sweeps_of_an_enrolled_label_as_of_a_trained_one(n):
    """1 - exp(-limit / 2) of them."""
    rng, known = np.random.default_rng(1), replace(toy_bundle.KNOWN, strict=4.0, balanced=4.0)
    kept = []
    for _ in range(100):
        mean = rng.normal(size=(n, 2)).mean(axis=0)
        classes = Classes(
            np.vstack([toy_bundle.MEANS + 100, mean]),
            np.zeros(4),
            np.array([0, 0, 0, n]),
            np.ones(4),
            np.zeros((4, 0, 0), np.float16),
        )
        means = ClassDistances(classes, known, ("a", "b", "c", "felt"))
        kept += [means.measured(z, {})[0].min() <= means.limit for z in rng.normal(size=(40, 2))]
    assert np.mean(kept) == pytest.approx(1 - np.exp(-2), abs=0.025)


def test_an_enrolled_label_has_the_common_shape_and_moves_as_the_others(tmp_path):
    """1; turned and shifted when displaced."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays())
    signed = toy_bundle.files(
        arrays=arrays, displacement=toy_bundle.DISPLACEMENT, contact=toy_bundle.IN_PLACE
    )
    new = enrolment.enrol(
        bundle.load(toy_bundle.put(tmp_path / "old", signed)), "felt", counts(*FELT)
    )
    classes = bundle.load(
        toy_bundle.put(tmp_path / "new", enrolment.files(signed, new, None))
    ).classes
    assert classes is not None
    assert classes.displaced is not None
    assert classes.shapes.ravel().tolist() == [0.5, 1, 1, 1]
    assert classes.displaced.shapes.ravel().tolist() == [1, 1, 1, 1]
    assert classes.displaced.means[3] == pytest.approx([0.7 + 0.1, 8], abs=1e-5)
    assert classes.displaced.means[:3].tolist() == arrays["displaced_means"].tolist()


def test_early_answers_end_and_close_materials_make_no_warning(tmp_path):
    """The heads lack the label; no closer than two trained ones is accepted."""
    quick = toy_bundle.load(
        tmp_path / "q", early=Early((0.9,) * 3, 1), outputs=("logits", "embedding", "early")
    )
    new = enrolment.enrol(quick, "felt", counts(*FELT))
    assert new.bundle.manifest.early is None
    assert len(new.warnings) == 1
    assert "answers" in new.warnings[0]
    Classifier(new.bundle, VirtualClock())
    arrays = toy_bundle.means(
        means=np.float32([[0, 0], [6, 0], [0, 2]]), bias=np.float32([0, -18, -2])
    )
    made = toy_bundle.load(tmp_path / "x", arrays=arrays)
    assert enrolment.enrol(made, "felt", counts((8.2, 0), (8.2, 0), (8.2, 0))).warnings == ()
    assert len(enrolment.enrol(made, "felt", counts((7.8, 0), (7.8, 0), (7.8, 0))).warnings) == 1


@pytest.mark.parametrize(
    ("at", "hints"),
    [
        ([(1, 0)] * 3, ["close to 'a' (squared distance 0.3, limit 9.0"]),
        ([(6, 2.9)] * 100, ["close to 'b' (squared distance 8.4"]),
        ([(6, 3.1)] * 100, []),
        ([(20, 20), (20, 24.2)], []),  # 4.2^2 / 2 = 8.8
        ([(20, 20), (20, 24.3)], ["disagree: they lie 9.2 from their mean"]),
        ([(20, 20), (20, 20), (30, 20), (20, 20)], ["number 3 most of all"]),
        ([(0, 0), (6.2, 0)], ["disagree", "close to"]),
    ],
)
def test_unsuitable_sweeps_are_told_with_numbers(old, at, hints):
    """Like a trained material, or unlike each other: a warning."""
    new = enrolment.enrol(old, "felt", counts(*at))
    found = [text for text in (new.disagreement, *new.warnings) if text]
    assert len(found) == len(hints), found
    assert all(hint in text for hint, text in zip(hints, found, strict=True))
    assert bool(new.disagreement) == any("close" not in hint for hint in hints)
    assert "felt" in new.bundle.manifest.labels


@pytest.mark.parametrize("label", ["b", "a,b", "", "x" * 25])
def test_labels_that_cannot_be_enrolled(old, label):
    """Used already, or not allowed in a sentence: before the first sweep."""
    for refused in (enrolment.admit, lambda *it: enrolment.enrol(*it, counts((7, 8)))):
        with pytest.raises(BundleError, match=f"label '{label}"):
            refused(old, label)


def test_bundles_and_sweeps_without_numbers_are_refused(tmp_path):
    """Without class means, and with a mean that is NaN, which would spoil every answer."""
    plain = toy_bundle.load(tmp_path / "p", known=None, outputs=("logits",))
    with pytest.raises(BundleError, match="embedding"):
        enrolment.enrol(plain, "felt", counts((7, 8)))
    format = replace(toy_bundle.FORMAT, dtype="float32")
    made = toy_bundle.load(tmp_path / "f", format=format)
    with pytest.raises(FormatError, match="number"):
        enrolment.enrol(made, "felt", np.full((1, 20, 2, 2), 3e38, np.float32))


@pytest.mark.parametrize(
    "sweeps",
    [counts((7, 8))[0], counts((7, 8))[:0], counts((7, 8))[:, 1:], counts((7, 8)).astype(np.uint8)],
)
def test_sweeps_of_another_format(old, sweeps):
    """Sweeps with a dimension too few, no sweeps, another window, another type."""
    with pytest.raises(FormatError, match="enrolled"):
        enrolment.enrol(old, "felt", sweeps)
