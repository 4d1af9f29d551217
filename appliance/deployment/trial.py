"""A bundle on trial. In: the box's health turn by turn, and its verdicts. Out: what the store
records: starts that count against the bundle, its progress, and the commit once enough went well.

`Store.choose` counts a start before the bundle is touched. The count is taken back while the skin
is away, when the program ends in order or because a device is missing, and at the next start where
the computer was booted in between.
"""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Protocol

from appliance.core.errors import ApplianceError, BundleError
from appliance.core.log import TroubleLog, log
from appliance.core.observer import Observer
from appliance.deployment.state import STATE_FILE

if TYPE_CHECKING:
    from appliance.core.config import StoreConfig
    from appliance.core.health import Health
    from appliance.core.types import Verdict
    from appliance.deployment.state import Standing

RETRY_NS = 10_000_000_000
"""After a write that failed, the disk is left alone for so long."""
ERRORS = (OSError, ApplianceError)
"""What a write to the store may raise: from the disk, or because another command holds the
store."""


class TrialStore(Protocol):
    """What a trial asks of the store. Both methods raise OSError or ApplianceError where nothing
    could be written."""

    @property
    def settings(self) -> StoreConfig:
        """How many sweeps and seconds a trial lasts."""

    def note(self, sha: str, starts: int, counted: bool, sweeps: int, streamed_s: float) -> None:
        """Write down how far the trial of `sha` has come, and whether this start is one of
        `starts`."""

    def commit(self, sha: str | None, wait_s: float) -> bool:
        """End the trial of `sha`; whether it was on trial."""


class Trial(Observer):
    """Observes one bundle's trial; also a context around the run.

    standing: with this start counted. Never raises for the disk: a failed write is logged once and
    tried again after RETRY_NS, and classifying goes on.
    """

    def __init__(self, store: TrialStore, sha: str, standing: Standing) -> None:
        self._store, self._sha = store, sha
        self._starts, self._counted = standing.starts, True
        self._sweeps, self._streamed_ns = standing.sweeps, round(standing.streamed_s * 1e9)
        self._last_ns: int | None = None  # the last turn's time, where frames came in it
        self._next_ns, self._over = 0, False
        self._log = TroubleLog(
            f"trial of bundle {sha[:8]}: {STATE_FILE} cannot be written", "it is tried again"
        )

    @property
    def text(self) -> str:
        """How far the trial is, for a person; "" once it is over."""
        if self._over:
            return ""
        settings = self._store.settings
        return (
            f"on trial: {self._sweeps} of {settings.trial_sweeps} sweeps, "
            f"{self._streamed_ns / 1e9:.0f} of {settings.trial_s:.0f} s"
        )

    def answered(self, verdict: Verdict) -> None:
        """Count a sweep that the bundle gave a label."""
        self._sweeps += bool(verdict.label)

    def turn(self, health: Health) -> None:
        """Add the time that the skin streams; record what has changed, or commit where it is
        enough."""
        if self._over:
            return
        if health.streams and self._last_ns is not None:
            self._streamed_ns += health.time_ns - self._last_ns
        self._last_ns = health.time_ns if health.streams else None
        if health.time_ns >= self._next_ns and not self._record(health):
            self._next_ns = health.time_ns + RETRY_NS

    def stopping(self) -> None:
        """The program ends in order: this start does not count."""
        if not self._over and self._counted:
            self._log.attempt(lambda: self._note(False), ERRORS)

    def __enter__(self) -> Trial:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        """An error of hardware or settings does not count against the bundle, nor does a signal;
        any other does."""
        if kind is None or not issubclass(kind, Exception) or _is_hardware_or_settings(error):
            self.stopping()

    def _record(self, health: Health) -> bool:
        """Whether the store knows all it should. A commit waits until no sweep is open."""
        settings = self._store.settings
        if self._sweeps >= settings.trial_sweeps or self._streamed_ns >= settings.trial_s * 1e9:
            return health.sweeping or self._log.attempt(self._commit, ERRORS)
        return health.streams == self._counted or self._log.attempt(
            lambda: self._note(health.streams), ERRORS
        )

    def _note(self, counts: bool) -> None:
        starts = self._starts - (not counts)
        self._store.note(self._sha, starts, counts, self._sweeps, self._streamed_ns / 1e9)
        self._counted = counts

    def _commit(self) -> None:
        done = self._store.commit(self._sha, 0.0)
        self._over = True
        if done:
            log.info(f"bundle {self._sha[:8]} has stood its trial and is committed")


def _is_hardware_or_settings(error: BaseException | None) -> bool:
    return isinstance(error, ApplianceError) and not isinstance(error, BundleError)
