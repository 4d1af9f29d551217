"""What all codecs give: frames, with what is known of each. In: numbers in the order of the wire.
Out: raw counts with rows along the direction of sliding."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.io.skin_profile import SkinProfile

MOST_PACKET = 8192
"""Longest packet or line, in bytes; a longer one has no end."""
NONE = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class Rest:
    """What a codec left over. synced: it begins with a frame, as the bytes before it have shown.
    form: of the frames before it, where a codec remembers that."""

    data: bytes = b""
    synced: bool = False
    form: Any = None


@dataclass(frozen=True, slots=True)
class Decoded:
    """What bytes contained.

    taxels: raw counts [n, R, C] or [n, R, C, A]. ends: int64 [n], bytes up to the end of each
    frame, counted from the beginning of what was left over. skipped: int64 [n], garbage right
    before each. size: bytes of a frame, 0 without one. counts: int64 [n] sequence numbers of 32
    bits, times_us: int64 [n] device time, 32 bits, each empty where the skin has none. garbage:
    bytes in no frame. rest: for the next bytes. wrong: why these frames cannot be of the profile,
    "" if they can.
    """

    taxels: NDArray[Any]
    ends: NDArray[np.int64]
    skipped: NDArray[np.int64]
    size: float
    garbage: int
    rest: Rest
    counts: NDArray[np.int64] = field(default_factory=NONE.copy)
    times_us: NDArray[np.int64] = field(default_factory=NONE.copy)
    wrong: str = ""

    def __len__(self) -> int:
        return len(self.ends)


def arranged(profile: SkinProfile, numbers: NDArray[Any]) -> NDArray[Any]:
    """Numbers as they are on the wire [n, rows * cols * values] -> raw counts [n, R, C] or [n, R,
    C, A]: the chosen values, the normal axis last, rows along the direction of sliding,
    little-endian."""
    grid = numbers.reshape(len(numbers), profile.rows, profile.cols, profile.values)
    if profile.take != tuple(range(profile.values)):
        grid = grid[..., list(profile.take)]
    for turn in profile.orientation:
        grid = {
            "transpose": grid.swapaxes(1, 2),
            "flip-rows": grid[:, ::-1],
            "flip-columns": grid[:, :, ::-1],
        }[turn]
    if len(profile.take) == 1:
        grid = grid[..., 0]
    return np.ascontiguousarray(grid, np.dtype(profile.number).newbyteorder("<"))


def collected(
    profile: SkinProfile,
    numbers: list[NDArray[Any]],
    ends: list[int],
    skipped: list[int],
    garbage: int,
    rest: Rest,
    size: float,
    **more: Any,
) -> Decoded:
    """Frames that were found one by one. numbers: of each frame, as on the wire."""
    table = (
        np.stack(numbers)
        if numbers
        else np.empty((0, profile.rows * profile.cols * profile.values), profile.number)
    )
    return Decoded(
        arranged(profile, table),
        np.array(ends, np.int64),
        np.array(skipped, np.int64),
        size,
        garbage,
        rest,
        **more,
    )
