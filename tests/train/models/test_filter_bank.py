"""The filter bank: its graph against the definition, what it cannot see, and what cannot be trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat
from tests.factories.sweep_sets import easy
from train.models import filter_bank
from train.models.filter_bank import DILATIONS, FLOOR, TAPS
from train.onnx_tools import graph_builder

FORMS = [
    SweepFormat(2, 2, 100.0, 64, "uint8"),
    SweepFormat(3, 3, 50.0, 40, "int16"),
    SweepFormat(1, 1, 10.0, 9, "uint16"),
    SweepFormat(4, 4, 750.0, 600, "float32"),
]
forms = pytest.mark.parametrize("form", FORMS, ids=str)


def counts(form: SweepFormat, n: int = 3) -> np.ndarray:
    """Random walks [n, T, R, C] of raw counts."""
    walk = np.random.default_rng(7).integers(-3, 4, (n, form.window, form.rows, form.cols)).cumsum(axis=1)
    return (1000 * (form.dtype != "uint8") + 100 + walk - walk.min()).astype(form.dtype)


def small(form: SweepFormat) -> filter_bank.Bank:
    """Twenty filters."""
    return filter_bank.draw(form, np.random.default_rng(3), 20)


@forms
def test_the_graph_is_the_definition(form: SweepFormat):
    """Each response tap by tap; log of its mean magnitude, share above its threshold."""
    bank, given, limits = small(form), counts(form), np.linspace(-2, 2, 20, dtype=np.float32)
    got = graph_builder.run(filter_bank.features(form, bank, 3.0, limits), given)
    stride, order = max(1, form.window // filter_bank.SAMPLES), np.argsort(bank.dilations, kind="stable")
    for sweep, row in zip(given.reshape(len(given), form.window, -1).astype(np.float64), got, strict=True):
        want = {}
        for k, (weights, dilation) in enumerate(zip(bank.weights, bank.dilations, strict=True)):
            starts = range(0, form.window - (TAPS - 1) * dilation, stride)
            y = np.array([sum(weights[:, tap] @ sweep[at + tap * dilation] for tap in range(TAPS)) for at in starts])
            want[k] = np.log(np.abs(y).mean() + FLOOR * 3.0), np.mean(y > limits[k])
        at = 0
        for dilation in np.unique(bank.dilations):
            chosen = [k for k in order if bank.dilations[k] == dilation]
            np.testing.assert_allclose(row[at : at + len(chosen)], [want[k][0] for k in chosen], atol=2e-3)
            shares = row[at + len(chosen) : at + 2 * len(chosen)]
            np.testing.assert_allclose(shares, [want[k][1] for k in chosen], atol=1.5 / len(starts))
            at += 2 * len(chosen)


@forms
def test_filters_sum_to_zero_on_every_taxel_and_fit_the_window(form: SweepFormat):
    """Unit norm; only dilations that fit; some filters see one taxel alone and some see all."""
    bank = filter_bank.draw(form, np.random.default_rng(0), 200)
    np.testing.assert_allclose(bank.weights.sum(axis=2), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(bank.weights, axis=(1, 2)), 1, atol=1e-5)
    assert set(bank.dilations) == {d for d in DILATIONS if 8 * d < form.window}
    seen = (bank.weights != 0).any(axis=2).sum(axis=1)
    assert (seen.min(), seen.max()) == (1, form.rows * form.cols)


def test_thresholds_leave_the_share_that_was_asked_for():
    """Over the sweeps they were taken from."""
    form, above = FORMS[0], np.linspace(0.1, 0.9, 20)
    given = counts(form, 12)
    limits = filter_bank.thresholds(form, small(form), given, above)
    shares = graph_builder.run(filter_bank.features(form, small(form), 1.0, limits), given).mean(axis=0)
    at, found = 0, []
    for dilation in np.unique(small(form).dilations):
        n = int((small(form).dilations == dilation).sum())
        found += list(shares[at + n : at + 2 * n])
        at += 2 * n
    np.testing.assert_allclose(np.sort(found), np.sort(above), atol=0.02)


@pytest.mark.slow
def test_what_is_easy_is_learnt_and_an_offset_changes_nothing():
    """Held-out sweeps are named rightly; the same with another offset on each taxel get the same logits."""
    sweeps, other = easy(20), easy(20, seed=1)
    model = filter_bank.train(sweeps, sweeps.samples, 1)
    logits = model.logits(other.samples)
    assert np.mean(logits.argmax(1) == other.labels) > 0.95
    raised = other.samples.astype(np.int16) + np.arange(4).reshape(1, 1, 2, 2)
    assert raised.max() <= 255
    np.testing.assert_allclose(model.logits(raised.astype(np.uint8)), logits, atol=0.05)
    assert np.isfinite(model.logits(np.full((1, 64, 2, 2), 255, np.uint8))).all()


def test_a_seed_gives_one_model(monkeypatch: pytest.MonkeyPatch):
    """The same bytes for the same seed, others for another."""
    monkeypatch.setattr(filter_bank, "FILTERS", 60)
    sweeps = easy(8)
    graphs = [filter_bank.train(sweeps, sweeps.samples, seed).graph().SerializeToString() for seed in (1, 1, 2)]
    assert graphs[0] == graphs[1] != graphs[2]


def test_what_cannot_be_trained_is_named():
    """Too short a window, one material, one sweep a material, constant windows."""
    sweeps = easy(8)
    short = replace(sweeps, samples=sweeps.samples[:, :8])
    with pytest.raises(FormatError, match="a window of 8 frames is too short for filter-bank; record at least 9"):
        filter_bank.train(short, short.samples, 0)
    one = sweeps.take(sweeps.labels == 2)
    with pytest.raises(FormatError, match="only one class, 'high'"):
        filter_bank.train(one, one.samples, 0)
    few = sweeps.take(np.unique(sweeps.labels, return_index=True)[1])
    with pytest.raises(FormatError, match="3 sweeps of as many materials are too few"):
        filter_bank.train(few, few.samples, 0)
    flat = replace(sweeps, samples=np.full_like(sweeps.samples, 7))
    with pytest.raises(FormatError, match="every taxel of every sweep is constant"):
        filter_bank.train(flat, flat.samples, 0)
