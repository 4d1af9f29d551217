"""The promises about a controller's requests over Modbus, and about texts that a person imports;
also seeds, and words of their formats.

A target raises an error if a promise is broken, as in `targets`.
"""

import struct
from pathlib import Path

import numpy as np

from palpate.bridges import modbus_pdu
from palpate.bridges.modbus_pdu import HEADER, MOST_PDU, ModbusRequest, Reading, RequestRefused
from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from tests.fuzz.files import one_line

REGISTERS = [0] * 100
WORDS = {
    "modbus": [struct.pack(">H", number) for number in (0, 1, 6, 125, 2000, 0xFF00, 0xFFFF)],
    "import-text": [b",", b";", b"\t", b"\n", b"1e999", b"nan", b"# ", b'"', b"-0.0", b"0x1p3"],
}
"""The words of each format."""


def modbus(data: bytes, folder: Path) -> None:
    """modbus_pdu: wherever the bytes are cut, each request is read or refused; replies fit."""
    try:
        found, rest = modbus_pdu.requests(data)
    except FormatError as e:
        one_line(e)
        return
    assert len(rest) < HEADER.size + MOST_PDU, "a rest that could hold a whole request"
    for cut in {len(data) // 2, len(data) // 3, len(rest)}:
        first, left = modbus_pdu.requests(data[:cut])
        more, left = modbus_pdu.requests(data[cut:], left)
        assert ([*first, *more], left) == (found, rest), f"cut at {cut}, other requests are found"
    for request in found:
        answered = modbus_pdu.reply(request, _reply(request))
        assert HEADER.unpack_from(answered)[2] == len(answered) - HEADER.size + 1
        assert len(answered) <= HEADER.size + MOST_PDU


def _reply(request: ModbusRequest) -> bytes:
    try:
        wanted = modbus_pdu.parse(request.pdu)
        return (
            modbus_pdu.read(wanted, REGISTERS)
            if isinstance(wanted, Reading)
            else modbus_pdu.written(request.pdu)
        )
    except RequestRefused as e:
        return modbus_pdu.refusal(request.pdu, e.fault)


def imported(data: bytes, folder: Path) -> None:
    """raw_files.read: a table of numbers with a name for each column, or a FormatError."""
    file = folder / "recording.csv"
    file.write_bytes(data)
    try:
        table = raw_files.read(file)
    except FormatError as e:
        one_line(e)
        return
    assert isinstance(table.values, np.ndarray)
    assert table.values.dtype.kind in "biufc", f"{table.values.dtype} is no number"


def modbus_seeds() -> list[bytes]:
    """A request of each kind, two in a row, a truncated request."""
    pdus = [struct.pack(">BHH", function, 0, 8) for function in (1, 2, 3, 4)]
    pdus += [struct.pack(">BHH", 5, 0, 0xFF00), struct.pack(">BHHBB", 15, 0, 3, 1, 5)]
    pdus += [struct.pack(">BHH", 6, 40, 305), struct.pack(">BHHBHH", 16, 40, 2, 4, 305, 150)]
    each = [HEADER.pack(i, 0, len(pdu) + 1, 1) + pdu for i, pdu in enumerate(pdus)]
    return [b"".join(each), *each, each[0] + each[1][:9]]


def text_seeds() -> list[bytes]:
    """Tables as people keep them: with and without a header, with commas, semicolons or spaces."""
    return [
        b"t,a,b\n0,1,2\n1,3,4\n",
        b"1;2\n3;4\n",
        b"# rate 100\n1 2 3\n4 5 6\n",
        b"\xef\xbb\xbfa\tb\n1\t-2.5e3\n",
    ]


def requests_of(data: bytes) -> list[bytes]:
    """An empty first piece, then the requests in `data`, cut by the lengths in their headers."""
    found, at = [b""], 0
    while at < len(data):
        end = at + 6 + max(int.from_bytes(data[at + 4 : at + 6], "big"), 1)
        found.append(data[at:end])
        at = end
    return found


TARGETS = {"modbus": modbus, "import-text": imported}
SEEDS = {"modbus": modbus_seeds, "import-text": text_seeds}
