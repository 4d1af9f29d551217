"""A folder of recorded sweeps: its only reader and writer.

A sweep is sweep-NNNNNN.npy with a sidecar .json. It is learnt from unless it has a reason not to
be: it is damaged, faulty, early, without a material, or forgotten. The file `forgotten` keeps what
a person has forgotten, next to the sweeps themselves.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import storage, wall_clock
from palpate.core.errors import FormatError
from palpate.core.sweep_file import load, save, sidecar
from palpate.core.types import Status, Sweep, SweepFormat, Verdict

FORGOTTEN = "forgotten"
"""File in the folder: the numbers of forgotten sweeps by material."""
DISCARDED = ".discarded"
"""Suffix of the file that reserves the number of a discarded sweep. It is the renamed sidecar,
since a rename needs no space, and is removed once a later number is in use."""
_KEPT = re.compile(
    rf"sweep-([0-9]+)(\.npy|\.json|{re.escape(DISCARDED)})({re.escape(storage.PART)})?"
)
Forgotten = Mapping[str, Sequence[int]]
REFUSED = tuple(status for status in Status if status.faulty)
"""The box's answers to windows that it does not classify."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSweep:
    """One sweep as the box recorded it. path: its .npy file. about: the contents of its sidecar.
    forgotten: whether a person has forgotten it."""

    path: Path
    sweep: Sweep
    format: SweepFormat
    about: Mapping[str, Any]
    forgotten: bool = False

    @classmethod
    def load(cls, path: Path, forgotten: Forgotten | None = None) -> RecordedSweep:
        """Read an .npy with its sidecar. Raises FormatError if a file is broken."""
        sweep, format = load(path)
        held = forgotten_in(path.parent) if forgotten is None else forgotten
        gone = number_of(path) in held.get(sweep.material, ())
        return cls(path, sweep, format, sidecar(path), gone)

    @property
    def exclusion(self) -> str:
        own = {"status": self.sweep.status, "share": self.sweep.share}
        return exclusion({**self.about, **own}, forgotten=self.forgotten)

    @property
    def unloaded(self) -> NDArray[np.float64]:
        """Mean and standard deviation of the unloaded skin, float [2, R, C] or [2, R, C, A]; NaN if
        the sidecar does not hold them. Raises FormatError if their shape is wrong."""
        found = self.about.get("unloaded")
        shape = self.format.shape
        if found is None:
            return np.full((2, *shape), np.nan)
        try:
            level = np.stack([np.asarray(found[name], np.float64) for name in ("level", "noise")])
        except (TypeError, KeyError, ValueError):
            level = np.empty(0)
        if level.shape != (2, *shape):
            raise FormatError(
                f"{self.path}: `unloaded` in its sidecar needs level and noise of shape"
                f" {list(shape)}; restore the sidecar, or remove the entry"
            )
        return level if np.isfinite(level).all() else np.full(level.shape, np.nan)


def exclusion(about: Mapping[str, Any], *, forgotten: bool = False) -> str:
    """One word that says why a sweep with this sidecar is not learnt from; "" if it is.

    Reasons are an incomplete window, a skin that the box refused, and a person who has forgotten
    it. Sweeps whose answer was unsure or unknown are kept: they were recorded to teach the box
    their material.
    """
    verdict = about.get("verdict")
    answer = verdict.get("status") if isinstance(verdict, dict) else ""
    if about.get("status") != Status.OK:
        return str(about.get("status"))
    if answer in REFUSED:
        return str(answer)
    return "early" if about.get("share", 1) < 1 else "forgotten" * forgotten


def number_of(path: Path) -> int:
    """The number in a file's name; -1 for another name."""
    name = _KEPT.fullmatch(path.name)
    return int(name[1]) if name else -1


def paths(folder: Path) -> list[Path]:
    """The .npy files in a folder that are named as sweeps, in order of their numbers."""
    return sorted((p for p in folder.glob("*.npy") if number_of(p) >= 0), key=number_of)


def taught(folder: Path, left_out: Counter[str]) -> Iterator[RecordedSweep]:
    """The sweeps in a folder that are learnt from, in order, each readable. left_out: gets the
    reasons of the others. Raises FormatError for a damaged file of forgotten sweeps."""
    forgotten = forgotten_in(folder)
    for path in paths(folder):
        try:
            one = RecordedSweep.load(path, forgotten)
            why = "no material" if not one.sweep.material else one.exclusion
        except FormatError:
            why = "damaged"
        if why:
            left_out[why] += 1
        else:
            yield one


def last_format(folder: Path) -> SweepFormat | None:
    """The format of the last readable sweep in a folder, None without one."""
    for path in reversed(paths(folder)):
        with suppress(FormatError):
            return load(path)[1]
    return None


NOT_THIS = "not this"
"""Material of sweeps over other things, which show a taught model what is unknown."""


@dataclass(frozen=True, slots=True)
class NoSlide:
    """A sweep that is not a slide. number: of its file. text: with the reason."""

    number: int
    text: str


def slides_alone(
    kept: Sequence[RecordedSweep], reasons: Iterable[str | None]
) -> tuple[list[RecordedSweep], tuple[NoSlide, ...]]:
    """The sweeps that are slides, and the others. reasons: why each is not one, None if it is."""
    slides, no_slides, number = [], [], Counter[str]()
    for one, why in zip(kept, reasons, strict=True):
        material = one.sweep.material
        number[material] += 1
        if why is not None:
            text = f"sweep {number[material]} of {material} is not learnt from: {why}"
            no_slides.append(NoSlide(number_of(one.path), text))
        else:
            slides.append(one)
    return slides, tuple(no_slides)


