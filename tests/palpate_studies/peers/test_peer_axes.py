"""Every method on a skin with three axes: it trains, and its graph takes [1, T, R, C, A] and
answers as the desktop does."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from palpate_train.models.methods import Effort
from palpate_train.onnx_tools import graph_builder
from tests.factories.costly import quick_first
from tests.factories.sheared import sheared

BRIEF = Effort(share=0.01)


@pytest.fixture(scope="module")
def sweeps() -> Dataset:
    """Half a second of six tubes at nine positions."""
    return sheared(1, frames=360)


@pytest.mark.slow
@pytest.mark.parametrize("name", quick_first(methods.every()))
def test_a_method_takes_three_axes(name: str, sweeps: Dataset):
    """Logits are finite, also those of the graph if there is one; other shear gives other
    logits."""
    (method,) = methods.find([name], BRIEF)
    if method.extra:
        pytest.importorskip("aeon", reason="aeon comes with palpate-train[peers]")
    given = methods.model_inputs(method.input, sweeps)
    model = method.train(sweeps, given, 1)
    logits = model.logits(given[:4])
    assert logits.shape == (4, 6)
    assert np.isfinite(logits).all()
    if not method.library:
        np.testing.assert_allclose(
            graph_builder.run(model.graph(), given[:4]), logits, atol=2e-3, rtol=1e-3
        )
    if method.input == "raw" and not method.library:
        (shape,) = {
            tuple(d.dim_value for d in i.type.tensor_type.shape.dim)
            for i in model.graph().graph.input
        }
        assert shape == (1, 360, 2, 2, 3)
        other = given[:4].copy()
        other[..., 0] = np.roll(other[..., 0] * 3, 1, axis=0)
        assert (model.logits(other) != logits).any(), "shear is not looked at"
