"""Measures how well the speed of a slide is measured from the counts of the taxels.

`python -m tests.campaigns slide-speed` prints the tables of docs/decisions/0007: simulated slides
of two worlds at several speeds, displaced, noisy and with broken taxels; windows without a slide;
real slides at 35.6 Hz, if PALPATE_DATA names the folder of FabricSlide; and the processor time.
Takes two minutes. No sweep of it was used to choose the limits of `palpate/signal/slide.py`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Frames, Status, Sweep, SweepFormat
from palpate.inference.classifier import Classifier
from palpate.signal.slide import Slide, SlideMeter
from palpate.sim import skin

Array = NDArray[Any]
NEAR = 0.2
"""Largest error of a speed that counts as right, as a share of the true speed."""
NOMINAL_MM_S = 30.0
FABRIC_PITCH_MM = 4.0
"""Assumed: the set does not state a pitch. It only scales the speeds."""
EVERY = 21
"""Frames of which one is kept for the skin at 36 Hz."""
BLOCKS, IN_BLOCK = 8, 50
"""The time: blocks of each call in turn, and calls in a block."""
_BAND = skin.band


def _ridges(n: int, tracks: int, *rest: Any) -> Array:
    """As `skin.band`, with the same track for all columns."""
    return np.repeat(_BAND(n, 1, *rest), tracks, axis=0)


def _broken(taxels: Array, rng: Generator) -> Array:
    """The window with a silent taxel and one that gives noise at full scale."""
    taxels[:, 1, 2] = 0
    taxels[:, 2, 0] = rng.integers(0, 255, len(taxels))
    return taxels


@dataclass(frozen=True)
class Slides:
    """Simulated slides. after: changes a window. ridges: the texture is the same across."""

    name: str
    set: skin.SetName = "T-REAL"
    noise: float = 1.0
    after: Callable[[Array, Generator], Array] = lambda taxels, rng: taxels
    ridges: bool = False
    direction: str = "rows+"

    def windows(self, world: skin.World, speed: float, count: int, seed: int) -> Iterator[Array]:
        """`count` windows of all materials in turn, each at an attachment of its own."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        slid = replace(world, speed=speed, noise_counts=self.noise * world.noise_counts)
        with patch.object(skin, "band", _ridges) if self.ridges else nullcontext():
            for i in range(count):
                place = skin.placements(self.set, int(rng.integers(1 << 30)))[0]
                material = skin.MATERIALS[i % len(skin.MATERIALS)]
                yield self.after(skin.window(material, place, rng, slid), rng)


CONDITIONS = (
    Slides("in place"),
    Slides("a row further", "T-HARD"),
    Slides("noise x 4", noise=4),
    Slides("two broken taxels", after=_broken),
    Slides("towards row 1", after=lambda taxels, rng: taxels[:, ::-1], direction="rows-"),
    Slides("along columns", after=lambda taxels, rng: taxels.swapaxes(1, 2), direction="cols+"),
    Slides("straight ridges", ridges=True),
)
SPEEDS = (0.5, 0.75, 1.0, 1.5, 2.0)


def without_slide(name: str, world: skin.World, i: int, rng: Generator) -> Array:
    """A window in which nothing slides."""
    frames = skin.FORMAT.window
    material = skin.MATERIALS[i % len(skin.MATERIALS)]
    place = skin.placements("T-REAL", int(rng.integers(1 << 30)))[0]
    rests, moving = np.zeros(frames, np.int64), np.full(frames, name == "rests and vibrates")
    if name.startswith("rests"):
        signal = skin.loaded(world.tube(material), place, rng, world, rests, moving)
        return skin.digitize(signal + skin.noise(frames, rng, world), world)
    if name == "untouched":
        return skin.idle(frames, rng, world)
    white = rng.standard_normal((frames, 4, 4))
    return 100 + 30 * white if name == "white noise" else 100 + white.cumsum(axis=0)


NOTHING = ("rests", "rests and vibrates", "untouched", "white noise", "random walks")


def row(found: Sequence[Slide], speed: float, direction: str) -> str:
    """Shares of windows that are right, wrong and not measured, and the median error of the
    measured ones."""
    errors = [abs(s.speed_mm_s / speed - 1) for s in found if s.speed_mm_s]
    right = sum(
        s.direction == direction and abs((s.speed_mm_s or 0) / speed - 1) <= NEAR for s in found
    )
    measured, n = len(errors), len(found)
    median = f"{100 * float(np.median(errors)):.1f} %" if errors else "-"
    return (
        f"right {100 * right / n:5.1f} %, wrong {100 * (measured - right) / n:4.1f} %, "
        f"not measured {100 * (n - measured) / n:5.1f} %, median error {median}"
    )


