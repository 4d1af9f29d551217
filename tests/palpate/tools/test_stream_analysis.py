"""Marker, length, type, grid and rate of an unknown stream are found in its bytes, or there is no
proposal."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.io.checksums import NAMED, Checksum
from palpate.tools import skin_new
from palpate.tools.stream_analysis import Proposal, Read, analyse, grids

PERIOD_NS = 10_000_000


def reads(frames: list[bytes], cut: int = 0) -> list[Read]:
    """One read a frame, 10 ms apart; or reads of `cut` bytes, wherever frames begin."""
    if not cut:
        return [Read(i * PERIOD_NS, frame) for i, frame in enumerate(frames)]
    data = b"".join(frames)
    span = (len(frames) - 1) * PERIOD_NS
    pieces = [data[i : i + cut] for i in range(0, len(data), cut)]
    return [Read(round(i * span / (len(pieces) - 1)), piece) for i, piece in enumerate(pieces)]


def matrix(seed: int, n: int, size: int, most: int) -> np.ndarray:
    """Slow waves and noise [n, size], 0 to `most`, as pressure is."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None]
    waves = 0.5 + 0.4 * np.sin(t / rng.uniform(5, 30, size) + rng.uniform(0, 6, size))
    return (waves * most * rng.uniform(0.2, 0.9, size) + rng.normal(0, most / 100, (n, size))).clip(
        0, most
    )


def first(found: list[Proposal]) -> Proposal:
    """The most likely proposal."""
    assert found
    return found[0]


@pytest.mark.parametrize("cut", [0, 64, 333])
def test_a_marker_and_bytes_however_reads_are_cut(cut: int) -> None:
    """A marker and bytes however reads are cut."""
    frames = [b"\xaa\x55" + frame.astype("u1").tobytes() for frame in matrix(1, 120, 512, 255)]
    best = first(analyse(reads(frames, cut)))
    assert (best.framing, best.mark, best.length, best.dtype, best.values) == (
        "marker",
        b"\xaa\x55",
        514,
        "uint8",
        512,
    )
    assert best.grids[0] == (16, 32, 1)
    assert best.rate_hz == pytest.approx(100, rel=0.05)


def test_an_untouched_skin_sends_zeros_and_they_are_not_taken_for_the_marker() -> None:
    """An untouched skin sends zeros and they are not taken for the marker."""
    touched = matrix(2, 80, 16, 200)
    touched[:, :5] = 0
    frames = [b"\xaa\x55" + frame.astype("u1").tobytes() for frame in touched]
    assert (first(analyse(reads(frames))).mark, first(analyse(reads(frames))).values) == (
        b"\xaa\x55",
        16,
    )


@pytest.mark.parametrize(
    ("wire", "dtype"), [("<u2", "uint16"), (">u2", "uint16"), ("<i2", "int16"), (">i2", "int16")]
)
def test_sixteen_bits_and_their_byte_order(wire: str, dtype: str) -> None:
    """Sixteen bits and their byte order."""
    values = matrix(3, 100, 24, 900) - (450 if "i" in wire else 0)
    frames = [b"\x7e\x81" + frame.astype(wire).tobytes() for frame in values]
    best = first(analyse(reads(frames)))
    assert (best.dtype, best.big_endian, best.values) == (dtype, wire[0] == ">", 24)
    assert best.grids[0] == (4, 6, 1)
    assert (2, 4, 3) in best.grids


def test_floats_with_a_trailer_where_reads_begin_with_a_frame() -> None:
    """Floats with a trailer where reads begin with a frame."""
    frames = [(frame - 300).astype("<f4").tobytes() + b"\r\n" for frame in matrix(4, 60, 20, 900)]
    best = first(analyse(reads(frames)))
    assert (best.framing, best.mark, best.length, best.dtype) == ("trailer", b"\r\n", 82, "float32")
    assert best.values == 20


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_count_of_the_frames_behind_the_marker_is_no_taxel(size: int) -> None:
    """A count of the frames behind the marker is recognized."""
    values = matrix(5, 600, 16, 200).astype("u1")
    values[:, 0] = 0  # an untouched taxel, which could be the count's next byte
    frames = [
        b"\xa5\x5a" + (i % 256**size).to_bytes(size, "little") + frame.tobytes()
        for i, frame in enumerate(values)
    ]
    best = first(analyse(reads(frames)))
    assert (best.mark, best.sequence, best.values) == (b"\xa5\x5a", f"uint{8 * size}", 16)


def described(frames: list[bytes], cut: int = 64) -> tuple[Proposal, dict]:
    """The most likely proposal of which a profile reads the frames, with its further keys."""
    best = first(skin_new.proposals(reads(frames, cut)))
    return best, dict(best.keys)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["crc8", "crc8-maxim", "crc8-sae-j1850", "sum8", "xor8"])
