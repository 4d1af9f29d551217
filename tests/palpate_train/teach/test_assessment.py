"""The assessment of a box: accuracy, confusion, wrong labels, and what to record next."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.learn.assessment import Assessment, LearningCurve
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import InnerPart
from palpate_train.teach.assessment import assess, judged
from palpate_train.teach.lesson import Lesson
from tests.factories.sweep_sets import easy


def lesson(sweeps: Dataset) -> Lesson:
    """The lesson of a set."""
    names = tuple(f"sweep-{i:06d}" for i in range(1, len(sweeps) + 1))
    plain = replace(sweeps, groups={"recording": np.arange(len(sweeps))})
    return Lesson(plain, names, {})


def answers(p: np.ndarray, labels: list[int]) -> Assessment:
    """The assessment of sweeps with these probabilities."""
    made = easy(1)
    sweeps = made.take(np.zeros(len(labels), int))
    sweeps = replace(sweeps, labels=np.array(labels), materials=("cork", "felt", "pine"))
    return judged(lesson(sweeps), [InnerPart("recording", np.ones(len(labels), bool))], p)


def sure(*named: int) -> np.ndarray:
    """Probabilities that name these materials."""
    return np.where(np.eye(3)[list(named)] > 0, 0.98, 0.01)


@pytest.mark.slow
def test_easy_materials_are_enough():
    """All sweeps are right, and the sentence agrees with the interval."""
    found = assess(lesson(easy(14)))
    assert found.json()["accuracy"] == 1
    assert found.interval[0] > 0.9
    assert found.advice().startswith("enough: at least 9")
    assert found.confused() is None
    assert "42 sweeps" in found.text()


@pytest.mark.slow
def test_the_assessment_says_what_else_would_get_a_label():
    """Junk and materials that are left out, with the share that would be named and their number."""
    found = assess(lesson(easy(8)))
    assert len(found.others) == 2
    for share, n in found.others.values():
        assert 0 <= share <= 1
        assert n >= 24
        assert f"of {n} " in found.text()
    assert [*found.json()["others"].values()] == [[*of] for of in found.others.values()]


@pytest.mark.parametrize(
    ("n", "before", "now", "least", "most"),
    [(8, 0.5, 0.75, 0.8, 0.85), (8, 0.5, 1.0, 1.0, 1.0), (20, 0.8, 0.85, 0.87, 0.89)],
)
def test_further_sweeps_are_estimated_from_what_the_last_have_brought(n, before, now, least, most):
    """Errors fall on as a power of the number of sweeps."""
    said = LearningCurve("cork", n, 4, before, now).text
    share = float(said.rsplit("about ")[1].split()[0]) / 100
    assert least <= share <= most
    assert f"{n} sweeps of cork" in said
    assert "%" not in LearningCurve("cork", n, 4, now, now).text


@pytest.mark.slow
def test_the_assessment_estimates_what_more_sweeps_bring():
    """For the material with most errors; nothing is said without an error or with three sweeps."""
    rng, sweeps = np.random.default_rng(5), easy(8)
    noise = 4 * rng.standard_normal(sweeps.samples.shape) * sweeps.samples.std()
    noisy = np.clip(sweeps.samples + noise, 0, 255).astype(sweeps.samples.dtype)
    found = assess(lesson(replace(sweeps, samples=noisy)))
    assert found.curve
    assert found.curve.material == found.materials[found.worst()]
    assert (found.curve.sweeps, found.curve.fewer) == (8, 4)
    assert found.curve.text in found.json()["text"]
    assert assess(lesson(easy(8))).curve is None


def test_few_or_wrong_sweeps_ask_for_more():
    """Nine right answers show little; the fewest, then the most errors come next."""
    found = answers(sure(0, 0, 0, 0, 1, 1, 1, 2, 2), [0, 0, 0, 0, 1, 1, 1, 2, 2])
    assert "9 sweeps are few" in found.advice()
    assert found.advice().endswith("of pine first")
    labels = [0] * 10 + [1] * 10 + [2] * 10
    named = list(labels)
    named[0], named[1] = 1, 1
    p = sure(*named)
    p[:2] = [0.3, 0.6, 0.1]
    assert answers(p, labels).advice().startswith("3 more of cork")


def test_a_mislabelled_sweep_is_pointed_out():
    """Sweep 4 of cork is surely pine, while all others are classified correctly."""
    labels = [0] * 6 + [1] * 6 + [2] * 6
    named = list(labels)
    named[3] = 2
    found = answers(sure(*named), labels)
    (suspect,) = found.suspects()
    assert suspect.text.startswith("sweep 4 of cork")
    assert suspect.text.endswith("pine")
    assert suspect.sweep == "sweep-000004"
    assert suspect.text in found.advice()


@pytest.mark.slow
def test_a_mislabelled_sweep_is_found_in_signals():
    """The same from raw counts: one label of easy materials is exchanged."""
    sweeps = easy(8)
    labels = sweeps.labels.copy()
    labels[2] = 1
    found = assess(lesson(replace(sweeps, labels=labels)))
    assert [one.sweep for one in found.suspects()] == ["sweep-000003"]
    assert found.suspects()[0].looks_like == "low"


@pytest.mark.slow
def test_materials_of_one_place_are_judged_by_sweeps():
    """Where places cannot be left out for all materials, sweeps are: none stays unjudged."""
    sweeps = easy(6)
    position = np.where((sweeps.labels == 0) & (np.arange(18) % 2 == 0), 2, 1)
    one = lesson(sweeps)
    found = assess(
        replace(one, sweeps=replace(one.sweeps, groups=one.sweeps.groups | {"position": position}))
    )
    assert found.left_out == ("recording",)
    assert (found.named.sum(axis=1) > 0.99).all()


def test_materials_that_cannot_be_told_apart_are_named():
    """No label is suspected, also where both materials look like the other."""
    found = answers(sure(1, 1, 0, 0, 2, 2), [0, 0, 1, 1, 2, 2])
    assert not found.suspects()
    labels = [0] * 8 + [1] * 8 + [2] * 8
    named = [0, 1] * 4 + [1, 0] * 4 + [2] * 8
    found = answers(sure(*named), labels)
    assert not found.suspects()
    assert found.inseparable() == (0, 1)
    assert found.advice().startswith("cork and felt cannot be")
    assert found.json()["confused"] == ["cork", "felt", 8.0]
