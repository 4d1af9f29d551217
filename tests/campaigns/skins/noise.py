"""Counts how often a bad cable makes a wrong frame of each skin.

A frame is wrong if the box accepts it although no such frame was sent. A skin with a checksum has
no wrong frames. A skin without a checksum cannot distinguish a changed number from a measured
number. Its promise is that lost and added bytes invent no frame.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from numpy.random import Generator, default_rng

from palpate.io.skin_codecs import Rest, codec
from tests.campaigns.skins.subjects import Subject

READ_BYTES = 701
"""Bytes of one read: not a multiple of any frame."""
APART = 6
"""One frame in this many is damaged, so that a codec finds the next frames again."""

Fault = Callable[[bytes, Generator], bytes]


def lost(data: bytes, rng: Generator) -> bytes:
    """One to eight bytes are missing."""
    at = int(rng.integers(len(data)))
    return data[:at] + data[at + int(rng.integers(1, 9)) :]


def changed(data: bytes, rng: Generator) -> bytes:
    """One byte arrives changed."""
    at = int(rng.integers(len(data)))
    return data[:at] + bytes([data[at] ^ int(rng.integers(1, 256))]) + data[at + 1 :]


def added(data: bytes, rng: Generator) -> bytes:
    """One to 64 random bytes arrive as well."""
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 65))) + data[at:]


def twice(data: bytes, rng: Generator) -> bytes:
    """A part of up to 64 bytes arrives twice."""
    at = int(rng.integers(len(data)))
    return data[:at] + data[at : at + int(rng.integers(1, 65))] + data[at:]


FAULTS: tuple[Fault, ...] = (lost, changed, added, twice)


@dataclass(frozen=True, slots=True)
class NoiseCount:
    """faults; frames taken; wrong: taken frames that were not sent; frames sent."""

    faults: int
    sent: int
    taken: int
    wrong: int


def count(subject: Subject, fault: Fault, faults: int) -> NoiseCount:
    """Play a stream with one damaged frame in APART; compare the received frames."""
    known = {frame.tobytes() for frame in subject.frames}
    read, rest = codec(subject.profile), Rest()
    taken = wrong = 0
    for block in _reads(_damaged(subject, fault, faults, default_rng(1))):
        found = read(rest, block)
        rest = found.rest
        taken += len(found)
        wrong += sum(taxels.tobytes() not in known for taxels in found.taxels)
    return NoiseCount(faults, faults * APART, taken, wrong)


def _damaged(subject: Subject, fault: Fault, faults: int, rng: Generator) -> Iterator[bytes]:
    skin = subject.wire()
    for i in range(faults * APART):
        data = subject.sent(skin, i)
        yield fault(data, rng) if i % APART == APART // 2 else data


def _reads(parts: Iterator[bytes]) -> Iterator[bytes]:
    waiting = b""
    for part in parts:
        waiting += part
        while len(waiting) >= READ_BYTES:
            yield waiting[:READ_BYTES]
            waiting = waiting[READ_BYTES:]
    yield waiting
