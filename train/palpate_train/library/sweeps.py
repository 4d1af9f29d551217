"""Sweeps from the arrays that scientists use: [n, channels, time] as aeon has them, [n, time] of
one channel, or [n, time, rows, columns]."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.types import DATA_TYPES, native
from palpate_train.models.recipe.architectures import LEAST_WINDOW


class InputError(FormatError, ValueError):
    """A FormatError that is a ValueError too, which scikit-learn's own tools expect."""


@contextmanager
def as_value_errors() -> Iterator[None]:
    """Raise an InputError for each FormatError."""
    try:
        yield
    except FormatError as e:
        raise InputError(str(e)) from e


def one_array(x: Any) -> Any:
    """X as it is if it has a shape; a tensor, lists, or a column of arrays of equal shape as one
    array. Raises FormatError, also for masked numbers."""
    if np.ma.is_masked(x):
        raise FormatError("X has masked numbers; fill them in")
    try:
        if len(getattr(x, "shape", ())) == 1:
            return np.stack([np.asarray(one) for one in x])
        return np.asarray(x) if hasattr(x, "detach") or not hasattr(x, "shape") else x
    except (ValueError, TypeError, RuntimeError) as e:
        raise FormatError(f"X is not one array: {e}; give sweeps of equal length") from e


def channels_first(frames: Array) -> Array:
    """Frames [n, time, ...] as [n, channels, time]."""
    n, time, *shape = frames.shape
    return frames.reshape(n, time, int(np.prod(shape))).transpose(0, 2, 1)


def raw_counts(x: Any, grid: tuple[int, ...] | None = None) -> Array:
    """Raw counts [n, T, R, C] or [n, T, R, C, A] of one of DATA_TYPES.

    x: [n, channels, time], [n, time] or [n, time, rows, columns(, axes)], of any type of numbers,
    as one_array takes it. grid: rows, columns and axes of the channels, which count the columns of
    the first row first; None for one column. Numbers that are not of DATA_TYPES become float32.
    Raises FormatError.
    """
    values = np.asarray(one_array(x))
    if values.dtype.kind == "O":
        try:
            values = values.astype(np.float64)
        except (ValueError, TypeError) as e:
            raise FormatError(
                f"X holds {values.shape} objects; give one array of sweeps of equal length"
            ) from e
    if not 2 <= values.ndim <= 5 or values.dtype.kind not in "biuf" or 0 in values.shape:
        raise FormatError(
            f"X holds {values.dtype} {list(values.shape)}; give numbers [n, channels, time], "
            "[n, time] or [n, time, rows, columns]"
        )
    if values.ndim == 2:
        values = values[:, None]
    if values.ndim == 3:
        shape = (values.shape[1], 1) if grid is None else tuple(map(int, grid))
        if min(shape) < 1 or int(np.prod(shape)) != values.shape[1]:
            raise FormatError(
                f"X has {values.shape[1]} channels, but the grid {'x'.join(map(str, shape))} has "
                f"{int(np.prod(shape))} places; set grid"
            )
        values = values.transpose(0, 2, 1).reshape(len(values), values.shape[2], *shape)
    if values.dtype.name in DATA_TYPES:
        return native(values)
    return values.astype(np.uint8 if values.dtype.kind == "b" else np.float32)


def of_type(samples: Array, dtype: str) -> Array:
    """The same counts in a data type. Raises FormatError if it cannot hold them."""
    with np.errstate(invalid="ignore"):
        kept = samples.astype(dtype, copy=False)
    if not np.array_equal(kept, samples, equal_nan=kept.dtype.kind == "f"):
        raise FormatError(
            f"X holds {samples.dtype} that is no {dtype}, as it was trained on; give it the counts "
            "of its skin"
        )
    return kept


def held(samples: Array) -> Array:
    """Sweeps [n, T, ...] with each frame as often as the shortest window of a trunk needs."""
    times = -(-LEAST_WINDOW // samples.shape[1])
    return samples if times == 1 else samples.repeat(times, axis=1)
