"""Reads the bytes of an ONNX file into a Message with the fields that a bundle's model may have.

Anything that two readers could interpret differently is refused with a BundleError. Constants are
not copied.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import BundleError

MOST_VALUES = 50_000
"""Largest number of fields and single numbers, counted before objects are made: protobuf's own
library makes 1 GB of 20 MB of empty nodes. MiniRocket, our largest graph, has a sixth. An array of
weights counts once."""
VARINT, BYTES, FOUR_BYTES = 0, 2, 5
"""Wire types of protobuf that are in use. Not used: 1 (eight bytes), 3 and 4 (groups)."""
_PROTO = {
    "model": "1 ir_version code, 2 producer_name text, 3 producer_version text, 7 graph graph,"
    " 8 opset_import opset*, 14 metadata_props entry*",
    "opset": "1 domain text, 2 version code",
    "entry": "1 key text, 2 value text",
    "graph": "1 node node*, 2 name text, 5 initializer tensor*, 11 input declared*,"
    " 12 output declared*, 13 value_info declared*",
    "node": "1 input text*, 2 output text*, 3 name text, 4 op_type text, 5 attribute attribute*,"
    " 7 domain text",
    "attribute": "1 name text, 2 f float, 3 i signed, 4 s bytes, 5 t tensor, 7 floats floats,"
    " 8 ints signed*, 20 type code",
    "tensor": "1 dims signed*, 2 data_type code, 4 float_data floats, 5 int32_data signed*,"
    " 7 int64_data signed*, 8 name text, 9 raw_data bytes",
    "declared": "1 name text, 2 type type",
    "type": "1 tensor_type tensortype",
    "tensortype": "1 elem_type code, 2 shape shape",
    "shape": "1 dim dimension*",
    "dimension": "1 dim_value signed",
}
FIELDS: dict[str, dict[int, tuple[str, str]]] = {
    kind: {int(n): (name, holds) for n, name, holds in map(str.split, text.split(", "))}
    for kind, text in _PROTO.items()
}
"""Name and content of each field, by message and number; * marks repeated fields. Any other field
is refused: functions, training, data in other files, graphs in a graph. No message contains a
message of its own kind, so the depth is limited."""


class Message(SimpleNamespace):
    """One message: an attribute for each of its FIELDS.

    A field that the file leaves out is 0 (code), "" (text), () (with *) or else None. Floats are
    float32 [n], bytes a memoryview.
    """


def read(data: bytes) -> Message:
    """The model in the bytes of an ONNX file. Raises a BundleError with the message, the field and
    the position in the file."""
    return _Reader(data).message("model", 0, len(data))


def fields(message: bytes) -> Iterator[tuple[int, slice, slice]]:
    """The fields of a model or a graph that `read` has accepted, in order: number, slice of the
    whole field, and slice of its content without tag and length."""
    reader, at = _Reader(message), 0
    while at < len(message):
        begin = at
        tag, at = reader.varint(at, len(message))
        if tag & 7 == VARINT:
            _, end = reader.varint(at, len(message))
        else:
            at, end = reader.block(tag, at, len(message))
        yield tag >> 3, slice(begin, end), slice(at, end)
        at = end


@cache
def _absent(kind: str) -> dict[str, Any]:
    """The values of fields that a message leaves out, by name."""
    usual: dict[str, Any] = {"code": 0, "text": ""}
    return {
        name: () if holds[-1] == "*" else usual.get(holds) for name, holds in FIELDS[kind].values()
    }


class _Reader:
    """Reads one file and counts its fields and values."""

    def __init__(self, data: bytes) -> None:
        self._data, self._view, self._left = data, memoryview(data), MOST_VALUES

    def message(self, kind: str, at: int, end: int) -> Message:
        """The message in the bytes from `at` to `end`."""
        found: dict[str, Any] = {}
        fields = FIELDS[kind]
        while at < end:
            begin = at
            tag, at = self.varint(at, end)
            if tag >> 3 not in fields:
                what = f"{kind}: field {tag >> 3}, which no model of a bundle may have"
                raise _wrong(begin, what)
            name, holds = fields[tag >> 3]
            if holds[-1] == "*":
                values, at = self._values(holds[:-1], tag, at, end)
                found.setdefault(name, []).extend(values)
            elif name in found:
                raise _wrong(begin, f"{kind}: {name} is there twice")
            else:
                found[name], at = self._value(holds, tag, at, end)
        return Message(**(_absent(kind) | found))

    def _values(self, holds: str, tag: int, at: int, end: int) -> tuple[list[Any], int]:
        """One value of a repeated field, or all its values if they are packed, and the position of
        the next field."""
        if holds != "signed" or tag & 7 == VARINT:
            value, at = self._value(holds, tag, at, end)
            return [value], at
        found = []
        at, end = self.block(tag, at, end)
        while at < end:
            number, at = self.varint(at, end)
            found.append(_signed(number))
        return found, end

    def _value(self, holds: str, tag: int, at: int, end: int) -> tuple[Any, int]:
        """The content of a field, and the position of the next field. tag: the field's number and
        wire type."""
        if holds in ("code", "signed") and tag & 7 == VARINT:
            number, at = self.varint(at, end)
            if holds == "code" and number >> 31:  # onnxruntime would cut off higher bits
                raise _wrong(at, f"{_signed(number)} is not a code or version")
            return _signed(number), at
        if holds in ("float", "floats") and tag & 7 == FOUR_BYTES:
            return self._four_bytes(holds == "floats", tag, at, end)
        if holds in ("code", "signed", "float"):
            raise _wrong(at, f"wire type {tag & 7} does not fit the field")
        at, end = self.block(tag, at, end)
        if holds == "floats":
            if (end - at) % 4:
                raise _wrong(at, f"{end - at} bytes are no floats")
            return np.frombuffer(self._view[at:end], "<f4"), end
        if holds == "bytes":
            return self._view[at:end], end
        if holds != "text":
            return self.message(holds, at, end), end
        try:
            return self._data[at:end].decode(), end
        except UnicodeDecodeError as e:
            raise _wrong(at, "a name is not UTF-8") from e

    def block(self, tag: int, at: int, end: int) -> tuple[int, int]:
        """Begin and end of a block of bytes that follows its length."""
        if tag & 7 != BYTES:
            raise _wrong(at, f"wire type {tag & 7} does not fit the field")
        size, at = self.varint(at, end)
        if size > end - at:
            raise _wrong(at, f"{size} bytes are announced and {end - at} are there")
        return at, at + size

    def _four_bytes(
        self, many: bool, tag: int, at: int, end: int
    ) -> tuple[float | NDArray[Any], int]:
        """One float, or one array of consecutive floats that each follow their tag; and the
        position of the next field."""
        if end - at < 4:
            raise _wrong(at, "a number is cut off")
        if not many:
            return struct.unpack_from("<f", self._data, at)[0], at + 4
        run = _runs(tag).match(self._data, at - 1, end)
        stop = run.end() if run else at - 1
        each = np.dtype([("tag", "u1"), ("value", "<f4")])
        return np.frombuffer(self._data, each, (stop - at + 1) // 5, at - 1)["value"], stop

    def varint(self, at: int, end: int) -> tuple[int, int]:
        """A number of up to 64 bits, seven in each byte, and the position of the next field."""
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


@cache
def _runs(tag: int) -> re.Pattern[bytes]:
    """Pattern of consecutive floats that each follow their tag of one byte. It is possessive, so it
    needs no memory for backtracking."""
    return re.compile(b"(?:" + re.escape(bytes([tag])) + b".{4})++", re.DOTALL)


def _signed(number: int) -> int:
    return number - (number >> 63 << 64)


def _wrong(at: int, what: str) -> BundleError:
    return BundleError(f"{what} (byte {at})")
