"""Shadow mode: a candidate bundle classifies along with the current bundle, before it is committed.

Shadow mode counts how often the candidate agrees and keeps the sweeps on which it does not. The
candidate cannot affect the robot, since it gets a sweep only after the answer was sent.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from palpate.answer.taxels import BrokenTaxels
from palpate.bundle.bundle import Bundle
from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.disk_thread import AtOnce, DiskWork
from palpate.core.errors import ApplianceError, BundleError, FormatError
from palpate.core.log import TroubleLog, log
from palpate.core.observer import Health, Observer
from palpate.core.schema import typed
from palpate.core.statistics import wilson
from palpate.core.types import Status, Sweep, Verdict
from palpate.deployment.state import MOST_STARTS
from palpate.deployment.trial import NEVER_NS
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.sweeps.sweep_folder import SweepFolder

FILE = "agreement.json"
KEPT = 100
"""Largest number of sweeps with different answers that are kept."""
FAILURES = 3
"""The candidate is stopped after failing on this many sweeps in a row."""
SLOW_NS = 100_000_000
"""Longest computing time; a candidate that takes longer has failed on the sweep, because frames
wait for it."""
MOST_MODELS = 20 << 20
"""Bytes that both models may have together. The paper's network in int8 has 16 MB, and needs 25 MB
besides the 60 of the service, which may have 256 MB (systemd/palpate.service)."""
PERIOD_NS = 60_000_000_000
"""Interval at which the counts are written while both bundles agree. After MOST_STARTS starts in a
row that did not last as long, the candidate is no longer loaded."""


@dataclass(slots=True)
class Agreement:
    """Counts of how two bundles answered the same sweeps; the content of agreement.json.

    candidate, current: ids of the bundles.
    starts: number of starts in a row without an orderly end, including the current start until it
        is older than PERIOD_NS.
    later: early answers at which the candidate needs more of the sweep; they are not compared.
    failed: sweeps on which the candidate failed.
    kept: sweeps in the same folder.
    total_ms, worst_ms: the candidate's total and longest computing time.
    pairs: answer of the current bundle -> answer of the candidate -> number of sweeps.
    """

    candidate: str
    current: str
    starts: int = 0
    compared: int = 0
    agreed: int = 0
    later: int = 0
    failed: int = 0
    kept: int = 0
    total_ms: float = 0.0
    worst_ms: float = 0.0
    pairs: dict[str, dict[str, int]] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The counts in one line, for a person."""
        text = f"candidate {self.candidate} agrees with {self.current}"
        text += f" on {self.agreed} of {self.compared} sweeps"
        if self.compared:
            low, high = wilson(self.agreed, self.compared)
            text += f" [{100 * low:.1f} to {100 * high:.1f} %], computing"
            text += f" {self.total_ms / self.compared:.2g} ms for each"
            text += f" and {self.worst_ms:.2g} ms at most"
        text += f"; {self.later} early answers are not compared" if self.later else ""
        return text + (f"; it failed on {self.failed}" if self.failed else "")

    def lines(self, folder: Path) -> list[str]:
        """The text, each pair of different answers with the most frequent first, and the folder of
        the kept sweeps."""
        pairs = [(n, one, other) for one, row in self.pairs.items() for other, n in row.items()]
        pairs = sorted((pair for pair in pairs if pair[1] != pair[2]), key=lambda pair: -pair[0])
        kept = [f"  {self.kept} of these are kept in {folder}"] if self.kept else []
        return [self.text, *(f"  {one} -> {other}: {n}" for n, one, other in pairs), *kept]

    def json(self) -> bytes:
        """The content of agreement.json."""
        return json.dumps(asdict(self), indent=1).encode()

    def add(self, one: Verdict, other: Verdict, took_ms: float) -> bool:
        """Count a sweep. Returns whether both answers are the same for the robot."""
        row = self.pairs.setdefault(_answer(one), {})
        row[_answer(other)] = row.get(_answer(other), 0) + 1
        same = _answer(one) == _answer(other)
        self.compared, self.agreed = self.compared + 1, self.agreed + same
        self.total_ms, self.worst_ms = self.total_ms + took_ms, max(self.worst_ms, took_ms)
        return same


def _answer(v: Verdict) -> str:
    """The part of a verdict that a robot acts on: the label, after the status if that is not
    ok."""
    return v.label if v.status is Status.OK else f"({v.status}) {v.label}".strip()


