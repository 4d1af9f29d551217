"""The room of stresses: the ways in which a sweep goes wrong. In: test sweeps. Out: the same sweeps with one thing wrong.

Each stress is one entry of STRESSES and goes from none to severe. What can be physical is: simulated sweeps are drawn
anew with the skin, the force or the window elsewhere, each from its own random stream. The rest is done to the digits,
which are digitized again. What is drawn does not depend on the severity, so that a stress only grows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from appliance.core.errors import FormatError
from appliance.core.types import Frames
from appliance.recording import sweep_window
from appliance.sim import skin
from train.data import sets
from train.data.sets import Dataset

Array = NDArray[Any]
HUM_HZ = 50.0
NOISY = 4.0
"""Noise of a noisy taxel, in the set's deviations."""
GAIN_LAW = 0.25
"""Of the shifted grid: gains are spread evenly by this much, on a logarithmic scale, at the severest shift."""
USUAL_SWEEPS = 120
"""Test sweeps of a file that are put under stress; more make a point surer and everything slower."""
REST_S = 0.1
"""How long the simulated finger rests before and after the slide, which is as long as the window."""


@dataclass(frozen=True)
class SimulatedScene:
    """Simulated sweeps that can be drawn anew, each from the random stream that it had.

    materials: text [N]. places: where the skin sat in each. worlds: seed of the set that each is of.
    """

    materials: tuple[str, ...]
    places: tuple[skin.Placement, ...]
    worlds: tuple[int, ...]

    def draw(
        self,
        place: Callable[[skin.Placement], skin.Placement] = lambda p: p,
        world: skin.World = skin.WORLD,
        late_ms: Array | float = 0.0,
    ) -> Array:
        """Digits uint8 [N, 1500, 4, 4]; late_ms (a number or [N], at most 100 each way): start of window minus slide's."""
        form, rest = skin.FORMAT, round(REST_S * skin.FORMAT.rate_hz)
        late = np.rint(np.broadcast_to(late_ms, len(self.places)) * form.rate_hz / 1000).astype(int)
        drawn = np.empty((len(self.places), form.window, form.rows, form.cols), form.digits)
        for i, (material, at, seed) in enumerate(zip(self.materials, self.places, self.worlds, strict=True)):
            rng = np.random.default_rng([seed, i, *b"stress"])
            length_s = {"rest_s": REST_S, "slide_s": form.window / form.rate_hz, "after_s": REST_S}
            whole = skin.sweep(material, place(at), rng, world, **length_s)
            drawn[i] = whole[rest + late[i] :][: form.window]
        return drawn


@dataclass(frozen=True)
class EvaluationSweeps:
    """What is put under stress: test sweeps and, where they are simulated, the scene that draws them anew."""

    sweeps: Dataset
    scene: SimulatedScene | None = None

    @classmethod
    def of(cls, sweeps: Dataset, most: int = USUAL_SWEEPS, seed: int = 0) -> EvaluationSweeps:
        """About `most` of the `sweeps`, as many of each material as there are."""
        order = np.random.default_rng(seed).permutation(len(sweeps))
        rank = np.empty(len(sweeps), int)
        for label in np.unique(sweeps.labels):
            those = order[sweeps.labels[order] == label]
            rank[those] = np.arange(len(those))
        return cls(sweeps.take(np.sort(order[np.argsort(rank[order], kind="stable")[:most]])))

    @classmethod
    def simulated(cls, spec: str, seed: int = 0) -> EvaluationSweeps:
        """The sweeps of the scene "sim:NAME[:SEED[-LAST][:SWEEPS]]" (see sets.load), with a rest before and after each.

        They are others than those of the set of that name, at the same places. Raises FormatError as `sets.load`.
        """
        base = sets.load(spec, seed)
        found = sets.SIMULATED.fullmatch(spec)
        if not found:
            raise FormatError(f"set {spec!r} is no simulated one; use sim:NAME, or EvaluationSweeps.of for a file")
        first = int(found["seed"] or seed)
        worlds = range(first, int(found["last"] or first) + 1)
        all_places = [(world, place) for world in worlds for place in skin.placements(found["name"], world)]
        own, places = zip(*(all_places[i] for i in base.group("position")), strict=True)
        scene = SimulatedScene(tuple(base.materials[k] for k in base.labels), places, own)
        return cls(replace(base, samples=scene.draw()), scene)

    @cached_property
    def deviation(self) -> Array:
        """Standard deviation in digits [R, C] within a sweep, rms over sweeps."""
        return np.sqrt(self.sweeps.samples.var(axis=1, dtype=np.float64).mean(axis=0))

    @cached_property
    def rms(self) -> float:
        """The deviation of all taxels together, in digits."""
        return float(np.sqrt(np.mean(self.deviation**2)))

    @cached_property
    def load(self) -> float:
        """Full load in digits: the 99.9 percentile of their magnitude. The very largest may be an accident."""
        return float(np.percentile(np.abs(self.sweeps.samples.astype(np.float32)), 99.9))


