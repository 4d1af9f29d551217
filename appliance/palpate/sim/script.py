"""Scripts for the simulated robot, by the name after `--sim`: sweeps over simulated tubes, a finger
at rest, or the sweeps of a recorded set, whose windows are exactly the middle of the played sweeps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.core.config import SweepConfig, TriggerConfig
from palpate.core.errors import ConfigError, FormatError
from palpate.core.sweep_set import SweepSet, load_file
from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate.sim.rig import Act

PLAYED = skin.LEVEL_BLIND
"""The world that is played. The packaged bundle is fitted to it, and the end of its pad is so near
that the contact shows a displacement in both directions."""
SETS = "replay:"
PAUSE_S = 0.1, 0.14
"""Time for which the finger is off the tube before and after a sweep. It is drawn for each sweep,
so that edges come anywhere within packets."""
PAUSE_FRAMES = 12
"""Least number of frames without contact, so that a slow skin is seen unloaded, too."""
SLIDE_S, REST_S = TriggerConfig().sweep_s, 0.1
"""Duration of the slide (paper, sec. II.B), and of the rest before and after it."""
FOLLOWED_S = 8.0
"""Duration of a slide that ends with the command STOP; it is repeated if STOP comes later."""
LEAD_S = SweepConfig().lead_ms / 1000
"""Time from an edge to a recorded window, for which its first and last frame are repeated."""
LIFTED_SET_S = 0.4
"""Time for which the finger is lifted before a sweep of a set. A set does not record the unloaded
skin, so all counts are 0."""
RESTS_MM = (4.0, 3.0), (-2.5, 2.0), (1.5, -1.0), (0.0, 0.0)
"""Positions of the skin while somebody aligns it: (along the finger, across) in mm."""
RESTS_FOR_S, LIFTED_S = 3.0, 1.0
"""Time for which the finger then rests on the tube, and for which it is lifted before."""
MARGIN = 8
"""Frames before the start edge and after the stop edge."""

_NAME_SKIN = "name another skin with --skin, or use --sim replay:FILE"
_NAME_BUNDLE = (
    "name a bundle for this skin with --set classifier.bundle=DIR; palpate record --sim skin "
    "--skin NAME, palpate-train fit and export make one"
)


def named(
    name: str,
    format: SweepFormat | None,
    seed: int,
    *,
    spread: bool = False,
    seen: Any = None,
    follows: bool = False,
) -> tuple[Iterator[Act], str, SweepFormat]:
    """The script with this name after `--sim`, the name of the source in sentences, and the format
    of its sweeps.

    format: wanted by the bundle, None without a bundle. spread: play the sweeps of a set in a drawn
    order, the materials in turn. seen: the skin on the finger, None for the simulator's own.
    follows: slides last FOLLOWED_S, since commands end them. Raises
    ConfigError for an unknown name, FormatError if the bundle needs another skin.
    """
    kind, _, only = name.partition(":")
    if name == "rest" or kind == "skin":
        worlds = {one.format: one for one in (PLAYED, replace(PLAYED, shear=True))}
        able = {seen.FORMAT: PLAYED} if seen else worlds
        format = format or next(iter(able))
        wanted = format.skin, format.rate_hz
        fits = [world for one, world in able.items() if (one.skin, one.rate_hz) == wanted]
        if not fits:
            sent, hint = " or ".join(map(str, able)), _NAME_BUNDLE if seen else _NAME_SKIN
            raise FormatError(f"the simulated skin sends {sent}, {format} is wanted; {hint}")
        if name == "rest":
            return rests(seed, fits[0], seen or skin), "sim", format
        slide_s = FOLLOWED_S if follows else SLIDE_S
        acts = tubes(seed, world=fits[0], seen=seen or skin, only=only, slide_s=slide_s)
        return acts, "sim", format
    if name.startswith(SETS):
        sweeps = load(Path(name.removeprefix(SETS)), format)
        acts = play(sweeps, in_turn(sweeps.labels, seed) if spread else range(len(sweeps)))
        return acts, "replay", sweeps.format
    raise ConfigError(
        f"--sim {name} is unknown; use skin, skin:MATERIAL, rest, or replay:FILE with a sweep set"
    )


def tubes(
    seed: int,
    sweeps: int | None = None,
    places: Sequence[skin.Placement] = (),
    world: skin.World = PLAYED,
    seen: Any = skin,
    only: str = "",
    slide_s: float = SLIDE_S,
) -> Iterator[Act]:
    """Sweeps over the six tubes in random order; each begins at another spot of its tube.

    sweeps: their number; None for no end. places: positions of the skin, the next for each round of
    six tubes; by default one position drawn from `seed`. seen: the skin on the finger. only: over
    this tube alone. Raises ConfigError for an unknown tube.
    """
    materials = (world.tube(only).name,) if only else skin.MATERIALS
    rng, places = np.random.default_rng(seed), places or skin.placements("T-LAB", seed)

    def spots() -> Iterator[tuple[str, skin.Placement]]:
        for place in itertools.cycle(places):
            for label in rng.permutation(materials)[::-1]:
                yield str(label), place

    some = itertools.islice(spots(), sweeps)
    return (slide(label, place, rng, world, seen, slide_s) for label, place in some)


def slide(
    label: str,
    place: skin.Placement,
    rng: Generator,
    world: skin.World,
    seen: Any = skin,
    slide_s: float = SLIDE_S,
) -> Act:
    """One sweep over the tube `label`, with the finger lifted before and after it."""
    rate = seen.FORMAT.rate_hz
    off = seen.idle(max(PAUSE_FRAMES, round(rng.uniform(*PAUSE_S) * rate)), rng, world)
    on = seen.sweep(label, place, rng, world, rest_s=REST_S, slide_s=slide_s, after_s=REST_S)
    frames = np.concatenate([off, on, off])
    start = len(off) + round(REST_S * rate)
    stop = start + round(slide_s * rate)
    return Act(frames, start, stop, label, lifted=len(off))


def rests(seed: int, world: skin.World = PLAYED, seen: Any = skin) -> Iterator[Act]:
    """A finger that is lifted and put on the wooden tube again, with a shifted skin."""
    rng = np.random.default_rng(seed)
    off = round(LIFTED_S * seen.FORMAT.rate_hz)
    for dx_mm, dy_mm in itertools.cycle(RESTS_MM):
        place = skin.Placement(dx_mm, dy_mm, seed=seed)
        on = seen.sweep("wood", place, rng, world, rest_s=RESTS_FOR_S, slide_s=0, after_s=0)
        frames = np.concatenate([seen.idle(off, rng, world), on])
        yield Act(frames, off, len(frames) - 1, "wood", lifted=off)


def load(path: Path, format: SweepFormat | None) -> SweepSet:
    """The set at `path`. Raises FormatError if it is not of `format`."""
    sweeps = load_file(path, SweepSet)
    if format not in (None, sweeps.format):
        raise FormatError(
            f"{path} holds {sweeps.format}, {format} is wanted; name its bundle with --set "
            "classifier.bundle=DIR"
        )
    return sweeps


def in_turn(labels: NDArray[Any], seed: int) -> list[int]:
    """An order of sweeps in which the materials come in turn. labels: int [N]."""
    rng = np.random.default_rng(seed)
    waiting = {
        label: rng.permutation(np.flatnonzero(labels == label)).tolist()
        for label in np.unique(labels).tolist()
    }
    order = []
    while waiting:
        for label in rng.permutation(list(waiting)).tolist():
            order.append(waiting[label].pop())
        waiting = {label: left for label, left in waiting.items() if left}
    return order


def play(sweeps: SweepSet, order: Iterable[int]) -> Iterator[Act]:
    """The sweeps of a set in this order, with NEW OBJECT where a recording begins."""
    recording = sweeps.groups.get("recording")
    before = None
    lead, lifted = (round(s * sweeps.format.rate_hz) for s in (LEAD_S, LIFTED_SET_S))
    start = lifted + MARGIN
    # even, so that a frame lies in the middle
    stop = start + 2 * lead + sweeps.format.window // 2 * 2
    for i in order:
        window, now = sweeps.samples[i], None if recording is None else recording[i]
        ahead, after = window[:1].repeat(MARGIN + lead, 0), window[-1:].repeat(MARGIN + lead, 0)
        dark = np.zeros((lifted, *window.shape[1:]), window.dtype)
        frames = np.concatenate([dark, ahead, window, after])
        label, new = sweeps.materials[sweeps.labels[i]], now is not None and now != before
        yield Act(frames, start, stop, label, new, lifted=lifted)
        before = now
