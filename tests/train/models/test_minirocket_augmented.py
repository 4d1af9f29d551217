"""MiniRocket with augmented copies: what the copies are, and that none of them leaks into what is held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from appliance.core.errors import FormatError
from appliance.sim import skin
from tests.factories.sweep_sets import easy
from train.data.sets import Dataset
from train.models import minirocket, minirocket_augmented
from train.models.compact import fit
from train.models.compact.architectures import DEFAULT
from train.models.compact.augment import augment
from train.models.networks import texture_scale


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_copies_are_changed_as_our_own_training_changes_them(dtype: str):
    """The sweeps as the networks see them, augmented with what they are augmented with, and put back into raw counts."""
    sweeps = easy(6, dtype=dtype)
    assert minirocket_augmented.COPIES == fit.COPIES
    assert minirocket_augmented.augmentation(64) == fit.default_augmentation(sweeps.format, DEFAULT)
    assert minirocket_augmented.augmentation(1500) == fit.default_augmentation(skin.FORMAT, DEFAULT)
    scale = texture_scale(sweeps.samples)
    x = sweeps.samples.reshape(18, 64, 4).transpose(0, 2, 1).astype(np.float32)
    means = x.mean(2, keepdims=True)
    rng = torch.Generator().manual_seed(5)
    y = augment(torch.from_numpy((x - means) * scale), 2, minirocket_augmented.augmentation(64), rng).numpy() / scale
    want = (y + means).transpose(0, 2, 1).reshape(sweeps.samples.shape)
    got = minirocket_augmented.changed(sweeps, 5)
    assert got.dtype == sweeps.samples.dtype
    np.testing.assert_allclose(got, want.clip(0, 255), atol=0.501 if dtype == "uint8" else 1e-2)
    assert np.mean(got != sweeps.samples) > 0.5


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_copies_keep_label_and_recording_of_their_sweep(dtype: str, monkeypatch: pytest.MonkeyPatch):
    """Twice as many beside the sweeps themselves, which come first; no two copies are equal."""
    seen: list[tuple[Dataset, np.ndarray]] = []
    monkeypatch.setattr(minirocket, "train", lambda sweeps, inputs, seed: seen.append((sweeps, inputs)))
    sweeps = easy(6, pieces=2, dtype=dtype)
    minirocket_augmented.train(sweeps, sweeps.samples, 1)
    minirocket_augmented.train(replace(sweeps, groups={}), sweeps.samples, 1)
    for several, inputs in seen:
        np.testing.assert_array_equal(several.labels, np.tile(sweeps.labels, 3))
        np.testing.assert_array_equal(inputs[:18], sweeps.samples)
        assert inputs.dtype == dtype
        assert not np.array_equal(inputs[18:36], inputs[36:])
    np.testing.assert_array_equal(seen[0][0].group("recording"), np.tile(sweeps.group("recording"), 3))
    np.testing.assert_array_equal(seen[1][0].group("recording"), np.tile(np.arange(18), 3))


@pytest.mark.slow
def test_what_is_easy_is_learnt_and_a_seed_gives_one_model(monkeypatch: pytest.MonkeyPatch):
    """Sweeps of another seed are named; the same bytes again, others for another seed; errors are those of minirocket."""
    pytest.importorskip("aeon")
    monkeypatch.setattr(minirocket, "FEATURES", 500)
    sweeps, other = easy(12), easy(12, seed=1)
    models = [minirocket_augmented.train(sweeps, sweeps.samples, seed) for seed in (1, 1, 2)]
    assert np.mean(models[0].logits(other.samples).argmax(1) == other.labels) > 0.95
    graphs = [model.graph().SerializeToString() for model in models]
    assert graphs[0] == graphs[1] != graphs[2]
    twelve = replace(sweeps, samples=sweeps.samples[:, :12])
    assert np.isfinite(minirocket_augmented.train(twelve, twelve.samples, 0).logits(twelve.samples)).all()
    short = replace(sweeps, samples=sweeps.samples[:, :8])
    with pytest.raises(FormatError, match="a window of 8 frames is too short for minirocket"):
        minirocket_augmented.train(short, short.samples, 0)
