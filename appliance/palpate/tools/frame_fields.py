"""Finds checksums, frame counts, clocks and number types in frames of one length, for `palpate skin
new`. Frames are bytes [frames, bytes], in the order of their arrival."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.io import wire_numbers
from palpate.io.checksums import KINDS, NAMED, Checksum, mirrored

Order = Literal["little", "big"]
FITS = 0.95
"""Share of the frames, or of the steps between them, in which a field must be right; the rest may
be damaged or lost."""
STEPS = 0.85
"""The same for steps from frame to frame, as single frames may be passed over."""
SAMPLE = 48
"""Frames in which checksums are searched. One wrong checksum of 8 bits fits once in 256 frames."""
LEAST_DISTINCT = 4
"""Number of values from which on a byte can be a part of a checksum."""
RANDOM = 0.6
"""Share of different values in a sample from which on a number may be a CRC: 0.91 are expected for
8 bits."""
MOST_SEARCHED = 2048
"""Longest frame in which polynomials without a name are searched."""
FLOATS = 1e-6, 1e7
"""Magnitudes of sensible numbers. Other bytes that are read as float32 are seldom within, and a
zero does not count against them."""
SELDOM = 0.4
"""Share of the frames in which the highest byte of a clock changes."""
CONTRAST = 4.0, 2.5
"""Ratio of the numbers of values of two bytes from which on they are one number, and of the numbers
of their changes."""
MOST_UNTOUCHED = 0.2
"""Largest share of numbers of 24 and 32 bits that rest in the sample."""
ORDERS: tuple[Order, ...] = ("little", "big")
_SIGNS = {"little": "<", "big": ">"}


@dataclass(frozen=True, slots=True)
class CheckField:
    """A checksum at the end of frames. first: the first byte that it covers."""

    checksum: Checksum
    first: int
    order: Order


@dataclass(frozen=True, slots=True)
class CountField:
    """A number in a frame that counts the frames. at: its first byte."""

    at: int
    kind: str
    order: Order

    @property
    def end(self) -> int:
        """The first byte behind it."""
        return self.at + np.dtype(self.kind).itemsize


def checksum(frames: NDArray[np.uint8], header: int) -> CheckField | None:
    """The checksum in the last bytes of the frames. header: it may begin to cover at any of this
    number of bytes."""
    step = max(1, len(frames) // SAMPLE)
    some = frames[::step]
    for size in (4, 2, 1):
        if some.shape[1] <= size + 1 or not _lively(some[:, -size:]):
            continue
        covered = some[:, :-size]
        for order, stored in _stored(some[:, -size:]):
            if found := _found(covered, stored, size):
                named = _by_name(found, covered, stored, header)
                return CheckField(*named, order)
    return None


def _lively(ending: NDArray[np.uint8]) -> bool:
    """Whether bytes [frames, bytes] vary enough for a checksum. The high bytes of a sum vary
    little."""
    return max(len(np.unique(column)) for column in ending.T) >= LEAST_DISTINCT


def _stored(ending: NDArray[np.uint8]) -> Iterator[tuple[Order, NDArray[np.int64]]]:
    """The last bytes as numbers in both orders."""
    raw = np.ascontiguousarray(ending)
    orders: tuple[Order, ...] = ("little", "big") if ending.shape[1] > 1 else ("little",)
    for order in orders:
        yield order, raw.view(f"{_SIGNS[order]}u{ending.shape[1]}")[:, 0].astype(np.int64)


def _found(covered: NDArray[np.uint8], stored: NDArray[np.int64], size: int) -> Checksum | None:
    """A checksum that covers all bytes and gives the `stored` values."""
    for kind in (kind for kind, bytes_ in KINDS.items() if bytes_ == size):
        if kind.startswith("crc"):
            bases = dict.fromkeys(
                Checksum(kind, c.poly, 0, 0, c.reflected) for c in NAMED.values() if c.kind == kind
            )
            made = (_completed(base, covered, stored) for base in bases)
            found = next((c for c in made if c), None)
            found = found or _any_polynomial(kind, covered, stored)
        else:
            found = _completed(Checksum(kind), covered, stored)
            most = (1 << 8 * size) - 1
            if not found and kind.startswith("sum"):
                inverted = _completed(Checksum(kind), covered, stored ^ most)
                found = inverted and replace(inverted, xorout=most)
        if found:
            return found
    return None


def _completed(
    base: Checksum, covered: NDArray[np.uint8], stored: NDArray[np.int64]
) -> Checksum | None:
    """The checksum with the constant that makes it give the stored values; None if there is no such
    constant. In frames of one length, every other initial value is such a constant."""
    values = base.of_each(covered).astype(np.int64)
    most = (1 << 8 * base.size) - 1
    added = base.kind.startswith("sum")
    rest = (stored - values) & most if added else stored ^ values
    usual = (
        int(np.bincount(rest - rest.min()).argmax() + rest.min())
        if most < 1 << 17
        else (int(np.median(rest)))
    )
    if (rest == usual).mean() < FITS or len(np.unique(values)) < LEAST_DISTINCT:
        return None
    return replace(base, init=usual) if added else replace(base, xorout=usual)


def _any_polynomial(
    kind: str, covered: NDArray[np.uint8], stored: NDArray[np.int64]
) -> Checksum | None:
    """A CRC of any polynomial. The difference of two frames shows it: initial value and exclusive
    or cancel out."""
    bits = 8 * KINDS[kind]
    random = len(np.unique(stored)) >= RANDOM * min(len(stored), 1 << bits)
    if bits > 16 or covered.shape[1] > MOST_SEARCHED or not random:
        return None
    other = int(np.argmax((stored != stored[0]) & (covered != covered[0]).any(axis=1)))
    difference, wanted = covered[0] ^ covered[other], int(stored[0] ^ stored[other])
    if not wanted:
        return None
    for reflected in (False, True):
        data = [mirrored(byte, 8) for byte in difference.tolist()] if reflected else difference
        result = mirrored(wanted, bits) if reflected else wanted
        for poly in _polynomials(list(map(int, data)), result, bits):
            base = Checksum(kind, poly, 0, 0, reflected)
            # two frames tell nearly all of those apart that are wrong
            if _completed(base, covered[:8], stored[:8]) and (
                found := _completed(base, covered, stored)
            ):
                return found
    return None


def _polynomials(data: list[int], wanted: int, bits: int) -> list[int]:
    """All polynomials whose CRC of `data` is `wanted`."""
    polys = np.arange(1, 1 << bits, 2, dtype=np.uint32)
    value, top, most = np.zeros_like(polys), np.uint32(1 << (bits - 1)), np.uint32((1 << bits) - 1)
    begin = next((i for i, byte in enumerate(data) if byte), len(data))
    for byte in data[begin:]:
        value ^= np.uint32(byte << (bits - 8))
        for _ in range(8):
            value = (value << np.uint32(1) ^ np.where(value & top, polys, np.uint32(0))) & most
    return [int(poly) for poly in polys[value == wanted]]


def _by_name(
    found: Checksum, covered: NDArray[np.uint8], stored: NDArray[np.int64], header: int
) -> tuple[Checksum, int]:
    """The same checksum under a name with the first byte that it covers, if there is such a name:
    the initial value of a name may look like another constant."""
    alike = [
        c
        for c in NAMED.values()
        if (c.kind, c.poly, c.reflected) == (found.kind, found.poly, found.reflected)
    ]
    for first in range(min(header, covered.shape[1] - 1) + 1):
        for one in alike:
            if (one.of_each(covered[:, first:]) == stored).mean() >= FITS:
                return one, first
    return found, 0


def counts(frames: NDArray[np.uint8], places: set[int]) -> list[CountField]:
    """Numbers that grow by one from frame to frame, the most likely first. places: where such a
    number may begin."""
    low = np.flatnonzero(
        (np.diff(frames.astype(np.int16), axis=0) % 256 == 1).mean(axis=0) >= STEPS
    )
    if len(low) > max(2, 0.5 * frames.shape[1]):
        return []  # all taxels of a test pattern may count
    found: dict[CountField, None] = {}
    for column in low.tolist():
        for size in (4, 2, 1):
            for order, at in (("little", column), ("big", column - size + 1)):
                if at not in places or at + size > frames.shape[1]:
                    continue
                number = _numbers(frames, at, f"u{size}", order)
                step = np.diff(number) % (1 << 8 * size)
                carried = step[number[:-1] % 256 == 255]
                # else the next byte is a taxel that stays at zero
                if (step == 1).mean() >= STEPS and (not len(carried) or carried[0] == 1):
                    field = CountField(at, f"uint{8 * size}", order)  # type: ignore[arg-type]
                    found[field if size > 1 else replace(field, order="little")] = None
    return list(found)


def is_clock(frames: NDArray[np.uint8], at: int, size: int) -> bool:
    """Whether the bytes from `at` on are a number that grows evenly, as the time does."""
    if at < 0 or at + size > frames.shape[1]:
        return False
    for order in ("little", "big"):
        step = np.diff(_numbers(frames, at, f"u{size}", order))
        step = step % (1 << 8 * size) if size < 8 else step
        middle = float(np.median(step))
        even = np.abs(step - middle) <= 0.5 * middle
        # all bytes of a test pattern grow evenly, of a clock the highest byte changes seldom
        high = np.diff(frames[:, at + (size - 1) * (order == "little")].astype(np.int16))
        if 1 < middle < 1e9 and even.mean() >= STEPS and (high != 0).mean() < SELDOM:
            return True
    return False


def _numbers(frames: NDArray[np.uint8], at: int, kind: str, order: str) -> NDArray[np.int64]:
    raw = np.ascontiguousarray(frames[:, at : at + int(kind[1:])])
    return raw.view(f"{_SIGNS[order]}{kind}")[:, 0].astype(np.int64)


class Columns:
    """Statistics of the bytes of frames, to find the type of the numbers among them."""

    def __init__(self, frames: NDArray[np.uint8]) -> None:
        self.frames = frames
        self._values = np.array([len(np.unique(column)) - 1 for column in frames.T], float)
        self._changes = (np.diff(frames.astype(np.int16), axis=0) != 0).mean(axis=0)

    def still(self, begin: int, end: int) -> int:
        """How many of these bytes never change."""
        return int(np.count_nonzero(self._values[begin:end] == 0))

    def types(self, begin: int, end: int) -> Iterator[tuple[str, bool]]:
        """Possible (type, big-endian) of the numbers in these bytes, the most likely first."""
        raw = self.frames[:, begin:end]
        if (end - begin) % 4 == 0:
            for order in ORDERS:
                with np.errstate(invalid="ignore"):
                    numbers = np.abs(wire_numbers.read(raw, "float32", order).astype(np.float64))
                sensible = (numbers == 0) | ((numbers >= FLOATS[0]) & (numbers <= FLOATS[1]))
                if sensible.mean() >= 0.99 and (numbers > 0).any():
                    yield "float32", order == "big"
        for size in (4, 3, 2):
            for order in ORDERS:
                if (end - begin) % size == 0 and self._grouped(begin, end, size, order):
                    bits = 8 * size
                    signed = wire_numbers.read(raw, f"int{bits}", order).astype(np.int64)
                    sign = "" if _crosses_zero(signed, bits) else "u"
                    yield f"{sign}int{bits}", order == "big"
        yield "uint8", False

    def _grouped(self, begin: int, end: int, size: int, order: str) -> bool:
        """Whether each byte of a group of `size` varies no more than the byte below it, and the
        highest so much less than the lowest that they are one number."""
        if size > 2 and self._untouched(begin, end, size, order) > MOST_UNTOUCHED:
            return False  # a few numbers of 16 bits between others that rest
        for column, contrast in ((self._values, CONTRAST[0]), (self._changes, CONTRAST[1])):
            means = [float(column[begin + i : end : size].mean()) for i in range(size)]
            rising = means if order == "big" else means[::-1]
            if rising == sorted(rising) and rising[-1] > contrast * rising[0]:
                return True
        return False

    def _untouched(self, begin: int, end: int, size: int, order: str) -> float:
        """The share of groups whose lowest byte never changes."""
        lowest = begin if order == "little" else begin + size - 1
        return float((self._values[lowest:end:size] == 0).mean())

    def roughness(self, begin: int, end: int, dtype: str, big_endian: bool) -> float:
        """Mean change of a number from frame to frame; bytes that belong to two numbers make it
        larger."""
        raw, order = self.frames[:, begin:end], "big" if big_endian else "little"
        with np.errstate(invalid="ignore", over="ignore"):
            numbers = wire_numbers.read(raw, dtype, order).astype(np.float64)
            steps = np.abs(np.diff(numbers, axis=0))
        return float(np.nan_to_num(steps, nan=1e30, posinf=1e30).mean())


def _crosses_zero(numbers: NDArray[Any], bits: int) -> bool:
    """Whether a value passes from a little above zero to a little below it: then it has a sign."""
    near = np.abs(numbers) < 1 << (bits - 3)
    return bool((near.all(axis=0) & (numbers.min(axis=0) < 0)).any())
