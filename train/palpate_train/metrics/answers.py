"""The box's answers to labelled sweeps, and the figures of them that a manifest holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.metrics.score import accuracy_figure

Array = NDArray[Any]
REFUSED, UNKNOWN = -1, -2
"""Stand for a label if the box refuses a sweep, or calls its material unknown."""
NETWORK = "network alone"
"""Ends the name of the accuracy of the network's most probable labels, without the box's checks."""


def outcomes(named: Array, sure: Array, labels: Array) -> dict[str, Array]:
    """The outcome of n sweeps: for each outcome bool [n]; every sweep has a single outcome. named:
    int [n], a label, REFUSED or UNKNOWN; sure: bool [n]; labels: int [n], the right ones."""
    right = sure & (named == labels)
    return {
        "right": right,
        "wrong": sure & (named >= 0) & ~right,
        "unsure": ~sure & (named >= 0),
        "unknown": named == UNKNOWN,
        "refused": named == REFUSED,
    }


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers to N sweeps. labels: int [N], a label, REFUSED or UNKNOWN. ok: bool [N], whether the
    box is certain of the label. fused: as `labels`, of the whole recording; UNKNOWN if uncertain.
    network: int [N], the network's most probable labels."""

    labels: Array
    ok: Array
    fused: Array
    network: Array

    def figures(self, labels: Array, recordings: Array, protocol: str) -> dict[str, Any]:
        """Accuracy by sweep, and by recording if a recording has several sweeps; labels,
        recordings: int [N] of the sweeps. A refused, unknown or unsure sweep does not count as
        right. Also the accuracy of the network alone."""
        became = outcomes(self.labels, self.ok, labels)
        counts = {name: int(of.sum()) for name, of in became.items()}
        right = counts.pop("right")
        network = int((self.network == labels).sum())
        result = {
            protocol: accuracy_figure(right, len(labels)) | counts,
            f"{protocol}, {NETWORK}": accuracy_figure(network, len(labels)),
        }
        first = np.unique(recordings, return_index=True)[1]
        if len(first) < len(labels):
            fused = int((self.fused == labels)[first].sum())
            result[f"{protocol}, by recording"] = accuracy_figure(fused, len(first))
        return result
