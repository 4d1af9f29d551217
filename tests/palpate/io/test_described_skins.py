"""Kinds of skins that owners describe in a file, each emulated and read whole."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.core.config import SkinConfig
from palpate.core.errors import ConfigError
from palpate.io import checksums, skin_codecs, skin_profile
from palpate.io.serial_sensor import SerialSensor, requests
from palpate.io.skin_codecs import Rest
from palpate.io.skin_profile import SkinProfile
from palpate.sim.rig import VirtualClock
from tests.factories.skins.wires import Polled, Taxels, Wire, crc16

GRID = (4, 6)


def lines(form: str, taxels: Taxels) -> bytes:
    """A line for each row in this form, which holds its number and the row's numbers."""
    rows = [" ".join(map(str, row)) for row in taxels.tolist()]
    return b"".join(form.format(n=i, row=row).encode() for i, row in enumerate(rows, 1))


def cells(form: str, taxels: Taxels) -> bytes:
    """A line for each taxel in this form."""
    places = np.ndindex(*taxels.shape)
    return b"".join(form.format(r=r, c=c, v=taxels[r, c]).encode() for r, c in places)


def halves(taxels: Taxels) -> bytes:
    """Two parts with the number of their first taxel, and a sum."""
    flat, parts = taxels.ravel().astype("<u2"), b""
    for begin in (0, 12):
        part = struct.pack("<HBH", 0xA55A, 12, begin) + flat[begin : begin + 12].tobytes()
        parts += part + bytes([sum(part) & 0xFF])
    return parts


def shortened(taxels: Taxels) -> bytes:
    """Bytes with runs of zeros as 0 and their number, and a length."""
    body, zeros = b"", 0
    for value in [*taxels.ravel().tolist(), None]:
        if value == 0:
            zeros += 1
            continue
        body += bytes([0, zeros]) if zeros else b""
        zeros = 0
        body += b"" if value is None else bytes([value])
    return b"\xee\xdd" + bytes([len(body)]) + body


class Registers(Polled):
    """A Modbus device whose input registers from 100 on are the taxels of one frame."""

    _latched = b""

    def receive(self, data: bytes) -> bytes:
        """The answer to function 4; an exception for other registers."""
        unit, function, first, count = struct.unpack(">BBHH", data[:6])
        assert data[6:] == crc16(data[:6])
        self._latched = self._newest if first == 100 else self._latched
        words = self._latched[2 * (first - 100) :][: 2 * count]
        head = bytes([unit, function])
        if first < 100 or len(words) < 2 * count:
            return bytes([unit, function | 0x80, 2]) + crc16(bytes([unit, function | 0x80, 2]))
        answer = head + bytes([len(words)]) + words
        return answer + crc16(answer)


@dataclass(frozen=True)
class Kind:
    """A skin of GRID. wire: given its rate; text: its description."""

    wire: Callable[[float], Wire]
    keys: dict[str, object]
    shape: tuple[int, int] = GRID

    @property
    def profile(self) -> SkinProfile:
        rows, cols = self.shape
        return SkinProfile(about="a", source="s", rows=rows, cols=cols, **self.keys)  # type: ignore[arg-type]


def big(taxels: Taxels) -> bytes:
    return taxels.astype(">u2").tobytes()


ROWS = {"codec": "text", "lines": "rows", "number": "uint16"}
PARTS = {"codec": "segments", "byte_order": "little"}
KINDS = {
    "a row a line, with its number": Kind(
        partial(Wire, partial(lines, "R{n}: {row}\r\n")), ROWS | {"index": "R#:"}
    ),
    "a bare number before each row": Kind(
        partial(Wire, partial(lines, "{n} {row}\n")), ROWS | {"index": "#"}
    ),
    "rows between reports of the firmware": Kind(
        partial(Wire, lambda taxels: b"temp 21.5\n" + lines("row={n};{row}\n", taxels)),
        ROWS | {"index": "row = #;"},
    ),
    "a taxel a line, with row and column": Kind(
        partial(Wire, partial(cells, "{r},{c},{v}\n")),
        ROWS | {"lines": "taxels", "index": "#,#,"},
    ),
    "asked for by a letter": Kind(
        partial(Polled, partial(lines, "{n},{row}\n"), b"A"),
        ROWS | {"index": "#,", "poll": ("A",)},
    ),
    "asked for, in two parts": Kind(
        partial(Polled, halves, b"\x01\x02"),
        PARTS
        | {
            **{"marker": b"\x5a\xa5", "skip_before": 3, "index": "uint16", "index_at": 1},
            **{"length": "uint8", "length_of": "numbers", "checksum": "sum8"},
            **{"number": "uint16", "poll": ("hex:01 02",)},
        },
    ),
    "runs of zeros": Kind(
        partial(Wire, shortened),
        PARTS | {"marker": b"\xee\xdd", "skip_before": 1, "length": "uint8", "zeros": True},
    ),
    "registers": Kind(
        partial(Registers, big, b""),
        {"codec": "modbus", "number": "uint16", "function": 4, "register": 100},
    ),
    "more registers than one answer holds": Kind(
        partial(Registers, big, b""),
        {"codec": "modbus", "number": "uint16", "function": 4, "register": 100},
        (16, 20),
    ),
}


