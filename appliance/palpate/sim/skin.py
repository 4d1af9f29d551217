"""Simulated skin: a soft finger with a 4 x 4 tactile skin slides along a tube. Gives raw counts
uint8 [n, 4, 4] at 750 Hz for a material and a placement of the skin on the finger; for a skin that
feels shear, too, int16 [n, 4, 4, 3].

The finger's pad is a bed of springs that is pressed on the tube. Each further effect is one
function, named in `EFFECTS`, with its own random stream, so that `World(off=...)` removes one
effect and leaves the others unchanged. Rows are along the direction of sliding (x), columns across
the tube (y); row 3 leads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.core.errors import ConfigError
from palpate.core.types import SweepFormat, shape

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Counts = NDArray[Any]
Flags = NDArray[np.bool_]
LabelledWindows = tuple[Counts, Whole, Whole]
SetName = Literal["T-LAB", "T-REAL", "T-HARD"]

FORMAT = SweepFormat(4, 4, 750.0, 1500, "uint8")
SHEAR_FORMAT = replace(FORMAT, dtype="int16", axes=3)
"""Format of a skin with three axes: shear along and across the sliding, pressure."""
SHEAR_FULL = 2047
PITCH_MM, TAXEL_MM, TUBE_RADIUS_MM = 4.0, 2.5, 25.0
STEP_MM = 30.0 / FORMAT.rate_hz  # path from one frame to the next, at 3 cm/s
# precision of the controller: largest error of the force, as a share of the desired one
FORCE_LIMIT = 0.2
SETS = {"T-LAB": (1, 40), "T-REAL": (9, 10), "T-HARD": (1, 10)}
"""Positions of each set, and sweeps of each tube per position."""
EFFECTS = ("position", "attachment", "drift", "spot", "texture", "vibration", "noise")


@dataclass(frozen=True, slots=True)
class Material:
    """A tube. pitch_mm, vibration_hz: centres of spectral peaks, `_octaves` their spread."""

    name: str
    softness_mm_per_kpa: float
    texture_mm: float  # rms height
    pitch_mm: float
    pitch_octaves: float
    vibration: float  # rms, as a share of the pressure
    vibration_hz: float
    vibration_octaves: float


TUBES = (
    Material("metal", 0.00, 0.0122, 9.0, 1.2, 0.0590, 159.0, 0.49),
    Material("wood", 0.15, 0.0380, 5.2, 1.0, 0.0880, 109.5, 0.52),
    Material("paper", 0.60, 0.3173, 5.2, 0.8, 0.0964, 86.0, 0.50),
    Material("plastic rough", 0.20, 0.4067, 3.4, 0.4, 0.1393, 54.5, 0.70),
    Material("plastic smooth", 0.30, 0.0304, 7.5, 1.2, 0.0598, 143.5, 0.88),
    Material("foam", 1.20, 0.2554, 4.5, 1.0, 0.0697, 20.3, 0.60),
)
MATERIALS = tuple(tube.name for tube in TUBES)
LEVEL_BLIND_TUBES = (
    Material("metal", 0.00, 0.0083, 9.0, 1.2, 0.0268, 159.0, 0.49),
    Material("wood", 0.00, 0.0167, 5.2, 1.0, 0.0400, 109.5, 0.52),
    Material("paper", 0.03, 0.0835, 5.2, 0.8, 0.0438, 86.0, 0.50),
    Material("plastic rough", 0.01, 0.1670, 3.4, 0.4, 0.0633, 54.5, 0.70),
    Material("plastic smooth", 0.00, 0.0102, 7.5, 1.2, 0.0272, 143.5, 0.88),
    Material("foam", 0.20, 0.0668, 4.5, 1.0, 0.0317, 20.3, 0.60),
)


@dataclass(frozen=True, slots=True)
class World:
    """Physical parameters of the simulation, without the skin's placement and random numbers. off:
    EFFECTS to omit.

    A spread is a standard deviation, of the natural logarithm unless stated otherwise. They were
    fitted as described in docs/decisions/0002 and 0010. Raises ConfigError if `off` has an
    unknown effect.
    """

    off: frozenset[str] = frozenset()
    rows: int = FORMAT.rows
    cols: int = FORMAT.cols
    pitch_mm: tuple[float, float] = (PITCH_MM, PITCH_MM)  # between taxels, along sliding and across
    tubes: tuple[Material, ...] = TUBES
    speed: float = 1.0  # of sliding, relative to 3 cm/s; friction vibrations keep their frequency
    force_n: float = 1.0
    force_spread: float = 0.10  # share of the force; half of the precision stated in the paper
    pad_kpa_per_mm: float = 4.0
    pad_half_mm: float = 14.0  # along the tube; further out the pad bends away,
    pad_edge: float = 10.0  # and the higher this power, the flatter it is before
    counts_per_kpa: float = 15.0
    noise_counts: float = 0.82
    gain_spread: float = 0.005  # per attachment, one draw for all taxels and one for each
    bedding_mm: float = 0.01  # spread of the height of tape and pad under a taxel, per attachment
    # of the transmission of vibrations by tape and glove, per attachment and octave
    colour_spread: float = 0.49
    damping_hz: float = 114.0  # the pad damps vibrations above this frequency,
    damping_octaves_per_mm: float = -0.56  # which is lower the closer the skin is to the fingertip;
    relief_per_mm: float = 0.138  # there it follows the relief more, as the logarithm of the height
    spot_spread: float = 0.24  # of height and vibration from one spot of a tube to another
    spot_octaves: float = 0.13  # spread of pitch and vibration frequency likewise
    shear: bool = False  # whether the skin feels shear, too
    friction: float = 0.4  # shear over pressure, of all tubes: the paper gives no coefficient

    def __post_init__(self) -> None:
        if unknown := self.off - set(EFFECTS):
            raise ConfigError(
                f"effect {min(unknown)!r} cannot be switched off; use some of {', '.join(EFFECTS)}"
            )

    def tube(self, name: str) -> Material:
        """The tube of this name. Raises ConfigError for an unknown name."""
        known = {tube.name: tube for tube in self.tubes}
        if name not in known:
            raise ConfigError(f"material {name!r} is unknown; use one of {', '.join(known)}")
        return known[name]

    @property
    def shape(self) -> tuple[int, ...]:
        return shape(self.rows, self.cols, 3 if self.shear else 1)

    @property
    def format(self) -> SweepFormat:
        return replace(SHEAR_FORMAT if self.shear else FORMAT, rows=self.rows, cols=self.cols)


WORLD = World()
"""The simulated laboratory: it agrees with the twenty accuracies that the paper prints of spectral
features, and gives the level a meaning, as the paper explains its network's (decision 2)."""
LEVEL_BLIND = World(
    tubes=LEVEL_BLIND_TUBES,
    pad_half_mm=8.5,
    pad_edge=6.0,
    noise_counts=0.36,
    gain_spread=0.17,
    bedding_mm=0.05,
    spot_spread=0.23,
    spot_octaves=0.125,
    damping_octaves_per_mm=-0.60,
    relief_per_mm=0.12,
)
"""A harder question with the same spectra: each attachment draws the gains anew, so that the level
of a taxel says nothing about the tube."""
WORLDS = {"": WORLD, "level-blind": LEVEL_BLIND}
"""Worlds by the name that follows the name of a set after a slash."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of the skin's centre on the pad, its rotation, and the attachment's seed."""

    dx_mm: float = 0.0
    dy_mm: float = 0.0
    turn_deg: float = 0.0
    seed: int = 0


