"""Observes a bundle or a release on trial and records its progress, the starts that count against
it, and the commit at its goal.

`Store.choose`, and for a release `releases.begin`, count a start before anything of it runs. The
start is no longer counted while the skin is away, after the program has ended in order or because a
device is missing, and at the next start if the computer was booted in between.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Protocol

from palpate.core.disk_thread import AtOnce, DiskWork
from palpate.core.errors import ApplianceError, BundleError
from palpate.core.log import TroubleLog, log
from palpate.core.observer import Health, Observer
from palpate.core.status import Status
from palpate.core.types import Verdict
from palpate.deployment.state import Goal, Standing, TrialProgress

RETRY_NS = 10_000_000_000
"""Pause after a failed write."""
NEVER_NS = 1 << 63
WORKED_S = 300.0
"""A start has made progress after a sweep with a label, or after so much time in which the skin
streamed. Progress is recorded as often: a cell may be switched off without an orderly end."""
ERRORS = (OSError, ApplianceError)
"""Errors of a write to the store: of the disk, or because another command holds the lock."""


class TrialStore(Protocol):
    """The part of a store that a trial uses. The methods raise OSError or ApplianceError if nothing
    could be written."""

    @property
    def goal(self) -> Goal:
        """The end of the trial."""

    def note(self, sha: str, progress: TrialProgress, *, counted: bool) -> None:
        """Record the progress of the trial of `sha`, and whether this start counts."""

    def commit(self, sha: str | None, wait_s: float) -> bool:
        """End the trial of `sha`. Returns whether it was on trial."""


class Trial(Observer):
    """Observes one trial; also a context around the run.

    sha: the name in the store. title: the name for a person. standing: its state with this
    start counted. disk: writes the state. Trouble with it raises no error: a failed write is logged
    once and tried again after RETRY_NS, and classifying goes on.
    """

    disk: DiskWork = AtOnce()

    def __init__(self, store: TrialStore, sha: str, title: str, standing: Standing) -> None:
        self._store, self._sha, self._title = store, sha, title
        self._starts, self._counted = standing.starts, True
        self._sweeps, self._streamed_ns = standing.sweeps, round(standing.streamed_s * 1e9)
        self._last_ns: int | None = None  # time of the last turn if it had frames
        self._worked, self._noted_ns = False, self._streamed_ns  # progress up to the last write
        self._next_ns, self._over, self._stale = 0, False, False
        self._log = TroubleLog(f"trial of {title} cannot be recorded", "it is tried again")

    @property
    def text(self) -> str:
        """Progress of the trial, for a person; "" after its end."""
        if self._over:
            return ""
        goal = self._store.goal
        return (
            f"on trial: {self._sweeps} of {goal.sweeps} sweeps, "
            f"{self._streamed_ns / 1e9:.0f} of {goal.streamed_s:.0f} s"
        )

    def answered(self, verdict: Verdict) -> None:
        """Count a sweep with a label. A sweep on which the bundle failed begins the trial anew."""
        self._sweeps += bool(verdict.label)
        if verdict.label and not self._worked:
            self._worked = self._stale = True
        if verdict.status is Status.FAILED:
            self._sweeps, self._streamed_ns, self._noted_ns, self._stale = 0, 0, 0, True

    def turn(self, health: Health) -> None:
        """Add the time in which the skin streamed. Record changes, or commit after enough sweeps
        and seconds."""
        if self._over:
            return
        if health.streams and self._last_ns is not None:
            self._streamed_ns += health.time_ns - self._last_ns
            if self._streamed_ns - self._noted_ns >= WORKED_S * 1e9:
                self._worked = self._stale = True
        self._last_ns = health.time_ns if health.streams else None
        if health.time_ns >= self._next_ns:
            self._record(health)

    def stopping(self) -> None:
        """At an orderly end of the program: do not count this start."""
        self.disk.settle()
        if not self._over:
            self._over = self._log.attempt(self._note(False), ERRORS)

    def __enter__(self) -> Trial:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        """Count this start against the bundle, unless a signal or an error of hardware or settings
        ended the program."""
        of_others = isinstance(error, ApplianceError) and not isinstance(error, BundleError)
        if kind is None or not issubclass(kind, Exception) or of_others:
            self.stopping()

    def _record(self, health: Health) -> None:
        """Record or commit if needed, again after a failure. A commit waits until no sweep is
        open."""
        act: Callable[[], object] = self._commit
        if self._store.goal.reached(self._sweeps, self._streamed_ns / 1e9):
            if health.sweeping:
                return
            self._over = True
        elif health.streams != self._counted or self._stale:
            self._stale, self._noted_ns, self._counted = False, self._streamed_ns, health.streams
            act = self._note(self._counted)
        else:
            return

        def written(succeeded: bool) -> None:
            self._next_ns = 0
            if not succeeded:
                self._over, self._stale, self._next_ns = False, True, health.time_ns + RETRY_NS

        self._next_ns = NEVER_NS  # one write at a time
        if not self.disk(lambda: self._log.attempt(act, ERRORS), written):
            written(False)

    def _note(self, counts: bool) -> Callable[[], object]:
        """The write of the present progress."""
        starts, s = self._starts - (not counts), round(self._streamed_ns / 1e9, 1)
        progress = TrialProgress(starts, self._sweeps, s, self._worked)
        return partial(self._store.note, self._sha, progress, counted=counts)

    def _commit(self) -> None:
        if self._store.commit(self._sha, 0.0):
            log.info(f"{self._title} has passed its trial and is committed")