class SparseFrames:
    """Frame i holds i in its first taxel, and zeros among the others."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape

    def frame(self, i: int, frame_ns: Callable[[int], int] = lambda i: 0) -> NDArray[np.uint8]:
        """Frame `i`; frame i + 199 is the same."""
        cells = np.arange(np.prod(self.shape)).reshape(self.shape)
        values = np.where(cells % 5 < 2, 0, (cells * 7 + i) % 251).astype(np.uint8)
        values[0, 0] = 1 + i % 199
        return values


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_streams(name: str) -> None:
    """At the rate of its profile: whole frames, and nothing that was not sent."""

    class VirtualPort:
        """A port in virtual time, behind which a skin takes frames and answers."""

        def __init__(self, wire: Wire, source: SparseFrames, clock: VirtualClock) -> None:
            self._wire, self._source, self._clock = wire, source, clock
            self._taken, self._data, self._begun_ns = 0, b"", clock.now_ns()

        def write(self, data: bytes) -> None:
            """The answer waits to be read."""
            self._data += self._wire.receive(data)

        def read(self, size: int, timeout_ms: int) -> bytes:
            """What came within the timeout, in pieces."""
            until_ns = self._clock.now_ns() + timeout_ms * 1_000_000
            while not self._data and self._clock.now_ns() < until_ns:
                due_ns = self._begun_ns + round((self._taken + 1) * self._wire.period_ns)
                self._clock.sleep_until(min(until_ns, due_ns))
                if due_ns <= self._clock.now_ns():
                    self._data += self._wire.frame(self._source.frame(self._taken), 0)
                    self._taken += 1
            piece, self._data = self._data[:200], self._data[200:]
            return piece

        def close(self) -> None:
            """Nothing is left open."""

    kind, clock = KINDS[name], VirtualClock()
    source, profile = SparseFrames(kind.shape), replace(kind.profile, rate_hz=40.0)
    wire = kind.wire(500.0 if requests(profile) else profile.rate_hz)
    made = SerialSensor(
        SkinConfig(profile="own", port="/dev/ttySkin"),
        *(profile, profile.format, clock),
        open_port=lambda path, baud: VirtualPort(wire, source, clock),
        ports=list,
    )
    taken: list[NDArray[np.generic]] = []
    until_ns = clock.now_ns() + 5_000_000_000
    with closing(made) as sensor:
        while clock.now_ns() < until_ns:
            taken += list(sensor.read().taxels)
    assert sensor.state == "streaming"
    assert len(taken) >= 190
    sent = {source.frame(i).tobytes() for i in range(5 * 500 + 9)}
    assert {frame.astype("u1").tobytes() for frame in taken} <= sent


@pytest.mark.parametrize("name", KINDS)
def test_split_or_damaged_bytes_make_no_other_frame(name: str) -> None:
    """Byte by byte, and with a byte lost: only frames that were sent, and none for ever waiting."""
    kind = KINDS[name]
    if "registers" in name:
        pytest.skip("an answer depends on its request")
    wire, source = kind.wire(100.0), SparseFrames(kind.shape)
    sent = [wire.encode(source.frame(i)) for i in range(9)]
    codec, rest, taken = skin_codecs.codec(kind.profile), Rest(), []
    broken = sent[3][: len(sent[3]) // 2] + sent[3][len(sent[3]) // 2 + 1 :]
    for byte in b"".join([*sent[:3], broken, *sent[4:]]):
        found = codec(rest, bytes([byte]))
        rest, taken = found.rest, [*taken, *found.taxels]
    numbers = [int(frame[0, 0]) - 1 for frame in taken]
    assert numbers[:3] == [0, 1, 2]
    assert numbers[-3:] in ([6, 7, 8], [5, 6, 7])
    summed = kind.profile.checksum or "text" in kind.profile.codec
    wrong = [i for i, f in zip(numbers, taken, strict=True) if not (source.frame(i) == f).all()]
    assert len(wrong) <= (0 if summed and kind.profile.codec != "text" else 1)


def test_requests_of_many_registers_have_length_and_checksum() -> None:
    """All registers, 125 at most each; the length of the numbers and the sum are put in."""
    for rows, cols in ((1, 1), (5, 25), (16, 16), (32, 32), (60, 60)):
        profile = replace(KINDS["registers"].profile, rows=rows, cols=cols)
        counts = [int.from_bytes(r[4:6], "big") for r in requests(profile)]
        firsts = [int.from_bytes(r[2:4], "big") for r in requests(profile)]
        assert firsts == [100 + sum(counts[:i]) for i in range(len(counts))]
        assert sum(counts) == rows * cols
        assert max(counts) <= 125
        assert len(set(counts)) == len(counts)
    keys = {"poll": ("hex:55 {bytes} {crc16-modbus} 0d",), "codec": "fixed", "marker": b"\xaa"}
    profile = SkinProfile(about="a", source="s", rows=3, cols=100, **keys)  # type: ignore[arg-type]
    before = b"\x55\x2c\x01"
    assert requests(profile) == [before + crc16(before) + b"\x0d"]
    assert checksums.NAMED["crc16-modbus"].of(before) == int.from_bytes(crc16(before), "little")


@pytest.mark.parametrize(
    ("exception", "said"), [(1, "function"), (2, "register"), (3, "rows"), (6, "rate_hz")]
)
def test_an_exception_says_what_to_correct(exception: int, said: str) -> None:
    """The key to correct is named."""
    profile, answer = KINDS["registers"].profile, bytes([1, 0x84, exception])
    assert said in skin_codecs.codec(profile)(Rest(), answer + crc16(answer)).misfit


@pytest.mark.parametrize("kinds", ["int8 int8 uint8", "int16 uint16", "uint8"])
def test_types_of_values(kinds: str) -> None:
    """Each value of a taxel is read as its own type."""
    types = [np.dtype(kind).newbyteorder(">") for kind in kinds.split()]
    values = [[200, 100, 200][i % 3] * (7 if t.itemsize == 2 else 1) for i, t in enumerate(types)]
    wire = b"".join(np.array(v).astype(t).tobytes() for v, t in zip(values, types, strict=True))
    keys = {"codec": "fixed", "marker": b"\xaa\x55", "number": kinds, "byte_order": "big"}
    profile = SkinProfile(
        about="a",
        source="s",
        rows=1,
        cols=1,
        values=len(types),
        take=tuple(range(len(types))),
        **keys,  # type: ignore[arg-type]
    )
    found = skin_codecs.codec(profile)(Rest(), 4 * (b"\xaa\x55" + wire))
    wanted = [np.array(v).astype(t).item() for v, t in zip(values, types, strict=True)]
    assert found.taxels[0].ravel().tolist() == wanted


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('codec = "segments"', "needs a marker"),
        ('codec = "segments"\nmarker = "aa"\nlength = "uint8"', "skip_before"),
        ('codec = "segments"\nmarker = "aa"\nsegment = 4', "as index"),
        (
            'codec = "segments"\nmarker = "aa"\nskip_before = 1\nindex = "uint8"\nsegment = 99',
            "rows",
        ),
        ('codec = "segments"\nmarker = "aa"\nindex = "R#"', "uint8"),
        ('codec = "segments"\nmarker = "aa"\nzeros = true\nnumber = "float32"', "zeros"),
        ('codec = "text"\nindex = "R"', "R#:"),
        ('codec = "text"\nlines = "taxels"', "index"),
        ('codec = "text"\nlines = "frames"\nindex = "#"', "rows"),
        ('codec = "text"\nprefix = "P:"\nindex = "#"', "index"),
        ('codec = "modbus"', "uint16"),
        ('codec = "fixed"\nmarker = "aa"\nnumber = "int8 uint16"', "number"),
        ('codec = "fixed"\nmarker = "aa"\nnumber = "int8 int8"', "one for each"),
        ('codec = "fixed"\nmarker = "aa"\npoll = ["hex:{crc99}"]', "poll"),
    ],
)
def test_contradictions(text: str, said: str, tmp_path: Path) -> None:
    """Each contradiction names the key to write."""
    (tmp_path / "own.toml").write_text(f'about = "a"\nsource = "s"\n{text}\n')
    with pytest.raises(ConfigError) as e:
        skin_profile.load("own", [tmp_path])
    assert said in str(e.value)