def test_counter_order_and_checksum_are_found_by_trying(name: str) -> None:
    """F0 0F, a count, 36 numbers with the high byte first, a checksum of 8 bits."""
    frames = []
    for i, frame in enumerate(matrix(21, 200, 36, 4000)):
        data = bytes([i % 256]) + frame.astype(">u2").tobytes()
        frames.append(b"\xf0\x0f" + data + bytes([NAMED[name].of(data)]))
    best, keys = described(frames)
    assert (best.mark, best.sequence, best.dtype) == (b"\xf0\x0f", "uint8", "uint16")
    assert (best.big_endian, best.values, best.grids[0]) == (True, 36, (6, 6, 1))
    assert keys == {"checksum": name, "checksum_from": 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order"), [("crc16-modbus", "little"), ("crc16-xmodem", "big"), ("crc32", "little")]
)
def test_clock_count_and_wide_checksum(name: str, order: str) -> None:
    """A clock in milliseconds, a count of the other byte order, and a checksum of 16 or 32 bits
    before a trailer: all found."""
    frames = []
    for i, frame in enumerate(matrix(22, 200, 16, 900)):
        data = b"\xaa\x55" + (5000 + 10 * i).to_bytes(4, "little") + (70_000 + i).to_bytes(4, "big")
        data += frame.astype("<u2").tobytes()
        frames.append(data + NAMED[name].of(data).to_bytes(NAMED[name].size, order) + b"\r\n")
    best, keys = described(frames)
    assert (best.values, best.sequence, best.dtype) == (16, "uint32", "uint16")
    assert (keys["checksum"], keys["sequence_order"], keys["skip_before"]) == (name, "big", 4)


@pytest.mark.slow
def test_a_polynomial_without_a_name_and_a_count_behind() -> None:
    """Any CRC of 8 bits is found from the frames alone, whatever its parameters."""
    odd, frames = Checksum("crc8", 0xB7, 0x12, 0x34, True), []
    for i, frame in enumerate(matrix(23, 200, 16, 900)):
        data = b"\xa5" + frame.astype("<u2").tobytes() + (60_000 + i).to_bytes(2, "big")
        frames.append(data + bytes([odd.of(data)]))
    best, keys = described(frames)
    assert (best.values, best.sequence, keys["sequence_at"]) == (16, "uint16", 32)
    assert keys["checksum"].startswith("crc8 poly=b7 ")


def test_bytes_of_unknown_meaning_are_found_by_the_grid() -> None:
    """A grid that no proposal has: bytes of other sensors lie before the numbers."""
    rng, frames = np.random.default_rng(24), []
    for frame in matrix(24, 120, 16, 900):
        other = rng.integers(0, 256, 14, np.uint8).tobytes()
        frames.append(b"\xaa\x55" + other + frame.astype("<u2").tobytes())
    heard = skin_new.PortSample(115_200, reads(frames, 64), skin_new.proposals(reads(frames, 64)))
    chosen, grid = skin_new.choose(heard, "4x4", 0)
    assert (grid, chosen.dtype, chosen.keys["skip_before"]) == ((4, 4, 1), "uint16", 14)


def test_lost_and_foreign_bytes_do_not_hide_the_pattern() -> None:
    """Lost and foreign bytes do not hide the pattern."""
    frames = [b"\xaa\x55" + frame.astype("u1").tobytes() for frame in matrix(6, 200, 16, 255)]
    frames[50], frames[90] = frames[50][:7], frames[90] + b"boot\n"
    best = first(analyse(reads(frames, 64)))
    assert (best.mark, best.length) == (b"\xaa\x55", 18)
    assert 0.9 < best.share <= 1


@pytest.mark.parametrize(
    "number", [lambda v: f"{v:.0f}", lambda v: f"{v - 100:.0f}", str], ids=["whole", "sign", "real"]
)
def test_lines_of_numbers_are_frames(number) -> None:
    """Lines of numbers are frames, of the widest type: signs and decimals may come later."""
    frames = [
        (",".join(number(float(v)) for v in frame) + "\n").encode()
        for frame in matrix(7, 50, 16, 200)
    ]
    best = first(analyse(reads(frames)))
    assert (best.framing, best.length, best.values, best.dtype) == ("text", 1, 16, "float32")
    assert best.grids[0] == (4, 4, 1)
    assert best.rate_hz == pytest.approx(100, rel=0.1)


def test_lines_that_a_shorter_one_ends_are_one_frame() -> None:
    """Lines that a shorter one ends are one frame."""

    def frame(values: np.ndarray) -> bytes:
        """frame"""
        return (
            b"".join(
                " ".join(f"{v:.0f}" for v in row).encode() + b"\n" for row in values.reshape(16, 16)
            )
            + b"\n"
        )

    best = first(analyse(reads([frame(v) for v in matrix(8, 40, 256, 200)])))
    assert (best.length, best.values, best.grids[0]) == (16, 256, (16, 16, 1))


