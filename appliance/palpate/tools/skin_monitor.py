"""The state of a skin, for `palpate skin show`: load, rate, noise and faults. No bundle is needed:
the format is the skin's own, and the faults are visible in the signal alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import Frames, SweepFormat
from palpate.io.sensor import Sensor

SPAN_S = 2.0
"""Length of the signal for rate and noise."""
SHOWN_S = 0.1
"""Length of the signal whose mean is shown as load."""
STUCK_S = 5.0
"""A taxel with one value for this long is stuck."""
ALL = "all taxels; touch the skin, or check its cable"
"""What is shown as stuck if no taxel changes: an unloaded skin may have no noise."""
MOVED = 10.0
"""The skin counts as touched once half of its taxels have moved this many times their noise."""
DEAD = 0.1
"""After a touch, a taxel is dead if it has moved less than this share of the median."""

MOST_NAMED = 8
"""Most faulty taxels of a kind whose names are shown; of more, the number is shown."""


@dataclass(frozen=True, slots=True)
class LiveView:
    """A skin at one moment.

    number: counts Views from 1. source: as sentences name it ("usb", "sim"). skin: profile and
    format. state: of the sensor (PROTOCOL.md). trouble: the reason why it does not stream, and the
    remedy. shape: rows, columns, axes. load: mean of the last SHOWN_S minus the lowest since the
    start, [axes][rows][columns] in raw counts; empty before the first frame. full: the strongest
    load on the scale. rate_hz: measured, None without frames. noise: [axes][rows][columns] in raw
    counts. stuck, dead, saturated: names of taxels, or ALL. frames, lost: since the start; lost is
    None if it cannot be known. unit: of load and noise, "" for raw counts.
    """

    number: int
    source: str
    skin: str
    state: str
    trouble: str
    shape: tuple[int, int, int]
    load: tuple[tuple[tuple[float, ...], ...], ...] = ()
    full: float = 1.0
    rate_hz: float | None = None
    noise: tuple[tuple[tuple[float, ...], ...], ...] = ()
    stuck: tuple[str, ...] = ()
    dead: tuple[str, ...] = ()
    saturated: tuple[str, ...] = ()
    frames: int = 0
    lost: int | None = None
    unit: str = ""

    def json(self) -> dict[str, Any]:
        return asdict(self)


def line(view: LiveView) -> str:
    """A LiveView in one line: rate, frames, loss, noise and faulty taxels."""
    rate = "" if view.rate_hz is None else f"{view.rate_hz:.1f} Hz, "
    lost = "loss cannot be known" if view.lost is None else f"{view.lost:,} lost"
    noise = sorted(value for axis in view.noise for row in axis for value in row)
    unit, middle = view.unit or "raw counts", ""
    if noise:
        middle = f", noise {noise[len(noise) // 2]:.2g}, at most {noise[-1]:.2g} {unit}"
    kinds = (("stuck", view.stuck), ("dead", view.dead), ("saturated", view.saturated))
    faults = "".join(f"; {name}: {_named(taxels)}" for name, taxels in kinds if taxels)
    text = view.trouble or f"{rate}{view.frames:,} frames, {lost}{middle}{faults}"
    return f"{'SIMULATED  ' * (view.source == 'sim')}{view.skin}  {view.state}: {text}"


def _named(taxels: Sequence[str]) -> str:
    more = f" and {len(taxels) - MOST_NAMED} more" if len(taxels) > MOST_NAMED else ""
    return ", ".join(taxels[:MOST_NAMED]) + more


class SkinMonitor:
    """Collects the frames of a skin. All times are times of frames, so no clock is needed. names:
    of the skin's profile, of the source in sentences, of the unit."""

    def __init__(self, format: SweepFormat, names: tuple[str, str, str] = ("", "", "")) -> None:
        name, self._source, self._unit = names
        self._skin, self._number = f"{name} {format}", 0
        self._grid = format.rows, format.cols, format.axes
        self._limits = np.iinfo(format.dtype) if format.numpy_type.kind in "iu" else None
        self._span, self._shown = (max(2, round(s * format.rate_hz)) for s in (SPAN_S, SHOWN_S))
        self.reset()

    def reset(self) -> None:
        self._t_ns, self._taxels = np.empty(0, np.int64), np.empty((0, *self._grid))
        self._lowest, self._highest = np.full(self._grid, np.inf), np.full(self._grid, -np.inf)
        self._changed_ns, self._full = np.zeros(self._grid, np.int64), 1.0

    def take(self, frames: Frames) -> None:
        """Add frames."""
        if not len(frames):
            return
        new = frames.taxels.reshape(len(frames), *self._grid).astype(np.float64)
        if not len(self._t_ns):
            self._changed_ns[:] = frames.t_ns[0]
        with_last = np.concatenate([self._taxels[-1:], new])
        changed = (np.diff(with_last, axis=0) != 0).any(axis=0)
        self._changed_ns[changed] = frames.t_ns[-1]
        self._t_ns = np.concatenate([self._t_ns, frames.t_ns])[-self._span :]
        self._taxels = np.concatenate([self._taxels, new])[-self._span :]
        self._lowest = np.fmin(self._lowest, new.min(axis=0))
        self._highest = np.fmax(self._highest, new.max(axis=0))

    def look(self, sensor: Sensor) -> LiveView:
        """The present state of a skin."""
        self._number += 1
        return LiveView(
            *(self._number, self._source, self._skin, sensor.state, str(sensor.trouble or "")),
            self._grid,
            frames=sensor.counters.frames,
            lost=sensor.counters.lost_frames if sensor.loss_known else None,
            unit=self._unit,
            **self.measured(),
        )

    def measured(self) -> dict[str, Any]:
        """The fields of a LiveView from the signal; none before the second frame."""
        if len(self._t_ns) < 2:
            return {}
        level = self._taxels[-self._shown :].mean(axis=0)
        load = np.where(np.isfinite(level), level - self._lowest, 0)
        self._full = max(self._full, float(load.max()))
        passed_ns = int(self._t_ns[-1] - self._t_ns[0])
        noise = self._noise()
        stuck = np.asarray(self._t_ns[-1] - self._changed_ns >= STUCK_S * 1e9)
        dead = self._dead(noise)
        return {
            "load": _nested(load),
            "full": self._full,
            "noise": _nested(noise),
            "rate_hz": (len(self._t_ns) - 1) * 1e9 / passed_ns if passed_ns > 0 else None,
            "stuck": (ALL,) if stuck.all() else self._names(stuck),
            "dead": self._names(dead & ~stuck),
            "saturated": self._names(self._saturated()),
        }

    def _noise(self) -> NDArray[np.float64]:
        """Standard deviation [R, C, A] of the signal's fast part: half the mean square of
        neighbours' differences (von Neumann 1941), which a slow touch does not raise."""
        return np.asarray(np.sqrt((np.diff(self._taxels, axis=0) ** 2).mean(axis=0) / 2))

    def _dead(self, noise: NDArray[np.float64]) -> NDArray[np.bool_]:
        moved, middle = self._highest - self._lowest, (0, 1)
        least = MOVED * np.maximum(1e-12, np.median(noise, axis=middle))
        usual = np.median(moved, axis=middle)
        return np.asarray((usual > least) & (moved < DEAD * usual))

    def _saturated(self) -> NDArray[np.bool_]:
        """Taxels at the end of their type's range in the newest frame."""
        newest, limits = self._taxels[-1], self._limits
        if limits is None:
            return np.zeros(self._grid, bool)
        return np.asarray((newest >= limits.max) | ((newest <= limits.min) & (limits.min < 0)))

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        """Names of taxels, counted from 1: "2.3", or "2.3 axis 1" with several axes."""
        several = self._grid[2] > 1
        return tuple(
            f"{r + 1}.{c + 1}" + f" axis {a + 1}" * several
            for r, c, a in np.argwhere(which).tolist()
        )


def _nested(values: NDArray[np.float64]) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """[R, C, A] as tuples [A][R][C], rounded for display: noise of a skin in newtons is small."""
    shown = np.moveaxis(values, -1, 0).round(4).tolist()
    return tuple(tuple(tuple(row) for row in axis) for axis in shown)
