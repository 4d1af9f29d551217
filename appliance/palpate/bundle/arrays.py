"""Reads, writes and checks the arrays in the files of a bundle.

Wrong content raises a BundleError. Nothing is unpickled.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.manifest import MEANS, MOST_BYTES
from palpate.core.errors import BundleError
from palpate.core.sweep_file import UNREADABLE
from palpate.core.types import SweepFormat


def read(data: bytes, file: str, *names: str) -> dict[str, NDArray[Any]]:
    """The arrays of the .npz `data` by name.

    names: arrays that must be there. Pickled objects are refused. Raises a BundleError about
    `file`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > MOST_BYTES:
            raise BundleError(
                f"{file} unpacks to {size} bytes, {MOST_BYTES} are allowed; export the bundle with "
                "fewer sweeps"
            )
        with np.load(io.BytesIO(data), allow_pickle=False) as z:
            arrays = dict(z.items())
        for name, values in arrays.items():
            if not isinstance(
                values, np.ndarray
            ):  # numpy returns a member without an array's header as bytes
                raise BundleError(
                    f"{file} cannot be read: {name!r} is not an array; export the bundle again"
                )
        return {name: arrays[name] for name in names} | arrays
    except (*UNREADABLE, OSError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as e:
        raise BundleError(f"{file} cannot be read: {e}; export the bundle again") from e


def packed(**arrays: NDArray[Any]) -> bytes:
    """The bytes of an .npz; equal arrays give equal bytes."""
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def changes(samples: NDArray[Any]) -> NDArray[np.uint8]:
    """The changes from frame to frame of sweeps [G, T, R, C] or [G, T, R, C, A], as bytes [B, G, T,
    R, C] or [B, G, T, R, C, A] for values of B bytes.

    The values' bits are read as whole numbers. The lowest bytes of all changes come first, then the
    next bytes. This compresses better than the values themselves and is lossless.
    """
    bits = np.ascontiguousarray(samples).view(f"<u{samples.itemsize}")
    steps = np.diff(bits, axis=1, prepend=np.zeros_like(bits[:, :1]))
    planes: NDArray[np.uint8] = np.moveaxis(
        steps.view(np.uint8).reshape(*bits.shape, samples.itemsize), -1, 0
    )
    return planes


def summed(planes: NDArray[Any], f: SweepFormat, file: str) -> NDArray[Any]:
    """Sweeps from the bytes of their changes [B, G, T, R, C] or [B, G, T, R, C, A]: the inverse of
    `changes`. Raises a BundleError about `file`."""
    size = f.numpy_type.itemsize
    if planes.dtype != np.uint8 or planes.shape[:1] + planes.shape[2:] != (
        size,
        f.window,
        *f.shape,
    ):
        raise BundleError(
            f"{file} holds changes {planes.dtype} {planes.shape}, which do not fit the format {f}; "
            "export the bundle again"
        )
    steps = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(f"<u{size}")[..., 0]
    return np.cumsum(steps, axis=1, dtype=steps.dtype).view(f.numpy_type)


def check(
    held: Mapping[str, NDArray[Any]],
    wanted: Mapping[str, tuple[str, tuple[int, ...]]],
    file: str,
    advice: str = "export the bundle again",
) -> None:
    """Raises BundleError for an array of `file` that has another type or shape than `wanted`, or a
    number that is not finite."""
    for name, (kind, shape) in wanted.items():
        values = held[name]
        if values.dtype != kind or values.shape != shape:
            given = f"{file} holds {name} {values.dtype} {list(values.shape)}"
            raise BundleError(f"{given}; {kind} {list(shape)} is wanted: {advice}")
        if not np.isfinite(values).all():
            raise BundleError(f"{file} holds {name} that are not finite; {advice}")


def check_classes(
    arrays: Mapping[str, NDArray[Any]], n: int, steps: int, disturbances: int = 0
) -> None:
    """Raises BundleError if an array of means.npz does not have the type and shape for `n` labels,
    `steps` early answers and this number of disturbances, or has a number out of range."""
    rank = max(1, arrays["means"].shape[-1]) if arrays["means"].ndim else 1
    trained = int((arrays["sweeps"] == 0).sum())
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "means": ("float32", (n, rank)),
        "bias": ("float32", (n,)),
        "sweeps": ("int64", (n,)),
        "spread": ("float32", (n,)),
        "displaced_turn": ("float32", (rank, rank)),
        "displaced_means": ("float32", (n, rank)),
    }
    if steps:
        wanted["early_means"] = ("float32", (steps, n, rank))
        wanted["early_shapes"] = ("float16", (steps, rank, rank))
    if disturbances:
        wanted["changes"] = ("float16", (disturbances, trained, rank))
    for name in ("shapes", "displaced_shapes"):
        side = min([rank, *arrays[name].shape[1:2]]) if name in arrays else 0
        wanted[name] = ("float16", (n, side, side))
    check(arrays, {name: of for name, of in wanted.items() if name in arrays}, MEANS)
    if not (arrays["spread"] > 0).all():
        given = f"{MEANS} holds spread {arrays['spread'].tolist()}"
        raise BundleError(f"{given}, which must be above 0; export the bundle again")