def read(folder: Path) -> Agreement | None:
    """The agreement in a shadow's folder, None if the file does not exist. Raises FormatError if it
    cannot be read."""
    try:
        return typed(Agreement, json.loads((folder / FILE).read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, RecursionError) as e:
        raise FormatError(
            f"{folder / FILE} cannot be read: {e}; remove it, and the counts begin anew"
        ) from e


class Shadow(Observer):
    """Observer of a running box that classifies each sweep with the candidate, by the same rules,
    and counts the agreement.

    current: the bundle in service. folder: for agreement and kept sweeps; files of another pair of
    bundles are removed. classifier: makes a bundle's classifier from the settings. disk: writes the
    files. Raises ApplianceError if the candidate or the folder cannot be used.
    """

    def __init__(
        self,
        candidate: Bundle,
        current: Bundle,
        folder: Path,
        clock: Clock,
        classifier: Callable[[Bundle], Classifier],
        disk: DiskWork | None = None,
    ) -> None:
        self._disk, self._busy = disk or AtOnce(), False
        if candidate.format != current.format:
            raise BundleError(
                f"candidate {candidate.id} wants {candidate.format}, the bundle in service "
                f"{current.format}: one skin cannot serve both; commit to it without a shadow"
            )
        size = len(candidate.model) + len(current.model)
        if size > MOST_MODELS:
            raise BundleError(
                f"the models of candidate {candidate.id} and of the bundle in service have {size} "
                f"bytes together, {MOST_MODELS} are allowed; commit to it without a shadow"
            )
        self._clock, self._failures_in_row, self._tare = clock, 0, current.manifest.tare
        self._log = TroubleLog(
            f"shadow: {folder} cannot be written", "make room there; classifying goes on"
        )
        self._waiting: deque[Callable[[], object]] = deque()  # to keep a sweep
        self._settled_ns = self._due_ns = clock.now_ns() + PERIOD_NS
        try:
            self._sweeps = SweepFolder(folder, current.format)
            self.agreement = self._begin(candidate.id, current.id)
        except OSError as e:
            raise ApplianceError(
                f"{folder}: {e.strerror}; see that it has room and may be written"
            ) from e
        try:  # the model may kill the program here, so the start was counted before
            self._classifier = classifier(candidate)
            self._classifier.self_test()
            self._early = EarlyExit(self._classifier) if candidate.manifest.early else None
        except ApplianceError:
            self.stopping()
            raise

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Classify a sweep that has a window with the candidate. If the answers differ, the sweep
        is kept in a later turn."""
        if self._failures_in_row == FAILURES or not len(sweep.frames):
            return
        tare = np.asarray(circumstances["tare"], np.float64)
        sent = not np.array_equal(tare, self._tare)  # by TARE; before it each bundle uses its own
        self._classifier.tare = tare if sent else self._classifier.bundle.manifest.tare
        self._classifier.taxels.broken = BrokenTaxels.read(
            circumstances.get("broken"), self._classifier.format
        )
        begin_ns = self._clock.now_ns()
        self._due_ns = min(self._due_ns, begin_ns + PERIOD_NS)
        try:
            other = self._verdict(sweep)
        except Exception as e:  # the classes of onnxruntime have no other base in common
            self._fail(str(e).strip()[:200])
            return
        took_ns = self._clock.now_ns() - begin_ns
        if took_ns > SLOW_NS:
            self._fail(
                f"it computed {took_ns / 1e6:.0f} ms for a sweep, {SLOW_NS / 1e6:.0f} are allowed"
            )
            return
        self._failures_in_row = 0
        if other is None:
            self.agreement.later += 1
        elif not self.agreement.add(verdict, other, took_ns / 1e6):
            self._due_ns = begin_ns
            if self.agreement.kept + self._busy + len(self._waiting) < KEPT:
                about = {**circumstances, "candidate": other.as_dict()}
                self._waiting.append(partial(self._sweeps.put, sweep, verdict, about))

    def turn(self, health: Health) -> None:
        """At the end of a turn: write one file. More would take the black box's room in the queue
        of a slow disk. The counts come last, and not while a sweep is open."""
        if self._busy:
            return
        if self._waiting:
            self._write(self._waiting.popleft(), kept=1)
        elif not health.sweeping and self._clock.now_ns() >= self._due_ns:
            self._due_ns = NEVER_NS
            if self._clock.now_ns() >= self._settled_ns:
                self.agreement.starts = 0
            self._write(partial(storage.put, self._sweeps.folder / FILE, self.agreement.json()))

    def stopping(self) -> None:
        """At an orderly end of the loop: write all, without this start."""
        self._disk.settle()
        while self._waiting:
            self.agreement.kept += self._log.attempt(self._waiting.popleft())
        self.agreement.starts = 0
        counts = self.agreement.json()
        self._log.attempt(partial(storage.put, self._sweeps.folder / FILE, counts))
        self._sweeps.close()

    def _write(self, act: Callable[[], object], kept: int = 0) -> None:
        """Do `act` next to the loop. kept: sweeps that it adds to the folder."""

        def done(succeeded: bool) -> None:
            self._busy = False
            self.agreement.kept += kept * succeeded

        self._busy = True
        if not self._disk(lambda: self._log.attempt(act), done):
            done(False)

    def _begin(self, candidate: str, current: str) -> Agreement:
        """The agreement to continue, or a new agreement, with this start counted."""
        try:
            found = read(self._sweeps.folder)
        except FormatError as e:
            log.warning(f"shadow: {e}")
            found = None
        if found is None or (found.candidate, found.current) != (candidate, current):
            for number in [*self._sweeps.numbers]:
                self._sweeps.remove(number)
            found = Agreement(candidate, current)
        if found.starts >= MOST_STARTS:
            self._sweeps.close()
            raise ApplianceError(
                f"the program has died {found.starts} times while candidate {candidate} ran next "
                f"to it; remove {self._sweeps.folder / FILE} to try again"
            )
        found.starts, found.kept = found.starts + 1, len(self._sweeps.numbers)
        storage.put(self._sweeps.folder / FILE, found.json())
        return found

    def _verdict(self, sweep: Sweep) -> Verdict | None:
        """The candidate's verdict; None if it needs more of the sweep."""
        if sweep.share == 1:
            return self._classifier(sweep)
        return self._early(sweep) if self._early else None

    def _fail(self, why: str) -> None:
        self.agreement.failed += 1
        self._failures_in_row += 1
        if self._failures_in_row == FAILURES:
            log.warning(
                f"shadow: candidate {self.agreement.candidate} was stopped, it failed {FAILURES} "
                f"times in a row: {why}; classifying goes on"
            )
