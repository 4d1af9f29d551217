"""Measures how much accuracy a faster slide over the same path costs.

`python -m tests.campaigns fast-slides` prints a table of docs/decisions/0004: the recipe without
trained stages, for windows of 2 s down to 0.5 s. A faster slide passes the same 60 mm in the
shorter window; the shorter slide keeps 30 mm/s and passes less. Training has slides at 0.8, 1 and
1.25 times the speed; the test has the speed itself, at other attachments. Takes twenty minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.sim import skin
from palpate_train.data.sets import Dataset
from palpate_train.metrics.score import interval
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.recipe import Settings
from palpate_train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
FASTER = (1.0, 1.5, 2.0, 3.0, 4.0)
SPREAD = (0.8, 1.0, 1.25)
"""Speeds in training, relative to the speed of the test."""
POSITIONS = 9
TESTED = 12
"""Attachments in training, and in the test of each seed."""
EACH = 2
"""Tested sweeps of each material at each attachment."""
NOMINAL_MM_S = 30.0


def slides(
    world: skin.World,
    speeds: Sequence[float],
    frames: int,
    positions: range,
    each: int,
    stream: Sequence[int],
) -> Dataset:
    """`each` windows of each material, speed and attachment, cut to the first `frames`. positions:
    seeds of the attachments. stream: seed of the sweeps."""
    samples, rows = [], []
    for position, label, speed, number in product(
        positions, range(len(skin.MATERIALS)), range(len(speeds)), range(each)
    ):
        rng = np.random.default_rng([*stream, position, label, speed, number])
        place = skin.placements("T-REAL", position)[0]
        slid = replace(world, speed=speeds[speed])
        samples.append(skin.window(skin.MATERIALS[label], place, rng, slid)[:frames])
        rows.append((label, position, round(1000 * NOMINAL_MM_S * speeds[speed])))
    labels, position, speed_um_s = np.array(rows).T
    groups = {"position": position, "speed": speed_um_s}
    rate_hz = skin.FORMAT.rate_hz
    return Dataset(np.stack(samples), labels, skin.MATERIALS, rate_hz, groups, "simulated")


def answers(world: skin.World, speed: float, frames: int, seed: int) -> tuple[Array, Array]:
    """Whether each tested sweep is named right, bool [n], and its attachment [n]."""
    first = 1000 * seed
    trained = range(first, first + POSITIONS)
    tested = range(first + POSITIONS, first + POSITIONS + TESTED)
    near = [speed * share for share in SPREAD]
    train = slides(world, near, frames, trained, 1, (seed, 0))
    test = slides(world, (speed,), frames, tested, EACH, (seed, 1))
    fit = recipe.fit(train, seed, Settings(steps=0, calibrate=False))
    logits = run(with_head(fit.trunk(), *fit.int8_head()), test.samples)
    return logits.argmax(axis=1) == test.labels, test.group("position")


def row(name: str, world: skin.World, speed: float, frames: int, seeds: Sequence[int]) -> str:
    """A line of the table, with a 95 % interval over attachments."""
    right, position = (
        np.concatenate(part)
        for part in zip(*(answers(world, speed, frames, seed) for seed in seeds), strict=True)
    )
    low, high = interval(right, position)
    seconds = frames / skin.FORMAT.rate_hz
    mm_s = NOMINAL_MM_S * speed
    return (
        f"{name:12} {seconds:4.2f} s at {mm_s:3.0f} mm/s, {seconds * mm_s:3.0f} mm: "
        f"{100 * right.mean():5.1f} % [{100 * low:.1f}, {100 * high:.1f}] of {len(right)}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.fast_slides", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32, 33])
    args = parser.parse_args()
    for (name, world), faster in product(skin.WORLDS.items(), FASTER):
        frames = round(skin.FORMAT.window / faster)
        for speed in dict.fromkeys((faster, 1.0)):
            print(row(name or "hardness", world, speed, frames, args.seeds), flush=True)


if __name__ == "__main__":
    main()
