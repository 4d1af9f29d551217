"""Observes the trial of a release, as that of a bundle, in the service; root's part is in
`releases`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.core.status import Status
from palpate.deployment import releases
from palpate.deployment.state import Goal, Standing
from palpate.deployment.trial import Trial

if TYPE_CHECKING:
    from palpate.core.types import Verdict
    from palpate.deployment.releases import ReleaseReport
    from palpate.deployment.state import TrialProgress

GOAL = Goal(50, 24 * 3600.0, both=True)
"""A release is proven after 50 sweeps with a label and 24 hours in which the skin streamed."""


class ReportStore:
    """Writes the reports of one start. report: as this start begins."""

    goal = GOAL

    def __init__(self, folder: Path, report: ReleaseReport) -> None:
        self._folder, self._report = folder, report

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
        self._report = replace(self._report, why=why)

    def _write(self, report: ReleaseReport) -> None:
        releases.write_report(self._folder, report)
        self._report = report


class ReleaseTrial(Trial):
    """The trial of the release that this program belongs to. A sweep on which it failed sends the
    release back at the next start."""

    _store: ReportStore

    def answered(self, verdict: Verdict) -> None:
        """As for a bundle."""
        super().answered(verdict)
        if verdict.status is Status.FAILED:
            self._store.failed(f"sweep {verdict.sweep} was not answered: {verdict.detail}")


def observed(environ: Mapping[str, str] = os.environ) -> ReleaseTrial | None:
    """The trial of the release that this program belongs to, None without one."""
    found = releases.own(environ)
    if not found:
        return None
    trial, folder = found
    before = releases.read_report(folder, trial)
    if before.passed:
        return None
    sweeps, s = trial.sweeps, trial.streamed_s
    begun = replace(
        before, start=trial.start, quiet=False, worked=False, sweeps=sweeps, streamed_s=s
    )
    standing = Standing(sweeps=sweeps, streamed_s=s)
    store = ReportStore(folder, begun)
    return ReleaseTrial(store, trial.release, f"release {trial.release}", standing)
