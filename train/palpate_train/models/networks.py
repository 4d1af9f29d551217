"""The base class of all networks.

A network has a linear head on features of a sweep; `prepare` scales raw counts for the
convolutions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

from torch import Tensor, nn
from torch.nn import functional

from palpate.core.types import SweepFormat


class Network(nn.Module, ABC):
    """Base class of all networks.

    scale: factor that brings raw counts to about 1 after the mean of each taxel is subtracted.
    dropout: share of the features that the head does not see in a training step.
    """

    head: nn.Linear

    def __init__(self, format: SweepFormat, scale: float) -> None:
        super().__init__()
        self.format, self.scale, self.dropout = format, scale, 0.0

    def prepare(self, counts: Tensor) -> Tensor:
        """Raw counts [B, T, R, C] -> float32 [B, R * C, T] of about 1."""
        x = counts.flatten(2).transpose(1, 2).float()
        return (x - x.mean(2, keepdim=True)) * self.scale

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

    def backward(self, x: Tensor, labels: Tensor, smoothing: float) -> float:
        """Leave the gradients of the cost of prepared sweeps in the weights, and return it."""
        loss = functional.cross_entropy(self.training_logits(x), labels, label_smoothing=smoothing)
        loss.backward()
        return loss.item()
