"""Answers to labelled sweeps, and counts of right ones with 95 % intervals, as figures for results
and manifests."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate.core.provenance import commit
from palpate.core.statistics import interval as interval
from palpate.core.statistics import widen as widen
from palpate.core.statistics import wilson
from palpate.core.status import LEAST_PROBABILITY

Array = NDArray[Any]
REFUSED, UNKNOWN = -1, -2
"""Stand for a label if the box refuses a sweep, or calls its material unknown."""
NETWORK = "network alone"
"""Ends the name of the accuracy of the network's most probable labels, without the box's checks."""


def score_entry(right: Array) -> dict[str, int]:
    """The entry of a result file for answers that are right or wrong, bool [n]."""
    return {"right": int(right.sum()), "total": len(right)}


def confusion(labels: Array, scores: Array) -> Array:
    """Counts int64 [K, K], rows by `labels` [n], columns by the largest of `scores` [n, K]."""
    counts = np.zeros((scores.shape[1],) * 2, np.int64)
    np.add.at(counts, (labels, scores.argmax(1)), 1)
    return counts


def row_shares(counts: Array) -> Array:
    """Each row of `counts` [K, K] divided by its sum; a row of zeros stays."""
    shares: Array = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    return shares


def fuse(logits: Array, together: Array) -> tuple[Array, Array]:
    """Fuse the sweeps that have the same value in `together` [n].

    Returns log scores [G, K], the logarithm of the product of the probabilities of `logits` [n, K],
    and the number [G] of the first sweep of each value.
    """
    _, first, member = np.unique(together, return_index=True, return_inverse=True)
    scores = np.zeros((len(first), logits.shape[1]))
    np.add.at(scores, member, np.log(np.maximum(softmax(logits), LEAST_PROBABILITY)))
    return scores, first


def accuracy_figure(right: int, n: int) -> dict[str, Any]:
    """The accuracy of `right` of `n` with its 95 % Wilson interval, as a manifest holds it."""
    low, high = wilson(right, n)
    return {"accuracy": round(right / n, 4), "n": n, "low": round(low, 4), "high": round(high, 4)}


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


@cache
def provenance() -> dict[str, str]:
    """The origin that a result file records next to its sets and seeds. shipped: the id of the
    packaged bundle.

    Cached at the first call, because the commit and the day may change during a long run.
    """
    return {
        "commit": commit(),
        "shipped": shipped(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def shipped() -> str:
    """The id of the packaged bundle, as the box prints it."""
    return bundle.identity((bundle.DEFAULT / "manifest.json").read_bytes())
