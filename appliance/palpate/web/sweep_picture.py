"""The picture of a sweep for the page: a `sweep` line of the feed becomes lines of the taxels and a
spectrogram, as numbers for JSON."""

from __future__ import annotations

from binascii import a2b_base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.core.errors import FormatError
from palpate.core.types import DATA_TYPES, normal

MOST_TAXELS = 16
"""Most taxels in a picture; of a larger skin, the most loaded taxels are drawn."""
FINEST = 300
"""Steps in time of a taxel's line. Lowest and highest count of each step are drawn, so that no peak
is lost."""
MOST_BYTES = 1 << 20
"""Fields of a window."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnWindow:
    """The window of a sweep. taxels: raw counts [T, R, C] or [T, R, C, A]."""

    sweep: int
    rate_hz: float
    taxels: NDArray[Any]


def window(line: Mapping[str, Any], rate_hz: float) -> DrawnWindow:
    """The window in a `sweep` line. Raises ValueError, TypeError or KeyError for a malformed
    line."""
    dtype, shape = line["dtype"], tuple(map(int, line["shape"]))
    data = a2b_base64(line["data"], strict_mode=True)
    known = dtype in DATA_TYPES and len(shape) in (3, 4) and min(shape) >= 1
    if not known or len(data) > MOST_BYTES:
        raise ValueError(f"a window of {shape} {dtype}")
    taxels = np.frombuffer(data, np.dtype(dtype).newbyteorder("<")).reshape(shape)
    return DrawnWindow(int(line["sweep"]), rate_hz, taxels)


def picture(one: DrawnWindow) -> dict[str, Any]:
    """The content of the picture.

    taxels: name, lowest and highest count of each step in time, of the normal axis. spectrogram:
    share of each band [steps][bands] (features.h_features), with `band_hz`, `step_s` and `top_hz`,
    the end of the last band; or `trouble`, the reason why there is none.
    """
    counts = normal(one.taxels, 1).astype(np.float64)
    counts = np.where(np.isfinite(counts), counts, 0)
    frames, rows, cols = counts.shape
    series = counts.reshape(frames, -1)
    shown = np.sort(np.argsort(-series.mean(axis=0), kind="stable")[:MOST_TAXELS])
    edges = np.linspace(0, frames, min(FINEST, frames) + 1).astype(int)[:-1]
    low, high = (
        reduce(series[:, shown], edges, axis=0).T.round(2).tolist()
        for reduce in (np.minimum.reduceat, np.maximum.reduceat)
    )
    names = [f"{i // cols + 1}.{i % cols + 1}" for i in shown.tolist()]
    each = zip(names, low, high, strict=True)
    lines = [{"name": name, "low": lo, "high": hi} for name, lo, hi in each]
    return {
        "sweep": one.sweep,
        "seconds": frames / one.rate_hz,
        "taxels": lines,
        "of": rows * cols,
        **_spectrogram(one.taxels, one.rate_hz),
    }


def _spectrogram(taxels: NDArray[Any], rate_hz: float) -> dict[str, Any]:
    try:
        shares = features.h_features(taxels, rate_hz, "hann")
        shares = shares.reshape(features.h_shape(len(taxels), rate_hz))
    except FormatError as e:
        return {"spectrogram": [], "trouble": str(e)}
    width = round(features.WINDOW_S * rate_hz)
    return {
        "spectrogram": shares.round(3).tolist(),
        "band_hz": 2 * rate_hz / width,
        "top_hz": min(features.HIGH_HZ[1], rate_hz / 2),
        "step_s": features.HOP_S,
        "trouble": "",
    }