Change = Callable[[Array, float, Generator, EvaluationSweeps], Array]


@dataclass(frozen=True)
class Corruption:
    """One thing that goes wrong.

    unit: of `severities`, which rise from 0 = none. change: (float32 [N, T, R, C], severity, rng, trial) -> the same
    shape, not yet digitized. only: "simulated" where a scene is needed, "files" for what stands in for one.
    """

    name: str
    unit: str
    severities: tuple[float, ...]
    about: str
    change: Change
    only: str = ""

    def apply(self, trial: EvaluationSweeps, severity: float, seed: int) -> Array:
        """The trial's digits [N, T, R, C] under stress, of the same type; at severity 0 as they are.

        The same seed draws the same taxels, signs and noise for every severity.
        Raises FormatError for a severity out of range, and where the stress needs a scene and the trial has none.
        """
        samples = trial.sweeps.samples
        if not 0 <= severity <= self.severities[-1]:
            raise FormatError(
                f"severity {severity:g} of stress {self.name!r} is out of range; use 0 to {self.severities[-1]:g}"
            )
        if self.only == "simulated" and trial.scene is None:
            raise FormatError(f"stress {self.name!r} draws sweeps anew and {trial.sweeps.source} cannot; use sim:NAME")
        if severity == 0:
            return samples
        rng = np.random.default_rng([seed, *self.name.encode()])
        return _digitized(self.change(samples.astype(np.float32), severity, rng, trial), samples.dtype)


def _digitized(x: Array, kind: np.dtype[Any]) -> Array:
    """The converter: whole digits within the range of their type; float32 stays as it is."""
    if kind.kind == "f":
        return x.astype(kind)
    limits = np.iinfo(kind)
    return np.clip(np.rint(x), limits.min, limits.max).astype(kind)


