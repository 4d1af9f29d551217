"""Displaced sweeps on Gaussians: variation like that of copies is known, other is not."""

from functools import partial

import numpy as np
import pytest

from palpate.answer.unknown import Classes
from palpate_train.answer import embedding, fit_contact
from palpate_train.answer.fit_contact import AugmentedCopies

PLAIN = partial(embedding.embed, fixed=2)

MEANS = 8 * np.eye(4)[:3]


def sweeps(n: int, seed: int, spread: float = 0.0):
    """n sweeps of each of three materials at each of eight positions, features [N, 4]; the last two
    are untrained, and the third varies by `spread` more."""
    rng = np.random.default_rng(seed)
    labels, groups = np.tile(np.repeat(np.arange(3), n), 8), np.repeat(np.arange(8), 3 * n)
    x = MEANS[labels] + rng.standard_normal((len(labels), 4))
    x[:, 3] += spread * rng.standard_normal(len(labels))
    return x, labels, groups


def made(n: int = 20, wrong: float = 0.0):
    """A DisplacementFit; a share `wrong` of held-out copies gets an unlikely wrong label."""
    x, labels, groups = sweeps(n, 0)
    held = groups >= 6
    copies, copied_labels, copied_groups = sweeps(n, 1, spread=10)
    copied = AugmentedCopies(copies, copied_labels, np.arange(len(x)), copied_groups >= 6)
    truth = copied_labels[copied_groups >= 6]
    logits = 4 * np.eye(3)[truth]
    others = np.arange(len(truth)) < wrong * len(truth)
    logits[others] = 1.2 * np.eye(3)[(truth[others] + 1) % 3]
    return (
        embedding.embed(x, labels, 2),
        fit_contact.fit(x, labels, groups, held, PLAIN, copied, logits),
        copied,
    )


def test_distances_leave_out_what_the_copies_vary_in():
    """Far in their direction is beyond the limit in place alone; means.npz gives the same."""
    z, fit, _ = made()
    assert fit
    x = sweeps(50, 5, spread=10)[0]
    turned = fit.embedding.novelty(z(x))
    assert 0.95 < np.mean(turned <= fit.rule.limit) <= 1
    assert np.mean(z.novelty(x) <= embedding.limit(z.novelty(sweeps(50, 6)[0]))) < 0.6
    x[:, 1] += 30
    assert (fit.embedding.novelty(z(x)) > fit.rule.limit).all()
    classes = fit.classes(z.classes())
    assert isinstance(classes, Classes)
    assert classes.displaced
    x = sweeps(3, 7)[0]
    away = (z(x) @ classes.displaced.turn)[:, None] - classes.displaced.means
    want = fit.embedding(z(x))[:, None] - fit.embedding.means
    assert (away**2).sum(axis=2) == pytest.approx((want**2).sum(axis=2), rel=1e-3, abs=1e-3)


def test_the_turned_embedding_keeps_all_directions():
    """Also those towards junk: a bundle holds a square matrix."""
    x, labels, groups = sweeps(20, 0)
    x = np.hstack([np.random.default_rng(2).standard_normal((len(x), 4)), x])
    held, towards = groups >= 6, 9 * np.eye(8)[:2]
    copied = AugmentedCopies(x, labels, np.arange(len(x)), held)
    embedded = partial(embedding.embed, fixed=2, beyond=towards)
    fit = fit_contact.fit(x, labels, groups, held, embedded, copied, 4 * np.eye(3)[labels[held]])
    assert fit
    displaced = fit.classes(embedded(x, labels).classes()).displaced
    assert displaced
    assert displaced.turn.shape == (6, 6)
    assert displaced.means.shape == (3, 6)


def test_a_moved_sweep_must_be_surer_where_copies_get_wrong_labels():
    """Ten in a hundred at .62 ask for more; none for none; half, surely wrong, for too much."""
    _, fit, _ = made()
    assert fit
    assert (fit.rule.unsure, fit.rule.temperature) == (fit_contact.UNSURE[0], 1)
    _, fit, _ = made(wrong=0.1)
    assert fit
    assert 0.5 < fit.rule.unsure < 0.95
    p = np.exp(1.2 / fit.rule.temperature) / (2 + np.exp(1.2 / fit.rule.temperature))
    assert fit.rule.unsure > p
    x, labels, groups = sweeps(10, 0)
    copied = AugmentedCopies(x, labels, np.arange(len(x)), groups >= 6)
    truth = labels[groups >= 6]
    logits = 40.0 * np.eye(3)[(truth + (np.arange(len(truth)) % 2)) % 3]
    logits[:, :] = np.where(logits > 0, 1e6, 0)
    fit = fit_contact.fit(x, labels, groups, groups >= 6, PLAIN, copied, logits)
    assert fit
    assert fit.rule.unsure == fit_contact.NEVER


def test_without_copies_that_judge_there_is_no_rule():
    """None without held-out copies, without copies of a material, or of one only held out."""
    x, labels, groups = sweeps(10, 0)
    held = groups >= 6
    none = AugmentedCopies(x[:0], labels[:0], groups[:0], held[:0])
    assert fit_contact.fit(x, labels, groups, held, PLAIN, none, np.zeros((0, 3))) is None
    copied = AugmentedCopies(x, labels, np.arange(len(x)), held)
    logits = np.zeros((int(held.sum()), 3))
    lacking = copied.take((labels < 2) | held)
    assert fit_contact.fit(x, labels, groups, held, PLAIN, lacking, logits) is None
    some = (labels < 2) | held
    assert (
        fit_contact.fit(x[some], labels[some], groups[some], held[some], PLAIN, copied, logits)
        is None
    )
