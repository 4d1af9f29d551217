"""Shadow mode: a candidate bundle classifies beside the one in service, before anybody commits to
it.

In: sweeps with the verdicts that were sent. Out: how often the candidate agrees, and the sweeps on
which it does not, in a folder. The candidate cannot affect the robot: it gets a sweep only after
the answer has been sent.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from appliance.bundle.bundle import Bundle
from appliance.core import storage
from appliance.core.clock import Clock
from appliance.core.errors import ApplianceError, BundleError, FormatError
from appliance.core.health import Health
from appliance.core.log import TroubleLog, log
from appliance.core.observer import Observer
from appliance.core.schema import typed
from appliance.core.statistics import wilson
from appliance.core.types import Status, Sweep, Verdict
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import EarlyExit
from appliance.recording.recording import SweepFolder

FILE = "agreement.json"
KEPT = 100
"""Most sweeps on which the two differ that are kept."""
FAILURES = 3
"""The candidate is no longer asked after it failed on so many sweeps in a row."""
SLOW_NS = 100_000_000
"""A candidate that computes for longer has failed on the sweep: frames wait for it."""
MOST_MEMORY = 180 << 20
"""Bytes that the candidate's model and the current one may need together, by the account of
onnx_check: the service may have 256 MB (systemd/palpate.service), and needs 60 without a model."""
STARTS = 3
"""After so many starts in a row that did not last PERIOD_NS, the candidate is not loaded any
more."""
PERIOD_NS = 60_000_000_000
"""How often the counts are written where the two agree."""
NEVER_NS = 1 << 63


@dataclass(slots=True)
class Agreement:
    """How two bundles have answered the same sweeps; the content of agreement.json.

    pairs: answer of the current one -> answer of the candidate -> number of sweeps. later: early
    answers where the candidate would have waited for more of the sweep; these are not compared.
    failed: sweeps on which the candidate failed. kept: sweeps in the same folder. worst_ms,
    total_ms: its longest and its whole computing time. starts: in a row without an orderly end, the
    present one included until it is older than PERIOD_NS.
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
    schema: int = 1

    @property
    def text(self) -> str:
        """In one line, for a person."""
        text = f"candidate {self.candidate} agrees with {self.current} on {self.agreed} of {self.compared} sweeps"
        if self.compared:
            low, high = wilson(self.agreed, self.compared)
            text += f" [{100 * low:.1f} to {100 * high:.1f} %], computing {self.total_ms / self.compared:.2g} ms for each"
            text += f" and {self.worst_ms:.2g} ms at most"
        text += f"; {self.later} early answers are not compared" if self.later else ""
        return text + (f"; it failed on {self.failed}" if self.failed else "")

    def lines(self, folder: Path) -> list[str]:
        """The text, then each pair of different answers, the most frequent first, and where the
        sweeps are."""
        pairs = [
            (n, one, other)
            for one, row in self.pairs.items()
            for other, n in row.items()
            if one != other
        ]
        differ = [
            f"  {one} -> {other}: {n}" for n, one, other in sorted(pairs, key=lambda pair: -pair[0])
        ]
        return [
            self.text,
            *differ,
            *([f"  {self.kept} of these are kept in {folder}"] if self.kept else []),
        ]

    def json(self) -> bytes:
        """The content of agreement.json."""
        return json.dumps(asdict(self), indent=1).encode()

    def add(self, one: Verdict, other: Verdict, took_ms: float) -> bool:
        """Count a sweep; whether the robot would have got the same answer."""
        row = self.pairs.setdefault(_answer(one), {})
        row[_answer(other)] = row.get(_answer(other), 0) + 1
        same = _answer(one) == _answer(other)
        self.compared, self.agreed = self.compared + 1, self.agreed + same
        self.total_ms, self.worst_ms = self.total_ms + took_ms, max(self.worst_ms, took_ms)
        return same


def _answer(v: Verdict) -> str:
    """What a robot acts on: the label, after the status where that is not ok."""
    return v.label if v.status is Status.OK else f"({v.status}) {v.label}".strip()


def read(folder: Path) -> Agreement | None:
    """The agreement in a shadow's folder, None where there is none. Raises FormatError where it
    cannot be read."""
    try:
        found = typed(Agreement, json.loads((folder / FILE).read_bytes()))
        if found.schema != 1:
            raise TypeError(f"schema {found.schema} is unknown to this version")
        return found
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, RecursionError) as e:
        raise FormatError(
            f"{folder / FILE} cannot be read: {e}; take it away, and the counts begin anew"
        ) from e


