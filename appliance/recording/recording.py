"""The room of recordings: sweeps on the disk, with the labels that a researcher gives while the robot works.

In: sweeps with their verdicts, commands. Out: sweep-NNNNNN.npy and .json in one folder, a REC sentence for each sweep.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from appliance.bundle.manifest import LABEL
from appliance.core import storage
from appliance.core.clock import Clock
from appliance.core.errors import ApplianceError, ConfigError
from appliance.core.log import TroubleLog, log
from appliance.core.observer import Observer
from appliance.core.types import Status, Sweep, SweepFormat, Verdict, save
from appliance.io.robot_link import sentence

FULL = (errno.ENOSPC, errno.EDQUOT)
"""What a disk says that has no room."""
LEAST_FREE = 64 << 20, 20
"""What is left to the system: so many bytes, or this part of a small disk. A card that is full to its end can stop more
than a recording."""
MOST_CHANGES = 1024
"""Changes of the labels that are remembered until the sweeps before them are answered; far more than a person makes."""
_KEPT = re.compile(rf"sweep-([0-9]+)\.(?:npy|json)({re.escape(storage.PART)})?")


class SweepFolder:
    """A folder of sweeps with their verdicts, numbered on over restarts: nothing is written over.

    What a program that was killed had not finished is taken away. One program at a time has the folder; the lock goes
    with it. numbers: of the sweeps that are there, in order. run: the number of this run's sweep 0; sidecars hold it,
    since each run counts its sweeps and objects anew. Raises OSError where the folder cannot be made, read or had alone.
    """

    def __init__(self, folder: Path, fmt: SweepFormat) -> None:
        self.folder, self._format = folder, fmt
        _make(folder)
        self._lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            self._take()
        except OSError:
            self.close()
            raise

    def put(self, sweep: Sweep, verdict: Verdict, about: Mapping[str, Any]) -> int:
        """Write a sweep and what is to be told about it, whole or not at all; its number. Raises OSError."""
        number = self.run + sweep.id
        save(self.path(number), sweep, self._format, {**about, "run": self.run, "verdict": verdict.as_dict()})
        self.numbers.append(number)
        return number

    def remove(self, number: int) -> None:
        """Take a sweep away, its .npy first: none is ever without its sidecar. Raises OSError."""
        path = self.path(number)
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)
        storage.sync(self.folder)
        self.numbers.remove(number)

    def path(self, number: int) -> Path:
        """Where the sweep of this number is."""
        return self.folder / f"sweep-{number:06d}.npy"

    def close(self) -> None:
        """Give the folder back."""
        os.close(self._lock)

    def _take(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as e:
            raise BlockingIOError(e.errno, "another program keeps sweeps there", str(self.folder)) from e
        there = [name for path in self.folder.iterdir() if (name := _KEPT.fullmatch(path.name))]
        for left in (name for name in there if name[2]):
            (self.folder / left[0]).unlink()
        self.numbers = sorted({int(name[1]) for name in there if not name[2]})
        # a half sweep was never told as stored, but its number is not given twice
        self.run = max((int(name[1]) for name in there), default=0)


def _make(folder: Path) -> None:
    """Have the folder, and those above it, on the disk."""
    folder.mkdir(parents=True, exist_ok=True)
    for above in folder.resolve().parents:  # all: a run that was killed may have made them and not synced them
        with suppress(PermissionError):  # not ours, so not made by us
            storage.sync(above)


@dataclass(frozen=True, slots=True)
class Labels:
    """What is touched, where, and in which session; "" is not told. Raises ConfigError where a text cannot be sent."""

    material: str = ""
    position: str = ""
    session: str = ""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            text = getattr(self, name)
            if text and not LABEL.fullmatch(text):
                raise ConfigError(
                    f"{name} {text!r} cannot be used: take 1 to 24 letters, digits, spaces, '.', '_' or '-'"
                )


class RecordingSession(Observer):
    """Writes each sweep that has a window, with the labels that held at its start edge.

    say: takes REC sentences. Raises ConfigError where the folder cannot be used.
    """

    def __init__(
        self, folder: Path, fmt: SweepFormat, labels: Labels, clock: Clock, say: Callable[[bytes], None]
    ) -> None:
        try:
            self._folder = SweepFolder(folder, fmt)
        except OSError as e:
            raise ConfigError(f"--out {folder}: {e.strerror}; name a folder that can be written") from e
        self._clock, self._say = clock, say
        # (since when, what): a command that comes while a sweep is open is not of that sweep
        self._labels = deque([(0, labels)], MOST_CHANGES)
        self._stored: list[int] = []
        self._log = TroubleLog("record")
        self.commands: Mapping[str, Callable[[str], list[object]]] = {
            "MATERIAL": partial(self._change, "material"), "POSITION": partial(self._change, "position"),
            "SESSION": partial(self._change, "session"), "NEXT": self._next, "DISCARD": self._discard,
        }  # fmt: skip

    @property
    def stored(self) -> int:
        """How many sweeps of this run are on the disk."""
        return len(self._stored)

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Write the sweep if it has a window, and say what became of it."""
        labels = next((labels for since_ns, labels in reversed(self._labels) if since_ns <= sweep.start_ns), Labels())
        sweep = replace(sweep, material=labels.material, position=labels.position, session=labels.session)
        outcome, detail = "skipped", f"{verdict.status}"
        if len(sweep.frames):
            outcome, detail = self._store(sweep, verdict, circumstances)
            trouble = "" if outcome == "stored" else outcome
            self._log.update(trouble, _news(outcome, sweep.id, detail, self._folder.folder))
        self._say(
            sentence("REC", sweep.id, outcome, self.stored, labels.material, labels.position, labels.session, detail)
        )

    def close(self) -> None:
        """Give the folder back, and say what is in it."""
        self._folder.close()
        log.info(f"record: sweeps of this run in {self._folder.folder}: {self.stored}")

    def _store(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> tuple[str, str]:
        """What became of the sweep, and what a person should know about that."""
        try:
            room = os.statvfs(self._folder.folder)
            least = min(LEAST_FREE[0] // room.f_frsize, room.f_blocks // LEAST_FREE[1])
            if room.f_bavail < least:
                left, wanted = (n * room.f_frsize / 1e6 for n in (room.f_bavail, least))
                return "full", f"{left:.1f} MB left of {wanted:.1f} for the system"
            number = self._folder.put(sweep, verdict, circumstances)
        except OSError as e:
            return "full" if e.errno in FULL else "failed", str(e.strerror)
        self._stored.append(number)
        # a material that the bundle does not know is what one records; what has no good window should be discarded
        doubt = "" if verdict.status.classified or verdict.status is Status.UNKNOWN else f" {verdict.status}"
        return "stored", self._folder.path(number).stem + doubt + " no material" * (not sweep.material)

    def _change(self, name: str, text: str) -> list[object]:
        """Sweeps that start from now on have this label; the labels that hold then."""
        labels = replace(self._labels[-1][1], **{name: text.strip()})
        self._labels.append((self._clock.now_ns(), labels))
        return [labels.material, labels.position, labels.session]

    def _next(self, _: str) -> list[object]:
        position = self._labels[-1][1].position
        if not position.isdecimal():
            raise ApplianceError(f"position {position!r} has no next one; begin with $PPLP,POSITION,1")
        return self._change("position", str(int(position) + 1).zfill(len(position)))

    def _discard(self, _: str) -> list[object]:
        """Take the last sweep of this run that is still there off the disk; its number, and how many are left."""
        if not self._stored:
            raise ApplianceError("no sweep of this run is left to discard")
        number = self._stored[-1]
        try:
            self._folder.remove(number)
        except OSError as e:
            raise ApplianceError(f"sweep {number - self._folder.run} cannot be discarded: {e.strerror}") from e
        self._stored.pop()
        return [number - self._folder.run, self.stored, self._folder.path(number).stem]


def _news(outcome: str, sweep: int, detail: str, folder: Path) -> str:
    """A line of the log for what has changed."""
    if outcome == "stored":
        return f"record: sweeps are stored again, from sweep {sweep} on"
    advice = f"make room in {folder}" if outcome == "full" else f"see that {folder} may be written"
    return f"record: sweep {sweep} is not stored: {detail}; {advice}; classifying goes on"
