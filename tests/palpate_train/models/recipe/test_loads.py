"""Loads of taxels as features: their means, and the movements of the first and the last tenth."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate_train.models.recipe import loads
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.onnx_tools.graph_builder import FLOAT, GraphBuilder, run


@pytest.mark.parametrize(
    "format",
    [
        skin.FORMAT,
        skin.SHEAR_FORMAT,
        replace(skin.FORMAT, window=83, dtype="uint16"),
        replace(skin.FORMAT, window=16, rows=1, cols=1),
    ],
    ids=str,
)
def test_means_and_movements_are_those_of_the_window(format: SweepFormat) -> None:
    """Also of each prefix, which depends on no frame after it."""
    scale = 0.5

    def expected(format: SweepFormat, samples: np.ndarray, end: int) -> np.ndarray:
        """The same by numpy, of the first `end` frames."""
        x = samples.reshape(len(samples), format.window, -1) * scale
        total = x.reshape(len(x), format.window, -1, format.axes).mean(axis=2)
        tenth = max(format.window // PREFIXES, 1)
        mean = total[:, :end].mean(axis=1)
        first, last = (
            total[:, :tenth].mean(axis=1),
            total[:, max(end - tenth, 0) : end].mean(axis=1),
        )
        return np.hstack([x[:, :end].mean(axis=1), first - mean, last - mean])

    def features(format: SweepFormat, samples: np.ndarray, prefixes: bool) -> np.ndarray:
        """The loads of raw counts, by a graph that has nothing else."""
        g, rows, size = GraphBuilder(), PREFIXES if prefixes else 1, loads.count(format)
        raw = g("Reshape", "sweep", g.constant([1, format.window, format.channels], "int64"))
        found = loads.nodes(g, g("Cast", raw, to=FLOAT), format, scale, prefixes)
        shape = (rows, size) if prefixes else (size,)
        g("Reshape", found, g.constant([1, *shape], "int64"), output="features")
        return run(g.model(format, "features", *shape), samples)

    rng = np.random.default_rng(0)
    drift = np.linspace(0, 60, format.window)[:, None, None]
    shape = (3, format.window, format.rows, format.cols)
    counts = rng.integers(0, 120, shape) + drift
    if format.axes > 1:
        counts = counts[..., None] + rng.integers(0, 60, format.axes)
    samples = counts.astype(format.numpy_type)
    whole = features(format, samples, False)
    np.testing.assert_allclose(whole, expected(format, samples, format.window), atol=2e-4)
    tenths = features(format, samples, True)
    assert tenths.shape == (3, PREFIXES, loads.count(format))
    for number in range(PREFIXES):
        end = max(format.window * (number + 1) // PREFIXES, 1)
        np.testing.assert_allclose(tenths[:, number], expected(format, samples, end), atol=2e-4)
    later = samples.copy()
    later[:, format.window // 2 :] = 0
    changed = features(format, later, True)
    np.testing.assert_array_equal(changed[:, :5], tenths[:, :5])
