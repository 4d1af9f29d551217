"""Types of the numbers that a skin sends, and the data type of the box that takes each of them.
Numbers of 24 and 32 bits become float32, which holds 24 bits exactly."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

WireNumber = Literal["uint8", "int16", "uint16", "float32", "int24", "uint24", "int32", "uint32"]
WIDE = ("int24", "uint24", "int32", "uint32")
"""Types that the box has no data type for."""


def data_type(kind: str) -> str:
    """The data type of raw counts that takes these numbers."""
    return "float32" if kind in WIDE else kind


def size(kind: str) -> int:
    return 3 if kind.endswith("24") else np.dtype(kind).itemsize


def read(raw: NDArray[np.uint8], kind: str, order: str) -> NDArray[Any]:
    """Bytes [n, k * size] as numbers [n, k]. order: "little" or "big"."""
    sign = "<" if order == "little" else ">"
    if size(kind) != 3:
        return np.ascontiguousarray(raw).view(f"{sign}{np.dtype(kind).str[1:]}")
    parts = raw.reshape(len(raw), -1, 3).astype(np.int32)
    low, middle, high = (parts[..., i] for i in ((0, 1, 2) if sign == "<" else (2, 1, 0)))
    number = low | middle << 8 | high << 16
    # the highest bit counts negative
    return (number ^ 0x800000) - 0x800000 if kind == "int24" else number
