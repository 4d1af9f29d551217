"""A bundle on trial. In: how the box is, turn by turn, and its verdicts. Out: the ledger, so that a start which goes wrong
is known at the next one, and the commit once enough went well.

A start counts against the bundle from `choose` on. It does not while the skin is away, and not once the program ends in
order or for want of a device: none of this is the bundle's doing.
"""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

from appliance.core.errors import ApplianceError, BundleError
from appliance.service.journal import WARNING

if TYPE_CHECKING:
    from appliance.core.health import Health
    from appliance.core.types import Verdict
    from appliance.deployment.state import Standing
    from appliance.deployment.store import Store

RETRY_NS = 10_000_000_000
"""How long a disk that took no note is left alone."""


class Trial:
    """Watches over one bundle's trial: a pulse, a sink for verdicts, and around both a context.

    standing: as it is with this start counted. Never raises for the disk: what cannot be written is told once and tried
    again later, and the classifying goes on.
    """

    def __init__(self, store: Store, sha: str, standing: Standing, log: Callable[[str], None]) -> None:
        self._store, self._sha, self._log = store, sha, log
        self._starts, self._counted = standing.starts, True
        self._sweeps, self._streamed_ns = standing.sweeps, round(standing.streamed_s * 1e9)
        self._last_ns: int | None = None  # the last turn's time, where frames came in it
        self._next_ns, self._trouble, self._over = 0, "", False

    @property
    def text(self) -> str:
        """How far it is, for a person; "" once it is over."""
        if self._over:
            return ""
        how = self._store.how
        return (
            f"on trial: {self._sweeps} of {how.trial_sweeps} sweeps, "
            f"{self._streamed_ns / 1e9:.0f} of {how.trial_s:.0f} s"
        )

    def send(self, verdict: Verdict) -> None:
        """Count a sweep that the bundle gave a label."""
        self._sweeps += bool(verdict.label)

    def turn(self, health: Health) -> None:
        """Count the time that the skin streams; write down what is new, or that it is enough."""
        if self._over:
            return
        if health.streams and self._last_ns is not None:
            self._streamed_ns += health.time_ns - self._last_ns
        self._last_ns = health.time_ns if health.streams else None
        if health.time_ns >= self._next_ns and not self._written(health):
            self._next_ns = health.time_ns + RETRY_NS

    def stopping(self) -> None:
        """The program ends in order: this start does not count."""
        if not self._over and self._counted:
            self._try(lambda: self._note(False))

    def __enter__(self) -> Trial:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """What ends the program without being the bundle's doing: hardware and settings that it was not started for."""
        if kind is None or not issubclass(kind, Exception) or _is_of_the_box(error):
            self.stopping()

    def _written(self, health: Health) -> bool:
        """Whether the ledger holds what it should; a sweep that is open is not disturbed for the commit."""
        how = self._store.how
        if self._sweeps >= how.trial_sweeps or self._streamed_ns >= how.trial_s * 1e9:
            return health.sweeping or self._try(self._commit)
        return health.streams == self._counted or self._try(lambda: self._note(health.streams))

    def _note(self, counts: bool) -> None:
        starts = self._starts - (not counts)
        self._store.note(self._sha, starts, self._sweeps, self._streamed_ns / 1e9)
        self._counted = counts

    def _commit(self) -> None:
        done = self._store.commit(self._sha, wait_s=0.0)
        self._over = True
        if done:
            self._log(f"bundle {self._sha[:8]} has stood its trial and is committed")

    def _try(self, write: Callable[[], None]) -> bool:
        """Whether it could be written."""
        try:
            write()
        except (OSError, ApplianceError) as e:
            trouble = str(getattr(e, "strerror", None) or e)
            if trouble != self._trouble:
                self._log(
                    f"{WARNING}trial of bundle {self._sha[:8]}: the ledger cannot be written: {trouble}; it is tried again"
                )
            self._trouble = trouble
            return False
        self._trouble = ""
        return True


def _is_of_the_box(error: BaseException | None) -> bool:
    return isinstance(error, ApplianceError) and not isinstance(error, BundleError)
