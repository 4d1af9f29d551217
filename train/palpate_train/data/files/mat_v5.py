"""Reads MAT files, versions 5 to 7, from their bytes.

Source: MathWorks, MAT-File Format (R2023a). SciPy's reader trusts the sizes in a damaged file: it
ends the process with a segmentation fault (scipy 1.17.1, three of three runs of 3,000 damaged
files). This module checks each size. Objects, such as strings, dates and tables, and sparse and
complex arrays are skipped. Version 7.3 is HDF5, which hdf5.py reads.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

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
CELL, STRUCT, OLD_OBJECT, CHAR = 1, 2, 3, 4
COMPLEX, LOGICAL = 0x0800, 0x0200
TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
"""Encodings of text on disk, by the number of their type."""
DEEPEST = 40
"""Structures may stand in each other up to this depth."""
MOST_BYTES = 1 << 31
"""Largest size of one array after decompression."""


@dataclass(frozen=True)
class Struct:
    """A structure array. records: the fields of each structure, in MATLAB's order."""

    records: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class CellArray:
    """A cell array. items: its contents, in MATLAB's order."""

    items: tuple[Any, ...]


def variables(data: bytes) -> dict[str, Any]:
    """The variables of a file by name: NumPy arrays, texts, Struct, CellArray; None for an object.

    Raises FormatError if the file is damaged or has another version.
    """
    order = ENDIAN.get(data[126:128], "")
    if not order:
        raise FormatError("is not a MAT file of version 4 to 7.3; save it with -v7")
    found: dict[str, Any] = {}
    for kind, content in _elements(data[HEADER:], order):
        if kind == COMPRESSED:
            content = _unpacked(content)
            ((kind, content),) = list(_elements(content, order)) or [(0, b"")]
        if kind == MATRIX and content:
            name, value = _matrix(content, order)
            found[name] = value
    return found


def arrays(data: bytes) -> dict[str, Array]:
    """The numeric arrays of a file by name; those in structures and cells by a path such as
    data.skin, runs(2).skin or c{1}."""
    return arrays_of(variables(data))


def arrays_of(found: Mapping[str, Any]) -> dict[str, Array]:
    """The same as `arrays`, of variables that were read already."""
    return {path: values for name, value in found.items() for path, values in _walk(name, value)}


def _walk(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, CellArray):
        for k, item in enumerate(value.items, 1):
            yield from _walk(f"{name}{{{k}}}", item)
    elif isinstance(value, Struct):
        for k, record in enumerate(value.records, 1):
            at = name if len(value.records) == 1 else f"{name}({k})"
            for field, item in record.items():
                yield from _walk(f"{at}.{field}", item)


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


def _matrix(data: bytes, order: str, depth: int = 0) -> tuple[str, Any]:
    """Name and value of an array.

    Raises FormatError if its shape, type and content do not fit together.
    """
    parts = list(_elements(data, order))
    if (parts and len(parts) < 3 and len(parts[0][1]) >= 4) or depth > DEEPEST:
        return "", None
    if len(parts) < 3 or len(parts[0][1]) < 4:
        raise FormatError("is damaged: an array lacks its shape or name")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    name = parts[2][1].decode("utf-8", errors="replace")
    if (kind := flags & 0xFF) not in (*CLASSES, CELL, STRUCT, OLD_OBJECT, CHAR) or flags & COMPLEX:
        return name, None
    if len(parts[1][1]) % 4:
        raise FormatError("is damaged: an array lacks its shape or name")
    shape = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
    if kind == CELL:
        return name, CellArray(tuple(_matrices(parts[3:], order, depth)))
    if kind == STRUCT:
        return name, _structure(parts[3:], order, depth)
    if kind == OLD_OBJECT:
        return name, _structure(parts[4:], order, depth)
    if kind == CHAR:
        stored, content = parts[3] if len(parts) > 3 else (1, b"")
        encoding = TEXT.get(stored, "latin-1")
        if encoding == "utf-16":
            encoding += "-le" if order == "<" else "-be"
        return name, content.decode(encoding, "replace")
    return name, _numbers(name, flags, shape, parts, order)


def _matrices(parts: Sequence[tuple[int, bytes]], order: str, depth: int) -> list[Any]:
    return [_matrix(content, order, depth + 1)[1] if content else None for _, content in parts]


def _structure(parts: Sequence[tuple[int, bytes]], order: str, depth: int) -> Struct:
    """A structure array, from the length of its field names, the names, and the values."""
    if len(parts) < 2 or len(parts[0][1]) < 4:
        raise FormatError("is damaged: a structure lacks the names of its fields")
    (wide,) = struct.unpack_from(f"{order}i", parts[0][1])
    if wide < 1:
        raise FormatError("is damaged: a structure lacks the names of its fields")
    texts = [parts[1][1][at : at + wide] for at in range(0, len(parts[1][1]), wide)]
    names = [text.split(b"\0")[0].decode("utf-8", errors="replace") for text in texts]
    values = _matrices(parts[2:], order, depth)
    if names and len(values) % len(names):
        raise FormatError(f"is damaged: {len(values)} values for the fields {', '.join(names)}")
    records = range(0, len(values), len(names)) if names else ()
    return Struct(
        tuple(dict(zip(names, values[at : at + len(names)], strict=True)) for at in records)
    )


def _numbers(
    name: str, flags: int, shape: Sequence[int], parts: Sequence[tuple[int, bytes]], order: str
) -> Array:
    kind, content = parts[3] if len(parts) > 3 else (0, b"")
    if kind not in STORED or min(shape, default=-1) < 0:
        raise FormatError(f"is damaged: array {name!r} has no values")
    stored = np.dtype(order + STORED[kind])
    if len(content) != math.prod(shape) * stored.itemsize:
        raise FormatError(
            f"is damaged: array {name!r} {list(shape)} holds {len(content)} bytes of {stored}"
        )
    kept = np.dtype("u1" if flags & LOGICAL else CLASSES[flags & 0xFF])
    return np.frombuffer(content, stored).reshape(shape, order="F").astype(kept)
