"""Objects end without NEW OBJECT: by a contradiction, a pause, and after max_sweeps."""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.objects import FusedSweeps, contradicts, softmax
from palpate.answer.unknown import KnownMaterial
from palpate.bundle.bundle import Bundle
from palpate.core.config import UNTIL_NEW_OBJECT, ClassifierConfig
from palpate.core.status import LEAST_PROBABILITY
from palpate.core.types import Status, Sweep, Verdict
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle
from tests.factories.settings import load
from tests.factories.toy_bundle import told

A, B, NEAR_A = (0.0, 0.0), (6.0, 0.0), (2.8, -1.0)
"""Embeddings of a sure "a", a sure "b", and an "a" with a probability of .65."""
BELOW, ASIDE = (0.0, -2.9), (0.0, 2.9)
"""A sure "a" that is far from "c", and an "a" with a probability of .57 between them."""
SAME_SHAPES = np.stack([np.eye(1)] * 3).astype(np.float16)
S = 1_000_000_000
ANOTHER = "another object: "
DELIVERED = ClassifierConfig()


def classifier(bundle: Bundle, settings: ClassifierConfig = DELIVERED, **more: Any) -> Classifier:
    """A classifier with these settings."""
    return Classifier(bundle, VirtualClock(), replace(settings, **more))


def timed(sweeps: Iterable[Sweep], pause_s: float = 7) -> list[Sweep]:
    """The sweeps with numbers and times, of an object that was signalled; a slide takes 3 s."""
    period, slide = round((pause_s + 3) * S), 3 * S
    return [
        replace(one, id=n, start_ns=n * period, stop_ns=n * period + slide, object=one.object or 1)
        for n, one in enumerate(sweeps, 1)
    ]


def felt(*embeddings: tuple[float, float], pause_s: float = 7) -> list[Sweep]:
    """Sweeps of one object with these embeddings."""
    return timed((toy_bundle.sweep(*z) for z in embeddings), pause_s)


def short(verdict: Verdict) -> tuple[str, str, int, str]:
    """The part of a verdict that these tests compare."""
    return str(verdict.status), verdict.label, verdict.fused, verdict.detail


def labels(it: Classifier, *embeddings: tuple[float, float]) -> list[tuple[str, int]]:
    """Label and number of fused sweeps of each answer."""
    return [short(it(sweep))[1:3] for sweep in felt(*embeddings)]


@pytest.fixture
def toy(tmp_path: Path) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path / "toy")


@pytest.mark.parametrize("labels", [2, 6, 50])
def test_a_bayes_factor_of_ten_contradicts(labels):
    """K * sum(fused * own) against 1 / 10 for any K; unsure sweeps contradict nothing."""

    def ratio_of(r: float) -> tuple[np.ndarray, np.ndarray]:
        fused, own = np.zeros(labels), np.zeros(labels)
        fused[0], own[:2] = 1, (r / labels, 1 - r / labels)
        return own, fused

    assert contradicts(*ratio_of(0.09))
    assert not contradicts(*ratio_of(0.11))
    assert not contradicts(np.full(labels, 1 / labels), ratio_of(0)[1])
    assert not contradicts(ratio_of(0)[0], np.full(labels, 1 / labels))


def test_a_pause_is_from_the_end_to_the_start():
    """More than object_s ends an object; 0 never does. A sweep before the end is not a pause."""
    paused = replace(UNTIL_NEW_OBJECT, object_s=60.0)
    before = FusedSweeps(1, (np.ones(2) / 2,), 1, 100 * S)
    assert not before.ended(160 * S, paused)
    assert before.ended(160 * S + 1, paused)
    assert not before.ended(10**6 * S, UNTIL_NEW_OBJECT)
    assert not before.ended(0, paused)


def test_a_contradiction_begins_another_object(toy):
    """Its evidence is that sweep alone, also with `vote`; the detail has both labels."""
    assert [short(one) for one in map(classifier(toy), felt(A, A, B, B, A))] == [
        ("ok", "a", 1, ""),
        ("ok", "a", 2, ""),
        ("ok", "b", 1, f"{ANOTHER}b after a"),
        ("ok", "b", 2, ""),
        ("ok", "a", 1, f"{ANOTHER}a after b"),
    ]
    assert labels(classifier(toy, fuse="vote"), A, A, B) == [("a", 1), ("a", 2), ("b", 1)]


