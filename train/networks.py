"""The room of networks. In: the form of a sweep. Out: the compact network in PyTorch, and graphs in ONNX.

The ONNX graphs are written node by node: what runs on the box is what stands here, with fixed shapes and no tracer's
surprises. They take the sensor's own digits; all scaling is inside.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.errors import FormatError
from appliance.sweep import SweepFormat

CHANNELS = 32
"""Of each stage: the fewest for which Arm's symmetric int8 kernel is used."""
FLOOR = 0.02
"""Added to a mean activation before its logarithm: a silent channel stays finite."""
LEAST_STEPS = 24
"""Time steps that the last stage should have: a mean over less is mostly noise."""
TENSOR = {
    "uint8": TensorProto.UINT8,
    "int16": TensorProto.INT16,
    "uint16": TensorProto.UINT16,
    "float32": TensorProto.FLOAT,
}
OPSET, IR = 17, 8


def stages(window: int) -> tuple[tuple[int, int], ...]:
    """(kernel, stride) of the three stages for a window of so many frames.

    The first stride is the largest of 4, 2, 1 that leaves LEAST_STEPS after the last stage, and 1 where none does; its
    kernel is four strides. 1500 frames: 16/4, then 5/2 twice. 128 frames: 4/1, then 5/2 twice.
    Raises FormatError where the window is too short for any.
    """
    for stride in (4, 2, 1):
        plan = ((4 * stride, stride), (5, 2), (5, 2))
        steps = window
        for kernel, by in plan:
            steps = (steps - kernel) // by + 1
        if steps >= LEAST_STEPS:
            return plan
    if steps < 1:
        raise FormatError(f"a window of {window} frames is too short for the network; record at least 16")
    return plan


class Compact(nn.Module):
    """Three strided convolutions over time with the taxels as channels; the head sees each one's mean activation.

    Each taxel's mean over the window is taken away first: what is left is texture, and int8 does not spend its range
    on the offset. `scale` makes the rest about 1. Batch norms serve training only; `fused` folds them in.
    keep_means: show the head the means as well, for comparison: where materials were recorded one after another they
    tell the session rather than the material.
    """

    def __init__(
        self, form: SweepFormat, classes: int, scale: float, norm: bool = True, keep_means: bool = False
    ) -> None:
        super().__init__()
        self.form, self.scale, self.keep_means = form, scale, keep_means
        plan = stages(form.window)
        inputs = (form.rows * form.cols,) + (CHANNELS,) * (len(plan) - 1)
        self.convs = nn.ModuleList(nn.Conv1d(n, CHANNELS, k, s) for n, (k, s) in zip(inputs, plan, strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm1d(CHANNELS) if norm else nn.Identity() for _ in plan)
        self.head = nn.Linear(CHANNELS * len(plan) + keep_means * inputs[0], classes)

    def prepare(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> float32 [B, R * C, T] about 1, without each taxel's mean."""
        x = digits.flatten(2).transpose(1, 2).float()
        return (x - x.mean(2, keepdim=True)) * self.scale

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> log mean activations [B, 3 * CHANNELS]."""
        means, x = [], prepared
        for conv, norm in zip(self.convs, self.norms, strict=True):
            x = torch.relu(norm(conv(x)))
            means.append(x.mean(2))
        return torch.log(torch.cat(means, 1) + FLOOR)

    def seen(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> what the head sees of them [B, F]."""
        features = self.features(self.prepare(digits))
        means = digits.flatten(2).float().mean(1) * self.scale
        return torch.cat([features, means], 1) if self.keep_means else features

    def forward(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> logits [B, K]."""
        logits: Tensor = self.head(self.seen(digits))
        return logits

    def fused(self) -> Compact:
        """The same network for inference, its batch norms folded into the convolutions."""
        plain = Compact(self.form, self.head.out_features, self.scale, norm=False)
        plain.head.load_state_dict(self.head.state_dict())
        for mine, conv, norm in zip(plain.convs, self.convs, self.norms, strict=True):
            mine.load_state_dict(fuse_conv_bn_eval(conv.eval(), norm.eval()).state_dict())
        return plain.eval()


class Graph:
    """An ONNX graph in the making."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Any, dtype: str = "float32") -> str:
        """The name of a new constant."""
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype, order="C"), name))
        return name

    def __call__(self, op: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """Add one node; the name of its output."""
        output = output or f"{op.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, inputs, [output], name=output, **attributes))
        return output

    def model(self, form: SweepFormat, output: str, size: int) -> onnx.ModelProto:
        """The finished, checked model: `sweep` [1, T, R, C] -> `output` float32 [1, size]."""
        sweep = helper.make_tensor_value_info("sweep", TENSOR[form.dtype], [1, form.window, form.rows, form.cols])
        out = helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, size])
        graph = helper.make_graph(self.nodes, "palpate", [sweep], [out], self.constants)
        made = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="palpate"
        )
        onnx.checker.check_model(made, full_check=True)
        return made


