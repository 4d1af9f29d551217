"""The base class of all networks.

A network has a linear head on features of a sweep; `prepare` scales raw counts for the
convolutions. It writes its own ONNX graph with palpate_train.onnx_tools.graph_builder; the graph
takes the raw counts of the sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from palpate.core.types import SweepFormat
from palpate_train.models.linear_head import ABSENT
from palpate_train.onnx_tools.graph_builder import GraphBuilder

Array = NDArray[Any]


class Network(nn.Module, ABC):
    """Base class of all networks.

    scale: factor that brings raw counts to about 1 after `offset` is subtracted; offset None: the
    mean of each taxel. dropout: share of the features that the head does not see in a training
    step.
    """

    head: nn.Linear

    def __init__(self, format: SweepFormat, scale: float, offset: float | None = None) -> None:
        super().__init__()
        self.format, self.scale, self.offset, self.dropout = format, scale, offset, 0.0

    def prepare(self, counts: Tensor) -> Tensor:
        """Raw counts [B, T, R, C] -> float32 [B, R * C, T] of about 1."""
        x = counts.flatten(2).transpose(1, 2).float()
        return (x - (x.mean(2, keepdim=True) if self.offset is None else self.offset)) * self.scale

    @abstractmethod
    def features(self, prepared: Tensor) -> Tensor:
        """Prepared sweeps [B, R * C, T] -> the features that the head sees [B, F]."""

    def training_logits(self, prepared: Tensor) -> Tensor:
        """Prepared sweeps [B, R * C, T] -> logits [B, K]; with dropout before the head while
        training."""
        logits: Tensor = self.head(
            functional.dropout(self.features(prepared), self.dropout, self.training)
        )
        return logits

    def forward(self, counts: Tensor) -> Tensor:
        """Raw counts [B, T, R, C] -> logits [B, K]."""
        logits: Tensor = self.head(self.features(self.prepare(counts)))
        return logits

    def fused(self) -> Self:
        """The same network, ready for inference."""
        return self.eval()

    @torch.no_grad()
    def expand_head(self, present: Array, classes: int, temperature: float) -> None:
        """Replace the head, trained for `present`, by a head for all `classes`; logits are
        divided by `temperature`.

        The trained logits are shifted to sum to 0, which changes no softmax; ABSENT lies far below
        the largest of them.
        """
        old = self.head
        new = nn.utils.skip_init(nn.Linear, old.in_features, classes)  # draws no random numbers
        new.weight.zero_()
        new.bias.fill_(ABSENT)
        new.weight[present] = (old.weight - old.weight.mean(0)) / temperature
        new.bias[present] = (old.bias - old.bias.mean()) / temperature
        self.head = new

    @abstractmethod
    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K], as in inference."""


def layer_constants(g: GraphBuilder, layer: nn.Linear | nn.Conv1d | nn.Conv2d) -> tuple[str, str]:
    """The names of a layer's weight and bias, added to the graph as constants."""
    assert layer.bias is not None
    return g.constant(layer.weight.detach().numpy()), g.constant(layer.bias.detach().numpy())