@pytest.mark.parametrize(
    ("conflict", "given"),
    [
        ("new", ("ok", "a", 1, f"{ANOTHER}a after a")),
        ("refuse", ("conflict", "", 0, f"{ANOTHER}a after a")),
        ("fuse", ("ok", "a", 3, "")),
    ],
)
def test_a_sweep_that_lies_elsewhere_is_not_made_surer(toy, conflict, given):
    """It has the label of the object, but is as far from "a" on the other side, where "c" is. A
    sweep with less difference is fused, and so is one after an unfinished one."""
    it, (*_, alone) = classifier(toy, conflict=conflict), felt(ASIDE)
    sweeps = felt(BELOW, BELOW, ASIDE)
    *_, last = [it(sweep) for sweep in sweeps]
    assert short(last) == given
    own = classifier(toy)(alone).probability
    assert own < 0.6
    if conflict == "new":
        assert last.probability == own
        for between in (A, BELOW):
            it.forget()
            assert [it(one).fused for one in felt(BELOW, between)] == [1, 2]
        it.judged(sweeps[1], told(it, np.array([0.9, 0.1, 0.0])))
        assert it(sweeps[2]).fused == 4


NEAR, BEYOND, FAR, ELSEWHERE = (0.0, -2.4), (0.0, -3.4), (0.0, -4.4), (-3.0, 3.0)
"""Squared distances of 5.8, 11.6 and 19.4 to "a", and of 18 on its other side."""
WIDE = replace(toy_bundle.KNOWN, strict=4.0, loose=25.0)


@pytest.fixture
def doubting(tmp_path: Path) -> Bundle:
    """The toy bundle, in which sweeps with squared distances between 4 and 25 are doubtful."""
    arrays = toy_bundle.means(**toy_bundle.displaced_arrays() | {"shapes": SAME_SHAPES})
    rules = {"displacement": toy_bundle.DISPLACEMENT, "contact": toy_bundle.IN_PLACE}
    return toy_bundle.load(tmp_path / "doubting", arrays=arrays, known=WIDE, **rules)


def last(it: Classifier, sweeps: Iterable[Sweep]) -> str:
    """Label of the last sweep, "" for an unknown material."""
    *_, verdict = [it(sweep) for sweep in sweeps]
    assert (verdict.status is Status.UNKNOWN) == (not verdict.label)
    return verdict.label


@pytest.mark.parametrize("fuse", ["product", "vote"])
def test_two_doubtful_sweeps_are_judged_together(doubting, fuse):
    """By the mean of the logarithms, within the limit or beyond it; a clear one alone."""
    for first, second, alone, label in (
        (NEAR, NEAR, "a", "a"),
        (NEAR, BEYOND, "", "a"),
        (BEYOND, NEAR, "a", "a"),
        (FAR, NEAR, "a", ""),
        (NEAR, FAR, "", ""),
        ((0.0, -4.1), (0.0, -2.0), "a", "a"),
        ((0.0, -5.1), (0.0, -2.9), "a", "a"),
    ):
        assert last(classifier(doubting, fuse=fuse), felt(second)) == alone
        assert last(classifier(doubting, fuse=fuse), felt(first, second)) == label
    first, second = map(classifier(doubting), felt(FAR, NEAR))
    mean = np.sqrt((1 + 19.36 / 9) * (1 + 5.76 / 9)) - 1
    assert f"squared distance {9 * mean:.4g} from a, limit 9" in second.detail
    assert (second.after, len(second.own), len(second.scores)) == (1, 3, 0)
    assert (first.after, len(first.own), len(first.scores)) == (0, 3, 0)
    single = classifier(doubting)(replace(felt(FAR)[0], object=0))
    assert (len(single.own), single.detail) == (0, first.detail)