def simulated(count: int, seed: int) -> None:
    """Print a line for each condition and world at the nominal speed, and for each other speed in
    place."""
    meter = SlideMeter(skin.FORMAT, skin.PITCH_MM)
    for condition in CONDITIONS:
        for speed in SPEEDS if condition.name == "in place" else (1.0,):
            for name, world in skin.WORLDS.items():
                found = [meter(w) for w in condition.windows(world, speed, count, seed)]
                line = row(found, speed * NOMINAL_MM_S, condition.direction)
                where = f"{condition.name}, {speed * NOMINAL_MM_S:g} mm/s, {name or 'hardness'}"
                print(f"{where:42} {line}", flush=True)


def slow_frames(count: int, seed: int) -> None:
    """Print lines for every 21st frame, as of a skin at 36 Hz that takes a frame in an instant."""
    frames = len(range(0, skin.FORMAT.window, EVERY))
    format = replace(skin.FORMAT, rate_hz=skin.FORMAT.rate_hz / EVERY, window=frames)
    meter = SlideMeter(format, skin.PITCH_MM)
    for speed in (1.0, 2.0, 4.0):
        windows = CONDITIONS[0].windows(skin.WORLD, speed, count, seed)
        line = row([meter(w[::EVERY]) for w in windows], speed * NOMINAL_MM_S, "rows+")
        print(f"{f'at 36 Hz, {speed * NOMINAL_MM_S:g} mm/s, hardness':42} {line}", flush=True)


def nothing(count: int, seed: int) -> None:
    """Print how many windows without a slide get a speed, and the greatest height."""
    meter, rng = SlideMeter(skin.FORMAT, skin.PITCH_MM), np.random.default_rng(seed)
    for name in NOTHING:
        found = [
            meter(without_slide(name, world, i, rng))
            for world in skin.WORLDS.values()
            for i in range(count)
        ]
        false = sum(s.speed_mm_s is not None for s in found)
        highest = max(s.height for s in found)
        print(f"{name:42} {false} of {len(found)} get a speed, greatest height {highest:.1f}")


def real(folder: Path) -> None:
    """Print the measured speeds and the reasons on FabricSlide, for each speed."""
    path = folder / "fabricslide" / "fabricslide.npz"
    with np.load(path if path.exists() else folder / path.name, allow_pickle=False) as held:
        samples, speeds, rate_hz = held["samples"], held["group_speed"], float(held["rate_hz"])
    meter = SlideMeter(SweepFormat(16, 1, rate_hz, samples.shape[1], "int16"), FABRIC_PITCH_MM)
    for speed in np.unique(speeds):
        found = [meter(window) for window in samples[speeds == speed]]
        reasons = Counter(s.why for s in found if s.why)
        said = ", ".join(f"{n} {why}" for why, n in reasons.most_common())
        measured = sorted(round(s.speed_mm_s) for s in found if s.speed_mm_s)
        print(f"FabricSlide, {speed:3} mm/s: {len(measured)} measured {measured}; {said}")


def timed(seed: int) -> None:
    """Print medians of the processor time, side by side: the speed, the network alone, and the
    whole answer, which includes both."""
    rng = np.random.default_rng(seed)
    window = next(Slides("in place").windows(skin.WORLD, 1.0, 1, seed))
    wide = rng.integers(0, 255, (1500, 16, 32)).astype(np.uint8)
    box = Classifier(bundle.load(bundle.DEFAULT), SystemClock())
    numbers = np.arange(skin.FORMAT.window)
    sweep = Sweep(1, 0, 0, Status.OK, Frames(numbers, numbers, window))
    small = SlideMeter(skin.FORMAT, skin.PITCH_MM)
    large = SlideMeter(SweepFormat(16, 32, 750.0, 1500, "uint8"), 2.0)
    calls: dict[str, Callable[[], object]] = {
        "speed, 1500x4x4": lambda: small(window),
        "speed, 1500x16x32": lambda: large(wide),
        "network, 1500x4x4": lambda: box.embedding(window),
        "whole answer, 1500x4x4": lambda: box(sweep),
    }
    spent: dict[str, list[int]] = {name: [] for name in calls}
    for name in [*calls] * BLOCKS:
        for _ in range(IN_BLOCK):
            begin_ns = time.thread_time_ns()
            calls[name]()
            spent[name].append(time.thread_time_ns() - begin_ns)
    for name, times in spent.items():
        print(f"{name:42} {np.median(times) / 1e6:.3f} ms")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.slide_speed", description=__doc__
    )
    parser.add_argument("--seed", type=int, default=2100)
    parser.add_argument("--count", type=int, default=240, help="windows of each line and world")
    args = parser.parse_args()
    simulated(args.count, args.seed)
    slow_frames(args.count, args.seed)
    nothing(args.count, args.seed)
    if data := os.environ.get("PALPATE_DATA"):
        real(Path(data))
    timed(args.seed)


if __name__ == "__main__":
    main()
