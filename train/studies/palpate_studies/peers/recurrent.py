"""A recurrent network, the paper's future work: the METHOD recurrent."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate.core.types import SweepFormat
from palpate_studies.peers.networks import (
    Build,
    PeerNetwork,
    PeerRecipe,
    centred_network,
    layer_constants,
    network_method,
    scale_steps,
)
from palpate_train.models.methods import FULL_EFFORT, Effort, Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, centred

Array = NDArray[Any]
STATE, PATCHES, MIN_PATCH = 64, 128, 8
"""Size of the state, number of patches that cover a window (approximately), frames of the shortest
patch."""
RECIPE = PeerRecipe(steps=400)
"""Half as many iterations as usual."""


class Recurrent(PeerNetwork):
    """A gated recurrent unit over patches of time whose channels are the taxels; the head sees its
    mean state.

    A patch is two strides long; about PATCHES of them cover the window, for any rate and length.
    """

    def __init__(self, format: SweepFormat, classes: int, scale: float) -> None:
        super().__init__(format, scale)
        self.stride = max(format.window // PATCHES, 1)
        kernel = min(max(2 * self.stride, MIN_PATCH), format.window)
        self.patches = nn.Conv1d(format.channels, STATE, kernel, self.stride)
        self.unit = nn.GRU(STATE, STATE)
        self.head = nn.Linear(STATE, classes)

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> mean state over time [B, STATE]."""
        states: Tensor = self.unit(torch.relu(self.patches(prepared)).permute(2, 0, 1))[0]
        return states.mean(0)

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]."""
        g = GraphBuilder()
        x = g("Mul", centred(g, self.format)[0], g.constant(self.scale))
        x = g("Relu", g("Conv", x, *layer_constants(g, self.patches), strides=[self.stride]))
        gates = dict(self.unit.named_parameters())
        from_input, from_state = (
            _onnx_gate_order(gates[name]) for name in ("weight_ih_l0", "weight_hh_l0")
        )
        biases = np.concatenate(
            [_onnx_gate_order(gates[name]) for name in ("bias_ih_l0", "bias_hh_l0")]
        )
        weights = [g.constant(w[None]) for w in (from_input, from_state, biases)]
        x = g(
            "GRU",
            g("Transpose", x, perm=[2, 0, 1]),
            *weights,
            hidden_size=STATE,
            linear_before_reset=1,
        )
        x = g("Reshape", g("ReduceMean", x, axes=[0]), [1, STATE])
        g("Gemm", x, *layer_constants(g, self.head), transB=1, output="logits")
        return g.model(self.format, "logits", self.head.out_features)


def _onnx_gate_order(gates: Tensor) -> Array:
    """PyTorch's gates (reset, update, new) in ONNX's order (update, reset, new)."""
    reset, update, new = gates.detach().numpy().reshape(3, STATE, *gates.shape[1:])
    return np.concatenate([update, reset, new])


build_recurrent: Build = partial(centred_network, Recurrent)


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """The method, trained with this effort."""
    about = "gated recurrent unit over patches, the paper's future work"
    return (network_method("recurrent", about, build_recurrent, scale_steps(RECIPE, effort)),)
