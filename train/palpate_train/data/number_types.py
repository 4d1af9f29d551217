"""Which data type of a set holds the counts of a recording."""

from __future__ import annotations

import numpy as np

from palpate.core.sweep_set import Array


def compact(counts: Array) -> Array:
    """Whole counts in float64, as of text, as int32, which is not a type of a set: the import
    still chooses that. Other counts stay as they are."""
    limits = np.iinfo(np.int32)
    if counts.dtype != np.float64 or counts.min() < limits.min or counts.max() > limits.max:
        return counts
    whole = counts.astype(np.int32)
    return whole if np.array_equal(whole, counts) else counts


def why_not(counts: Array, dtype: str) -> str:
    """The reason why a data type cannot hold these counts, or "" if it can.

    float32 may round fractions, but must hold whole numbers exactly.
    """
    kind = np.dtype(dtype)
    if counts.dtype == kind:
        return ""
    low, high = (
        (-np.finfo(kind).max, np.finfo(kind).max)
        if kind.kind == "f"
        else (np.iinfo(kind).min, np.iinfo(kind).max)
    )
    bad = (counts < low) | (counts > high)
    what = f"{dtype} holds {low:g} to {high:g}"
    if not bad.any() and kind.kind != "f":
        bad, what = counts % 1 != 0, f"{dtype} holds whole numbers"
    elif not bad.any():
        bad, what = (
            (counts % 1 == 0) & (counts.astype(kind) != counts),
            f"{dtype} would round it; subtract an offset",
        )
    if not bad.any():
        return ""
    value = counts[tuple(np.argwhere(bad)[0])]
    return f"a count is {value:.17g}, and {what}"
