"""Simulated sweeps as seen by another skin: the simulated finger with another grid, rate and scale.

The finger and the tubes are those of `sim.skin`, whose parameters were fitted to one skin. Scale
and noise here are round numbers that were not fitted. Such sweeps test the way of a skin's data
through the box. They do not show how well that skin distinguishes materials.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate.sim.skin import Array, Placement, World

SPAN_MM = 12.0
"""From the first taxel to the last, along and across: the extent of the simulated skin on the
finger."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Units of a skin. rest: raw count of an unloaded taxel. gain: raw counts for one count of the
    simulated skin.

    noise: of each value, rms in raw counts. least, most: limits of the converter.
    """

    rest: float = 0.0
    gain: float = 1.0
    noise: float = 0.36
    least: float = 0.0
    most: float = 255.0


SCALES: Mapping[str, Scale] = {
    "papillarray": Scale(gain=0.02, noise=0.01, least=-100, most=100),  # N
    "anyskin": Scale(rest=-120, gain=6, noise=2, least=-5000, most=5000),  # uT
    "reskin": Scale(rest=-120, gain=6, noise=2, least=-5000, most=5000),
    "paxini": Scale(gain=0.5, least=-128, most=127),  # 0.1 N
    "bota-serial": Scale(gain=0.2, noise=0.05, least=-500, most=500),  # N
    "xela-can": Scale(rest=20_000, gain=80, noise=30, most=0xF9FF),
    "robotiq-tsf": Scale(rest=12_000, gain=60, noise=20, most=0xFFFF),
}
"""Scales by the name of a profile; all other skins have the scale of the simulated skin."""


@dataclass(frozen=True, slots=True)
class SkinView:
    """The simulated finger with a skin of the format `FORMAT` instead of its own."""

    FORMAT: SweepFormat
    scale: Scale = field(default_factory=Scale)

    def world(self, world: World) -> World:
        """The same world with this skin's grid on the finger."""
        f = self.FORMAT
        pitch = SPAN_MM / max(1, f.rows - 1), SPAN_MM / max(1, f.cols - 1)
        return replace(world, rows=f.rows, cols=f.cols, pitch_mm=pitch, shear=f.axes == 3)

    def sweep(
        self,
        material: str,
        placement: Placement,
        rng: Generator,
        world: World,
        *,
        rest_s: float,
        slide_s: float,
        after_s: float,
    ) -> NDArray[Any]:
        """As `skin.sweep`: raw counts [n, R, C] or [n, R, C, A] at this skin's rate.

        A slow skin does not filter before it samples, so frequencies above half its rate are
        aliased, as in real skins.
        """
        world = self.world(world)
        slid, moving = skin.slide(rest_s, slide_s, after_s)
        of_touch, of_noise = rng.spawn(2)
        signal = skin.loaded(world.tube(material), placement, of_touch, world, slid, moving)
        n = sum(round(s * self.FORMAT.rate_hz) for s in (rest_s, slide_s, after_s))
        step = skin.FORMAT.rate_hz / self.FORMAT.rate_hz
        return self._digitize(_at(signal, step * np.arange(n, dtype=np.float64)), of_noise)

    def idle(self, n: int, rng: Generator, world: World) -> NDArray[Any]:
        """As `skin.idle`: n frames of a skin without contact."""
        return self._digitize(np.zeros((n, *self.FORMAT.shape)), rng)

    def _digitize(self, counts: Array, rng: Generator) -> NDArray[Any]:
        s = self.scale
        signal = s.rest + s.gain * counts + s.noise * rng.standard_normal(counts.shape)
        dtype = self.FORMAT.numpy_type
        whole = np.rint(signal) if dtype.kind in "iu" else signal
        return np.clip(whole, s.least, s.most).astype(dtype)


def _at(values: Array, at: Array) -> Array:
    """Values [n, ...] between their frames, at the positions `at` [m]."""
    low = np.minimum(at.astype(int), len(values) - 1)
    high = np.minimum(low + 1, len(values) - 1)
    part = (at - low).reshape(-1, *[1] * (values.ndim - 1))
    between: Array = values[low] * (1 - part) + values[high] * part
    return between


def view(name: str, format: SweepFormat) -> SkinView:
    """The simulated finger with a profile's skin. Raises FormatError for 2 or over 3 axes."""
    if format.axes not in (1, 3):
        raise FormatError(
            f"the simulated finger is felt with 1 or 3 axes, not {format.axes}; use another profile"
        )
    return SkinView(format, SCALES.get(name, Scale()))
