"""The result of all codecs: raw counts with rows along the direction of sliding, and counts and
times as far as the skin sends them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_profile import SkinProfile

MOST_PACKET = 8192
"""Longest packet or line, in bytes; after that it counts as garbage."""
NONE = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class Rest:
    """The leftover of a codec. synced: it begins with a frame, as the bytes before it have shown.
    layout: of the last frame, if the codec keeps it."""

    data: bytes = b""
    synced: bool = False
    layout: Any = None


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """The content of bytes.

    taxels: raw counts [n, R, C] or [n, R, C, A]. ends: int64 [n], bytes up to the end of each
    frame, counted from the beginning of the leftover. skipped: int64 [n], garbage right before each
    frame. size: bytes of a frame, 0 if there is none. counts: int64 [n], sequence numbers of 32
    bits. times_us: int64 [n], device time of 32 bits. Both are empty if the skin sends none.
    garbage: bytes outside of frames. rest: for the next bytes. wrong: why these frames do not fit
    the profile, "" if they do. misfit: why bytes are garbage, and the remedy, as far as it shows.
    foreign: frames of other nodes on the same bus, which are passed over.
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
    misfit: str = ""
    foreign: int = 0

    def __len__(self) -> int:
        return len(self.ends)


def arranged(profile: SkinProfile, numbers: NDArray[Any]) -> NDArray[Any]:
    """Numbers in the order of the wire [n, rows * cols * values] -> raw counts [n, R, C] or [n, R,
    C, A]: the chosen values with the normal axis last, rows along the direction of sliding,
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
    return np.ascontiguousarray(grid, np.dtype(profile.data_type).newbyteorder("<"))


@dataclass(slots=True, eq=False)
class Gathering:
    """Frames from parts whose numbers rise within a frame. begun: where the current frame begins.
    garbage: bytes in no frame."""

    profile: SkinProfile
    numbers: list[NDArray[Any]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    skipped: list[int] = field(default_factory=list)
    begun: int = 0
    garbage: int = 0
    size: int = 0
    _before: int = 0  # garbage since the last frame
    _held: int = 0  # bytes of the parts of the current frame
    _parts: list[tuple[int, NDArray[Any]]] = field(default_factory=list)

    @property
    def open(self) -> bool:
        """Whether parts of an unfinished frame are held."""
        return bool(self._parts)

    def waste(self, upto: int) -> None:
        """The bytes up to `upto` are in no frame."""
        self.garbage += upto - self.begun
        self._before += upto - self.begun
        self.begun, self._held, self._parts = upto, 0, []

    def passed_over(self, begin: int, end: int) -> None:
        """Bytes that are neither a part nor garbage."""
        if self._parts:
            self._held += end - begin
        else:
            self.begun = end

    def put(self, begin: int, end: int, index: int, numbers: NDArray[Any]) -> None:
        """A part from `begin` to `end`. A frame ends when numbers begin again."""
        if not self._parts or index <= self._parts[-1][0]:
            self.waste(begin)
        self._parts.append((index, numbers))
        self._held += end - begin
        missing = self.profile.numbers - sum(len(part) for _, part in self._parts)
        if missing < 0 or (missing == 0 and not self._rises()):
            self.waste(end)
        elif missing == 0:
            self.frame(end, [part for _, part in self._parts], end - self.begun - self._held)

    def frame(self, end: int, numbers: list[NDArray[Any]], between: int = 0) -> None:
        """A whole frame up to `end`. between: garbage among its parts."""
        self.garbage += between
        self.numbers.append(np.concatenate(numbers))
        self.ends.append(end)
        self.skipped.append(self._before + between)
        self.size, self.begun = end - self.begun, end
        self._before, self._held, self._parts = 0, 0, []

    def _rises(self) -> bool:
        """Whether no part is missing: indices count parts, numbers or bytes."""
        steps = np.diff([index for index, _ in self._parts])
        lengths = np.array([len(part) for _, part in self._parts[:-1]])
        each = steps // lengths
        whole = (steps == each * lengths).all() and (each == each[:1]).all()
        return bool(whole or (steps == steps[:1]).all())

    def decoded(self, rest: Rest, misfit: str = "", **more: Any) -> Decoded:
        """The whole frames. rest, misfit, more: as for Decoded."""
        found = (
            np.stack(self.numbers)
            if self.numbers
            else np.empty((0, self.profile.numbers), self.profile.data_type)
        )
        return Decoded(
            arranged(self.profile, found),
            np.array(self.ends, np.int64),
            np.array(self.skipped, np.int64),
            self.size,
            self.garbage,
            rest,
            misfit=misfit,
            **more,
        )