def band(
    n: int,
    tracks: int,
    centre: float,
    octaves: float,
    rate: float,
    rng: Generator,
    passed: Array | float = 1.0,
) -> Array:
    """Noise [tracks, n] whose amplitude spectrum is a Gaussian over log frequency, with rms 1
    before the gain `passed`. centre, rate (sampling): both per second or both per mm. octaves:
    standard deviation. passed: gain [n // 2 + 1] of the bins of rfft."""
    amplitude = np.exp(-0.5 * (np.log2(np.fft.rfftfreq(n, 1 / rate)[1:] / centre) / octaves) ** 2)
    amplitude *= n / 2 / np.sqrt(np.sum(amplitude**2))
    bins = np.zeros((tracks, n // 2 + 1), complex)
    bins[:, 1:] = amplitude * rng.standard_normal((tracks, len(amplitude), 2)).view(complex)[..., 0]
    return np.fft.irfft(bins * passed, n)


def position(placement: Placement, world: World) -> tuple[Array, Array]:
    """Effect: positions of the taxels' centres on the pad, x and y [R, C] in mm."""
    sits = Placement() if "position" in world.off else placement
    along, across = (
        (np.arange(n) - (n - 1) / 2) * pitch
        for n, pitch in zip((world.rows, world.cols), world.pitch_mm, strict=True)
    )
    place = complex(sits.dx_mm, sits.dy_mm) + (along[:, None] + 1j * across) * np.exp(
        1j * np.deg2rad(sits.turn_deg)
    )
    return place.real, place.imag


def attachment(placement: Placement, world: World) -> tuple[Array, Array, Array]:
    """Effect: influence of the attachment: gains [R, C], bedding height [R, C] in mm, colour of
    vibrations [7]. The colour is the logarithm of the gain at 6 Hz and at each octave above it, up
    to 375 Hz."""
    grid = world.rows, world.cols
    if "attachment" in world.off:
        return np.ones(grid), np.zeros(grid), np.zeros(7)
    rng = np.random.default_rng(placement.seed)
    gain = np.exp(world.gain_spread * (rng.standard_normal() + rng.standard_normal(grid)))
    bedding = world.bedding_mm * rng.standard_normal(grid)
    return gain, bedding, world.colour_spread * rng.standard_normal(7)


def drift(n: int, rng: Generator, world: World) -> Array:
    """Effect: contact force [n] in N; half of the error is constant, half varies at 0.5 Hz."""
    if "drift" in world.off:
        return np.full(n, world.force_n)
    wander = band(max(n, FORMAT.window), 1, 0.5, 1.0, FORMAT.rate_hz, rng)[0, :n]
    error: Array = np.sqrt(0.5) * world.force_spread * (rng.standard_normal() + wander)
    return world.force_n + world.force_n * FORCE_LIMIT * np.tanh(error / FORCE_LIMIT)


def spot(tube: Material, rng: Generator, world: World) -> Material:
    """Effect: the tube was turned; texture and vibrations differ from spot to spot."""
    if "spot" in world.off:
        return tube
    height, squeak = np.exp(world.spot_spread * rng.standard_normal(2))
    pitch, rate = np.exp2(world.spot_octaves * rng.standard_normal(2))
    height, pitch = tube.texture_mm * height, tube.pitch_mm * pitch
    squeak, rate = tube.vibration * squeak, tube.vibration_hz * rate
    return replace(tube, texture_mm=height, pitch_mm=pitch, vibration=squeak, vibration_hz=rate)


def texture(tube: Material, x: Array, slid: Whole, rng: Generator, world: World) -> Array:
    """Effect: height [n, R, C] in mm under the taxels, averaged over their length. slid: int64 [n],
    path in frames.

    Each column slides over its own track, on which the rows follow one another at the speed of
    sliding. A part of the skin that extends beyond the pad is not pressed down: the further forward
    it is, the more it follows the relief.
    """
    if "texture" in world.off:
        return np.zeros((1, 1, 1))
    lead = np.rint((x - x.min()) / STEP_MM).astype(np.int64)
    n = 500 * int(np.ceil((slid[-1] + lead.max() + 1) / 500))  # a length for which the FFT is fast
    blur = np.sinc(np.fft.rfftfreq(n, STEP_MM) * TAXEL_MM)
    of = 1 / tube.pitch_mm, tube.pitch_octaves, 1 / STEP_MM
    track = tube.texture_mm * band(n, world.cols, *of, rng, blur)
    relief = track[np.arange(world.cols), slid[:, None, None] + lead]
    height: Array = np.exp(world.relief_per_mm * x.mean()) * relief
    return height


def vibration(
    tube: Material, x: Array, colour: Array, moving: Flags, rng: Generator, world: World
) -> Array:
    """Effect: friction vibrations, [n, 1, 1] as a share of the pressure, while `moving` [n]."""
    if "vibration" in world.off:
        return np.zeros((1, 1, 1))
    n = len(moving)
    hz = np.fft.rfftfreq(n, 1 / FORMAT.rate_hz)
    octave = np.log2(np.maximum(hz, 1) * 2 / FORMAT.rate_hz) + len(colour) - 1
    limit_hz = world.damping_hz * np.exp2(world.damping_octaves_per_mm * x.mean())
    damping = np.hypot(1, hz / limit_hz)
    passed = np.exp(np.interp(octave, np.arange(len(colour)), colour)) / damping
    of = tube.vibration_hz, tube.vibration_octaves, FORMAT.rate_hz
    shake = tube.vibration * band(n, 1, *of, rng, passed)
    return (shake * moving).reshape(n, 1, 1)


def shear(pressure: Array, height: Array, y: Array, moving: Flags, world: World) -> Array:
    """Shear along the rows, shear across, pressure: [n, R, C, 3] in the unit of `pressure` [n, R,
    C].

    Pressure is normal to the surface, which is tilted along the rows by the slope of the relief
    (`height` [n, R, C] in mm) and across by y / radius (`y` [R, C] in mm from the tube's crest).
    While the finger slides (`moving` [n]), friction adds its share of the pressure, vibrations
    included, against the motion; at rest there is none.
    """
    # 0 where the finger rests
    slope = np.diff(height, axis=0, prepend=height[:1]) / (STEP_MM * world.speed)
    along = -pressure * (slope + world.friction * moving.reshape(-1, 1, 1))
    return np.stack([along, pressure * (y / TUBE_RADIUS_MM), pressure], axis=-1)


def noise(n: int, rng: Generator, world: World) -> Array:
    """Effect: white noise of the readout, [n, R, C] or [n, R, C, 3] in counts."""
    counts = 0.0 if "noise" in world.off else world.noise_counts
    return rng.standard_normal((n, *world.shape)) * counts


def gap(x: Array, y: Array | float, world: World) -> Array:
    """Distance in mm between the unloaded pad and a tube that it just touches."""
    return np.square(y) / (2 * TUBE_RADIUS_MM) + np.abs(x / world.pad_half_mm) ** world.pad_edge


def indentation(force_n: Array, kpa_per_mm: float, world: World) -> Array:
    """Indentation [n] in mm of the pad under `force_n` [n] in N."""
    x = np.linspace(-1.5, 1.5, 61) * world.pad_half_mm
    depth = np.linspace(0, 8, 161)
    pressed = np.maximum(depth[:, None] - gap(x, 0.0, world), 0)
    # the springs of one x, integrated over y
    across = 4 / 3 * np.sqrt(2 * TUBE_RADIUS_MM * pressed) * pressed
    newton = kpa_per_mm * across.sum(axis=1) * (x[1] - x[0]) / 1000
    return np.interp(force_n, newton, depth)


def digitize(signal: Array, world: World) -> Counts:
    """The analogue-to-digital converter: raw counts 0 to 255, with shear -2047 to 2047."""
    least, most = (-SHEAR_FULL, SHEAR_FULL) if world.shear else (0, 255)
    return np.clip(np.rint(signal), least, most).astype(world.format.numpy_type)


def loaded(
    tube: Material, placement: Placement, rng: Generator, world: World, slid: Whole, moving: Flags
) -> Array:
    """The readout's signal [n, R, C] or [n, R, C, 3] in counts for a finger in contact, without
    noise and conversion. slid: path along the tube in frames [n]. moving: [n]."""
    of_drift, of_spot, of_texture, of_vibration = rng.spawn(4)
    x, y = position(placement, world)
    gain, bedding, colour = attachment(placement, world)
    tube = spot(tube, of_spot, world)
    kpa_per_mm = 1 / (1 / world.pad_kpa_per_mm + tube.softness_mm_per_kpa)
    depth = indentation(drift(len(slid), of_drift, world), kpa_per_mm, world)[:, None, None]
    path = np.rint(world.speed * slid).astype(np.int64)
    height = bedding + texture(tube, x, path, of_texture, world)
    pressure_kpa = kpa_per_mm * np.maximum(depth - gap(x, y, world) + height, 0)
    pressure_kpa *= 1 + vibration(tube, x, colour, moving, of_vibration, world)
    signal: Array = world.counts_per_kpa * gain * pressure_kpa
    return shear(signal, height, y, moving, world) if world.shear else signal


def _touch(
    tube: Material, placement: Placement, rng: Generator, world: World, slid: Whole, moving: Flags
) -> Counts:
    """Raw counts [n, R, C(, 3)] of a finger in contact. slid: path in frames [n]. moving: [n]."""
    signal = loaded(tube, placement, rng, world, slid, moving)
    return digitize(signal + noise(len(slid), rng.spawn(1)[0], world), world)


def slide(rest_s: float, slide_s: float, after_s: float) -> tuple[Whole, Flags]:
    """A finger that rests, slides and rests again: path in frames [n], and whether it moves [n]."""
    rest, moving, after = (round(s * FORMAT.rate_hz) for s in (rest_s, slide_s, after_s))
    frame = np.arange(rest + moving + after) - rest
    return frame.clip(0, moving), (frame >= 0) & (frame < moving)


def sweep(
    material: str,
    placement: Placement,
    rng: Generator,
    world: World = WORLD,
    *,
    rest_s: float = 0.3,
    slide_s: float = 3.0,
    after_s: float = 0.3,
) -> Counts:
    """Raw counts [n, 4, 4] or [n, 4, 4, 3] of a finger that rests on the tube, slides along it and
    rests again. The slide is in frames [rest_s * 750, (rest_s + slide_s) * 750). Raises ConfigError
    for an unknown material."""
    return _touch(world.tube(material), placement, rng, world, *slide(rest_s, slide_s, after_s))


def window(material: str, placement: Placement, rng: Generator, world: World = WORLD) -> Counts:
    """The middle two seconds of a slide, raw counts [1500, 4, 4] or [1500, 4, 4, 3]. Raises
    ConfigError for an unknown material."""
    n = FORMAT.window
    return _touch(world.tube(material), placement, rng, world, np.arange(n), np.ones(n, bool))


def idle(n: int, rng: Generator, world: World = WORLD) -> Counts:
    """Raw counts [n, 4, 4] or [n, 4, 4, 3] of a skin without contact."""
    return digitize(noise(n, rng, world), world)


def _set_rng(name: SetName, seed: int) -> Generator:
    """Random generator of a set, of its own for each name. Raises ConfigError."""
    if name not in SETS:
        raise ConfigError(f"sweep set {name!r} is unknown; use one of {', '.join(SETS)}")
    return np.random.default_rng([seed, *name.encode()])


def placements(name: SetName, seed: int) -> list[Placement]:
    """Placements of a set: within 1 mm of the middle, in T-HARD one row (4 mm) forward; rotated by
    2 degrees rms. Raises ConfigError for an unknown set."""
    rng = _set_rng(name, seed)
    places = []
    for _ in range(SETS[name][0]):
        # uniform on a disc of 1 mm radius
        aside = np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
        dx_mm = PITCH_MM if name == "T-HARD" else float(aside.real)
        turn_deg, of_attachment = 2 * rng.standard_normal(), int(rng.integers(2**32))
        places.append(Placement(dx_mm, float(aside.imag), turn_deg, of_attachment))
    return places


def sweep_set(
    name: SetName, seed: int, per_material: int | None = None, world: World = WORLD
) -> LabelledWindows:
    """A set of the paper: windows [N, 1500, 4, 4] or [N, 1500, 4, 4, 3], labels int64 [N] into
    MATERIALS, positions int64 [N]. per_material: windows of each tube at each position (default: as
    in the paper). Raises ConfigError for an unknown set."""
    places = placements(name, seed)
    each = SETS[name][1] if per_material is None else per_material
    position_of, label_of = np.divmod(
        np.arange(len(places) * len(MATERIALS) * each) // each, len(MATERIALS)
    )
    samples = np.empty((len(label_of), FORMAT.window, *world.format.shape), world.format.numpy_type)
    for i, rng in enumerate(_set_rng(name, seed).spawn(len(samples))):
        samples[i] = window(MATERIALS[label_of[i]], places[position_of[i]], rng, world)
    return samples, label_of, position_of