@pytest.mark.parametrize(("conflict", "label"), [("new", "a"), ("refuse", "a"), ("fuse", "")])
def test_doubtful_sweeps_that_are_not_alike_are_two_objects(doubting, conflict, label):
    """Unless only NEW OBJECT ends an object."""
    assert last(classifier(doubting, conflict=conflict), felt(ELSEWHERE, NEAR)) == label


def test_doubt_ends_with_its_object(doubting):
    """By NEW OBJECT, a pause, max_sweeps, and a sweep that is clear, displaced or early."""
    far, near = felt(FAR, NEAR)
    it = classifier(doubting)
    assert last(it, [far, near]) == ""
    assert last(it, [replace(far, object=2), replace(near, object=3)]) == "a"
    for more in ({"object_s": 6.0}, {"fuse": "none"}):
        assert last(classifier(doubting, **more), [far, near]) == "a"
    assert last(classifier(doubting), [replace(one, object=0) for one in (far, near)]) == "a"
    for most, label in ((1, ""), (2, "a")):
        assert last(classifier(doubting, max_sweeps=most), felt(NEAR, BEYOND)) == label
    assert last(classifier(doubting), felt(FAR, A, NEAR)) == "a"
    assert last(classifier(doubting), felt(FAR, (30.0, 30.0), NEAR)) == ""
    sweeps = felt(FAR, A, NEAR)
    sweeps[1].frames.taxels[:, 1] -= 80  # displaced
    assert last(classifier(doubting), sweeps) == "a"
    sweeps[2] = replace(toy_bundle.sweep(0.0, -1.8), id=3, object=1)
    sweeps[2].frames.taxels[:, 1] -= 80  # displaced, and doubtful by the limits of these
    assert last(classifier(doubting, conflict="fuse"), sweeps[::2]) == "a"
    it, sweeps = classifier(doubting), felt(FAR, A, NEAR)
    it(sweeps[0])
    it.unfinished(sweeps[1], told(it, np.array([0.9, 0.1, 0.0])))
    assert last(it, sweeps[2:]) == "a"


def test_an_unknown_sweep_leaves_the_evidence(doubting):
    """A doubtful one between others is neither fused nor compared, nor does it delay a pause."""
    it = classifier(doubting, object_s=8.0)
    given = [it(one) for one in felt(A, FAR, A, pause_s=5)]
    assert [(v.fused, v.after) for v in given] == [(1, 0), (0, 1), (1, 2)]
    it = classifier(doubting, object_s=20.0)
    given = [it(one) for one in felt(A, FAR, A, pause_s=5)]
    assert [(v.fused, v.after) for v in given] == [(1, 0), (0, 1), (2, 2)]


@pytest.mark.parametrize("given", [np.nan, np.inf, 0.0])
def test_a_sweep_without_numbers_is_not_doubtful(doubting, given):
    """It is unknown as by itself: its answer has no probabilities, and it is joined with none."""
    it, (far, near) = classifier(doubting), felt(FAR, NEAR)
    at = next(i for i, stage in enumerate(it._stages) if isinstance(stage, KnownMaterial))
    stages = [*it._stages[:at], toy_bundle.GivenAnswer(np.array([given, 1, 1])), *it._stages[at:]]
    verdict = it.verdict(it.judged(far, stages))
    assert (verdict.status, verdict.own.tolist(), verdict.after) == (Status.UNKNOWN, [], 0)
    verdict = it(near)
    assert (verdict.label, verdict.after) == ("a", 0)


def test_checks_leave_no_doubt(doubting):
    """Golden sweeps, which are doubtful here, are joined with none and part none."""
    it, (far, near) = classifier(doubting), felt(FAR, NEAR)
    it(far)
    it.rehearse()
    assert it.refusals() == [Status.OK, Status.OK]
    assert last(it, [near]) == ""


@pytest.mark.parametrize(
    ("strangers", "label"), [("strict", ""), ("balanced", "a"), ("loose", "a")]
)
def test_doubtful_sweeps_are_compared_with_the_limit_that_applies(doubting, strangers, label):
    """The strict one makes none known; the loose one refuses none of them."""
    assert last(classifier(doubting, strangers=strangers), felt(NEAR, BEYOND)) == label
    alone = last(classifier(doubting, strangers=strangers), felt(BEYOND))
    assert alone == ("a" if strangers == "loose" else "")


