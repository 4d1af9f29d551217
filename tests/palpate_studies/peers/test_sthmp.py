"""ST-HMP: codes against scikit-learn's pursuit, pooling against plain loops, training on sets."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.core.types import SweepFormat
from palpate_train.onnx_tools import graph_builder
from tests.factories.later import Later

sthmp = Later("palpate_studies.peers.sthmp")

SETS = {"uint8": (4, 4, 90), "int16": (3, 3, 24), "uint16": (1, 1, 20), "float32": (16, 1, 128)}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dictionary that is learned quickly."""
    for name, value in {"ATOMS": 20, "SAMPLED": 300, "ROUNDS": 3}.items():
        monkeypatch.setattr(f"palpate_studies.peers.sthmp.{name}", value)


def patches(n: int, rows: int = 2, cols: int = 2, frames: int = 12) -> np.ndarray:
    """Random patches [n, frames, rows, cols] without the taxels' means."""
    x = np.random.default_rng(n).standard_normal((n, frames, rows, cols))
    return x - x.mean(axis=1, keepdims=True)


def atoms(n: int, rows: int = 2, cols: int = 2, frames: int = 12) -> np.ndarray:
    """Random atoms float32 [n, frames, rows, cols]."""
    x = patches(n, rows, cols, frames)
    return (x / np.linalg.norm(x.reshape(n, -1), axis=1)[:, None, None, None]).astype(np.float32)


def test_the_codes_are_those_of_orthogonal_matching_pursuit():
    """Each patch gets the four atoms, and the amounts of them, that scikit-learn finds."""
    linear_model = Later("sklearn.linear_model")
    x, d = patches(50), atoms(40)
    codes = sthmp.encode(x, d)
    want = linear_model.orthogonal_mp(
        d.reshape(40, -1).T.astype(np.float64), x.reshape(50, -1).T, n_nonzero_coefs=sthmp.ACTIVE
    ).T
    np.testing.assert_array_equal((codes != 0).sum(axis=1), sthmp.ACTIVE)
    np.testing.assert_allclose(codes, want, rtol=0, atol=1e-4)


def test_a_patch_of_fewer_atoms_stays_so():
    """An empty patch, one of one atom, a dictionary of one: no residual, nothing grows."""
    d = atoms(9)
    codes = sthmp.encode(np.stack([0 * d[0], -3 * d[4]]), d)
    np.testing.assert_allclose(
        codes, np.array([np.zeros(9), -3.0 * np.eye(9)[4]]), rtol=0, atol=1e-3
    )
    np.testing.assert_allclose(sthmp.encode(2 * d[:1], d[:1]), [[2]], rtol=0, atol=1e-3)


