"""Corruptions of test sweeps: one fault at a time, in steps from none to severe.

Each corruption is an entry of CORRUPTIONS. A physical corruption of simulated sweeps draws them
again with another placement of the skin, another force or another window, each sweep from its own
random stream. All other corruptions change the raw counts, which are then digitized again. The
random draws do not depend on the severity, so that a corruption only grows with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.answer.hum import MAINS_HZ
from palpate.core.errors import FormatError
from palpate.core.types import Frames, digitized
from palpate.sim import skin
from palpate.sweeps import frame_ring
from palpate_train.data.augment import NOISY
from palpate_train.data.evaluation_sweeps import EvaluationSweeps, SimulatedScene

Array = NDArray[Any]
HUM_HZ = MAINS_HZ[0]
GAIN_LAW = 0.25
"""Spread of the gains at the severest shift of the grid: their logarithms are drawn evenly within
this range each way."""


Change = Callable[[Array, float, Generator, EvaluationSweeps], Array]


@dataclass(frozen=True)
class Corruption:
    """One fault.

    title: its name for readers. unit: of `severities`, which rise from 0 for none. change: takes
    (float32 [N, T, R, C] or [N, T, R, C, A], severity, rng, test) and returns the same shape, not
    yet digitized. only: "simulated" if the corruption needs a scene, "files" if it replaces such a
    corruption for sweeps without a scene.
    """

    name: str
    title: str
    unit: str
    severities: tuple[float, ...]
    about: str
    change: Change
    only: str = ""

    def apply(self, test: EvaluationSweeps, severity: float, seed: int) -> Array:
        """The corrupted raw counts of `test`, with the same type; unchanged at severity 0.

        The same seed draws the same taxels, signs and noise for every severity. Raises FormatError
        for a severity out of range, and if the corruption needs a scene and `test` has none.
        """
        samples = test.sweeps.samples
        if not 0 <= severity <= self.severities[-1]:
            raise FormatError(
                f"severity {severity:g} of stress {self.name!r} is out of range; use 0 to "
                f"{self.severities[-1]:g}"
            )
        if self.only == "simulated" and test.scene is None:
            raise FormatError(
                f"stress {self.name!r} draws sweeps anew and {test.sweeps.source} cannot; "
                "use sim:NAME"
            )
        if severity == 0:
            return samples
        rng = np.random.default_rng([seed, *self.name.encode()])
        return digitized(
            self.change(samples.astype(np.float32), severity, rng, test), samples.dtype
        )


def _scene(test: EvaluationSweeps) -> SimulatedScene:
    """The scene of a corruption that draws again; `apply` has refused sweeps without a scene."""
    assert test.scene
    return test.scene


def _force(sign: int, x: Array, share: float, rng: Generator, test: EvaluationSweeps) -> Array:
    scene = _scene(test)
    force_n = scene.physics.force_n * (1 + sign * share)
    return scene.draw(world=replace(scene.physics, force_n=force_n))


def _speed(sign: int, x: Array, share: float, rng: Generator, test: EvaluationSweeps) -> Array:
    scene = _scene(test)
    return scene.draw(world=replace(scene.physics, speed=1 + sign * share))


def _error_ms(x: Array, ms: float, rng: Generator) -> Array:
    late_ms: Array = ms * rng.choice([-1, 1], len(x))
    return late_ms


def _window_held(x: Array, ms: float, rng: Generator, test: EvaluationSweeps) -> Array:
    late = np.rint(_error_ms(x, ms, rng) * test.sweeps.rate_hz / 1000).astype(int)
    at = np.clip(np.arange(x.shape[1]) + late[:, None], 0, x.shape[1] - 1)
    moved: Array = np.take_along_axis(x, _over(at, x), axis=1)
    return moved


def _over(times: Array, x: Array) -> Array:
    """`times` [..., T] in the shape that broadcasts over the taxels and axes of `x` [N, T, R, C] or
    [N, T, R, C, A]."""
    return times.reshape(*times.shape, *(1,) * (x.ndim - 2))


def _regrid(x: Array, rows: float, degrees: float, share: float, rng: Generator) -> Array:
    """Taxels interpolated between their neighbours on a grid that is shifted by `rows` and turned.

    Beyond its edge the grid is mirrored. With three axes, the two of shear along rows and columns
    turn with the skin. share: part of GAIN_LAW by which the gains spread.
    """
    from scipy.ndimage import map_coordinates

    r, c = x.shape[2:4]
    i, j = np.indices((r, c)) - (np.array([r, c]) - 1)[:, None, None] / 2
    place = rows + (i + 1j * j) * np.exp(1j * np.deg2rad(degrees))
    at = np.stack([place.real + (r - 1) / 2, place.imag + (c - 1) / 2])
    taxels = np.eye(r * c).reshape(-1, r, c)
    weights = np.stack(
        [map_coordinates(taxel, at, order=1, mode="mirror").ravel() for taxel in taxels]
    )
    gain = np.exp(GAIN_LAW * share * rng.uniform(-1, 1, (len(x), 1, r, c)))
    axes = np.moveaxis(x.reshape(*x.shape[:2], r * c, -1), 3, 0) @ weights.astype(
        np.float32
    )  # [A, N, T, R * C]
    if len(axes) == 3:
        turned = (axes[0] + 1j * axes[1]) * np.exp(-1j * np.deg2rad(degrees))
        axes[0], axes[1] = turned.real, turned.imag
    read: Array = np.moveaxis(axes, 0, 3).reshape(x.shape) * gain.reshape(
        *gain.shape, *(1,) * (x.ndim - 4)
    )
    return read


def _some(x: Array, n: float, rng: Generator) -> Array:
    """`n` random taxels of each sweep, or all if there are fewer: bool [N, 1, R, C] or [N, 1, R, C,
    1]."""
    r, c, *axes = x.shape[2:]
    order = rng.permuted(np.tile(np.arange(r * c), (len(x), 1)), axis=1)
    chosen: Array = (order < n).reshape(len(x), 1, r, c, *(1,) * len(axes))
    return chosen


def dead(x: Array, chosen: Array, rng: Generator, test: EvaluationSweeps) -> Array:
    """`x` float32 [N, T, R, C] or [N, T, R, C, A] with the taxels `chosen` at 0. chosen: bool, as
    `_some` returns it."""
    return np.where(chosen, 0, x)


def stuck(x: Array, chosen: Array, rng: Generator, test: EvaluationSweeps) -> Array:
    """As `dead`, with each taxel at some count of the set's range."""
    return np.where(chosen, rng.uniform(x.min(), x.max(), (len(x), 1, *x.shape[2:])), x)


