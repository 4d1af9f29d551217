"""MultiRocket-Hydra and QUANT: aeon's answers, small windows, random states, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

aeon_peers = Later("palpate_studies.peers.aeon_peers")

NAMES = ("multirocket-hydra", "quant")
names = pytest.mark.parametrize("name", NAMES)


def train(name: str, sweeps: Dataset, seed: int = 1) -> aeon_peers.AeonModel:
    """The method trained on all sweeps."""
    return methods.find([name])[0].train(sweeps, sweeps.samples, seed)


@pytest.mark.slow
@pytest.mark.parametrize("materials", [3, 2])
@names
def test_the_labels_are_aeons(name: str, materials: int):
    """aeon's classifier with default settings and this seed, also on hard sweeps."""

    def hard(n: int = 12) -> Dataset:
        """Noisy sweeps, so that answers differ."""
        sweeps = easy(n)
        noise = np.random.default_rng(1).normal(0, 25, sweeps.samples.shape)
        return replace(sweeps, samples=(sweeps.samples + noise).astype(np.float32))

    rockets = pytest.importorskip("aeon.classification.convolution_based")
    from aeon.classification.interval_based import QUANTClassifier

    sweeps = hard()
    sweeps = sweeps.take(sweeps.labels < materials)
    train_part, test = sweeps.split("recording", 0.5, 0)
    kind = QUANTClassifier if name == "quant" else rockets.MultiRocketHydraClassifier
    x, y = (aeon_peers.series(part.samples) for part in (train_part, test))
    want = kind(random_state=3).fit(x, train_part.labels).predict(y)
    logits = train(name, train_part, 3).logits(test.samples)
    assert logits.dtype == np.float32
    assert logits.shape == (len(test), 3)
    np.testing.assert_array_equal(logits.argmax(1), want)


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "taxels"), [(80, 16), (128, 1), (24, 1), (10, 1)])
@names
def test_small_windows_and_one_channel(name: str, frames: int, taxels: int):
    """float32 sweeps of ten and more frames: finite logits, equal one by one and all at once."""
    pytest.importorskip("aeon")
    rng, labels = np.random.default_rng(0), np.arange(12) % 3
    samples = (
        rng.standard_normal((12, frames, taxels, 1)) * (1 + labels[:, None, None, None])
    ).astype(np.float32)
    model = train(name, Dataset(samples, labels, ("a", "b", "c"), 100.0))
    logits = model.logits(samples)
    assert np.isfinite(logits).all()
    np.testing.assert_allclose(
        np.concatenate([model.logits(x[None]) for x in samples]), logits, atol=1e-2
    )
