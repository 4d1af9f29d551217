"""MiniRocket with augmented copies: never of a held-out sweep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate_train.data.augment import copies
from palpate_train.data.sets import Dataset
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

minirocket_augmented = Later("palpate_studies.peers.minirocket_augmented")


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_copies_keep_label_and_recording_of_their_sweep(
    dtype: str, monkeypatch: pytest.MonkeyPatch
):
    """There are two copies of each sweep, after the sweeps themselves; no two copies are equal."""
    seen: list[tuple[Dataset, np.ndarray]] = []
    monkeypatch.setattr(
        "palpate_studies.peers.minirocket.train",
        lambda sweeps, inputs, seed: seen.append((sweeps, inputs)),
    )
    sweeps = easy(6, pieces=2, dtype=dtype)
    minirocket_augmented.train(sweeps, sweeps.samples, 1)
    minirocket_augmented.train(replace(sweeps, groups={}), sweeps.samples, 1)
    changed = copies(sweeps, minirocket_augmented.augmentation(64), 1, 2)
    for copy, start in zip(changed, (18, 36), strict=True):
        np.testing.assert_array_equal(seen[0][1][start : start + 18], copy.samples)
    for several, inputs in seen:
        np.testing.assert_array_equal(several.labels, np.tile(sweeps.labels, 3))
        np.testing.assert_array_equal(inputs[:18], sweeps.samples)
        assert inputs.dtype == dtype
        assert not np.array_equal(inputs[18:36], inputs[36:])
    np.testing.assert_array_equal(
        seen[0][0].group("recording"), np.tile(sweeps.group("recording"), 3)
    )
    np.testing.assert_array_equal(seen[1][0].group("recording"), np.tile(np.arange(18), 3))
