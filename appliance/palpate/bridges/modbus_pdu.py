"""Modbus TCP as bytes, in pure functions: requests from the bytes of a connection, and replies to
them (Modbus Application Protocol V1.1b3; Modbus Messaging on TCP/IP V1.0b)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from palpate.core.errors import FormatError

HEADER = struct.Struct(">HHHB")
"""Transaction, protocol (0), number of bytes that follow, unit."""
MOST_PDU = 253
READ_COILS, READ_INPUTS, READ_HOLDING, READ_REGISTERS, WRITE_COIL, WRITE_COILS = 1, 2, 3, 4, 5, 15
WRITE_REGISTER, WRITE_REGISTERS = 6, 16
MOST_BITS, MOST_REGISTERS, MOST_COILS, MOST_WRITTEN = 2000, 125, 1968, 123
ON, OFF = 0xFF00, 0x0000


class ExceptionCode(IntEnum):
    """Exception codes of the application protocol, section 7."""

    FUNCTION = 1
    ADDRESS = 2
    VALUE = 3
    DEVICE = 4
    BUSY = 6


class RequestRefused(Exception):
    """A request is answered with an exception code. It is not an error of the program."""

    def __init__(self, fault: ExceptionCode) -> None:
        super().__init__(fault.name)
        self.fault = fault


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """One request. pdu: function code and data."""

    transaction: int
    unit: int
    pdu: bytes


@dataclass(frozen=True, slots=True)
class Reading:
    """A request for bits or registers."""

    function: int
    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Writing:
    """A request to write coils (0 or 1) or registers (0 to 65535), from `address` on."""

    function: int
    address: int
    values: tuple[int, ...]


def requests(data: bytes, rest: bytes = b"") -> tuple[list[ModbusRequest], bytes]:
    """The requests in `data`, which continues `rest`, and the new unfinished rest.

    Raises FormatError for bytes that are not Modbus TCP, since the beginning of the next request is
    then unknown.
    """
    data, found = rest + data, []
    while len(data) >= HEADER.size:
        transaction, protocol, length, unit = HEADER.unpack_from(data)
        if protocol or not 2 <= length <= MOST_PDU + 1:
            raise FormatError(
                f"{data[: HEADER.size].hex()} is not a header of Modbus TCP; speak it to this port"
            )
        end = HEADER.size + length - 1
        if len(data) < end:
            break
        found.append(ModbusRequest(transaction, unit, data[HEADER.size : end]))
        data = data[end:]
    return found, data


def reply(request: ModbusRequest, pdu: bytes) -> bytes:
    return HEADER.pack(request.transaction, 0, len(pdu) + 1, request.unit) + pdu


def refusal(pdu: bytes, fault: ExceptionCode) -> bytes:
    return bytes([pdu[0] | 0x80, fault])


def parse(pdu: bytes) -> Reading | Writing:
    """The content of a request. Raises RequestRefused: FUNCTION for an unsupported function, VALUE
    for a wrong length or number."""
    function, data = pdu[0], pdu[1:]
    if function in (READ_COILS, READ_INPUTS, READ_HOLDING, READ_REGISTERS):
        address, count = _pair(data)
        if len(data) != 4 or not 1 <= count <= (
            MOST_BITS if function <= READ_INPUTS else MOST_REGISTERS
        ):
            raise RequestRefused(ExceptionCode.VALUE)
        return Reading(function, address, count)
    if function in (WRITE_COIL, WRITE_REGISTER):
        address, value = _pair(data)
        if len(data) != 4 or (function == WRITE_COIL and value not in (ON, OFF)):
            raise RequestRefused(ExceptionCode.VALUE)
        return Writing(function, address, (value if function == WRITE_REGISTER else value == ON,))
    if function in (WRITE_COILS, WRITE_REGISTERS):
        return _several(function, data)
    raise RequestRefused(ExceptionCode.FUNCTION)


def _several(function: int, data: bytes) -> Writing:
    """A request to write several coils or registers. Raises RequestRefused."""
    address, count = _pair(data)
    packed, coils = data[5:], function == WRITE_COILS
    if (
        not 1 <= count <= (MOST_COILS if coils else MOST_WRITTEN)
        or data[4:5] != bytes([len(packed)])
        or len(packed) != (-(-count // 8) if coils else 2 * count)
    ):
        raise RequestRefused(ExceptionCode.VALUE)
    if coils:
        values = tuple(bool(packed[i // 8] >> i % 8 & 1) for i in range(count))
        return Writing(function, address, values)
    return Writing(function, address, struct.unpack(f">{count}H", packed))


def _pair(data: bytes) -> tuple[int, int]:
    if len(data) < 4:
        raise RequestRefused(ExceptionCode.VALUE)
    first, second = struct.unpack_from(">HH", data)
    return first, second


def read(wanted: Reading, values: Sequence[int]) -> bytes:
    """The reply to a request for these bits or registers. Raises RequestRefused if it reaches
    beyond them."""
    chosen = values[wanted.address : wanted.address + wanted.count]
    if len(chosen) < wanted.count:
        raise RequestRefused(ExceptionCode.ADDRESS)
    if wanted.function <= READ_INPUTS:
        packed = bytearray(-(-wanted.count // 8))
        for i, value in enumerate(chosen):
            packed[i // 8] |= bool(value) << i % 8
        return bytes([wanted.function, len(packed)]) + packed
    return bytes([wanted.function, 2 * wanted.count]) + struct.pack(f">{wanted.count}H", *chosen)


def written(pdu: bytes) -> bytes:
    """The reply to a write that was carried out: function, address, and value or count."""
    return pdu[:5]
