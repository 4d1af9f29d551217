"""Sweeps from the arrays that scientists use: [n, channels, time] as aeon has them, or
[n, time, rows, columns]."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.types import DATA_TYPES

Array = NDArray[Any]


def raw_counts(x: Any, grid: tuple[int, ...] | None = None) -> Array:
    """Raw counts [n, T, R, C] or [n, T, R, C, A] of one of DATA_TYPES.

    x: [n, channels, time], or [n, time, rows, columns(, axes)], of any type of numbers. grid: rows,
    columns and axes of the channels, which count the columns of the first row first; None for one
    column. Numbers that are not of DATA_TYPES become float32. Raises FormatError.
    """
    values = np.asarray(x)
    if values.dtype.kind == "O":
        try:
            values = values.astype(np.float64)
        except (ValueError, TypeError) as e:
            raise FormatError(
                f"X holds {values.shape} objects; give one array of sweeps of equal length"
            ) from e
    if values.ndim not in (3, 4, 5) or values.dtype.kind not in "biuf" or 0 in values.shape:
        raise FormatError(
            f"X holds {values.dtype} {list(values.shape)}; give numbers [n, channels, time] or "
            "[n, time, rows, columns]"
        )
    if values.ndim == 3:
        shape = grid or (values.shape[1], 1)
        if int(np.prod(shape)) != values.shape[1]:
            raise FormatError(
                f"X has {values.shape[1]} channels, but the grid {'x'.join(map(str, shape))} has "
                f"{int(np.prod(shape))} places; "
                "set grid"
            )
        values = values.transpose(0, 2, 1).reshape(len(values), values.shape[2], *shape)
    if values.dtype.name in DATA_TYPES:
        return values
    return values.astype(np.uint8 if values.dtype.kind == "b" else np.float32)
