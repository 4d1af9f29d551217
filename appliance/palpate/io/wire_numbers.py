"""Types of the numbers that a skin sends, and the data type of the box that takes each of them.
Numbers of 24 and 32 bits become float32, which holds 24 bits exactly; int8 becomes int16."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import DATA_TYPES

TYPES = (*DATA_TYPES, "int8", "int24", "uint24", "int32", "uint32")


def known(value: Any) -> str | None:
    """`value` if it is one of TYPES, or several of one size in a text; else None."""
    kinds = value.split() if isinstance(value, str) else []
    good = kinds and all(kind in TYPES for kind in kinds) and len({*map(size, kinds)}) == 1
    return " ".join(kinds) if good else None


def data_type(kind: str) -> str:
    """The data type of raw counts that takes these numbers."""
    kinds = {*kind.split()}
    if len(kinds) == 1 and kinds <= {*DATA_TYPES}:
        return kinds.pop()
    return "int16" if kinds <= {"int8", "uint8"} else "float32"


def size(kind: str) -> int:
    """Bytes of one number."""
    one = kind.split()[0]
    return 3 if one.endswith("24") else np.dtype(one).itemsize


def read(raw: NDArray[np.uint8], kind: str, order: str) -> NDArray[Any]:
    """Bytes [n, k * size] as numbers [n, k]. kind: may hold a type for each value of a taxel.
    order: "little" or "big"."""
    if several := kind.split()[1:]:
        kinds = [kind.split()[0], *several]
        taxels = raw.reshape(len(raw), -1, len(kinds), size(kind))
        values = [
            read(taxels[:, :, i].reshape(len(raw), -1), one, order) for i, one in enumerate(kinds)
        ]
        return np.stack(values, axis=-1).reshape(len(raw), -1)
    sign = "<" if order == "little" else ">"
    if size(kind) != 3:
        return np.ascontiguousarray(raw).view(f"{sign}{np.dtype(kind).str[1:]}")
    parts = raw.reshape(len(raw), -1, 3).astype(np.int32)
    low, middle, high = (parts[..., i] for i in ((0, 1, 2) if sign == "<" else (2, 1, 0)))
    number = low | middle << 8 | high << 16
    # the highest bit counts negative
    return (number ^ 0x800000) - 0x800000 if kind == "int24" else number
