"""Scripts for the robot of the rig: sweeps over simulated tubes, or the sweeps of a recorded set. Out: Acts.

A set is played so that the middle of each sweep is exactly the recorded window.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, FormatError
from ..sweep import DIGITS, SweepFormat
from . import skin
from .rig import Act

SETS = "replay:"
PAUSE_S = 0.1, 0.14
"""The finger is off the tube so long before and after it; drawn anew each time, so that edges meet packets anywhere."""
SLIDE_S, REST_S = 3.0, 0.1
"""The slide (paper, sec. II.B), and the finger at rest on the tube before and after it."""
MARGIN = 8
"""Frames held before and after a recorded window, so that edges have room; its first and last frames are repeated."""


def named(name: str, fmt: SweepFormat, seed: int) -> tuple[Iterator[Act], str]:
    """The script that `--sim` names, and the source that its sentences name.

    Raises ConfigError for another name, FormatError where the bundle wants another skin.
    """
    if name == "skin":
        if fmt != skin.FORMAT:
            raise FormatError(f"the simulated skin sends {skin.FORMAT}, the bundle wants {fmt}; use --sim replay:FILE")
        return tubes(seed), "sim"
    if name.startswith(SETS):
        return replay(Path(name.removeprefix(SETS)), fmt), "replay"
    raise ConfigError(f"--sim {name} is unknown; use skin, or replay:FILE with a sweep set")


def tubes(seed: int, sweeps: int | None = None, places: Sequence[skin.Placement] = ()) -> Iterator[Act]:
    """Sweeps over the six tubes in random order, `sweeps` of them or without end; each tube is turned before each sweep.

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


def read_set(path: Path) -> tuple[SweepFormat, dict[str, NDArray[Any]]]:
    """Format and arrays of a sweep set (.npz): samples [N, T, R, C], labels [N], materials [K], rate_hz, group_*.

    Raises FormatError where the file cannot be read or lacks one of them.
    """
    try:
        with np.load(path, allow_pickle=False) as z:
            arrays = dict(z)
        n, frames, rows, cols = arrays["samples"].shape
        fmt = SweepFormat(rows, cols, float(arrays["rate_hz"]), frames, arrays["samples"].dtype.name)
        names = [str(arrays["materials"][k]) for k in arrays["labels"]]
    except KeyError as e:
        raise FormatError(f"{path}: a sweep set needs samples, labels, materials and rate_hz; {e} is missing") from e
    except (OSError, ValueError, IndexError, TypeError) as e:
        raise FormatError(
            f"{path}: not a sweep set: {e}; see the README for its form, digits are {', '.join(DIGITS)}"
        ) from e
    if len(names) != n:
        raise FormatError(f"{path}: {n} samples but {len(names)} labels; each sweep needs one")
    arrays["names"] = np.array(names)
    return fmt, arrays


def replay(path: Path, fmt: SweepFormat) -> Iterator[Act]:
    """The sweeps of a set in their order; NEW OBJECT wherever a new recording begins. FormatError where it is not `fmt`."""
    held, arrays = read_set(path)
    if held != fmt:
        raise FormatError(
            f"{path} holds {held}, the bundle wants {fmt}; name its bundle with --set classifier.bundle=DIR"
        )
    return _play(fmt, arrays)


def _play(fmt: SweepFormat, arrays: dict[str, NDArray[Any]]) -> Iterator[Act]:
    recordings = arrays.get("group_recording")
    before = None
    for i, window in enumerate(arrays["samples"]):
        frames = np.concatenate([window[:1].repeat(2 * MARGIN, 0), window, window[-1:].repeat(2 * MARGIN, 0)])
        recording = None if recordings is None else int(recordings[i])
        yield Act(
            frames, MARGIN, fmt.window // 2 * 2 + 3 * MARGIN, str(arrays["names"][i]),
            new_object=recording is not None and recording != before,
        )  # fmt: skip
        before = recording
