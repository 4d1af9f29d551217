"""Observes the trial of a release, as that of a bundle, in the service; root's part is in
`releases`.

In the trial the proven release answers the latest sweeps, too (ReleaseComparison). A sweep on which
the new release fails, or which it answers otherwise with the same bundle, ends the program between
two sweeps, and root sends the release back before the next start.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.core.log import log
from palpate.core.observer import Health, Observer
from palpate.core.status import Status
from palpate.core.types import Verdict
from palpate.deployment import releases
from palpate.deployment.releases import ReleaseReport
from palpate.deployment.state import Goal, TrialProgress
from palpate.deployment.trial import ERRORS, Trial

if TYPE_CHECKING:
    from palpate.sweeps.black_box import BlackBox

GOAL = Goal(50, 24 * 3600.0, both=True)
"""A release is proven after 50 sweeps with a label and 24 hours in which the skin streamed."""

KEPT, EVERY = 50, 10
"""Sweeps of a start that are compared, and new ones for each comparison. A release 3 points worse
answers 6 % of sweeps otherwise, so 50 show it 19 times of 20."""
COMPARED_S = 60.0
"""Time for a comparison, which runs at the lowest priority while the loop goes on."""
OTHERWISE = 3
"""Exit code of palpate.runtime.replay if answers differ."""


class ReportStore:
    """Writes the reports of one start. report: as this start begins."""

    goal = GOAL

    def __init__(self, folder: Path, report: ReleaseReport) -> None:
        self._folder, self._report, self._why = folder, report, report.why

    def note(self, sha: str, progress: TrialProgress, *, counted: bool) -> None:
        """Record the progress."""
        made = progress._asdict()
        del made["starts"]  # root counts them
        self._write(replace(self._report, quiet=not counted, **made))

    def commit(self, sha: str | None, wait_s: float) -> bool:
        """Say that the goal was reached; root ends the trial before the next start."""
        self._write(replace(self._report, passed=True))
        return True

    def failed(self, why: str) -> None:
        """From the next report on, the release must go back."""
        self._why = why

    def _write(self, report: ReleaseReport) -> None:
        releases.write_report(self._folder, replace(report, why=self._why))
        self._report = report


class ReleaseTrial(Trial):
    """The trial of the release that this program belongs to. proven: the Python of the release to
    go back to. over: whether the program must end, so that the release goes back."""

    _store: ReportStore
    proven = ""
    over = False

    def goes_back(self, why: str) -> None:
        """The release has failed."""
        log.error(f"{self._title} goes back: {why}")
        self._store.failed(why)
        self.over = os.path.exists(self.proven)

    def serves(self) -> None:
        """This start has nothing to answer, as on a box that is being taught, but serves: the mains
        switch may end it."""
        self._worked = True
        self._log.attempt(self._note(True), ERRORS)

    def answered(self, verdict: Verdict) -> None:
        """As for a bundle."""
        super().answered(verdict)
        if verdict.status is Status.FAILED:
            self.goes_back(f"sweep {verdict.sweep} was not answered: {verdict.detail}")


class ReleaseComparison(Observer):
    """The proven release answers the sweeps in a folder again. command: the program that does it.
    differs: gets the text of this program if answers differ."""

    def __init__(self, command: Sequence[str], differs: Callable[[str], object]) -> None:
        self._command, self._differs = command, differs
        self._sweeps = self._compared = 0
        self._end_ns = 0
        self._process: subprocess.Popen[bytes] | None = None

    def answered(self, verdict: Verdict) -> None:
        """Count the sweep."""
        self._sweeps += 1

    def turn(self, health: Health) -> None:
        """Begin a comparison, or look for its end."""
        if self._process:
            self._look(self._process, health.time_ns)
        elif not health.sweeping and self._compared < min(KEPT, self._sweeps - EVERY + 1):
            self._compared += EVERY
            self._begin(health.time_ns)

    def _begin(self, now_ns: int) -> None:
        with suppress(OSError):  # without the proven release nothing is compared
            self._process = subprocess.Popen(
                self._command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            self._end_ns = now_ns + round(COMPARED_S * 1e9)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, 19)

    def _look(self, process: subprocess.Popen[bytes], now_ns: int) -> None:
        if (code := process.poll()) is None and now_ns < self._end_ns:
            return
        said = self._ended(process)
        if code == OTHERWISE:
            self._differs(said)

    def _ended(self, process: subprocess.Popen[bytes]) -> str:
        """Its text."""
        process.kill()
        process.wait()
        self._process = None
        assert process.stdout
        with process.stdout as out:
            return out.read().decode(errors="replace").strip()

    def stopping(self) -> None:
        """End a comparison that runs."""
        if self._process:
            self._ended(self._process)


def comparison(trial: ReleaseTrial, kept: BlackBox, bundle: Path) -> ReleaseComparison | None:
    """Compares the kept sweeps of this run, which were answered by the bundle in a folder; None if
    none are kept. Earlier ones may be of an earlier release."""
    if kept.run is None:
        return None
    words = ["-I", "-m", "palpate.runtime.replay", str(kept.path), str(bundle), str(kept.run)]
    return ReleaseComparison([trial.proven, *words], trial.goes_back)


def observed(environ: Mapping[str, str] = os.environ) -> ReleaseTrial | None:
    """The trial of the release that this program belongs to, None without one."""
    found = releases.own(environ)
    if not found:
        return None
    trial, folder = found
    before = releases.read_report(folder, trial)
    if before.passed:
        return None
    held = trial.standing
    progress = held.sweeps, held.streamed_s
    begun = releases.ReleaseReport(trial.id, trial.start, False, *progress, why=before.why)
    store = ReportStore(folder, begun)
    made = ReleaseTrial(store, trial.release, f"release {trial.release}", held)
    made.proven = str(Path(sys.prefix).resolve().parent / trial.back / "bin" / "python")
    return made
