"""Frames of a fixed length with a marker before or a trailer after each, and perhaps a count and a
checksum: FlexiTac, AnySkin, most self-made matrices."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.io import checksums, wire_numbers
from palpate.io.checksums import Checksum
from palpate.io.skin_codecs.frames import NONE, Decoded, Rest, arranged, collected
from palpate.io.skin_profile import SkinProfile

AMBIGUOUS_FRAMES = 32
"""Most frames that are kept while their beginning is ambiguous; then the oldest are dropped."""

_SIGNS: dict[str, Literal["<", ">"]] = {"little": "<", "big": ">"}

MOST_RIVALS = 8
"""Most places in a frame where the mark may repeat; real frames have none or one."""


@dataclass(frozen=True, slots=True)
class FixedLayout:
    """Frames of a fixed length. mark: the bytes between two frames, the end of the first and the
    beginning of the second. period: bytes from one mark to the next. tail: bytes of the mark that
    belong to the frame before it.

    Offsets are counted from the beginning of a mark. count: of the frame count, whose type is
    count_type (None: there is none). numbers: of the first number. check: of
    the checksum; covered: of the first byte that it covers. checksum: None if there is none.
    """

    profile: SkinProfile
    mark: bytes
    tail: int
    period: int
    count: int
    count_type: np.dtype[Any] | None
    numbers: int
    check: int
    covered: int
    checksum: Checksum | None
    check_order: Literal["little", "big"]

    @property
    def body(self) -> slice:
        return slice(self.numbers, self.numbers + self.profile.body)


@lru_cache(8)
def layout(p: SkinProfile) -> FixedLayout:
    """The offsets of a profile's frames."""
    order = _SIGNS[p.sequence_order or p.byte_order]
    count = np.dtype(p.sequence).newbyteorder(order) if p.sequence else None
    mark, room = p.trailer + p.marker, count.itemsize if count else 0
    ahead = room if p.sequence_at <= p.skip_before else 0  # else the count is behind the numbers
    checksum = checksums.parsed(p.checksum)
    check = len(mark) + room + p.skip_before + p.body + p.skip_after
    return FixedLayout(
        p,
        mark,
        len(p.trailer),
        check + (checksum.size if checksum else 0),
        len(mark) + p.sequence_at,
        count,
        len(mark) + ahead + p.skip_before,
        check,
        len(p.trailer) + p.checksum_from,
        checksum,
        p.checksum_order or p.byte_order,
    )


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Read frames: the bytes between two marks that are exactly one period apart."""
    plan = layout(profile)
    data, synced = rest.data + new, rest.synced
    at = garbage = before = 0
    runs: list[NDArray[np.uint8]] = []
    ends: list[NDArray[np.int64]] = []
    skipped: list[NDArray[np.int64]] = []
    while True:
        if not synced:
            at, wasted, synced = _beginning(plan, data, at)
            garbage += wasted
            before += wasted
            if not synced:
                break
        n, broken = _run(plan, data, at)
        if n:
            runs.append(np.frombuffer(data, np.uint8, n * plan.period, at).reshape(n, plan.period))
            ends.append(at + plan.period * np.arange(1, n + 1) + plan.tail)
            skipped.append(np.array([before, *[0] * (n - 1)], np.int64))
            at, before = at + n * plan.period, 0
        if not broken:
            break
        # no mark follows one period later: bytes are missing, or this is not the beginning of a
        # frame
        at, garbage, before, synced = at + 1, garbage + 1, before + 1, False
    left = Rest(data[at:], synced)
    if not runs:
        return collected(plan.profile, [], [], [], garbage, left, 0)
    table = np.concatenate(runs) if len(runs) > 1 else runs[0]
    taxels, counts = _columns(plan, table)
    found = Decoded(
        taxels, np.concatenate(ends), np.concatenate(skipped), plan.period, garbage, left, counts
    )
    return _checked(plan, table, found) if plan.checksum else found


def _checked(layout: FixedLayout, table: NDArray[np.uint8], found: Decoded) -> Decoded:
    """The frames whose checksum is right. table: all frames as bytes [n, period]."""
    assert layout.checksum
    right = np.array(
        [
            layout.checksum.of(row[layout.covered : layout.check])
            == int.from_bytes(row[layout.check :], layout.check_order)
            for row in map(bytes, table)
        ]
    )
    if right.all():
        return found
    # bytes that are skipped before a frame include the damaged frames before it
    skipped = np.cumsum(found.skipped + layout.period * ~right)[right]
    misfit = (
        f"the {layout.profile.checksum} of {np.count_nonzero(~right)} frames is wrong; "
        "correct checksum, checksum_from or checksum_order in its profile, or check the cable"
    )
    return Decoded(
        found.taxels[right],
        found.ends[right],
        np.diff(skipped, prepend=0),
        layout.period if right.any() else 0,
        found.garbage + layout.period * int(np.count_nonzero(~right)),
        found.rest,
        found.counts[right] if len(found.counts) else found.counts,
        misfit=misfit,
    )


def _columns(
    layout: FixedLayout, table: NDArray[np.uint8]
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Frames as bytes [n, period] -> raw counts, and sequence numbers if there are any."""
    counts = NONE
    if kind := layout.count_type:
        raw = np.ascontiguousarray(table[:, layout.count : layout.count + kind.itemsize])
        counts = raw.view(kind)[:, 0].astype(np.int64)
    p = layout.profile
    numbers = wire_numbers.read(table[:, layout.body], p.number, p.byte_order)
    return arranged(p, numbers), counts


def _run(layout: FixedLayout, data: bytes, at: int) -> tuple[int, bool]:
    """How many frames follow the mark at `at`, and whether the next is broken."""
    mark, period = layout.mark, layout.period
    n = 0
    while (end := at + (n + 1) * period) + len(mark) <= len(data):
        if not data.startswith(mark, end):
            return n, True
        n += 1
    return n, False


def _beginning(layout: FixedLayout, data: bytes, at: int) -> tuple[int, int, bool]:
    """Where frames begin at or after `at`, the bytes before it, and whether that is certain."""
    begun = at
    while (at := data.find(layout.mark, at)) >= 0:
        skip = _begins(layout, data, at)
        if not skip:
            return at, at - begun, skip == 0
        at += skip
    kept = max(begun, len(data) - len(layout.mark) + 1)
    return kept, kept - begun, False


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
