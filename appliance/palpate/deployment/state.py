"""The state of the store's bundles, as in bundles.json.

This module only computes; `store` reads and writes the file. Bundles are identified by their names
(`bundle.name`), the packaged bundle by PACKAGED.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

from palpate.core.errors import BundleError
from palpate.core.schema import typed
from palpate.core.text import printable

STATE_FILE = "bundles.json"
"""The file of a StoreState."""
PACKAGED = ""
"""The bundle that comes with the program. It is never on trial."""
MOST_STARTS = 3
"""Largest number of starts without a commit; the next start goes back."""
MOST_CUTS = 10
"""Largest number of power-offs in a row, each before the trial had shown anything. Without this
limit a bundle that switches the computer off would stay for ever. A start that answered a sweep or
streamed for some minutes resets it: a cell that is switched off each evening is not at fault."""
MOST_WHY = 300
"""Largest number of characters kept of the reason why a trial failed."""


@dataclass(frozen=True, slots=True)
class Goal:
    """The end of a trial: a number of sweeps with a label, a time in which the skin streamed,
    or both."""

    sweeps: int
    streamed_s: float
    both: bool = False

    def reached(self, sweeps: int, streamed_s: float) -> bool:
        """Whether the trial has ended."""
        done = sweeps >= self.sweeps, streamed_s >= self.streamed_s
        return all(done) if self.both else any(done)


class TrialProgress(NamedTuple):
    """The part of a Standing that the program on trial records."""

    starts: int
    sweeps: int
    streamed_s: float
    worked: bool


@dataclass(frozen=True, slots=True)
class Standing:
    """State of one bundle in the store.

    previous: the bundle to go back to while this bundle is current.
    counter: of its manifest.
    starts: number of starts on trial without an orderly end.
    sweeps, streamed_s: progress of its trial without the last start.
    last_sweeps, last_s: the same with the last start, as of the last write. They hold if a power
    cut or an orderly end has ended that start, and are lost if the program has failed.
    why: why its trial failed, "" if it did not.
    boot: id of the boot of the last counted start, "" if that start is no longer counted.
    worked: whether the last start has made progress.
    cuts: number of starts in a row that a power cut or a reset of the computer ended before they
    had made progress.
    """

    previous: str = PACKAGED
    counter: int = 0
    committed: bool = True
    starts: int = 0
    sweeps: int = 0
    streamed_s: float = 0.0
    why: str = ""
    boot: str = ""
    worked: bool = False
    cuts: int = 0
    last_sweeps: int = 0
    last_s: float = 0.0

    def since(self, boot: str) -> Standing:
        """The state at a start in this boot. If the last counted start was in another boot, the end
        of that boot ended it, so it does not count against the bundle, but as a cut if it had made
        no progress."""
        cuts = 0 if self.worked else self.cuts
        if not self.boot or not boot or self.boot == boot:
            return replace(self, cuts=cuts, last_sweeps=0, last_s=0.0)
        cuts += not self.worked
        return replace(self._settled(), starts=self.starts - 1, cuts=cuts, boot="")

    def begun(self, boot: str) -> Standing:
        """The state with one more start, in this boot."""
        return replace(self, starts=self.starts + 1, boot=boot, worked=False)

    def spent(self, started: str) -> str:
        """Why no further start may follow, "" if one may. started: the words for too many."""
        if self.starts >= MOST_STARTS:
            return self.why or started
        if self.cuts >= MOST_CUTS:
            return f"the box was switched off {MOST_CUTS} times, each time soon after its start"
        return ""

    def noted(self, progress: TrialProgress, boot: str) -> Standing:
        """The state with the progress of a start. boot: "" if the start does not count, so that its
        progress holds. Less progress than before holds, too: the trial has begun anew."""
        made = replace(
            self,
            starts=progress.starts,
            worked=progress.worked,
            boot=boot,
            sweeps=min(self.sweeps, progress.sweeps),
            streamed_s=min(self.streamed_s, progress.streamed_s),
            last_sweeps=progress.sweeps,
            last_s=progress.streamed_s,
        )
        return made if boot else made._settled()

    def _settled(self) -> Standing:
        """The state in which the progress of the last start holds whatever comes."""
        sweeps, s = max(self.sweeps, self.last_sweeps), max(self.streamed_s, self.last_s)
        return replace(self, sweeps=sweeps, streamed_s=s, last_sweeps=0, last_s=0.0)


@dataclass(frozen=True, slots=True)
class StoreState:
    """State of all bundles in the store.

    counter, highest: the highest counter that was ever committed, and its bundle. candidate: the
    bundle that classifies along with the current bundle in `palpate run --shadow`, PACKAGED without
    a candidate.
    """

    counter: int = 0
    highest: str = PACKAGED
    candidate: str = PACKAGED
    standings: dict[str, Standing] = field(default_factory=dict)

    def of(self, sha: str) -> Standing:
        """State of a bundle. A bundle without an entry was put there by hand and goes back to the
        packaged bundle."""
        return self.standings.get(sha, Standing())

    def changed(self, sha: str, **changes: Any) -> StoreState:
        """The state with these fields of one bundle changed."""
        return replace(self, standings=self.standings | {sha: replace(self.of(sha), **changes)})

    def activated(self, sha: str, counter: int, now: str) -> StoreState:
        """The state that must be written before `sha` replaces the current bundle `now`: `sha` is
        on trial and goes back to a committed bundle."""
        back = now if self.of(now).committed else self.of(now).previous
        fresh = self if sha != self.candidate else replace(self, candidate=PACKAGED)
        if sha == back:
            return fresh
        standings = fresh.standings | {sha: Standing(back, counter, committed=False)}
        return replace(fresh, standings=standings)

    def committed(self, sha: str) -> StoreState:
        """The state after `sha` passed its trial: bundles with a lower counter are refused."""
        standing = Standing(self.of(sha).previous, self.of(sha).counter)
        made = replace(self, standings=self.standings | {sha: standing})
        counter = standing.counter
        return replace(made, counter=counter, highest=sha) if counter >= self.counter else made

    def left(self, sha: str, why: str) -> StoreState:
        """The state after the trial of `sha` failed for this reason. Its starts are set to the
        limit, in case the power fails before `current` changes."""
        text = printable(why, " ")
        return self.changed(sha, starts=MOST_STARTS, why=text[:MOST_WHY], boot="")

    def exchanged(self, sha: str) -> StoreState:
        """The state that must be written before a rollback from `sha`: a second rollback returns
        to `sha`."""
        return self.changed(self.of(sha).previous, previous=sha)

    def chain(self, sha: str) -> tuple[str, ...]:
        """A bundle and the bundle that it goes back to. For a bundle on trial also the next in the
        chain, which is needed if the trial fails."""
        back = self.of(sha).previous
        return (sha, back) if self.of(sha).committed else (sha, back, self.of(back).previous)

    def only(self, *kept: str) -> StoreState:
        """The state with the entries of these bundles alone."""
        return replace(
            self, standings={sha: one for sha, one in self.standings.items() if sha in kept}
        )

    def admit(self, sha: str, counter: int, least: int = 0) -> None:
        """Raises BundleError if the bundle is older than a bundle that was committed, or than the
        last delivery, whose counter is `least`."""
        if sha == self.highest:
            return
        known = max(self.counter, least - 1)
        if counter <= known:
            raise BundleError(
                f"bundle has counter {counter}, and {max(self.counter, least)} was delivered here "
                "before; sign it with a higher counter (palpate-train sign --counter), or use "
                "`palpate bundles rollback` to go back"
            )

    def json(self) -> bytes:
        """The content of bundles.json."""
        return (json.dumps(asdict(self), indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def parse(cls, text: bytes) -> StoreState:
        """The state in the content of bundles.json. Raises ValueError or TypeError for wrong
        content."""
        raw = json.loads(text)
        if isinstance(raw, dict) and "standings" not in raw:
            raise TypeError("it has no standings")
        return typed(cls, raw)