def forgotten_in(folder: Path) -> dict[str, list[int]]:
    """The numbers of forgotten sweeps by material, empty without a file. A material without a
    number is forgotten where it was taught without sweeps in this folder. Raises FormatError."""
    path = folder / FORGOTTEN
    try:
        held = json.loads(path.read_bytes())
        return {str(name): [int(n) for n in numbers] for name, numbers in held.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as e:
        raise FormatError(
            f"{path} cannot be read: {e}; remove it, then forgotten materials are taught again"
        ) from e


class SweepFolder:
    """A folder of sweeps with their verdicts, for one program at a time; its lock ends with the
    program. Numbers continue after a restart, and no number is used twice.

    Unfinished files of a program that was killed are removed. format: None if no sweep is put.
    numbers: of the sweeps in the folder, in order. run: offset of this run's sweep numbers in the
    folder; sidecars have it, since each run counts its sweeps and objects from 1. forgotten: as of
    `forgotten_in`. Raises OSError if the folder cannot be made, read or locked.
    """

    def __init__(self, folder: Path, format: SweepFormat | None) -> None:
        self.folder, self._format = folder, format
        _make(folder)
        self._lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            self.forgotten = forgotten_in(folder)
            self._take()
        except (OSError, FormatError):
            self.close()
            raise

    def put(self, sweep: Sweep, verdict: Verdict, about: Mapping[str, Any]) -> int:
        """Write a sweep, completely or not at all; returns its number. Raises OSError."""
        number = self.run + sweep.id
        assert self._format
        more = {"date": wall_clock.date(), "run": self.run, "verdict": verdict.as_dict()}
        save(self.path(number), sweep, self._format, {**about, **more})
        self.numbers.append(number)
        return number

    def adopt(self, one: RecordedSweep, material: str) -> int:
        """Copy a sweep of another folder as one of a material. Raises OSError."""
        number = max([self.run, *self.numbers]) + 1
        about = {**one.about, "run": number - one.sweep.id}
        save(self.path(number), replace(one.sweep, material=material), one.format, about)
        self.numbers.append(number)
        return number

    def remove(self, number: int, *, reserve: bool = False) -> None:
        """Remove a sweep, its .npy first, so that no .npy is ever without its sidecar. Raises
        OSError. reserve: do not use its number again after a restart, even if it was the
        highest."""
        path = self.path(number)
        path.unlink(missing_ok=True)
        with suppress(FileNotFoundError):
            if reserve:
                path.with_suffix(".json").replace(path.with_suffix(DISCARDED))
            else:
                path.with_suffix(".json").unlink()
        storage.sync(self.folder)
        self.numbers.remove(number)

    def relabel(self, materials: Mapping[int, str], displays: Mapping[str, str]) -> None:
        """Move sweeps to other materials, by number. displays: of materials that have one. Only
        sidecars are replaced, each at once, so a power cut leaves each sweep with its old or its
        new material. Raises OSError, and FormatError for a damaged sidecar."""
        for number, material in materials.items():
            path = self.path(number)
            about = sidecar(path) | {"material": material, "display": displays.get(material)}
            held = {name: value for name, value in about.items() if value is not None}
            storage.put(path.with_suffix(".json"), json.dumps(held, indent=1).encode())

    def forget(self, material: str, numbers: Iterable[int]) -> None:
        """Learn from these sweeps no longer; they may still wait. Raises OSError."""
        new = self.forgotten | {material: sorted({*self.forgotten.get(material, ()), *numbers})}
        storage.put(self.folder / FORGOTTEN, (json.dumps(new, indent=1) + "\n").encode())
        self.forgotten = new

    def sidecars(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Number and sidecar of each sweep with a readable one, in order."""
        for number in self.numbers:
            with suppress(FormatError):  # damaged: training reports it
                yield number, sidecar(self.path(number))

    def is_forgotten(self, number: int, material: str) -> bool:
        """Whether a person has forgotten a sweep, also while it waits to be put."""
        return number in self.forgotten.get(material, ())

    def path(self, number: int) -> Path:
        return self.folder / f"sweep-{number:06d}.npy"

    def close(self) -> None:
        os.close(self._lock)

    def _take(self) -> None:
        if not storage.locked(self._lock):
            why = "another program keeps sweeps there"
            raise BlockingIOError(errno.EWOULDBLOCK, why, str(self.folder))
        names = [name for path in self.folder.iterdir() if (name := _KEPT.fullmatch(path.name))]
        # an unfinished sweep was never reported as stored, but its number is not used again; nor
        # are forgotten numbers, in a folder that a person has emptied
        gone = (n for numbers in self.forgotten.values() for n in numbers)
        self.run = max([0, *(int(name[1]) for name in names), *gone])
        kept = (name for name in names if name[2] != DISCARDED and not name[3])
        self.numbers = sorted({int(name[1]) for name in kept})
        for name in names:
            if name[3] or (name[2] == DISCARDED and int(name[1]) < self.run):
                (self.folder / name[0]).unlink()
        (self.folder / (FORGOTTEN + storage.PART)).unlink(missing_ok=True)


def _make(folder: Path) -> None:
    """Make the folder and those above it, and sync them to the disk."""
    folder.mkdir(parents=True, exist_ok=True)
    # all folders: a run that was killed may have made folders without syncing them
    for above in folder.resolve().parents:
        with suppress(PermissionError):  # a folder that we may not open is not ours
            storage.sync(above)
