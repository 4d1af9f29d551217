"""Samples of large sets stay on the disk: they are mapped, so the kernel reads the parts that are
used and drops them when memory is short.

A mapped file may be replaced, as this program does (palpate.core.storage), but not shortened
in place: reads beyond its new end kill the process.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array

if TYPE_CHECKING:
    import h5py

LEAST = 256_000_000
"""Bytes of samples from which on they are written uncompressed and mapped instead of read."""
BATCH = 16 << 20
"""Bytes that are copied at a time."""
LASTING = Path("/var/tmp")
"""Folder of temporary files on a disk; /tmp may be memory."""
_LOCAL_HEADER = struct.Struct("<26xHH")
FORMAT: Any = np.lib.format
"""NumPy's reader of headers; it has no types."""


def is_mapped(samples: Array) -> bool:
    """Whether an array, or the array that it is a view of, lies in a mapped file."""
    base: Any = samples
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(base, mmap.mmap)


def header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """The shape of an .npy, whether its first axis runs fastest, and its type. Raises ValueError
    for another file."""
    version = FORMAT.read_magic(file)
    read = FORMAT.read_array_header_1_0 if version == (1, 0) else FORMAT.read_array_header_2_0
    found: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(file)
    return found


def of_npz(path: Path) -> dict[str, Array]:
    """The samples of an .npz, mapped; {} if they are small, compressed or not as this machine
    computes, and for what is not an .npz: then they are read, and reading says what is wrong."""
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            member = archive.getinfo("samples.npy")
            if member.compress_type != zipfile.ZIP_STORED or member.file_size < LEAST:
                return {}
            file.seek(member.header_offset)
            name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
            file.seek(name + extra, os.SEEK_CUR)
            shape, by_columns, dtype = header(file)
            return {} if by_columns else _samples(path, dtype, file.tell(), shape)
    except (OSError, KeyError, ValueError, struct.error, zipfile.BadZipFile):
        return {}


def of_hdf5(path: Path, data: h5py.Dataset) -> dict[str, Array]:
    """As `of_npz`, for the array `samples` of an HDF5 file that was found to be complete."""
    offset = None if data.chunks else data.id.get_offset()
    return {} if offset is None else _samples(path, data.dtype, offset, data.shape)


def _samples(
    path: Path, dtype: np.dtype[Any], offset: int, shape: tuple[int, ...]
) -> dict[str, Array]:
    size = int(np.prod(shape)) * dtype.itemsize
    if dtype.hasobject:  # the file would hold addresses, and NumPy would follow them
        return {}
    if not dtype.isnative or size < LEAST or offset + size > path.stat().st_size:
        return {}
    return {"samples": np.memmap(path, dtype, "r", offset, shape)}


def taken(samples: Array, index: Array) -> Array:
    """`samples[index]` (mask or numbers); of a mapped set in a file without a name if it is large.
    Raises FormatError if the disk has no room for it."""
    numbers = np.flatnonzero(index) if np.asarray(index).dtype == bool else np.asarray(index)
    each = samples[:1].nbytes
    if not is_mapped(samples) or len(numbers) * each < LEAST:
        return samples[index]
    step = max(BATCH // each, 1)
    parts = (samples[numbers[k : k + step]] for k in range(0, len(numbers), step))
    return _written(parts, samples.dtype, (len(numbers), *samples.shape[1:]))


def joined(parts: Sequence[Array]) -> Array:
    """The samples of sets one after the other, in a file without a name if one of them is mapped.
    Raises FormatError if the disk has no room for them."""
    if not any(map(is_mapped, parts)):
        return np.concatenate(parts)
    shape = sum(map(len, parts)), *parts[0].shape[1:]
    return _written(_batches(parts), parts[0].dtype, shape)


def _batches(parts: Sequence[Array]) -> Iterator[Array]:
    for part in parts:
        step = max(BATCH // part[:1].nbytes, 1)
        yield from (part[k : k + step] for k in range(0, len(part), step))


def _written(parts: Iterable[Array], dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """An array of these parts, mapped from a file that ends with it."""
    folder = Path(
        tempfile.gettempdir() if "TMPDIR" in os.environ or not LASTING.is_dir() else LASTING
    )
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            for part in parts:
                file.write(np.ascontiguousarray(part).data)
            file.flush()
            return np.memmap(file, dtype, "r", 0, shape)
    except OSError as e:
        size = int(np.prod(shape)) * dtype.itemsize
        raise FormatError(
            f"{folder}: {size / 1e6:.0f} MB of sweeps cannot be kept there: {e.strerror}; make "
            "room, or name another folder with the variable TMPDIR"
        ) from e