def noisy(x: Array, chosen: Array, rng: Generator, test: EvaluationSweeps) -> Array:
    """As `dead`, with white noise of NOISY standard deviations of the set."""
    noise: Array = x + chosen * np.float32(NOISY * test.rms) * rng.standard_normal(
        x.shape, np.float32
    )
    return noise


TaxelFault = Callable[[Array, Array, Generator, EvaluationSweeps], Array]
TAXEL_FAULTS: dict[str, TaxelFault] = {"dead": dead, "stuck": stuck, "noisy": noisy}


def _random(fault: TaxelFault, x: Array, n: float, rng: Generator, test: EvaluationSweeps) -> Array:
    return fault(x, _some(x, n, rng), rng, test)


def _stretch(sign: int, x: Array, share: float, rng: Generator, test: EvaluationSweeps) -> Array:
    """Stretch the sweep in time about the middle of the window; it is mirrored beyond its ends."""
    frames = x.shape[1]
    spectrum = np.fft.rfft(np.concatenate([x[:, ::-1], x, x[:, ::-1]], axis=1), axis=1)
    n = round(3 * frames / (1 + sign * share))
    stretched = np.fft.irfft(spectrum[:, : n // 2 + 1], n, axis=1) * (n / (3 * frames))
    middle: Array = stretched[:, (n - frames) // 2 :][:, :frames]
    return middle


def _drift(x: Array, share: float, rng: Generator, test: EvaluationSweeps) -> Array:
    start, end = share * test.load * rng.uniform(-1, 1, (2, len(x), 1, *x.shape[2:]))
    drifted: Array = x + start + (end - start) * _over(np.linspace(0, 1, x.shape[1]), x)
    return drifted


def _bits(x: Array, fewer: float, rng: Generator, test: EvaluationSweeps) -> Array:
    low, high = float(x.min()), float(x.max())
    step = max((high - low) / (2.0 ** (8 - fewer) - 1), float(np.finfo(np.float32).tiny))
    coarse: Array = low + np.rint((x - low) / step) * step
    return coarse


def _lost(x: Array, share: float, rng: Generator, test: EvaluationSweeps) -> Array:
    lost = rng.random(x.shape[:2]) < share
    lost[:, [0, -1]] = False  # the box also has the frames around the window
    # the box refuses a sweep with more lost frames in a row
    for t in range(frame_ring.MAX_GAP, x.shape[1]):
        lost[:, t] &= ~lost[:, t - frame_ring.MAX_GAP : t].all(axis=1)
    number = np.arange(x.shape[1])
    for taxels, missing in zip(x, lost, strict=True):
        frames = Frames(number.copy(), number, taxels)
        frame_ring.interpolate(frames, np.flatnonzero(~missing), np.flatnonzero(missing))
    return x


def _hum(x: Array, ratio: float, rng: Generator, test: EvaluationSweeps) -> Array:
    turns = HUM_HZ * np.arange(x.shape[1]) / test.sweeps.rate_hz + rng.random((len(x), 1))
    return x + ratio * test.rms * np.sin(2 * np.pi * _over(turns, x))


def _noise(x: Array, ratio: float, rng: Generator, test: EvaluationSweeps) -> Array:
    noisy: Array = x + (ratio * test.deviation).astype(np.float32) * rng.standard_normal(
        x.shape, np.float32
    )
    return noisy


Axis = tuple[str, tuple[float, ...]]
"""Unit and strengths."""
ROWS: Axis = "rows", (0, 0.25, 0.5, 1, 1.5)
DEGREES: Axis = "degrees", (0, 5, 10, 20, 30)
MS: Axis = "ms", (0, 10, 25, 50, 100)
SHARE: Axis = "share", (0, 0.1, 0.2, 0.35, 0.5)
LOST: Axis = "share", (0, 0.02, 0.05, 0.1, 0.2)
TAXELS: Axis = "taxels", (0, 1, 2, 3, 4)
DRIFT: Axis = "of full load", LOST[1]
BITS: Axis = "fewer than 8", TAXELS[1]
HUM: Axis = "deviations", (0, 0.25, 0.5, 1, 2)
NOISE: Axis = "deviations", (0, 0.1, 0.2, 0.3, 0.5)
EDGE, LATE = "edge mirrored, new gains", "window too early or late"
Row = tuple[str, str, Axis, str, Change]
# fmt: off
_DRAWN: Sequence[Row] = (
    ("shift-rows", "skin further along", ROWS, "skin further along the sliding",
        lambda x, rows, rng, test: _scene(test).draw(
            lambda p: replace(p, dx_mm=p.dx_mm + rows * skin.PITCH_MM))),
    ("turn", "skin turned", DEGREES, "skin turned on the finger",
        lambda x, degrees, rng, test: _scene(test).draw(
            lambda p: replace(p, turn_deg=p.turn_deg + degrees))),
    ("force-down", "less force", SHARE, "pressed less", partial(_force, -1)),
    ("force-up", "more force", SHARE, "pressed more", partial(_force, 1)),
    ("speed-down", "slower", SHARE, "slid slower", partial(_speed, -1)),
    ("speed-up", "faster", SHARE, "slid faster", partial(_speed, 1)),
    ("window", "window off", MS, f"{LATE}, into the rest",
        lambda x, ms, rng, test: _scene(test).draw(late_ms=_error_ms(x, ms, rng))),
)
_PLACED: Sequence[Row] = (
    ("shift-grid", "skin further along", ROWS, f"taxels read further on, {EDGE}",
        lambda x, rows, rng, test: _regrid(x, rows, 0.0, rows / ROWS[1][-1], rng)),
    ("turn-grid", "skin turned", DEGREES, f"taxels read on a turned grid, {EDGE}",
        lambda x, degrees, rng, test: _regrid(x, 0.0, degrees, degrees / DEGREES[1][-1], rng)),
    ("window-held", "window off", MS, f"{LATE}, first or last frame held", _window_held),
)
_TAXELS: Sequence[Row] = (
    ("dead", "dead taxels", TAXELS, "read 0", partial(_random, dead)),
    ("stuck", "stuck taxels", TAXELS, "each at some count of the set's range",
        partial(_random, stuck)),
    ("noisy", "noisy taxels", TAXELS, f"white noise of {NOISY:g} of the set's deviations",
        partial(_random, noisy)),
    ("gain-spread", "uneven gains", SHARE, "each taxel's gain off by up to this share",
        lambda x, share, rng, test: x * (
            1 + share * rng.uniform(-1, 1, (len(x), 1, *x.shape[2:])))),
    ("gain-down", "lower gain", SHARE, "all gains lower", lambda x, share, *_: x * (1 - share)),
    ("gain-up", "higher gain", SHARE, "all gains higher", lambda x, share, *_: x * (1 + share)),
)
_TIMED: Sequence[Row] = (
    ("stretch", "slower", SHARE, "slower: all is stretched in time", partial(_stretch, -1)),
    ("shorten", "faster", SHARE, "faster: all is shortened in time", partial(_stretch, 1)),
)
_SIGNAL: Sequence[Row] = (
    ("drift", "drift", DRIFT, "offset of each taxel, from one to another", _drift),
    ("bits", "fewer bits", BITS, "steps of the set's range: 7, 6, 5, 4 bits", _bits),
    ("lost", "lost frames", LOST, "frames lost, at most two in a row, filled as the box does",
        _lost),
    ("saturation", "saturation", SHARE, "clipped so far below full load",
        lambda x, share, rng, test: np.clip(x, -(top := (1 - share) * test.load), top)),
    ("hum", "50 Hz hum", HUM, "50 Hz on all taxels, amplitude", _hum),
    ("noise", "white noise", NOISE, "white, of each taxel's deviation", _noise),
)
# fmt: on


def _corruption(row: Row, only: str = "", more: str = "") -> Corruption:
    name, label, (unit, strengths), text, change = row
    return Corruption(name, label, unit, strengths, text + more, change, only)


CORRUPTIONS = (
    *(_corruption(row, "simulated", ", drawn anew") for row in _DRAWN),
    *(_corruption(row, "files") for row in _PLACED),
    *(_corruption(row) for row in _TAXELS),
    *(_corruption(row, "files") for row in _TIMED),
    *(_corruption(row) for row in _SIGNAL),
)


def applicable(test: EvaluationSweeps) -> tuple[Corruption, ...]:
    """All corruptions that apply to `test`: physical ones with a scene, changes of raw counts
    without."""
    other = "files" if test.scene else "simulated"
    return tuple(corruption for corruption in CORRUPTIONS if corruption.only != other)


def find(names: Sequence[str]) -> tuple[Corruption, ...]:
    """The corruptions with these names. Raises FormatError with the first unknown name."""
    known = {corruption.name: corruption for corruption in CORRUPTIONS}
    for name in names:
        if name not in known:
            raise FormatError(f"stress {name!r} is unknown; use some of {', '.join(known)}")
    return tuple(known[name] for name in names)
