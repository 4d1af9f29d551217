"""Reads MAT files of version 4 from their bytes: matrices one after the other, without a header.

Source: MathWorks, MAT-File Format (R2023a), appendix on level 4. Texts, sparse and complex matrices
are passed over.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

Array = NDArray[Any]
HEADER = 20
STORED = ("f8", "f4", "i4", "i2", "u2", "u1")
"""NumPy types of the values by their number in the type of a matrix."""
LITTLE, BIG = 0, 1
"""Machines whose floating-point numbers are those of IEEE 754; VAX and Cray are not read."""
NUMBERS = 0
LONGEST_NAME = 1024


def is_version_4(data: bytes) -> bool:
    """Whether a file begins with the header of a matrix."""
    return bool(_header(data, 0))


def variables(data: bytes) -> dict[str, Array | None]:
    """The matrices of a file by name; None for a text, a sparse or a complex one. Raises
    FormatError if the file is damaged."""
    found: dict[str, Array | None] = {}
    at = 0
    while at < len(data):
        header = _header(data, at)
        if not header:
            raise FormatError(f"is damaged: no matrix of version 4 begins at byte {at}")
        order, kind, rows, cols, imaginary, letters = header
        stored = np.dtype(order + STORED[kind // 10 % 10])
        begin = at + HEADER + letters
        size = rows * cols * stored.itemsize
        at = begin + size * (2 if imaginary else 1)
        if at > len(data):
            beyond = at - len(data)
            raise FormatError(f"is damaged or cut off: a matrix exceeds its end by {beyond} bytes")
        name = data[begin - letters : begin].split(b"\0")[0].decode("latin-1")
        plain = kind % 10 == NUMBERS and not imaginary
        values = np.frombuffer(data[begin : begin + size], stored).reshape((rows, cols), order="F")
        found[name] = values.astype(stored.newbyteorder("=")) if plain else None
    return found


def _header(data: bytes, at: int) -> tuple[str, int, int, int, int, int] | None:
    """Byte order, type without the machine, rows, columns, whether there are imaginary parts, and
    the length of the name; None for other bytes."""
    if len(data) < at + HEADER:
        return None
    for order, machine in (("<", LITTLE), (">", BIG)):
        kind, rows, cols, imaginary, letters = struct.unpack_from(f"{order}5i", data, at)
        fits = kind // 1000 == machine and kind // 100 % 10 == 0 and 0 <= kind % 1000 < 60
        sizes = min(rows, cols) >= 0 and 0 < letters <= LONGEST_NAME
        if fits and sizes and kind % 10 <= 2 and imaginary in (0, 1):
            return order, kind % 1000, rows, cols, imaginary, letters
    return None
