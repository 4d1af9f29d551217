"""Time: the host's monotonic clock as an object that is passed in, and device microseconds -> host nanoseconds.

In: device time stamps with the host time at which each packet arrived. Out: when each frame was really taken.
"""

from __future__ import annotations

import time
from collections import deque
from itertools import pairwise
from typing import Protocol

WRAP = 1 << 32
USB_PPM = 2500
"""How far the clock of a full-speed device may be off (USB 2.0, 7.1.11)."""


class Clock(Protocol):
    """What every room asks for the time; the rig passes a virtual one."""

    def now_ns(self) -> int:
        """`CLOCK_MONOTONIC` in nanoseconds, the clock that GPIO edges are stamped with."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns` or at once where that has passed."""
        ...


class SystemClock:
    """The real clock."""

    def now_ns(self) -> int:
        """`CLOCK_MONOTONIC` in nanoseconds."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Sleep until `t_ns`."""
        left = t_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left / 1e9)


class DeviceClock:
    """Device time -> host time, from packets that arrive late but never early.

    Arrival minus device time is the clock offset plus a delay that is never negative, so the offset is the lower
    envelope of these points. Until `settle_s` have been seen it is their minimum. Then it is the line below all points
    of the last `span_s` that lies closest to them on average: the edge of their lower convex hull over the mean time,
    with its slope bounded by `max_ppm` (two crystals differ by less). What stays is the shortest delay itself, some
    0.1 ms, which cannot be told from the offset. A line that lies higher than the worst clock on USB can have drifted
    since the last one is none: frames that all come late, from a full FIFO, were not taken late; the last line goes on.
    Make a new one after each enumeration: the device's clock starts anew.
    """

    def __init__(
        self, *, settle_s: float = 2.0, span_s: float = 20.0, step_s: float = 0.25, max_ppm: float = 200.0
    ) -> None:
        self._settle_ns = settle_s * 1e9
        self._step_ns = int(step_s * 1e9)
        self._max_slope = max_ppm * 1e-6
        # the lowest point of each step: (device ns, offset ns); old steps fall off the left end
        self._points: deque[tuple[int, int]] = deque(maxlen=round(span_s / step_s))
        self._device_us: int | None = None
        self._first_ns = 0
        self._line = (0, 0.0, 0.0)  # at device ns, offset ns, slope
        self._fitted_ns = 0  # device time when it was found

    def unwrap(self, device_us: int) -> int:
        """Full microseconds of a 32-bit stamp, which wraps each 71.6 minutes; the nearest to the one before."""
        if self._device_us is None:
            self._device_us = device_us
        else:
            self._device_us += (device_us - self._device_us + WRAP // 2) % WRAP - WRAP // 2
        return self._device_us

    def update(self, device_ns: int, arrival_ns: int) -> None:
        """Take note that the frame taken at `device_ns` (unwrapped) had arrived at host time `arrival_ns`."""
        offset = arrival_ns - device_ns
        if not self._points:
            self._first_ns = device_ns
        if self._points and device_ns // self._step_ns == self._points[-1][0] // self._step_ns:
            if offset >= self._points[-1][1]:
                return
            self._points[-1] = (device_ns, offset)
            at, low, slope = self._line
            if offset >= low + slope * (device_ns - at):
                return  # above the line: it stays the lower envelope
        else:
            self._points.append((device_ns, offset))
        line = self._fit()
        settled = device_ns - self._first_ns >= self._settle_ns
        drift_ns = (USB_PPM * 1e-6 + self._max_slope) * (device_ns - self._fitted_ns)
        if not settled or _at(line, device_ns) <= _at(self._line, device_ns) + drift_ns:
            self._line, self._fitted_ns = line, device_ns

    def to_host_ns(self, device_ns: float) -> int:
        """Host time of `device_ns`; needs one `update` before."""
        return round(device_ns + _at(self._line, device_ns))

    def quality(self) -> dict[str, float] | None:
        """How well device time is known, or None before the first packet: for the record of a sweep.

        seconds: how much of the past the line rests on. drift_ppm: how much faster host time runs than the device's.
        late_ms: how late the promptest packet of a quarter of a second was at worst, beside the promptest of all.
        """
        if not self._points:
            return None
        late = max(offset - _at(self._line, at) for at, offset in self._points)
        seconds = (self._points[-1][0] - self._points[0][0]) / 1e9
        return {"seconds": seconds, "drift_ppm": self._line[2] * 1e6, "late_ms": late / 1e6}

    def _fit(self) -> tuple[int, float, float]:
        points = self._points
        low = min(points, key=lambda p: p[1])
        if points[-1][0] - self._first_ns < self._settle_ns:
            return low[0], low[1], 0.0
        hull: list[tuple[int, int]] = []
        for p in points:
            while len(hull) > 1 and _turns_up(hull[-2], hull[-1], p) <= 0:
                hull.pop()
            hull.append(p)
        middle = sum(p[0] for p in points) / len(points)
        left, right = next((a, b) for a, b in pairwise(hull) if b[0] >= middle)
        slope = (right[1] - left[1]) / (right[0] - left[0])
        slope = max(-self._max_slope, min(self._max_slope, slope))
        # with a bounded slope the line may cut the hull: lower it until it touches from below
        x, y = min(hull, key=lambda p: p[1] - slope * p[0])
        return x, y, slope


def _at(line: tuple[int, float, float], device_ns: float) -> float:
    """Offset of a line (at device ns, offset ns, slope) at another device time, ns."""
    at, offset, slope = line
    return offset + slope * (device_ns - at)


def _turns_up(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
    """Positive where b lies below the line from a to c."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
