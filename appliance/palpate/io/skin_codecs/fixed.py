"""Frames of a fixed length with a marker before or a trailer after each, and perhaps a count and a
checksum: FlexiTac, AnySkin, most self-made matrices."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from palpate.io import checksums, wire_numbers
from palpate.io.checksums import Checksum
from palpate.io.skin_codecs.frames import Decoded, Gathering, Rest
from palpate.io.skin_profile import FIELD_BYTES, SkinProfile

AMBIGUOUS_FRAMES = 32
"""Most frames that are kept while their beginning is ambiguous; then the oldest are dropped."""

MOST_RIVALS = 8
"""Most places in a frame where the mark may repeat; real frames have none or one."""


@dataclass(frozen=True, slots=True)
class FixedLayout:
    """Frames of a fixed length. mark: the bytes between two frames, the end of the first and the
    beginning of the second. period: bytes from one mark to the next. tail: bytes of the mark that
    belong to the frame before it.

    Offsets are counted from the beginning of a mark. count: of the frame count, if there is one.
    numbers: of the first number. check: of the checksum; covered: of the first byte that it covers.
    checksum: None if there is none.
    """

    mark: bytes
    tail: int
    period: int
    count: slice
    numbers: int
    check: int
    covered: int
    checksum: Checksum | None
    check_order: Literal["little", "big"]

    def sums(self, frame: bytes) -> tuple[bytes, bytes]:
        """The checksum of a frame from its mark on, as sent and as it should be; empty without
        one."""
        if not self.checksum:
            return b"", b""
        right = self.checksum.of(frame[self.covered : self.check])
        return frame[self.check :], right.to_bytes(self.checksum.size, self.check_order)


@lru_cache(8)
def layout(p: SkinProfile) -> FixedLayout:
    """The offsets of a profile's frames."""
    mark, room = p.trailer + p.marker, FIELD_BYTES.get(p.sequence, 0)
    ahead = room if p.sequence_at <= p.skip_before else 0  # else the count is behind the numbers
    checksum = checksums.parsed(p.checksum)
    count, check = (
        len(mark) + p.sequence_at,
        len(mark) + room + p.skip_before + p.body + p.skip_after,
    )
    return FixedLayout(
        mark,
        len(p.trailer),
        check + (checksum.size if checksum else 0),
        slice(count, count + room),
        len(mark) + ahead + p.skip_before,
        check,
        len(p.trailer) + p.checksum_from,
        checksum,
        p.checksum_order or p.byte_order,
    )


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Read frames: the bytes between two marks that are exactly one period apart."""
    plan, p = layout(profile), profile
    data, synced, at, wrong = rest.data + new, rest.synced, 0, 0
    frames, counts = Gathering(profile), list[int]()
    while True:
        if not synced:
            at, synced = _beginning(plan, data, at)
            frames.waste(at)
        end = at + plan.period
        if not synced or end + len(plan.mark) > len(data):
            break
        frame = data[at:end]
        sent, right = plan.sums(frame)
        if not data.startswith(plan.mark, end):
            # bytes are missing, or this is not the beginning of a frame
            at, synced = at + 1, False
            frames.waste(at)
        elif sent != right:
            at, wrong = end, wrong + 1
            frames.waste(at)
        else:
            raw = np.frombuffer(frame, np.uint8, p.body, plan.numbers)
            frames.frame(end, [wire_numbers.read(raw[None], p.number, p.byte_order)[0]])
            frames.ends[-1] += plan.tail
            if p.sequence:
                order = p.sequence_order or p.byte_order
                counts.append(int.from_bytes(frame[plan.count], order))
            at = end
    misfit = (
        f"the {p.checksum} of {wrong} frames is wrong; correct checksum, checksum_from or"
        " checksum_order in its profile, or check the cable"
    )
    left = Rest(data[at:], synced)
    return frames.decoded(left, misfit if wrong else "", counts=np.array(counts, np.int64))


def _beginning(layout: FixedLayout, data: bytes, at: int) -> tuple[int, bool]:
    """Where frames begin at or after `at`, and whether that is certain."""
    begun = at
    while (at := data.find(layout.mark, at)) >= 0:
        skip = _begins(layout, data, at)
        if not skip:
            return at, skip == 0
        at += skip
    return max(begun, len(data) - len(layout.mark) + 1), False


def _begins(layout: FixedLayout, data: bytes, at: int) -> int | None:
    """0 if frames begin with the mark at `at`, else the bytes to pass over; None if more bytes are
    needed.

    A mark may also occur among the numbers, in every frame at the same place as long as the skin is
    at rest. So a beginning is certain once two periods have followed it, and no other mark within
    the first period is followed by two. The result does not depend on further bytes. Frames with an
    ambiguous beginning are passed over as a whole. So are frames full of marks, which would take
    more time to judge than to arrive.
    """
    mark, period, rivals = layout.mark, layout.period, [at]
    for i in range(1, AMBIGUOUS_FRAMES + 1):
        if (end := at + i * period) + len(mark) > len(data):
            return None
        if not data.startswith(mark, end):
            return 1
        if i == 1:
            places = re.finditer(b"(?=%b)" % re.escape(mark), data[at + 1 : end + len(mark) - 1])
            rivals = [at + 1 + place.start() for place in places]
        if rivals and rivals[-1] + i * period + len(mark) > len(data):
            return None
        rivals = [other for other in rivals if data.startswith(mark, other + i * period)]
        if i >= 2 and not rivals:
            return 0
        if i >= 2 and len(rivals) > MOST_RIVALS:
            return period
    return period
