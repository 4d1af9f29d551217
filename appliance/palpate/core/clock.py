"""The host's monotonic clock as an object that is passed in, and the conversion of device time to
host time.

From device time stamps (us) and the host time (ns) of each packet's arrival follows the host time
at which each frame was taken.
"""

from __future__ import annotations

import select
import time
from collections import deque
from itertools import pairwise
from typing import Protocol

WRAP = 1 << 32
"""Device time stamps are 32 bits wide."""
USB_PPM = 2500
"""Largest error of a full-speed device's clock, parts per million (USB 2.0, 7.1.11)."""


class Clock(Protocol):
    """The source of time for every module; the simulator passes a virtual clock."""

    def now_ns(self) -> int:
        """`CLOCK_MONOTONIC` in nanoseconds, the clock by which the kernel stamps GPIO edges."""

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, or at once if that has passed."""


class SystemClock:
    """The real clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        left = t_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left / 1e9)


def wait_readable(fd: int, timeout_s: float) -> bool:
    """Wait until `fd` can be read, in real time; False if no bytes came."""
    return bool(select.select([fd], [], [], timeout_s)[0])


class DeviceClock:
    """Converts device time to host time, from packets that arrive late but never early.

    Arrival minus device time is the clock offset plus a delay that is never negative, so the offset
    is the lower envelope of these points. During the first `settle_s` it is their minimum. After
    that it is the line below all points of the last `span_s` that is closest to them on average:
    the edge of their lower convex hull at the mean time, with its slope bounded by `max_ppm` (two
    crystals differ by less). The remaining error is the shortest delay itself, about 0.1 ms, which
    cannot be distinguished from the offset. A new line is rejected if it lies higher than the worst
    clock on USB can have drifted since the last line, which then stays in use: frames that all come
    late, from a full FIFO, were not taken late. Make a new object after each enumeration, since the
    device's clock then starts again at 0.
    """

    def __init__(
        self, *, settle_s: float = 2, span_s: float = 20, step_s: float = 0.25, max_ppm: float = 200
    ) -> None:
        self._settle_ns = settle_s * 1e9
        self._step_ns = int(step_s * 1e9)
        self._max_slope = max_ppm * 1e-6
        # the lowest point of each step: (device ns, offset ns); the deque drops the oldest step
        self._points: deque[tuple[int, int]] = deque(maxlen=round(span_s / step_s))
        self._device_us: int | None = None
        self._first_ns = 0
        self._line = (0, 0.0, 0.0)  # (device ns, offset there in ns, slope)
        self._fitted_ns = 0  # device time at which the line was fitted

    def unwrap(self, device_us: int) -> int:
        """The unwrapped time in us of a 32-bit stamp: the time nearest to the last."""
        if self._device_us is None:
            self._device_us = device_us
        else:
            self._device_us += (device_us - self._device_us + WRAP // 2) % WRAP - WRAP // 2
        return self._device_us

    def update(self, device_ns: int, arrival_ns: int) -> None:
        """Record that the frame of `device_ns` (unwrapped) arrived at host time `arrival_ns`."""
        offset = arrival_ns - device_ns
        if not self._points:
            self._first_ns = device_ns
        if self._points and device_ns // self._step_ns == self._points[-1][0] // self._step_ns:
            if offset >= self._points[-1][1]:
                return
            self._points[-1] = (device_ns, offset)
            at, low, slope = self._line
            if offset >= low + slope * (device_ns - at):
                return  # above the line, which remains the lower envelope
        else:
            self._points.append((device_ns, offset))
        line = self._fit()
        settled = device_ns - self._first_ns >= self._settle_ns
        drift_ns = (USB_PPM * 1e-6 + self._max_slope) * (device_ns - self._fitted_ns)
        if not settled or _at(line, device_ns) <= _at(self._line, device_ns) + drift_ns:
            self._line, self._fitted_ns = line, device_ns

    def to_host_ns(self, device_ns: float) -> int:
        """Host time of `device_ns`; call `update` at least once before."""
        return round(device_ns + _at(self._line, device_ns))

    def quality(self) -> dict[str, float] | None:
        """Accuracy of the conversion, for the sidecar of a recorded sweep; None before the first
        packet.

        seconds: length of the past in the fit of the line. drift_ppm: how much faster host time
        runs than device time. late_ms: the fastest packet of each quarter of a second is compared
        with the fastest of all; this is the largest delay among them.
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
        # with a bounded slope the line may intersect the hull, so lower it until it touches the
        # hull from below
        x, y = min(hull, key=lambda p: p[1] - slope * p[0])
        return x, y, slope


def _at(line: tuple[int, float, float], device_ns: float) -> float:
    """Offset in ns of a line (device ns, offset there in ns, slope) at the time `device_ns`."""
    at, offset, slope = line
    return offset + slope * (device_ns - at)


def _turns_up(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
    """Positive if b lies below the line from a to c."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
