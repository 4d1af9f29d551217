"""The room of the ONNX file. In: its bytes. Out: what stands in it, as a Model; nothing is computed or believed.

What onnxruntime reads must be what is read here: a field that is not known, or there twice, a number in more bytes than it
needs, an end that is cut off are refused. Tensors stay where they are in the file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.onnx_check.messages import REFUSED, Kind, Model
from appliance.core.errors import BundleError

MOST_VALUES = 50_000
"""Fields and single numbers of a file, read one by one, at most: six times those of MiniRocket, which has most of our own.
Weights do not count: they are read as one."""
VARINT, BYTES, FOUR_BYTES = 0, 2, 5
"""Wire types of protobuf that are in use; 1 had eight bytes, 3 and 4 were groups."""

T = TypeVar("T")


def read(data: bytes) -> Model:
    """What stands in the bytes of an ONNX file. Raises BundleError naming the message, the field and the place."""
    return _Reader(data).message(Model, 0, len(data))


@cache
def _table(kind: type) -> dict[int, tuple[str, Kind]]:
    """The fields of a message by number: name, and what it holds."""
    return {f.metadata["number"]: (f.name, f.metadata["kind"]) for f in fields(kind)}


class _Reader:
    """Reads one file; counts what it has read."""

    def __init__(self, data: bytes) -> None:
        self._data, self._view, self._left = data, memoryview(data), MOST_VALUES

    def message(self, message: type[T], at: int, end: int) -> T:
        """The message between two places."""
        found: dict[str, Any] = {}
        table = _table(message)  # type: ignore[arg-type]  # types can be hashed
        while at < end:
            begin = at
            tag, at = self._varint(at, end)
            name, kind = table.get(tag >> 3, ("", ""))
            if not name:
                what = REFUSED.get((message, tag >> 3), f"field {tag >> 3}")
                raise _wrong(begin, f"{message.__name__.lower()}: {what}, which no model of a bundle may have")
            many = kind in ("ints", "texts") or isinstance(kind, list)
            if not many and name in found:
                raise _wrong(begin, f"{message.__name__.lower()}: {name} is there twice")
            value, at = self._value(kind[0] if isinstance(kind, list) else kind, tag, at, end)
            if not many:
                found[name] = value
            elif kind == "ints":
                found.setdefault(name, []).extend(value)
            else:
                found.setdefault(name, []).append(value)
        return message(**found)

    def _value(self, kind: str | type, tag: int, at: int, end: int) -> tuple[Any, int]:
        """What a field holds, and where the next one begins. tag: the field's number and wire type."""
        wire = tag & 7
        if wire == FOUR_BYTES and kind in ("float", "floats"):
            return self._four_bytes(kind == "floats", tag, at, end)
        if wire == VARINT and kind in _INTEGERS:
            number, at = self._varint(at, end)
            return _INTEGERS[kind](number, at), at
        if wire != BYTES or kind in ("code", "signed", "float"):
            raise _wrong(at, f"wire type {wire} does not fit the field")
        size, at = self._varint(at, end)
        if size > end - at:
            raise _wrong(at, f"{size} bytes are announced and {end - at} are there")
        end = at + size
        return (_READ[kind](self, at, end) if isinstance(kind, str) else self.message(kind, at, end)), end

    def _four_bytes(self, many: bool, tag: int, at: int, end: int) -> tuple[Any, int]:
        """One float; or all that stand one after another, each behind its tag, as one array."""
        if end - at < 4:
            raise _wrong(at, "a number is cut off")
        if not many:
            return float(np.frombuffer(self._data, "<f4", 1, at)[0]), at + 4
        run = _runs(tag).match(self._data, at - 1, end)
        stop = run.end() if run else at - 1
        each = np.dtype([("tag", "u1"), ("value", "<f4")])
        return np.frombuffer(self._data, each, (stop - at + 1) // 5, at - 1)["value"], stop

    def _varint(self, at: int, end: int) -> tuple[int, int]:
        """A number of up to 64 bits, seven in each byte, and where the next field begins."""
        self._left -= 1
        if self._left < 0:
            raise _wrong(at, f"more than {MOST_VALUES} values")
        begin, value = at, 0
        for shift in range(0, 70, 7):
            if at >= end:
                raise _wrong(begin, "a number is cut off")
            byte = self._data[at]
            at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                if value >> 64 or (shift and not byte):
                    break
                return value, at
        raise _wrong(begin, "a number in more bytes than it needs")

    def _text(self, at: int, end: int) -> str:
        try:
            return self._data[at:end].decode()
        except UnicodeDecodeError as e:
            raise _wrong(at, "a name is not UTF-8") from e

    def _bytes(self, at: int, end: int) -> memoryview:
        return self._view[at:end]

    def _ints(self, at: int, end: int) -> list[int]:
        found = []
        while at < end:
            number, at = self._varint(at, end)
            found.append(_signed(number))
        return found

    def _floats(self, at: int, end: int) -> NDArray[Any]:
        if (end - at) % 4:
            raise _wrong(at, f"{end - at} bytes are no floats")
        return np.frombuffer(self._view[at:end], "<f4")


_READ: dict[str, Callable[[_Reader, int, int], Any]] = {
    "text": _Reader._text,
    "texts": _Reader._text,
    "bytes": _Reader._bytes,
    "raw": _Reader._bytes,
    "ints": _Reader._ints,
    "floats": _Reader._floats,
}


@cache
def _runs(tag: int) -> re.Pattern[bytes]:
    """As many floats as follow each other, each behind its tag of one byte; possessive, so that nothing is remembered."""
    return re.compile(b"(?:" + re.escape(bytes([tag])) + b".{4})++", re.DOTALL)


def _signed(number: int, at: int = 0) -> int:
    return number - (number >> 63 << 64)


def _code(number: int, at: int) -> int:
    """Of a type, or a version: onnxruntime would cut off what is beyond 31 bits."""
    if number >> 31:
        raise _wrong(at, f"{_signed(number)} is no code or version")
    return number


_INTEGERS: dict[str | type, Callable[[int, int], Any]] = {
    "code": _code,
    "signed": _signed,
    "ints": lambda number, at: [_signed(number)],
}


def _wrong(at: int, what: str) -> BundleError:
    return BundleError(f"{what} (byte {at})")
