"""The check of unknown materials in unfinished sweeps, and the limit of displaced ones."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.unknown import EarlyDistances
from palpate.bundle import bundle
from palpate_train.answer import fit_contact, fit_early
from palpate_train.data import sets


def test_known_sweeps_are_within_the_limits_and_others_are_not():
    """Of 400 new sweeps a share of KEPT; of those of another material none."""
    rng = np.random.default_rng(0)
    means = np.array([[[0, 0, 0], [8, 0, 0]], [[0, 0, 0], [9, 0, 0]]])  # [D, K, r]
    labels = rng.integers(2, size=800)
    z = means[:, labels].swapaxes(0, 1) + rng.standard_normal((800, 2, 3)) * [2, 1, 0.5]
    seen, new = slice(0, 400), slice(400, 800)
    classes = fit_early.early_classes(z[seen], labels[seen])
    assert np.allclose(classes.means, means, atol=0.5)
    limits = fit_early.early_limits(classes, z[new])
    distances = EarlyDistances(classes, limits)
    known = np.stack([distances.known(sweep) for sweep in z[new]])
    assert known.mean(axis=0) == pytest.approx(fit_early.KEPT, abs=0.01)
    assert not distances.known(np.array([[0, 0, 6], [0, 0, 6]])).any()


def test_limits_of_training_sweeps_are_told_where_there_is_a_rule():
    """As far as in the copies, both limits; without the rules nothing is said or changed."""
    packaged = bundle.load(bundle.DEFAULT).manifest
    assert packaged.displacement
    assert packaged.contact
    train = sets.load("sim:T-REAL/level-blind:41:2")
    without = replace(packaged.displacement, farthest_mm=None)
    manifest = fit_contact.limited(replace(packaged, displacement=without), train)
    assert manifest.displacement
    copies_mm = manifest.displacement.farthest_mm - packaged.contact.limit_mm
    assert copies_mm == pytest.approx(1.9, abs=0.4)  # of a pitch of 4 mm
    assert "up to" in fit_contact.text(manifest)
    assert "9 steps" in fit_early.text(packaged)
    manifest = bundle.load(bundle.DEFAULT).manifest
    bare = replace(manifest, early=None, displacement=None)
    assert fit_early.text(bare) == fit_contact.text(bare) == ""
    sweeps = sets.load("sim:T-REAL/level-blind:41:1")
    assert fit_contact.limited(bare, sweeps) is bare
