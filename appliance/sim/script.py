"""Scripts for the robot of the rig: sweeps over simulated tubes, a finger at rest, or a recorded set. Out: Acts.

A set is played so that the middle of each sweep is exactly the recorded window.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from appliance.core.errors import ConfigError, FormatError
from appliance.core.sweep_set import SweepSet, load_file
from appliance.core.types import SweepFormat
from appliance.sim import skin
from appliance.sim.rig import Act

SETS = "replay:"
PAUSE_S = 0.1, 0.14
"""The finger is off the tube so long before and after it; drawn anew each time, so that edges meet packets anywhere."""
SLIDE_S, REST_S = 3.0, 0.1
"""The slide (paper, sec. II.B), and the finger at rest on the tube before and after it."""
LEAD_S = 0.5
"""From an edge to a recorded window, as `sweep.lead_ms` has it; the window's first and last frames are held so long."""
RESTS_MM = (4.0, 3.0), (-2.5, 2.0), (1.5, -1.0), (0.0, 0.0)
"""Where the skin sits while somebody places it, a little better each time: ahead along the finger, and aside."""
RESTS_FOR_S, LIFTED_S = 3.0, 1.0
"""How long the finger then rests on the tube, and how long it is off before."""
MARGIN = 8
"""Frames before and after the edges, so that these have room."""


def named(name: str, fmt: SweepFormat, seed: int) -> tuple[Iterator[Act], str]:
    """The script that `--sim` names, and the source that its sentences name.

    Raises ConfigError for another name, FormatError where the bundle wants another skin.
    """
    if name in ("skin", "rest"):
        if fmt != skin.FORMAT:
            raise FormatError(f"the simulated skin sends {skin.FORMAT}, the bundle wants {fmt}; use --sim replay:FILE")
        return (tubes(seed) if name == "skin" else rests(seed)), "sim"
    if name.startswith(SETS):
        return replay(Path(name.removeprefix(SETS)), fmt), "replay"
    raise ConfigError(f"--sim {name} is unknown; use skin, rest, or replay:FILE with a sweep set")


def tubes(seed: int, sweeps: int | None = None, places: Sequence[skin.Placement] = ()) -> Iterator[Act]:
    """Sweeps over the six tubes in random order, `sweeps` of them or without end; tubes are turned before each sweep.

    places: where the skin sits, the next one for each round of six tubes; by default one place drawn from `seed`.
    """
    rng = np.random.default_rng(seed)
    rate = skin.FORMAT.rate_hz
    world = skin.World()
    rounds = itertools.cycle(places or skin.placements("T-LAB", seed))
    tubes_left: list[str] = []
    for _ in itertools.count() if sweeps is None else range(sweeps):
        if not tubes_left:
            tubes_left, place = [str(m) for m in rng.permutation(skin.MATERIALS)], next(rounds)
        label = tubes_left.pop()
        off = skin.idle(round(rng.uniform(*PAUSE_S) * rate), rng, world)
        on = skin.sweep(label, place, rng, world, rest_s=REST_S, slide_s=SLIDE_S, after_s=REST_S)
        start = len(off) + round(REST_S * rate)
        yield Act(np.concatenate([off, on, off]), start, start + round(SLIDE_S * rate), label)


def rests(seed: int) -> Iterator[Act]:
    """A finger that is lifted and put on the wooden tube again, without end; between the touches the skin is moved."""
    rng = np.random.default_rng(seed)
    world = skin.World()
    off = round(LIFTED_S * skin.FORMAT.rate_hz)
    for dx_mm, dy_mm in itertools.cycle(RESTS_MM):
        place = skin.Placement(dx_mm, dy_mm, seed=seed)
        on = skin.sweep("wood", place, rng, world, rest_s=RESTS_FOR_S, slide_s=0, after_s=0)
        frames = np.concatenate([skin.idle(off, rng, world), on])
        yield Act(frames, off, len(frames) - 1, "wood")


def replay(path: Path, fmt: SweepFormat) -> Iterator[Act]:
    """The sweeps of a set in order; NEW OBJECT wherever a new recording begins. FormatError where it is not `fmt`."""
    held = load_file(path, SweepSet)
    if held.format != fmt:
        raise FormatError(
            f"{path} holds {held.format}, the bundle wants {fmt}; name its bundle with --set classifier.bundle=DIR"
        )
    return _play(held)


def _play(held: SweepSet) -> Iterator[Act]:
    begins = np.ones(len(held), bool)
    recording = held.groups.get("recording", np.zeros(len(held), int))
    begins[1:] = recording[1:] != recording[:-1]
    lead = round(LEAD_S * held.format.rate_hz)
    stop = MARGIN + 2 * lead + held.format.window // 2 * 2  # even, so that a frame lies in the middle
    for window, label, new in zip(held.samples, held.labels, begins & ("recording" in held.groups), strict=True):
        before, after = window[:1].repeat(MARGIN + lead, 0), window[-1:].repeat(MARGIN + lead, 0)
        yield Act(np.concatenate([before, window, after]), MARGIN, stop, held.materials[label], bool(new))
