"""The newest frames of a skin, found by number or by time, and gaps in them interpolated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import EPOCH_BITS, Frames, SweepFormat

MAX_GAP = 2
"""Most consecutive missing frames that are interpolated; for more the status is `gap`."""


NEAR = 32
"""The frame at a time is searched first among so many frames before and after the place where it
would be without lost frames and drift."""


class FrameRing:
    """The frames of the last `seconds` and a window more. newest: number, -1 at first."""

    def __init__(self, format: SweepFormat, seconds: float) -> None:
        self.newest = -1
        self._period_ns = format.period_ns
        self._size = format.window + 2 * MAX_GAP + int(seconds * format.rate_hz)
        # slot = seq % size: a frame is found without searching, and stays until it is overwritten
        self._seq = np.full(self._size, -1, np.int64)
        self._t_ns = np.zeros(self._size, np.int64)
        self._taxels = np.zeros((self._size, *format.shape), format.numpy_type)

    @property
    def newest_ns(self) -> int:
        """Time of the newest frame, host monotonic."""
        return int(self._t_ns[self.newest % self._size])

    def restarted(self, frames: Frames) -> bool:
        """Whether `frames`, at least one, are of another enumeration than those before."""
        return self.newest >= 0 and bool(frames.seq[-1] >> EPOCH_BITS != self.newest >> EPOCH_BITS)

    def put(self, frames: Frames) -> None:
        """Put frames, at least one, into the ring."""
        n = len(frames)
        at = int(frames.seq[0]) % self._size
        slots: slice | NDArray[np.int64] = slice(at, at + n)
        if at + n > self._size or frames.seq[-1] - frames.seq[0] != n - 1:
            slots = frames.seq % self._size
        self._seq[slots], self._t_ns[slots] = frames.seq, frames.t_ns
        self._taxels[slots] = frames.taxels
        self.newest = int(frames.seq[-1])

    def latest(self, n: int) -> NDArray[Any] | None:
        """The newest `n` frames, raw counts [n, R, C(, A)]; None if some are missing."""
        window = np.arange(self.newest - n + 1, self.newest + 1)
        slots = window % self._size
        whole = self.newest >= 0 and (self._seq[slots] == window).all()
        return self._taxels[slots] if whole else None

    def window(self, first: int, n: int) -> tuple[Frames, tuple[int, ...]]:
        """Frames `first` to `first + n` with missing frames interpolated, and the indices of the
        missing frames. No frames if a gap is too wide."""
        pad = MAX_GAP
        seq = np.arange(first - pad, first + n + pad)
        slots = seq % self._size
        there = (self._seq[slots] == seq) & (seq >= 0)
        missing = pad + np.flatnonzero(~there[pad : pad + n])
        frames = Frames(self._t_ns[slots], seq, self._taxels[slots])
        whole = not len(missing) or interpolate(frames, np.flatnonzero(there), missing)
        cut = slice(pad, pad + n) if whole else slice(0)
        window = Frames(frames.t_ns[cut], frames.seq[cut], frames.taxels[cut])
        return window, tuple((missing - pad).tolist())

    def seq_at(self, t_ns: float) -> int:
        """Number of the frame at `t_ns`, computed from the nearest frame in the ring."""
        guess = self.newest - round((self.newest_ns - t_ns) / self._period_ns)
        for slots in (np.arange(guess - NEAR, guess + NEAR) % self._size, slice(None)):
            away = np.abs(self._t_ns[slots] - round(t_ns))
            k = int(away.argmin())
            if away[k] <= self._period_ns / 2:  # no other frame is nearer
                break
        seq, at_ns = int(self._seq[slots][k]), int(self._t_ns[slots][k])
        return seq + round((t_ns - at_ns) / self._period_ns)


def interpolate(frames: Frames, have: NDArray[np.int64], missing: NDArray[np.int64]) -> bool:
    """Interpolate the rows `missing` of `frames` in place from their neighbours in `have`; False if
    a gap is too wide. have, missing: int64, sorted row indices."""
    right = np.searchsorted(have, missing)
    if len(missing) and (right.min() == 0 or right.max() == len(have)):
        return False
    lo, hi = have[right - 1], have[right % max(len(have), 1)]
    if len(missing) and (hi - lo).max() > MAX_GAP + 1:
        return False
    part = (missing - lo) / (hi - lo)
    for values in (frames.t_ns, frames.taxels):
        a, b = values[lo].astype(np.float64), values[hi].astype(np.float64)
        between = a + (b - a) * part.reshape(-1, *[1] * (values.ndim - 1))
        values[missing] = between if values.dtype.kind == "f" else np.rint(between)
    return True
