"""Limits of the window check that are fitted to a skin."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.window import WindowLimits, inspect
from palpate.core.types import Status
from palpate_train.answer import fit_window
from palpate_train.data.sets import Dataset

USUAL, TARE = WindowLimits(contact=10, full_scale=255), np.zeros((3, 3))


def skin(n: int = 40) -> Dataset:
    """Loaded and varying taxels, 3 x 3."""
    counts = np.random.default_rng(0).integers(60, 140, (n, 50, 3, 3)).astype(np.uint8)
    return Dataset(counts, np.arange(n) % 2, ("a", "b"), 15.0, {}, "skin")


def spoiled(share: float, count: int, taxels: int) -> Dataset:
    """The skin with this count on so many taxels throughout, in this share of its sweeps."""
    sweeps = skin()
    sweeps.samples.reshape(40, 50, 9)[: round(share * 40), :, :taxels] = count
    return sweeps


def refused(sweeps: Dataset, limits: WindowLimits) -> int:
    found = fit_window.findings(sweeps, limits, TARE)
    return sum(one.status is not Status.OK for one in found)


@pytest.mark.parametrize(("count", "taxels"), [(100, 1), (100, 3), (255, 1), (255, 4)])
def test_limits_keep_what_a_skin_does_in_many_of_its_sweeps(count: int, taxels: int):
    """Constant taxels and full counts pass where many sweeps have them, and no more of them."""
    sweeps = spoiled(0.5, count, taxels)
    assert refused(sweeps, USUAL) == 20
    limits = fit_window.fitted(USUAL, (sweeps, skin()), TARE)
    assert refused(sweeps, limits) == 0
    assert refused(spoiled(1.0, count, taxels + 1), limits) == 40
    other = 255 if count == 100 else 100
    assert refused(spoiled(1.0, other, 1), limits) == 40


def test_a_few_faulty_sweeps_and_a_wrong_full_scale_change_nothing():
    """The usual limits refuse them, as on a sound skin; neither a full scale below the counts nor
    sweeps without a contact change them."""
    for sweeps in (skin(), spoiled(0.05, 100, 2), spoiled(0.05, 255, 9)):
        assert fit_window.fitted(USUAL, (sweeps,), TARE) == USUAL
    low = replace(USUAL, full_scale=100)
    assert fit_window.fitted(low, (skin(),), TARE) == low
    lifted = replace(skin(), samples=skin().samples // 50)
    assert fit_window.fitted(USUAL, (lifted,), TARE) == USUAL


def test_a_dead_skin_and_enclosed_dead_taxels():
    """One taxel at least has to vary; a dead taxel between loaded ones counts as a stuck one."""
    limits = fit_window.fitted(USUAL, (spoiled(1.0, 100, 9),), TARE)
    assert limits.dead_taxels == 8
    sweeps = skin()
    sweeps.samples[:, :, 1, 1] = 0
    limits = fit_window.fitted(USUAL, (sweeps,), TARE)
    assert limits.dead_taxels == inspect(sweeps.samples[0], TARE, limits).silent == 1
