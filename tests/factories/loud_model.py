"""A model that needs no training, its method, and sweeps of its two materials."""

from dataclasses import dataclass, field

import numpy as np
import onnx
from onnx import TensorProto

from palpate.core.types import SweepFormat
from palpate_train.data.sets import Dataset
from palpate_train.models.methods import Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, GraphModel, run
from palpate_train.onnx_tools.quantize import quantize

FORMAT = SweepFormat(2, 2, 100.0, 40, "uint8")


def sweeps(kind: str = "uint8", n: int = 24) -> Dataset:
    """Sweeps of two materials at six positions. The second material is louder."""
    labels = np.arange(n) % 2
    noise = (
        np.random.default_rng(5).standard_normal((n, 40, 2, 2))
        * (2 + 18 * labels)[:, None, None, None]
    )
    groups = {"position": np.arange(n) // 4, "recording": np.arange(n)}
    return Dataset(
        (100 + noise).clip(0, 255).astype(kind), labels, ("soft", "loud"), 100.0, groups, "small"
    )


def loudness(format: SweepFormat = FORMAT) -> onnx.ModelProto:
    """A graph that distinguishes both by the mean size of differences."""
    g, taxels = GraphBuilder(), format.rows * format.cols
    x = g(
        "Cast",
        g("Reshape", "sweep", g.constant([1, format.window, taxels], "int64")),
        to=TensorProto.FLOAT,
    )
    x = g("Transpose", x, perm=[0, 2, 1])
    taps = np.zeros((3, taxels, 2))
    taps[:, :, 0], taps[:, :, 1] = 1, -1
    x = g("Relu", g("Conv", x, g.constant(taps), g.constant(np.zeros(3)), strides=[1]))
    x = g("ReduceMean", x, axes=[2], keepdims=0)
    g("Gemm", x, g.constant([[-1, 1]] * 3), g.constant([45, -45]), output="logits")
    return g.model(format, "logits", 2)


@dataclass
class Loud:
    """A model in two precisions."""

    model: onnx.ModelProto
    precisions: dict[str, GraphModel] = field(default_factory=dict)

    def logits(self, given: np.ndarray) -> np.ndarray:
        return run(self.model, given)

    def graph(self) -> onnx.ModelProto:
        return self.model


def loud(calls: list[int]) -> Method:
    """A method that needs no training. `calls` gets an entry for each training."""

    def train(known: Dataset, given: np.ndarray, seed: int) -> Loud:
        calls.append(seed)
        return Loud(loudness(), {"int8": GraphModel(quantize(loudness(), given))})

    return Method("L-gauss", "for tests", "raw", train)
