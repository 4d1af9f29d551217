"""Finds a recording's frame rate from its sampling times, and its runs of evenly spaced frames.

Times come from clocks that round, drivers that deliver late, and programs that lose frames. Frames
at even times are kept unchanged. Frames at uneven times are interpolated linearly onto even times.
A run ends at a gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.sweeps.frame_ring import MAX_GAP

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
GAP_FRAMES = MAX_GAP + 1.5
"""An interval longer than this many frames is a gap: three or more frames are missing. The box
counts gaps in the same way."""
MOST_ROUNDING = 1.0
"""Largest range of deviations from even times, in frames, that a clock's rounding explains."""
SAME_RATE, NEAR_RATE = 0.01, 0.05
"""Relative differences of rates: up to the first, frames are kept unchanged; up to the second, they
are interpolated."""
FEWEST_BURSTS = 5
"""This many gaps that add up to more than half of the time show that frames came in bursts."""
BURSTS = "its frames come in bursts, so their times are those at which a program read them"


@dataclass(frozen=True, eq=False)
class Runs:
    """Evenly spaced frames. parts: [n, ...] each, in the recorded type or, if interpolated, float.
    gaps: number of gaps between the parts. interpolated: whether any part was interpolated."""

    parts: tuple[Array, ...]
    gaps: int = 0
    interpolated: bool = False


def measured_hz(time_s: Array) -> float:
    """The mean frame rate of a recording, without its gaps. Raises FormatError if its times do not
    increase."""
    if not np.isfinite(time_s).all():
        first = int(np.flatnonzero(~np.isfinite(time_s))[0]) + 1
        raise FormatError(f"the time of frame {first} is not a number; fill it in or cut it away")
    steps = np.diff(time_s)
    if not len(steps):
        raise FormatError("holds one frame")
    if len(back := np.flatnonzero(steps < 0)):
        raise FormatError(
            f"the time of frame {back[0] + 2} is before that of frame {back[0] + 1}; if a clock "
            "began again there, cut the file in two, or give --rate instead of --time"
        )
    if not steps.any():
        raise FormatError("all its times are the same; give --rate instead of --time")
    usual = float(np.median(steps))
    if not usual:  # a clock too coarse for the rate, or bursts
        rate_hz = float(len(steps) / steps.sum())
        if _wander(time_s, rate_hz) > MOST_ROUNDING:
            raise FormatError(f"{BURSTS}; {remedy(time_s)}")
        return rate_hz
    gaps = steps > GAP_FRAMES * usual
    if gaps.sum() >= FEWEST_BURSTS and steps[gaps].sum() > steps[~gaps].sum():
        raise FormatError(f"{BURSTS}; {remedy(time_s)}")
    return float(1 / np.mean(steps[~gaps]))


def remedy(time_s: Array) -> str:
    """The advice for a recording whose times [n] repeat or jump, with the rate that its frames have
    if they are even."""
    rate_hz = nominal_hz(np.array([(len(time_s) - 1) / (time_s[-1] - time_s[0])]))
    return (
        "if only the times are uneven, not the frames, give --rate instead of --time; "
        f"its mean rate is --rate {rate_hz:g}"
    )


def nominal_hz(rates: Array) -> float:
    """The rate of a set from its recordings' rates: their median, to three digits."""
    return float(f"{np.median(rates):.3g}")


def runs(frames: Array, time_s: Array, rate_hz: float) -> Runs:
    """The runs of `frames` [n, ...], sampled at `time_s` [n], at `rate_hz`.

    Raises FormatError if the recording's own rate differs too much, or if uneven frames share a
    time.
    """
    own_hz = measured_hz(time_s)
    if abs(own_hz / rate_hz - 1) > NEAR_RATE:
        raise FormatError(
            f"is sampled at {own_hz:.4g} Hz, the set at {rate_hz:g} Hz; import it by itself"
        )
    gaps = np.flatnonzero(np.diff(time_s) > GAP_FRAMES / own_hz) + 1
    parts, changed = [], False
    for part, t in zip(np.split(frames, gaps), np.split(time_s, gaps), strict=True):
        if abs(own_hz / rate_hz - 1) <= SAME_RATE and _wander(t, own_hz) <= MOST_ROUNDING:
            parts.append(part)
        else:
            parts.append(_interpolated(part, t, rate_hz))
            changed = True
    return Runs(tuple(parts), len(gaps), changed)


def _wander(time_s: Array, rate_hz: float) -> float:
    """The range of the deviations of times [n] from a straight line, in frames."""
    if len(time_s) < 3:
        return 0.0
    late = (time_s - time_s[0]) * rate_hz - np.arange(len(time_s))
    line = np.polynomial.Polynomial.fit(np.arange(len(time_s)), late, 1)
    return float(np.ptp(late - line(np.arange(len(time_s)))))


def _interpolated(frames: Array, time_s: Array, rate_hz: float) -> Array:
    """Frames [m, ...] at even times, each linear between the two frames around it."""
    if len(still := np.flatnonzero(np.diff(time_s) <= 0)):
        pair = f"{still[0] + 1} and {still[0] + 2}"
        raise FormatError(f"frames {pair} of a run have the same time; {remedy(time_s)}")
    even = time_s[0] + np.arange(int((time_s[-1] - time_s[0]) * rate_hz * (1 + 1e-9)) + 1) / rate_hz
    flat = frames.reshape(len(frames), -1).astype(np.float64)
    columns = [np.interp(even, time_s, column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(len(even), *frames.shape[1:])
