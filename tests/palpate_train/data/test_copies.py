"""Augmented copies of raw counts: changes, invariants, and independence of PyTorch."""

from dataclasses import fields, replace

import numpy as np
import pytest

from palpate_train.data.augment import BATCH, Augmentation, augment, copies, texture_scale
from tests.factories.sweep_sets import easy

STILL = Augmentation(**{f.name: 0.0 for f in fields(Augmentation)})
TYPES = ("uint8", "int16", "uint16", "float32")


@pytest.mark.parametrize("dtype", TYPES)
def test_without_augmentation_copies_are_the_sweeps_themselves(dtype: str):
    """As many as asked for, with type, labels and groups, also beyond one batch."""
    sweeps = easy(BATCH // 2, dtype=dtype)
    made = list(copies(sweeps, STILL, 5, 3))
    assert len(made) == 3
    for copy in made:
        assert copy.samples.dtype == sweeps.samples.dtype
        np.testing.assert_allclose(
            copy.samples, sweeps.samples, atol=1e-3 if dtype == "float32" else 0
        )
        for name in (f.name for f in fields(sweeps) if f.name != "samples"):
            np.testing.assert_equal(getattr(copy, name), getattr(sweeps, name))
    assert list(copies(sweeps, STILL, 5, 0)) == []


@pytest.mark.parametrize("dtype", TYPES)
def test_copies_are_augmented_raw_counts(dtype: str):
    """The texture is augmented on the networks' scale, around the mean of each taxel."""
    sweeps = easy(6, dtype=dtype)
    scale = texture_scale(sweeps.samples)
    x = sweeps.samples.reshape(18, 64, 4).transpose(0, 2, 1).astype(np.float32)
    means = x.mean(axis=2, keepdims=True)
    y = augment((x - means) * scale, 2, Augmentation(), np.random.default_rng(5)) / scale + means
    want = y.transpose(0, 2, 1).reshape(sweeps.samples.shape)
    if dtype != "float32":
        want = want.clip(np.iinfo(dtype).min, np.iinfo(dtype).max)
    (got,) = copies(sweeps, Augmentation(), 5, 1)
    np.testing.assert_allclose(got.samples, want, atol=0.501 if dtype != "float32" else 1e-3)
    assert (got.samples != sweeps.samples).any(axis=(1, 2, 3)).all()


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [("uint8", 0, 255), ("int16", -32768, 32767), ("uint16", 0, 65535)]
)
def test_what_the_data_type_cannot_hold_is_clipped(dtype: str, low: int, high: int):
    """Strong gains reach both ends of the range, and no value wraps around."""
    sweeps = easy(6, dtype=dtype)
    rng = np.random.default_rng(2)
    sweeps = replace(
        sweeps, samples=rng.integers(low, high, sweeps.samples.shape, endpoint=True).astype(dtype)
    )
    (made,) = copies(sweeps, replace(STILL, gain=1.0), 1, 1)
    assert (made.samples.min(), made.samples.max()) == (low, high)
    means = sweeps.samples.mean(axis=1, keepdims=True)
    far = np.abs(sweeps.samples - means) > (high - low) / 4
    assert ((sweeps.samples > means) == (made.samples > means))[far].all()


def test_a_seed_gives_the_same_copies_and_each_differs():
    """Another seed gives other copies; the sweeps themselves do not change."""
    sweeps = easy(4)
    before = sweeps.samples.copy()
    once, again, other = (
        [c.samples for c in copies(sweeps, Augmentation(), seed, 2)] for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once[0], once[1])
    assert not np.array_equal(once[0], other[0])
    np.testing.assert_array_equal(sweeps.samples, before)