def test_an_unsure_sweep_is_fused(toy):
    """Neither an unsure sweep of another label nor a sure one after unsure ones ends the object."""
    it = classifier(toy, min_probability=0.9)
    assert labels(it, A, (3.2, -1.0)) == [("a", 1), ("a", 2)]
    it.forget()
    assert labels(it, NEAR_A, B) == [("a", 1), ("b", 2)]


def test_a_contradiction_can_be_refused(toy):
    """`conflict` without a label, and the evidence stays, until NEW OBJECT."""
    it, sweeps = classifier(toy, conflict="refuse"), felt(A, B, A, B)
    given = [it(sweep) for sweep in sweeps]
    refused = ("conflict", "", 0, f"{ANOTHER}b after a")
    fused = ("ok", "a", 1, ""), ("ok", "a", 2, "")
    assert [short(v) for v in given] == [fused[0], refused, fused[1], refused]
    found = [(len(v.scores), len(v.own), v.after) for v in given]
    assert found == [(3, 3, 0), (0, 3, 1), (3, 3, 2), (0, 3, 3)]
    assert short(it(replace(sweeps[3], object=2))) == ("ok", "b", 1, "")


def test_a_refused_sweep_is_not_a_pause(toy):
    """The object goes on while sweeps of it are refused; it ends after a pause without sweeps."""
    it = classifier(toy, conflict="refuse", object_s=10)
    sweeps = felt(A, B, B, B)
    assert [short(it(sweep))[0] for sweep in sweeps] == ["ok"] + ["conflict"] * 3
    later = sweeps[-1].stop_ns + 10 * S + 1
    assert short(it(replace(sweeps[-1], id=5, start_ns=later)))[:3] == ("ok", "b", 1)


@pytest.mark.parametrize(("pause_s", "fused"), [(60.0, [1, 2, 3]), (60.5, [1, 1, 1])])
def test_a_pause_ends_an_object(toy, pause_s, fused):
    """By the times of the sweeps; the default is 60 s."""
    it = classifier(toy)
    assert [it(sweep).fused for sweep in felt(A, A, A, pause_s=pause_s)] == fused


def test_after_max_sweeps_another_object_begins(toy):
    """Whether the last answer was `ok` or `undecided`, and without the evidence of the object."""
    it = classifier(toy)
    assert [it(sweep).fused for sweep in felt(*[A] * 12)] == [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1, 2]
    it = classifier(toy, min_probability=0.999, max_sweeps=2)
    given = [short(it(sweep)) for sweep in felt(*[NEAR_A] * 3)]
    assert [g[::2] for g in given] == [("unsure", 1), ("undecided", 2), ("unsure", 1)]


@pytest.mark.parametrize(("object", "fuse"), [(0, "product"), (1, "none")])
def test_sweeps_by_themselves_end_no_object(toy, object, fuse):
    """Before NEW OBJECT and with `none` nothing is compared."""
    it = classifier(toy, fuse=fuse, conflict="refuse")
    given = [short(it(replace(sweep, object=object))) for sweep in felt(A, B)]
    assert given == [("ok", "a", 1, ""), ("ok", "b", 1, "")]


@pytest.mark.parametrize(
    ("conflict", "label", "fused"), [("new", "b", 1), ("refuse", None, 3), ("fuse", "a", 4)]
)
def test_early_answers_end_objects_too(toy, conflict, label, fused):
    """A sure one of another label; if it is refused or not ok, the sweep goes on uncounted."""
    it = classifier(toy, conflict=conflict)
    first, second, third, fourth = felt(A, A, B, A)
    assert [it(sweep).fused for sweep in (first, second)] == [1, 2]
    half = replace(third, share=0.5)
    early = it.unfinished(half, told(it, np.array([0.001, 0.999, 0.0])))
    given = it.verdict(early).label if early.status is Status.OK else None
    assert given == label
    assert it(fourth).fused == fused