@pytest.mark.parametrize("dtype", SETS)
def test_the_features_are_largest_codes_of_each_cell(dtype: str):
    """Over the grid and its quarters, the window and its parts; any grid, signs apart."""

    def by_loops(sweep: np.ndarray, d: np.ndarray, scale: float) -> np.ndarray:
        """The features of counts [T, R, C], cell by cell."""
        frames, height, width = d.shape[1:]
        steps = range(0, len(sweep) - frames + 1, sthmp.STEP)
        rows, cols = sweep.shape[1] - height + 1, sweep.shape[2] - width + 1
        cut = [
            sweep[t : t + frames, r : r + height, c : c + width]
            for t in steps
            for r in range(rows)
            for c in range(cols)
        ]
        x = np.array(cut, np.float64) * scale
        codes = sthmp.encode(x - x.mean(axis=1, keepdims=True), d).reshape(
            len(steps), rows, cols, -1
        )

        def halves(n: int) -> list[slice]:
            return (
                [slice(0, n), slice(0, (n + 1) // 2), slice(n // 2, n)] if n > 1 else [slice(0, 1)]
            )

        spaces = [
            (r, c)
            for r in halves(rows)[1:] or halves(rows)
            for c in halves(cols)[1:] or halves(cols)
        ]
        spaces = ([(slice(0, rows), slice(0, cols))] if rows * cols > 1 else []) + spaces
        found = []
        for level in (1, 2, 4):
            for i in range(level):
                first, last = (
                    int(np.floor(i * len(steps) / level)),
                    int(np.ceil((i + 1) * len(steps) / level)),
                )
                for r, c in spaces:
                    cell = codes[first:last, r, c].reshape(-1, len(d))
                    pair = np.maximum(np.concatenate([cell.max(0), -cell.min(0)]), 0)
                    found.append(pair / np.sqrt(pair @ pair + 0.1))
            if len(steps) < 2 * level:
                break
        return np.concatenate(found)

    rows, cols, window = SETS[dtype]
    sweep = (120 + 9 * np.random.default_rng(2).standard_normal((window, rows, cols))).astype(dtype)
    d = atoms(7, min(rows, 2), min(cols, 2))
    graph = sthmp.pooled(SweepFormat(rows, cols, 50.0, window, dtype), d, 0.1)
    np.testing.assert_allclose(
        graph_builder.run(graph, sweep[None])[0], by_loops(sweep, d, 0.1), rtol=0, atol=1e-3
    )


def test_a_patch_holds_all_axes_of_its_taxels():
    """The codes are those of whole taxels, each with its axes beside each other."""
    sweep = np.random.default_rng(2).standard_normal((64, 3, 2, 3)).astype(np.float32)
    d = atoms(7, 2, 6)
    graph = sthmp.pooled(SweepFormat(3, 2, 50.0, 64, "float32", 3), d, 0.1)
    seen = []
    for r in (0, 1):
        alone = sthmp.pooled(SweepFormat(2, 6, 50.0, 64, "float32"), d, 0.1)
        seen.append(
            graph_builder.run(alone, sweep[:, r : r + 2].reshape(1, 64, 2, 6))[0].reshape(7, -1)
        )
    whole = graph_builder.run(graph, sweep[None])[0].reshape(
        7, 3, -1
    )  # per time: the grid, its upper and lower half
    np.testing.assert_allclose(whole[:, 1:].swapaxes(0, 1), seen, rtol=0, atol=1e-3)
    patch = sthmp.sample_patches(sweep[None], np.random.default_rng(0))
    assert patch.shape[1:] == (16, 2, 6)
    cut = np.stack([sweep[t : t + 16, r : r + 2] for t in range(49) for r in (0, 1)]).reshape(
        -1, 16, 2, 6
    )
    cut = cut - cut.mean(axis=1, keepdims=True)
    assert all(np.abs(cut - one).max(axis=(1, 2, 3)).min() < 1e-5 for one in patch[:20])


def test_the_dictionary_finds_what_patches_are_made_of(monkeypatch: pytest.MonkeyPatch):
    """Of patches of two out of twenty atoms most are found, and the residual is small."""
    monkeypatch.setattr("palpate_studies.peers.sthmp.ACTIVE", 2)
    monkeypatch.setattr("palpate_studies.peers.sthmp.ROUNDS", 15)
    rng, truth = np.random.default_rng(5), atoms(20).astype(np.float64)
    mix = np.zeros((1500, 20))
    for row in mix:
        row[rng.choice(20, 2, replace=False)] = rng.choice([-1, 1], 2) * rng.uniform(1, 2, 2)
    x = np.tensordot(mix, truth, 1)
    found = sthmp.learn_dictionary(x, np.random.default_rng(0))
    flat = found.reshape(20, -1)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), 1, atol=1e-5)
    alike = np.abs(flat @ truth.reshape(20, -1).T)
    assert (alike.max(axis=0) > 0.95).sum() >= 15
    assert (np.abs(flat @ flat.T) - np.eye(20)).max() < 0.999
    left = x - np.tensordot(sthmp.encode(x, found), found, 1)
    assert np.square(left).sum() < 0.1 * np.square(x).sum()
    np.testing.assert_allclose(found.mean(axis=1), 0, atol=1e-6)