@pytest.mark.parametrize("data", [b"", b"\xaa\x55" * 3, bytes(4000), b"hello\nworld\n" * 40])
def test_what_has_no_frames_gets_no_proposal(data: bytes) -> None:
    """Bytes without frames get no proposal."""
    assert analyse([Read(0, data[:5]), Read(10**9, data[5:])]) == []


def test_noise_gets_no_proposal() -> None:
    """Noise gets no proposal."""
    noise = np.random.default_rng(9).integers(0, 256, 20_000).astype("u1").tobytes()
    assert analyse(reads([noise[i : i + 100] for i in range(0, 20_000, 100)])) == []


def test_grids_are_the_squarest_first_and_fit_the_format() -> None:
    """Grids are the squarest first and fit the format."""
    assert grids(16)[0] == (4, 4, 1)
    assert grids(45)[:1] == ((5, 9, 1),)
    assert (3, 5, 3) in grids(45)
    assert all(max(grid) <= 255 for grid in grids(1024))


@pytest.mark.slow
@pytest.mark.parametrize("bits", [24, 32])
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("most", [3_000, 800_000])
def test_numbers_of_24_and_32_bits_and_their_byte_order(
    bits: int, order: str, signed: bool, most: int
) -> None:
    """A converter of 24 bits behind a marker and a count, with a checksum; numbers that use the
    whole range, and numbers that leave the highest byte at rest."""
    values = matrix(31, 200, 24, most).astype(int) - signed * most // 2
    frames = []
    for i, frame in enumerate(values.tolist()):
        data = bytes([i % 256])
        data += b"".join(v.to_bytes(bits // 8, order, signed=signed) for v in frame)  # type: ignore[arg-type]
        frames.append(b"\xaa\x55" + data + bytes([NAMED["crc8"].of(data)]))
    best, keys = described(frames)
    assert (best.dtype, best.big_endian) == (f"{'' if signed else 'u'}int{bits}", order == "big")
    assert (best.values, best.sequence, keys["checksum"]) == (24, "uint8", "crc8")
    text = skin_new.profile(best, (4, 6, 1), 115_200, skin_new.PortInfo(""))
    found, _ = skin_new.decoded(text, reads(frames))
    assert found >= 198


def test_one_touched_number_of_16_bits_is_not_one_of_32() -> None:
    """All others are zero, and so the bytes beside it look like its high bytes."""
    values = np.zeros((120, 16))
    values[:, 6] = matrix(32, 120, 1, 900)[:, 0]
    frames = [b"\xa5\x5a" + frame.astype("<u2").tobytes() for frame in values]
    found = analyse(reads(frames))
    assert {p.dtype for p in found} <= {"uint8", "uint16", "int16"}


@pytest.mark.parametrize(
    ("line", "skipped"),
    [
        (lambda i, row: f"{','.join(row)},{sum(map(int, row)) % 256}\n", [16]),
        (lambda i, row: f"{','.join(row)},3.70V\n", [16]),
        (lambda i, row: f'{{"n":{i},"rows":4,"cols":4,"v":[{",".join(row)}]}}\n', [0, 1, 2]),
        (lambda i, row: f"{i * 10};{22 + i % 2}.5;{';'.join(row)};{i % 7}\n", [0, 1, 18]),
    ],
)
def test_numbers_beside_the_taxels_of_a_text_are_found_by_the_grid(line, skipped) -> None:
    """A checksum, a voltage, facts in JSON, a clock and a temperature: no proposal has 16 values,
    and the grid tells that there are 16."""
    rows = [[f"{v:.0f}" for v in frame] for frame in matrix(33, 120, 16, 900)]
    frames = [line(i, row).encode() for i, row in enumerate(rows)]
    heard = skin_new.PortSample(115_200, reads(frames, 64), skin_new.proposals(reads(frames, 64)))
    chosen, grid = skin_new.choose(heard, "4x4", 0)
    assert (chosen.values, chosen.keys["skip_columns"]) == (16, skipped)
    text = skin_new.profile(chosen, grid, 115_200, skin_new.PortInfo(""))
    found, _ = skin_new.decoded(text, reads(frames))
    assert found >= 118


@pytest.mark.parametrize("high", [0, 1])
def test_a_number_that_rests_before_the_marker_does_not_shift_the_frames(high: int) -> None:
    """The high byte of the last number is constant, and so looks like the marker's first byte; a
    clock of eight bytes follows the marker."""
    values = matrix(34, 150, 16, 900).astype(int)
    values[:, -1] = 256 * high + values[:, -1] % 256
    frames = [
        b"\xaa\x55" + (10**12 + 10_000 * i).to_bytes(8, "little") + frame.astype("<u2").tobytes()
        for i, frame in enumerate(values)
    ]
    best = first(skin_new.proposals(reads(frames, 64)))
    assert (best.mark, best.values, best.dtype, best.big_endian) == (
        b"\xaa\x55",
        16,
        "uint16",
        False,
    )
