"""MultiRocket-Hydra and QUANT: aeon's answers, small windows, random states, and refusals."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from palpate.core.errors import FormatError
from palpate.inference.classifier import softmax
from palpate_studies.peers import aeon_peers
from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from tests.factories.sweep_sets import easy

NAMES = ("multirocket-hydra", "quant")
names = pytest.mark.parametrize("name", NAMES)


def train(name: str, sweeps: Dataset, seed: int = 1) -> aeon_peers.AeonModel:
    """The method trained on all sweeps."""
    return methods.find([name])[0].train(sweeps, sweeps.samples, seed)


def hard(n: int = 12) -> Dataset:
    """Noisy sweeps, so that answers differ."""
    sweeps = easy(n)
    noise = np.random.default_rng(1).normal(0, 25, sweeps.samples.shape)
    return replace(sweeps, samples=(sweeps.samples + noise).astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("materials", [3, 2])
@names
def test_the_labels_are_aeons(name: str, materials: int):
    """The labels are those of aeon's classifier with default settings and this seed, also for
    sweeps that are hard to separate."""
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
    """float32 sweeps of any window from ten frames on: logits are finite, and equal one by one and
    all at once."""
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


@pytest.mark.slow
@names
def test_silence_and_single_sweeps_are_no_trouble(name: str):
    """Logits are finite for a training set without any signal, a taxel without a signal, and one
    sweep of each material."""
    pytest.importorskip("aeon")
    sweeps = easy(4)
    silent = replace(sweeps, samples=np.full_like(sweeps.samples, 7))
    dead = replace(sweeps, samples=sweeps.samples * np.array([[0, 1], [1, 1]], np.uint8))
    for given in (silent, dead, easy(1)):
        assert np.isfinite(train(name, given).logits(sweeps.samples)).all()


@pytest.mark.slow
@names
def test_a_seed_gives_one_model_and_random_states_stay(name: str):
    """The same seed gives the same logits, another seed others; the random streams of numpy and
    PyTorch go on."""
    pytest.importorskip("aeon")
    sweeps, other = hard(20).split("recording", 0.3, 0)
    np.random.seed(4)
    before = np.random.get_state()[1].copy(), torch.get_rng_state(), torch.get_num_threads()
    first, again, another = (train(name, sweeps, seed).logits(other.samples) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, another)
    assert np.array_equal(np.random.get_state()[1], before[0])
    assert torch.equal(torch.get_rng_state(), before[1])
    assert torch.get_num_threads() == before[2]


@pytest.mark.slow
@names
def test_a_material_not_trained_on_is_never_said(name: str):
    """Its logit is far below the others, which keep their places."""
    pytest.importorskip("aeon")
    sweeps = easy(8)
    logits = train(name, sweeps.take(sweeps.labels != 1)).logits(sweeps.samples)
    assert softmax(logits)[:, 1].max() < 1e-8
    assert np.mean(logits.argmax(1)[sweeps.labels != 1] == sweeps.labels[sweeps.labels != 1]) > 0.9


@names
def test_what_cannot_be_trained_is_named(name: str, monkeypatch: pytest.MonkeyPatch):
    """A window that is too short, one material, and a missing aeon are refused; so is a graph."""
    sweeps = easy(4)
    short = replace(sweeps, samples=sweeps.samples[:, :9])
    with pytest.raises(
        FormatError, match=f"a window of 9 frames is too short for {name}; record at least 10"
    ):
        train(name, short)
    with pytest.raises(FormatError, match="only one class, 'high'"):
        train(name, sweeps.take(sweeps.labels == 2))
    for module in ("convolution_based", "interval_based"):
        monkeypatch.setitem(sys.modules, f"aeon.classification.{module}", None)
    with pytest.raises(FormatError, match=r"needs aeon .*pip install 'palpate-train\[peers\]'"):
        train(name, sweeps)
    with pytest.raises(FormatError, match=f"{name} runs in aeon alone and has no graph"):
        aeon_peers.AeonModel(name, np.zeros_like, np.arange(3), 3).graph()