def trunk(
    form: SweepFormat, scale: float, weights: Mapping[str, NDArray[Any]], keep_means: bool = False
) -> onnx.ModelProto:
    """`Compact` up to its features: `sweep` -> `features` float32 [1, F]. weights: the state of a fused Compact.

    The means are taken away by matrix products, five times as fast in onnxruntime as ReduceMean and Sub along time, and
    exact for whole digits in whatever order a processor adds them up. The first convolution takes the scale along.
    """
    g, taxels = Graph(), form.rows * form.cols
    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    ones = g("ConstantOfShape", g.constant([form.window, 1], "int64"), value=one)
    x = g("Cast", g("Reshape", "sweep", g.constant([form.window, taxels], "int64")), to=TensorProto.FLOAT)
    sums = g("Gemm", ones, x, transA=1)
    x = g("Gemm", ones, sums, x, alpha=-1 / form.window)
    x = g("Transpose", g("Reshape", x, g.constant([1, form.window, taxels], "int64")), perm=[0, 2, 1])
    means = []
    for i, (_, stride) in enumerate(stages(form.window)):
        w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
        x = g("Relu", g("Conv", x, g.constant(w if i else w * scale), g.constant(b), strides=[stride]))
        means.append(g("ReduceMean", x, axes=[2], keepdims=0))
    seen = g("Log", g("Add", g("Concat", *means, axis=1), g.constant(FLOOR)), output="" if keep_means else "features")
    if keep_means:
        g("Concat", seen, g("Mul", sums, g.constant(scale / form.window)), axis=1, output="features")
    return g.model(form, "features", CHANNELS * len(means) + keep_means * taxels)


def with_head(trunk: onnx.ModelProto, weight: NDArray[Any], bias: NDArray[Any]) -> onnx.ModelProto:
    """A trunk (float or int8) and a linear head, weight [K, F] and bias [K]: `sweep` -> `logits` float32 [1, K]."""
    whole = onnx.ModelProto()
    whole.CopyFrom(trunk)
    graph = whole.graph
    for name, value in (("head.weight", weight), ("head.bias", bias)):
        graph.initializer.append(numpy_helper.from_array(np.ascontiguousarray(value, np.float32), name))
    inputs = [graph.output[0].name, "head.weight", "head.bias"]
    graph.node.append(helper.make_node("Gemm", inputs, ["logits"], name="logits", transB=1))
    graph.output.pop()
    graph.output.append(helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(bias)]))
    onnx.checker.check_model(whole, full_check=True)
    return whole


def paper_cnn(form: SweepFormat, classes: int, rng: np.random.Generator) -> onnx.ModelProto:
    """The paper's CNN (eq. 6 to 9, table I) with random weights: a yardstick for time and memory, not for accuracy.

    Its input is one image, time by taxels; zero padding keeps sizes.
    """
    g, taxels, steps = Graph(), form.rows * form.cols, form.window

    def weights(*shape: int) -> tuple[str, str]:
        drawn = rng.standard_normal(shape, np.float32) * np.sqrt(2 / np.prod(shape[1:]), dtype=np.float32)
        return g.constant(drawn), g.constant(np.zeros(shape[0]))

    x = g("Reshape", g("Cast", "sweep", to=TensorProto.FLOAT), g.constant([1, 1, steps, taxels], "int64"))
    x = g("Mul", x, g.constant(1 / 255))
    for before, channels in ((1, 32), (32, 64)):
        x = g("Relu", g("Conv", x, *weights(channels, before, 15, 5), pads=[7, 2, 7, 2]))
        x = g("MaxPool", x, kernel_shape=[10, 1], strides=[10, 1])
        steps //= 10
    x = g("Relu", g("Gemm", g("Flatten", x), *weights(1024, channels * steps * taxels), transB=1))
    g("Gemm", x, *weights(classes, 1024), transB=1, output="logits")
    return g.model(form, "logits", classes)


def weight_count(model: onnx.ModelProto) -> int:
    """How many trained numbers a float graph holds: what is left of its constants without shapes and scalars."""
    return sum(int(np.prod(c.dims)) for c in model.graph.initializer if c.data_type == TensorProto.FLOAT and c.dims)