def _shift(x: Array, rows: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return trial.scene.draw(lambda p: replace(p, dx_mm=p.dx_mm + rows * skin.PITCH_MM))


def _turn(x: Array, degrees: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return trial.scene.draw(lambda p: replace(p, turn_deg=p.turn_deg + degrees))


def _force(sign: int, x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return trial.scene.draw(world=replace(skin.WORLD, force_n=skin.WORLD.force_n * (1 + sign * share)))


def _error_ms(x: Array, ms: float, rng: Generator) -> Array:
    return ms * rng.choice([-1, 1], len(x))


def _window(x: Array, ms: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return trial.scene.draw(late_ms=_error_ms(x, ms, rng))


def _window_held(x: Array, ms: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    late = np.rint(_error_ms(x, ms, rng) * trial.sweeps.rate_hz / 1000).astype(int)
    at = np.clip(np.arange(x.shape[1]) + late[:, None], 0, x.shape[1] - 1)
    return np.take_along_axis(x, at[:, :, None, None], axis=1)


def _regrid(x: Array, rows: float, degrees: float, share: float, rng: Generator) -> Array:
    """Taxels read between their neighbours, `rows` further on and turned; beyond its edge the grid is mirrored."""
    r, c = x.shape[2:]
    i, j = np.indices((r, c)) - (np.array([r, c]) - 1)[:, None, None] / 2
    place = rows + (i + 1j * j) * np.exp(1j * np.deg2rad(degrees))
    at = np.stack([place.real + (r - 1) / 2, place.imag + (c - 1) / 2])
    one_by_one = np.eye(r * c).reshape(-1, r, c)
    weights = np.stack([map_coordinates(one, at, order=1, mode="mirror").ravel() for one in one_by_one])
    gain = np.exp(GAIN_LAW * share * rng.uniform(-1, 1, (len(x), 1, r, c)))
    return (x.reshape(*x.shape[:2], -1) @ weights.astype(np.float32)).reshape(x.shape) * gain


def _shift_grid(x: Array, rows: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return _regrid(x, rows, 0.0, rows / SHIFTS[-1], rng)


def _turn_grid(x: Array, degrees: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return _regrid(x, 0.0, degrees, degrees / TURNS[-1], rng)


def _some(x: Array, n: float, rng: Generator) -> Array:
    """`n` taxels of each sweep, or all where there are fewer: bool [N, 1, R, C]."""
    order = rng.permuted(np.tile(np.arange(x[0, 0].size), (len(x), 1)), axis=1)
    return (order < n).reshape(len(x), 1, *x.shape[2:])


def _dead(x: Array, n: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return np.where(_some(x, n, rng), 0, x)


def _stuck(x: Array, n: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return np.where(_some(x, n, rng), rng.uniform(x.min(), x.max(), (len(x), 1, *x.shape[2:])), x)


def _noisy(x: Array, n: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return x + _some(x, n, rng) * np.float32(NOISY * trial.rms) * rng.standard_normal(x.shape, np.float32)


def _gain_spread(x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return x * (1 + share * rng.uniform(-1, 1, (len(x), 1, *x.shape[2:])))


def _gain(sign: int, x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return x * (1 + sign * share)


def _speed(sign: int, x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return trial.scene.draw(world=replace(skin.WORLD, speed=1 + sign * share))


def _stretch(sign: int, x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    """All that happens is stretched in time about the window's middle; beyond its ends a sweep runs back."""
    frames = x.shape[1]
    spectrum = np.fft.rfft(np.concatenate([x[:, ::-1], x, x[:, ::-1]], axis=1), axis=1)
    n = round(3 * frames / (1 + sign * share))
    stretched = np.fft.irfft(spectrum[:, : n // 2 + 1], n, axis=1) * (n / (3 * frames))
    return stretched[:, (n - frames) // 2 :][:, :frames]


def _drift(x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    start, end = share * trial.load * rng.uniform(-1, 1, (2, len(x), 1, *x.shape[2:]))
    return x + start + (end - start) * np.linspace(0, 1, x.shape[1])[:, None, None]


def _bits(x: Array, fewer: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    low, high = float(x.min()), float(x.max())
    step = max((high - low) / (2 ** (8 - fewer) - 1), np.finfo(np.float32).tiny)
    return low + np.rint((x - low) / step) * step


def _lost(x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    lost = rng.random(x.shape[:2]) < share
    lost[:, [0, -1]] = False  # on the box the frames around the window are there too
    for t in range(sweep_window.MAX_GAP, x.shape[1]):  # what lacks more in a row is refused there
        lost[:, t] &= ~lost[:, t - sweep_window.MAX_GAP : t].all(axis=1)
    number = np.arange(x.shape[1])
    for taxels, gone in zip(x, lost, strict=True):
        frames = Frames(number.copy(), number, taxels)
        sweep_window.interpolate(frames, np.flatnonzero(~gone), np.flatnonzero(gone))
    return x


def _saturation(x: Array, share: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    top = (1 - share) * trial.load
    return np.clip(x, -top, top)


def _hum(x: Array, ratio: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    turns = HUM_HZ * np.arange(x.shape[1]) / trial.sweeps.rate_hz + rng.random((len(x), 1))
    return x + ratio * trial.rms * np.sin(2 * np.pi * turns)[:, :, None, None]


def _noise(x: Array, ratio: float, rng: Generator, trial: EvaluationSweeps) -> Array:
    return x + (ratio * trial.deviation).astype(np.float32) * rng.standard_normal(x.shape, np.float32)


SHIFTS, TURNS, ERRORS_MS = (0, 0.25, 0.5, 1, 1.5), (0, 5, 10, 20, 30), (0, 10, 25, 50, 100)
HALVES, TAXELS = (0, 0.1, 0.2, 0.35, 0.5), (0, 1, 2, 3, 4)
STRESSES = (
    Corruption("shift-rows", "rows", SHIFTS, "skin further along the sliding, drawn anew", _shift, "simulated"),
    Corruption("turn", "degrees", TURNS, "skin turned on the finger, drawn anew", _turn, "simulated"),
    Corruption("force-down", "share", HALVES, "pressed less, drawn anew", partial(_force, -1), "simulated"),
    Corruption("force-up", "share", HALVES, "pressed more, drawn anew", partial(_force, 1), "simulated"),
    Corruption("speed-down", "share", HALVES, "slid slower, drawn anew", partial(_speed, -1), "simulated"),
    Corruption("speed-up", "share", HALVES, "slid faster, drawn anew", partial(_speed, 1), "simulated"),
    Corruption("window", "ms", ERRORS_MS, "window too early or late, into the rest, drawn anew", _window, "simulated"),
    Corruption("shift-grid", "rows", SHIFTS, "taxels read further on, edge mirrored, new gains", _shift_grid, "files"),
    Corruption("turn-grid", "degrees", TURNS, "taxels read on a turned grid, edge mirrored, new gains", _turn_grid, "files"),
    Corruption("window-held", "ms", ERRORS_MS, "window too early or late, first or last frame held", _window_held, "files"),
    Corruption("dead", "taxels", TAXELS, "read 0", _dead),
    Corruption("stuck", "taxels", TAXELS, "each at some digit of the set's range", _stuck),
    Corruption("noisy", "taxels", TAXELS, f"white noise of {NOISY:g} of the set's deviations", _noisy),
    Corruption("gain-spread", "share", HALVES, "each taxel's gain off by up to this share", _gain_spread),
    Corruption("gain-down", "share", HALVES, "all gains lower", partial(_gain, -1)),
    Corruption("gain-up", "share", HALVES, "all gains higher", partial(_gain, 1)),
    Corruption("stretch", "share", HALVES, "slower: all is stretched in time", partial(_stretch, -1), "files"),
    Corruption("shorten", "share", HALVES, "faster: all is shortened in time", partial(_stretch, 1), "files"),
    Corruption("drift", "of full load", (0, 0.02, 0.05, 0.1, 0.2), "offset of each taxel, from one to another", _drift),
    Corruption("bits", "fewer than 8", (0, 1, 2, 3, 4), "steps of the set's range: 7, 6, 5, 4 bits", _bits),
    Corruption("lost", "share", (0, 0.02, 0.05, 0.1, 0.2), "frames lost, at most two in a row, filled as the box does", _lost),
    Corruption("saturation", "share", HALVES, "clipped so far below full load", _saturation),
    Corruption("hum", "deviations", (0, 0.25, 0.5, 1, 2), "50 Hz on all taxels, amplitude", _hum),
    Corruption("noise", "deviations", (0, 0.1, 0.2, 0.3, 0.5), "white, of each taxel's deviation", _noise),
)  # fmt: skip


def usual(trial: EvaluationSweeps) -> tuple[Corruption, ...]:
    """All stresses that make sense for `trial`: drawn anew where it has a scene, in the digits where it has none."""
    without = "files" if trial.scene else "simulated"
    return tuple(stress for stress in STRESSES if stress.only != without)


def find(names: Sequence[str]) -> tuple[Corruption, ...]:
    """The stresses of these names. Raises FormatError naming one that is unknown."""
    known = {stress.name: stress for stress in STRESSES}
    for name in names:
        if name not in known:
            raise FormatError(f"stress {name!r} is unknown; use some of {', '.join(known)}")
    return tuple(known[name] for name in names)