def test_enrolled_labels_contradict(tmp_path):
    """A label that was enrolled counts as any other."""
    arrays = toy_bundle.means(sweeps=np.array([0, 0, 5]))
    it = classifier(toy_bundle.load(tmp_path / "enrolled", arrays=arrays, labels=2))
    given = [short(it(sweep)) for sweep in felt(A, (0.0, 6.0))]
    assert given[1] == ("ok", "c", 1, f"{ANOTHER}c after a")


def in_runs(seed: int) -> Iterable[int]:
    """Materials in random order, 2 to 4 sweeps of each."""
    rng = np.random.default_rng(seed)
    while True:
        yield from [int(rng.integers(6))] * int(rng.integers(2, 5))


ORDERS = {
    "in turn": lambda: (i % 6 for i in range(240)),
    "in random order": lambda: np.random.default_rng(8).integers(0, 6, 240).tolist(),
    "in runs": lambda: islice(in_runs(9), 240),
}


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_new_object_forgotten(default_bundle, order):
    """240 sweeps of six materials after one NEW OBJECT: 1 % wrong at most; fused over half."""

    def named(it: Classifier, sweeps: Iterable[Sweep]) -> list[str]:
        """The label of each answer, "" unless its status is ok."""
        return [v.label if v.status is Status.OK else "" for v in map(it, sweeps)]

    def drawn(materials: Iterable[int], seed: int) -> list[tuple[str, Sweep]]:
        """A sweep of each material (index into MATERIALS) with its name; attached anew every 30."""
        rng = np.random.default_rng(seed)
        places = skin.placements("T-REAL", seed)
        found = []
        for i, k in enumerate(materials):
            name, place = skin.MATERIALS[k], places[i // 30 % len(places)]
            window = skin.window(name, place, rng, skin.LEVEL_BLIND)
            found.append((name, toy_bundle.sweep_of(window)))
        return found

    truth, sweeps = zip(*drawn(ORDERS[order](), 41), strict=True)
    alone = named(classifier(default_bundle), sweeps)

    def harmed(settings: ClassifierConfig) -> int:
        given = named(classifier(default_bundle, settings), timed(sweeps))
        triples = zip(truth, alone, given, strict=True)
        return sum(own == name and answer not in ("", name) for name, own, answer in triples)

    assert harmed(ClassifierConfig()) <= 2
    assert harmed(UNTIL_NEW_OBJECT) > 120


def test_the_settings_reach_the_classifier(toy):
    """Box, shadow and replays use the same ones; the rule is with each sweep."""
    sets = ("conflict=refuse", "object_s=7.5", "max_sweeps=3", "fuse=vote", "min_probability=0.6")
    for given in ((), sets):
        settings = load([f"classifier.{text}" for text in given])
        rule = Classifier(toy, VirtualClock(), settings.classifier).rule
        chosen = asdict(settings.classifier)
        chosen["min_probability"] = chosen["min_probability"] or toy_bundle.LIMITS.unsure
        assert rule.keys() >= {"fuse", "min_probability", "max_sweeps", "conflict", "object_s"}
        assert rule == {name: chosen[name] for name in rule}
    assert (rule["conflict"], rule["object_s"], rule["max_sweeps"]) == ("refuse", 7.5, 3)


@pytest.mark.parametrize("fusion", ["product", "vote"])
def test_an_object_without_end_takes_no_more_memory_or_time(toy, fusion):
    """After 300 sweeps as small as after two, and all are fused."""
    it = classifier(toy, UNTIL_NEW_OBJECT, fuse=fusion)
    rng, given = np.random.default_rng(1), []
    sizes = []
    for n, own in enumerate(rng.dirichlet((2, 1, 1), 300), 1):
        sweep = replace(toy_bundle.sweep(0, 0), id=n, object=1)
        last = it.verdict(it.judged(sweep, told(it, own)))
        given.append(own)
        if n in (2, 300):
            sizes.append(len(pickle.dumps(it._objects.present.evidence)))
    assert sizes[1] <= sizes[0] + 32
    assert last.fused == 300
    if fusion == "product":
        together = softmax(np.log(np.maximum(given, LEAST_PROBABILITY)).sum(axis=0))
    else:
        together = np.bincount([int(p.argmax()) for p in given], minlength=3) / 300
    assert last.scores == pytest.approx(together, abs=1e-8)
