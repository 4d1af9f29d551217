"""Reads the numeric arrays of MAT files, versions 5 to 7, from their bytes.

Source: MathWorks, MAT-File Format (R2023a). Readers in C trust the sizes in a damaged file; this
module checks each size. Cells, structures, text and sparse arrays are skipped. Version 7.3 is
HDF5, which raw_files.py reads.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError

Array = NDArray[Any]
HEADER = 128
ENDIAN = {b"IM": "<", b"MI": ">"}
MATRIX, COMPRESSED = 14, 15
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""NumPy types of the values on disk, by their number; smaller than the array's type if the values
fit."""
CLASSES = {
    6: "f8",
    7: "f4",
    8: "i1",
    9: "u1",
    10: "i2",
    11: "u2",
    12: "i4",
    13: "u4",
    14: "i8",
    15: "u8",
}
"""NumPy types of numeric arrays, by the number of their class; all other classes are skipped."""
COMPLEX, LOGICAL = 0x0800, 0x0200
MOST_BYTES = 1 << 31
"""Largest size of one array after decompression."""


def arrays(data: bytes) -> dict[str, Array]:
    """All numeric arrays of a file, by name. Raises FormatError if the file is damaged or has
    another version."""
    order = ENDIAN.get(data[126:128], "")
    if not order:
        raise FormatError("is not a MAT file of version 5 to 7.3; save it with -v7")
    found: dict[str, Array] = {}
    for kind, content in _elements(data[HEADER:], order):
        if kind == COMPRESSED:
            content = _unpacked(content)
            ((kind, content),) = list(_elements(content, order)) or [(0, b"")]
        if kind == MATRIX and (array := _matrix(content, order)):
            found[array[0]] = array[1]
    return found


def _unpacked(content: bytes) -> bytes:
    unpack = zlib.decompressobj()
    try:
        whole = unpack.decompress(content, MOST_BYTES)
    except zlib.error as e:
        raise FormatError(f"is damaged: {e}") from e
    if not unpack.eof:
        raise FormatError("is damaged, or one of its arrays is larger than 2 GB")
    return whole


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """(type, content) of each element. Raises FormatError if an element exceeds the data."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, end = at + 8, at + 8 + size
        if kind >> 16:  # a small element: its tag holds up to four bytes of content
            kind, size = kind & 0xFFFF, kind >> 16
            start, end = at + 4, at + 4 + size
            if size > 4:
                raise FormatError(f"is damaged: {size} bytes at {at}, where at most 4 fit")
        if end > len(data):
            raise FormatError(f"is damaged or cut off: {size} bytes at {at} exceed its end")
        yield kind, data[start:end]
        at = end if kind == COMPRESSED else at + 8 * math.ceil((end - at) / 8)


def _matrix(data: bytes, order: str) -> tuple[str, Array] | None:
    """Name and values of an array, or None if it is not numeric.

    Raises FormatError if its shape, type and content do not fit together.
    """
    parts = list(_elements(data, order))
    if len(parts) < 3 or len(parts[0][1]) < 4 or len(parts[1][1]) % 4:
        raise FormatError("is damaged: an array lacks its shape or name")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    shape = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
    name = parts[2][1].decode("utf-8", errors="replace")
    if flags & 0xFF not in CLASSES or flags & COMPLEX:
        return None
    kind, content = parts[3] if len(parts) > 3 else (0, b"")
    if kind not in STORED or min(shape, default=-1) < 0:
        raise FormatError(f"is damaged: array {name!r} has no values")
    stored = np.dtype(order + STORED[kind])
    if len(content) != math.prod(shape) * stored.itemsize:
        raise FormatError(
            f"is damaged: array {name!r} {list(shape)} holds {len(content)} bytes of {stored}"
        )
    kept = np.dtype("u1" if flags & LOGICAL else CLASSES[flags & 0xFF])
    return name, np.frombuffer(content, stored).reshape(shape, order="F").astype(kept)