class Shadow(Observer):
    """Observer of a running box that lets the candidate judge each sweep by the same rules, and
    counts.

    current: the bundle in service. folder: for agreement and kept sweeps; those of another pair of
    bundles are removed. judge: makes a bundle's classifier by the settings. Raises ApplianceError
    where the candidate or the folder cannot be used.
    """

    def __init__(
        self,
        candidate: Bundle,
        current: Bundle,
        folder: Path,
        clock: Clock,
        judge: Callable[[Bundle], Classifier],
    ) -> None:
        if candidate.format != current.format:
            raise BundleError(
                f"candidate {candidate.id} wants {candidate.format}, the bundle in service {current.format}: one skin "
                "cannot serve both; commit to it without a shadow"
            )
        if candidate.memory + current.memory > MOST_MEMORY:
            raise BundleError(
                f"candidate {candidate.id} may need {candidate.memory >> 20} MB and the bundle in service "
                f"{current.memory >> 20}, which is more than the {MOST_MEMORY >> 20} that there are for both; commit to it "
                "without a shadow"
            )
        self._clock, self._failures_in_row, self._tare = clock, 0, current.manifest.tare
        self._log = TroubleLog(
            f"shadow: {folder} cannot be written", "make room there; classifying goes on"
        )
        self._waiting: list[tuple[Sweep, Verdict, Mapping[str, Any]]] = []
        self._settled_ns = self._due_ns = clock.now_ns() + PERIOD_NS
        try:
            self._sweeps = SweepFolder(folder, current.format)
            self.agreement = self._begin(candidate.id, current.id)
        except OSError as e:
            raise ApplianceError(
                f"{folder}: {e.strerror}; see that it has room and may be written"
            ) from e
        try:  # the model may kill the program here, so the start was counted before
            self._classifier = judge(candidate)
            self._classifier.self_test()
            self._early = EarlyExit(self._classifier) if candidate.manifest.early else None
        except ApplianceError:
            self.stopping()
            raise

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Let the candidate judge a sweep that has a window; one on which they differ is kept in a
        later turn."""
        if self._failures_in_row == FAILURES or not len(sweep.frames):
            return
        tare = np.asarray(circumstances["tare"], np.float64)
        sent = not np.array_equal(tare, self._tare)  # by TARE; without one each bundle has its own
        self._classifier.tare = tare if sent else self._classifier.bundle.manifest.tare
        begin_ns = self._clock.now_ns()
        self._due_ns = min(self._due_ns, begin_ns + PERIOD_NS)
        try:
            other = self._judge(sweep)
        except (
            Exception
        ) as e:  # onnxruntime raises its own classes, which share no base but Exception
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
            if self.agreement.kept + len(self._waiting) < KEPT:
                self._waiting.append(
                    (sweep, verdict, {**circumstances, "candidate": other.as_dict()})
                )

    def turn(self, health: Health) -> None:
        """At the end of a turn: write one thing that is due, while no sweep is open."""
        if health.sweeping:
            return
        if self._waiting:
            self._log.attempt(self._keep)
        elif self._clock.now_ns() >= self._due_ns:
            self._log.attempt(self._write)

    def stopping(self) -> None:
        """The loop has ended in order: write what is left, and do not count this start."""
        self.agreement.starts = 0
        while self._waiting:
            self._log.attempt(self._keep)
        self._log.attempt(self._write)
        self._sweeps.close()

    def _begin(self, candidate: str, current: str) -> Agreement:
        """The agreement to continue, or a new one; with this start counted."""
        try:
            found = read(self._sweeps.folder)
        except FormatError as e:
            log.warning(f"shadow: {e}")
            found = None
        if found is None or (found.candidate, found.current) != (candidate, current):
            for number in [*self._sweeps.numbers]:
                self._sweeps.remove(number)
            found = Agreement(candidate, current)
        if found.starts >= STARTS:
            self._sweeps.close()
            raise ApplianceError(
                f"the program has died {found.starts} times while candidate {candidate} ran beside it; take away "
                f"{self._sweeps.folder / FILE} to try again"
            )
        found.starts += 1
        storage.put(self._sweeps.folder / FILE, found.json())
        return found

    def _judge(self, sweep: Sweep) -> Verdict | None:
        """The candidate's verdict; None where it would wait for more of the sweep."""
        if sweep.share == 1:
            return self._classifier(sweep)
        return self._early(sweep) if self._early else None

    def _fail(self, why: str) -> None:
        self.agreement.failed += 1
        self._failures_in_row += 1
        if self._failures_in_row == FAILURES:
            log.warning(
                f"shadow: candidate {self.agreement.candidate} is not asked any more, it failed {FAILURES} times "
                f"in a row: {why}; classifying goes on"
            )

    def _keep(self) -> None:
        self._sweeps.put(*self._waiting.pop(0))
        self.agreement.kept = len(self._sweeps.numbers)

    def _write(self) -> None:
        self._due_ns = NEVER_NS
        if self._clock.now_ns() >= self._settled_ns:
            self.agreement.starts = 0
        storage.put(self._sweeps.folder / FILE, self.agreement.json())
