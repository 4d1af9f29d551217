"""Records sweeps to files, with labels that a researcher sets by commands while the robot works
(`palpate record`).

Each sweep becomes sweep-NNNNNN.npy and .json in one folder, and is reported in a REC sentence.
"""

from __future__ import annotations

import errno
import os
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core.clock import Clock
from palpate.core.disk_thread import AtOnce, DiskWork
from palpate.core.errors import ApplianceError, ConfigError, TemporaryError, passes
from palpate.core.log import TroubleLog, log
from palpate.core.names import LABEL, TypedNames
from palpate.core.observer import Observer
from palpate.core.sentences import CommandHandler, Reply, sentence
from palpate.core.types import Status, Sweep, SweepFormat, Verdict, entries
from palpate.service.systemd import words
from palpate.sweeps.progress import RecordingProgress
from palpate.sweeps.sweep_folder import SweepFolder, exclusion

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk."""
LEAST_FREE = 64 << 20, 20
"""Space that is left free for the system: this number of bytes, or on a small disk one part in this
number. A completely full card can stop more than a recording."""
TARGET = 10
"""Default of the wanted number of sweeps of each material at each position."""
MOST_CHANGES = 1024
"""Most label changes that wait for the answers to sweeps before them."""


@dataclass(frozen=True, slots=True)
class Labels:
    """Material, position and session, "" if unknown. Raises ConfigError if not sendable."""

    material: str = ""
    position: str = ""
    session: str = ""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if (text := getattr(self, name)) and not LABEL.fullmatch(text):
                allowed = "take 1 to 24 letters, digits, spaces, '.', '_' or '-'"
                raise ConfigError(f"{name} {text!r} cannot be used: {allowed}")


class RecordingSession(Observer):
    """Records each sweep that has a window, with the labels that applied at its start edge, and
    logs the missing sweeps.

    say: called with REC sentences. disk: writes the sweeps; a REC sentence follows once its sweep
    is on the disk. target: wanted number of sweeps of each material at each position; sweeps of
    earlier runs in the folder count. names: of materials that were typed; names of earlier sweeps
    are added; sidecars keep them. sweeps: the folder. Raises ConfigError if it cannot be used, or
    has sweeps of another format.
    """

    def __init__(
        self,
        folder: Path,
        format: SweepFormat,
        labels: Labels,
        clock: Clock,
        say: Callable[[bytes], None],
        target: int = TARGET,
        disk: DiskWork | None = None,
        names: TypedNames | None = None,
    ) -> None:
        self.names = names or TypedNames()
        self.disk = disk or AtOnce()
        # each sweep that is not put yet: its material, and whether it will count
        self._writing: dict[int, tuple[str, bool]] = {}
        try:
            self.sweeps = SweepFolder(folder, format)
        except OSError as e:
            raise (TemporaryError if passes(e) else ConfigError)(
                f"--out {folder}: {e.strerror}; name a folder that can be written"
            ) from e
        self._progress = RecordingProgress(target)
        self._counted: dict[int, Labels] = {}  # of each sweep in the folder that can be trained on
        self._count_earlier(format)
        self._clock, self._say = clock, say
        # (valid from, labels): a command during a sweep does not apply to that sweep
        self._labels = deque([(0, labels)], MOST_CHANGES)
        self._answered = False
        self._stored: list[int] = []
        self._changes = 0  # DISCARD, FORGET, MOVE … that are not on the disk yet
        self._undo: list[_Moved] = []
        self._last: dict[str, Any] | None = None
        self._log = TroubleLog("record")
        self.commands: Mapping[str, CommandHandler] = {
            "MATERIAL": partial(self._change, "material"),
            "POSITION": partial(self._change, "position"),
            "SESSION": partial(self._change, "session"),
            "NEXT": self._next,
            "DISCARD": self._discard,
            "MOVE": self._move,
            "RENAME": self._rename,
            "UNDO": self._undone,
        }

    @property
    def stored(self) -> int:
        return len(self._stored)

    @property
    def last(self) -> int | None:
        """The number in the folder of the last stored sweep of this run."""
        return self._stored[-1] if self._stored else None

    @property
    def undoes(self) -> tuple[str, str]:
        """The name that UNDO would take away, and the former name; ("", "") if it undoes none."""
        return self._undo[-1].names if self._undo else ("", "")

    def counted(self) -> dict[int, str]:
        """The material of each sweep in the folder that counts, by its number."""
        return {number: labels.material for number, labels in self._counted.items()}

    def awaited(self, sweep: Sweep) -> tuple[int, str]:
        """The number and material that a sweep will have in the folder."""
        return self.sweeps.run + sweep.id, self._labels_of(sweep).material

    def materials(self) -> dict[str, int]:
        """The number of sweeps in the folder of each material, without forgotten ones."""
        kept = (labels.material for _, labels in sorted(self._counted.items()) if labels.material)
        return dict(Counter(kept))

    def coming(self, material: str) -> int:
        """The number of its sweeps that are being written and will count."""
        return sum(held == (material, True) for held in self._writing.values())

    def once_written(self, act: Callable[[], list[object]], what: str) -> Reply:
        """Do `act` for the reply once all sweeps so far are written. Raises ApplianceError."""
        self.refuse_while_changing()
        if not self._writing:
            return act()
        return self._beside(lambda: None, act, what, "try again")

    def refuse_while_changing(self) -> None:
        """Raises ApplianceError while such a change is not on the disk yet."""
        if self._changes:
            raise ApplianceError(
                "DISCARD, FORGET, MOVE, RENAME, UNDO or USE is under way; wait for its answer"
            )

    def leave_out(self, number: int) -> None:
        """Count a stored sweep no longer: it is discarded, forgotten or no slide."""
        if labels := self._counted.pop(number, None):
            self._progress.add(labels.material, labels.position, -1)

    def forget(self, material: str, done: Callable[[], list[object]] = list) -> Reply:
        """Learn no longer from the sweeps of a material so far, also sweeps that are still being
        written; they stay in the folder. done: called when that is on the disk; returns the fields
        of the reply. Raises ApplianceError."""
        self.refuse_while_changing()  # which may move sweeps to this material, or away
        held = [n for n, labels in self._counted.items() if labels.material == material]
        waiting = [n for n, (label, _) in self._writing.items() if label == material]
        numbers = *held, *waiting

        def forgotten() -> list[object]:
            for number in numbers:
                self.leave_out(number)
            return done()

        write = partial(self.sweeps.forget, material, numbers)
        return self._beside(write, forgotten, f"{material!r} cannot be forgotten", "make room")

    def _beside(
        self, work: Callable[[], None], done: Callable[[], list[object]], what: str, advice: str
    ) -> Reply:
        """Do work on the disk next to the loop, which a sync would halt for seconds, then `done`
        for the reply: what the box has answered must survive a loss of power. Raises
        ApplianceError if it fails at once."""
        reply: Future[list[object]] = Future()

        def tried() -> Exception | None:
            try:
                work()
            except Exception as e:  # also an unexpected error: somebody waits for the reply
                return e
            return None

        def end(e: Exception | None) -> None:
            self._changes -= 1
            if e:
                why = f"{what}: {getattr(e, 'strerror', None) or e}; {advice}"
                log.warning(f"record: {why}, and repeat it")
                reply.set_exception(ApplianceError(why))
                return
            try:
                reply.set_result(done())
            except ApplianceError as refused:
                reply.set_exception(refused)

        self._changes += 1
        if not self.disk(tried, end):
            self._changes -= 1
            raise ApplianceError(f"{what}: too much waits for the disk; try again")
        return reply.result() if reply.done() else reply

    def about(self) -> dict[str, Any]:
        """The progress of the recording, for JSON.

        It has the present labels, the display names of materials by label, the number of sweeps of
        this run, the count and the wanted number of each material and position, the missing sweeps
        in words, the outcome of the last sweep as in REC, the number of the sweep that DISCARD
        would remove (None: no sweep), number and material of the last sweep that MOVE can move
        (None: no sweep), and what UNDO would undo ("": nothing).
        """
        return {
            **entries(self._labels[-1][1]),
            "displays": dict(self.names.displays),
            "stored": self.stored,
            "counts": self._progress.counts,
            "target": self._progress.target,
            "missing": self._progress.missing(),
            "last": self._last,
            "discard": None if self.last is None else self.last - self.sweeps.run,
            "newest": self._newest(),
            "undo": self._undo[-1].what if self._undo else "",
        }

    def _newest(self) -> list[object] | None:
        labels = self._counted.get(-1 if self.last is None else self.last)
        return [self.last, labels.material] if labels else None

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Write the sweep if it has a window, and report the outcome in a REC sentence."""
        self._answered = True
        labels = self._labels_of(sweep)
        sweep = replace(sweep, **entries(labels))
        counts = bool(len(sweep.frames)) and not verdict.status.faulty
        self._writing[self.sweeps.run + sweep.id] = labels.material, counts
        report = partial(self._report_outcome, sweep, verdict, labels)
        if not self.disk(partial(self._write, sweep, verdict, circumstances), report):
            report(("failed", "the disk is too slow"))

    def _report_outcome(
        self, sweep: Sweep, verdict: Verdict, labels: Labels, written: tuple[str, str] | int
    ) -> None:
        """Count, log and send the outcome of a sweep. written: as returned by `_write`."""
        self._writing.pop(self.sweeps.run + sweep.id)
        if isinstance(written, int):
            outcome, detail = "stored", self._count_stored(written, labels, verdict.status)
        else:
            outcome, detail = written
        if len(sweep.frames):
            trouble = "" if outcome == "stored" else outcome
            self._log.update(trouble, _report(outcome, sweep.id, detail, self.sweeps.folder))
        self._tell(verdict, outcome, labels)
        self._last = {"sweep": sweep.id, "outcome": outcome, "detail": detail, **entries(labels)}
        said = outcome, self.stored, labels.material, labels.position, labels.session, detail
        self._say(sentence("REC", sweep.id, *said))

    def close(self) -> None:
        """Finish writing, release the folder, and log the number of stored sweeps."""
        self.disk.settle()
        self.sweeps.close()
        if self._answered:
            where = f"record: sweeps of this run in {self.sweeps.folder}: {self.stored}"
            log.info(f"{where}; {self._progress.missing()}")

    def _count_earlier(self, format: SweepFormat) -> None:
        """Count the sweeps of earlier runs. Raises ConfigError for another format."""
        for number, about in self.sweeps.sidecars():
            path = self.sweeps.path(number)
            try:
                Status(about["verdict"]["status"])
                labels, stored = _labels(about), about["format"]
            except (ConfigError, KeyError, TypeError, ValueError):
                continue  # not a sweep of ours: training reports it
            if stored != format.json():
                self.sweeps.close()
                raise ConfigError(
                    f"{path} has another format than {format}; name another folder with --out"
                )
            gone = self.sweeps.is_forgotten(number, labels.material)
            self._count(number, labels, exclusion(about, forgotten=gone))
            self.names.add(labels.material, about.get("display"))

    def _count(self, number: int, labels: Labels, excluded: str) -> None:
        if not excluded:
            self._progress.add(labels.material, labels.position)
            self._counted[number] = labels

    def _tell(self, verdict: Verdict, outcome: str, labels: Labels) -> None:
        """Log the outcome of a sweep, for a person at the robot and a person at a terminal."""
        if outcome in ("full", "failed"):
            return  # that was logged when it began
        if verdict.status.faulty or outcome != "stored":
            log.warning(words(verdict) + "; it is not counted")
        else:
            log.info(f"{words(verdict)}; {self._progress.line(labels.material, labels.position)}")

    def _write(
        self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]
    ) -> tuple[str, str] | int:
        """Write a sweep; its number, or the outcome and details for a person."""
        if not len(sweep.frames):
            return "skipped", f"{verdict.status}"
        try:
            disk = os.statvfs(self.sweeps.folder)
            least = min(LEAST_FREE[0] // disk.f_frsize, disk.f_blocks // LEAST_FREE[1])
            if disk.f_bavail < least:
                left, wanted = (n * disk.f_frsize / 1e6 for n in (disk.f_bavail, least))
                return "full", f"{left:.1f} MB left of {wanted:.1f} for the system"
            display = self.names.displays.get(sweep.material or "")
            about = {**circumstances, "display": display} if display else circumstances
            return self.sweeps.put(sweep, verdict, about)
        except OSError as e:
            return "full" if e.errno in FULL else "failed", str(e.strerror)

    def _count_stored(self, number: int, labels: Labels, status: Status) -> str:
        """Count a stored sweep; its file's name with remarks, for a person."""
        self._stored.append(number)
        gone = "forgotten" * self.sweeps.is_forgotten(number, labels.material)
        self._count(number, labels, str(status) if status.faulty else gone)
        fault = f" {status}" if status.faulty else ""
        return self.sweeps.path(number).stem + fault + " no material" * (not labels.material)

    def _labels_of(self, sweep: Sweep) -> Labels:
        """The labels that applied at its start edge."""
        since = (labels for t_ns, labels in reversed(self._labels) if t_ns <= sweep.start_ns)
        return next(since, Labels())

    def _change(self, name: str, text: str) -> list[object]:
        """Set a label for sweeps that start from now on; returns the labels that then apply."""
        labels = replace(self._labels[-1][1], **{name: text.strip()})
        self._labels.append((self._clock.now_ns(), labels))
        return [labels.material, labels.position, labels.session]

    def _next(self, _: str) -> list[object]:
        position = self._labels[-1][1].position
        if not position.isdecimal():
            raise ApplianceError(f"position {position!r} has no next; begin with PPLP POSITION 1")
        return self._change("position", str(int(position) + 1).zfill(len(position)))

    def _discard(self, which: str) -> Reply:
        """Remove the last stored sweep of this run; returns its number, the number of sweeps left,
        and its file name. which: the expected number, so that a later sweep is not removed by
        mistake; "" for any."""
        if self._writing:
            raise ApplianceError("a sweep is still being written; wait for its REC sentence")
        self.refuse_while_changing()
        if (number := self.last) is None:
            raise ApplianceError("no sweep of this run is left to discard; record one first")
        shown = number - self.sweeps.run
        if which and which != str(shown):
            raise ApplianceError(f"the last stored sweep is {shown}, not {which}; look at it first")
        remove = partial(self.sweeps.remove, number, reserve=True)
        gone = partial(self._discarded, number, shown)
        return self._beside(remove, gone, f"sweep {shown} cannot be discarded", "look at the disk")

    def _discarded(self, number: int, shown: int) -> list[object]:
        """A sweep is off the disk. Returns the fields of the reply."""
        self._stored.remove(number)
        self.leave_out(number)
        if self._last and self._last["sweep"] == shown:
            self._last["outcome"] = "discarded"
        return [shown, self.stored, self.sweeps.path(number).stem]

    def _move(self, text: str) -> Reply:
        """Move a sweep to another material; returns both. text: the number of its file, the
        material."""
        which, _, label = (part.strip() for part in text.partition(","))
        number = int(which) if which.isascii() and which.isdecimal() else -1
        if number not in self._counted:
            raise ApplianceError(
                f"no sweep {which!r} is counted; take a number of a file, such as PPLP MOVE 7,wood"
            )
        moved = _Moved(f"sweep {number} to {label}", {number: self._counted[number].material})

        def done() -> list[object]:
            self._undo.append(moved)
            return [number, label]

        return self._relabel({number: _material(label)}, done)

    def _rename(self, text: str) -> Reply:
        """Give a material another name, also for sweeps to come; returns the name and the number
        of its sweeps. text: the old name, the new name."""
        old, _, new = (part.strip() for part in text.partition(","))
        numbers = [n for n, labels in self._counted.items() if labels.material == old]
        if not old or (not numbers and self._labels[-1][1].material != old):
            raise ApplianceError(f"no sweep is of {old!r}; name a material that was recorded")
        ahead = self._labels[-1][1].material != new
        moved = _Moved(f"{old} to {new}", dict.fromkeys(numbers, old), (new, old), ahead)

        def done() -> list[object]:
            self._undo.append(moved)
            return [new, self.materials().get(new, 0)]

        reply = self._relabel(dict.fromkeys(numbers, _material(new)), done)
        self._call(old, new)
        return reply

    def _undone(self, _: str) -> Reply:
        """Undo the last MOVE or RENAME of this run; returns what it was."""
        if not self._undo:
            raise ApplianceError("nothing was moved in this run; use MOVE or RENAME first")
        last = self._undo[-1]

        def done() -> list[object]:
            self._undo.pop()
            return [last.what]

        back = {n: label for n, label in last.before.items() if n in self._counted}
        reply = self._relabel(back, done)
        if last.ahead:
            self._call(*last.names)
        return reply

    def _relabel(self, materials: Mapping[int, str], done: Callable[[], list[object]]) -> Reply:
        """Move counted sweeps to materials; `done` gives the reply. Raises ApplianceError."""
        if self._writing:
            raise ApplianceError("a sweep is still being written; wait for its REC sentence")
        self.refuse_while_changing()

        def moved() -> list[object]:
            for number, label in materials.items():
                if labels := self._counted.get(number):
                    self.leave_out(number)
                    self._count(number, replace(labels, material=label), "")
                if self._last and self._last["sweep"] == number - self.sweeps.run:
                    self._last = self._last | {"material": label}
            return done()

        write = partial(self.sweeps.relabel, materials, dict(self.names.displays))
        return self._beside(write, moved, "the other material is not kept", "look at the disk")

    def _call(self, old: str, new: str) -> None:
        """Sweeps of one material that are not answered yet are of the other."""
        if old != new:
            for i, (t_ns, labels) in enumerate(self._labels):
                if labels.material == old:
                    self._labels[i] = t_ns, replace(labels, material=new)


@dataclass(frozen=True, slots=True)
class _Moved:
    """What UNDO undoes: in words, the materials of the sweeps before, and the name of a renamed
    material with its former name. ahead: also for sweeps to come, which had another name before."""

    what: str
    before: Mapping[int, str]
    names: tuple[str, str] = ("", "")
    ahead: bool = True


def _material(label: str) -> str:
    """The label of a sweep that is moved. Raises ApplianceError without one."""
    if not label.strip():
        raise ApplianceError("MOVE and RENAME need a material, such as PPLP RENAME cork,oak")
    return Labels(material=label.strip()).material


def _labels(about: Mapping[str, Any]) -> Labels:
    """The labels in a sidecar. Raises ConfigError or KeyError if it has no valid labels."""
    return Labels(*(str(about[name]) for name in Labels.__slots__))


def _report(outcome: str, sweep: int, detail: str, folder: Path) -> str:
    if outcome == "stored":
        return f"record: sweeps are stored again, from sweep {sweep} on"
    advice = f"make room in {folder}" if outcome == "full" else f"see that {folder} may be written"
    return f"record: sweep {sweep} is not stored: {detail}; {advice}; the answers go on"
