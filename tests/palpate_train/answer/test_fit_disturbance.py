"""Allowances for disturbances are found from altered copies."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import Generator

from palpate.core.types import SweepFormat
from palpate_train.answer.fit_disturbance import DisturbanceMeter, Judge, fit
from palpate_train.answer.fit_unknown import DisturbedSweeps

MEANS = np.array([[0.0, 0, 0, 0], [12, 0, 0, 0], [0, 12, 0, 0]])
CHANGE = np.array([[0.0, 0, 0, 60], [0, 0, 0, 30], [0, 0, 0, 60]])
"""Change of each mean by lost frames of size 1."""
MOST = 0.2


def sweeps(
    rng: Generator, each: int = 80, kind: str = "lost", worst: float = 0.0
) -> DisturbedSweeps:
    """Sweeps of covariance 1 and copies with rising severity, which move by CHANGE. worst: the
    last third moves towards another material by this much more."""
    labels = np.repeat(np.arange(3), each)
    z = MEANS[labels] + rng.standard_normal((3 * each, 4))
    source = rng.permutation(len(z))
    size = np.repeat(np.arange(1, 7) / 6 * MOST, len(z) // 6)
    moved = z[source] + size[:, None] * CHANGE[labels[source]]
    moved[2 * len(z) // 3 :, :2] += worst
    values = size, np.zeros(len(z))
    return DisturbedSweeps(z, labels, {kind: (moved, source)}, {kind: values})


def judge(altered: DisturbedSweeps) -> Judge:
    return Judge(altered, MEANS, np.stack([np.eye(4)] * 3), 14.0)


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(0)


def test_the_means_move_as_the_copies_do(rng: Generator):
    """Copies that were unknown are known, and other materials stay unknown."""
    found = fit(judge(sweeps(rng)), sweeps(rng))
    (allowance,) = found.allowances
    assert (allowance.of, allowance.start) == ("lost", 0.0)
    assert allowance.end == pytest.approx(1.05 * MOST)
    assert found.changes[0].shape == (1, 3, 4)
    assert found.changes[0][0] == pytest.approx(CHANGE, abs=4)
    figures = found.figures["lost+"]
    assert figures["kept"][0] < 0.7
    assert figures["kept"][1] > 0.97
    assert figures["left out"][1] < 0.05


def test_changes_are_those_of_the_embedding_and_end_with_accuracy(rng: Generator):
    """In reverse for the second; from two thirds of the severities on another mean is near."""
    given = sweeps(rng)
    found = fit(judge(sweeps(rng)), given, given.seen_by(lambda z: z[:, ::-1]))
    assert (found.changes[1] == found.changes[0][:, :, ::-1]).all()
    found = fit(judge(sweeps(rng, worst=9.0)), sweeps(rng, worst=9.0))
    assert found.allowances[0].end == pytest.approx(1.05 * MOST * 4 / 6)


def test_stretched_copies_neither_move_the_means_nor_refuse(rng: Generator):
    """Harder than slides at another speed: the limit grows as far as they are named."""
    given = sweeps(rng, kind="stretch", worst=9.0)
    size, values = given.disturbed["stretch"]
    given = replace(given, disturbed={"stretch": (2.0 - size, values + 2.0)})
    found = fit(judge(given), given)
    (allowance,) = found.allowances
    assert (allowance.of, allowance.start) == ("speed", 2.0)
    assert allowance.end == pytest.approx(2 - 1.05 * MOST * 4 / 6, abs=1e-3)
    assert allowance.tried == pytest.approx(2 - 1.05 * MOST, abs=1e-3)
    assert not found.changes[0].any()
    assert allowance.slope > 1


def test_nothing_is_allowed_for_what_was_not_measured(rng: Generator):
    """Kinds without a disturbance, values that are not known, and few copies."""
    other = sweeps(rng, kind="drift")
    assert fit(judge(other), other).allowances == ()
    assert fit(judge(other), other).changes[0].shape == (0, 3, 4)
    few = sweeps(rng, each=8)
    assert fit(judge(few), few).allowances == ()
    given = sweeps(rng, kind="stretch")
    copied, values = given.disturbed["stretch"]
    unknown = replace(given, disturbed={"stretch": (copied, np.full_like(values, np.nan))})
    assert fit(judge(unknown), unknown).allowances == ()


def test_changes_that_do_not_help_are_left_out(rng: Generator):
    """The copies move in random directions, so the means stay and the limit grows."""

    def jittered(seed: int) -> DisturbedSweeps:
        given = sweeps(np.random.default_rng(seed))
        z, source = given.copies["lost"]
        size = given.disturbed["lost"][0]
        steps = np.random.default_rng(seed + 9).standard_normal(z.shape)
        return replace(
            given, copies={"lost": (given.z[source] + 12 * size[:, None] * steps, source)}
        )

    found = fit(judge(jittered(1)), jittered(2))
    assert found.allowances[0].slope > 0.5
    assert np.abs(found.changes[0].astype(float)).max() < 12


def test_hum_is_removed_only_where_training_has_none():
    """A periodic texture in phase on all taxels at 50 Hz ends the removal."""
    format = SweepFormat(4, 4, 750.0, 1500, "uint8")
    rng, times = np.random.default_rng(0), np.arange(1500)[:, None, None] / 750
    plain = 100 + 3 * rng.standard_normal((6, 1500, 4, 4))
    humming = plain + 6 * np.sin(2 * np.pi * 50 * times)

    def meter(x: np.ndarray) -> DisturbanceMeter:
        return DisturbanceMeter(format, np.zeros((4, 4)), np.rint(x).astype(np.uint8))

    usual = meter(plain)
    assert usual.hum == 3.5
    clean, removed = usual.clean(np.rint(humming).astype(np.uint8))
    assert removed == pytest.approx(np.full(6, 6), rel=0.05)
    assert clean.std() < 3.3
    periodic = meter(humming)
    assert periodic.hum is None
    assert not periodic.clean(np.rint(humming).astype(np.uint8))[1].any()
