"""The store's ledger: what is known of each bundle beside its files. In: the bytes of ledger.json. Out: these, changed.

Values only; the disk is `store`'s. A bundle goes by the sha256 of its manifest, the box's own by PACKAGED.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from appliance.core.errors import BundleError
from appliance.core.schema import typed

PACKAGED = ""
"""The bundle that the program brings along. It is never on trial."""
MOST_STARTS = 3
"""So often a bundle is started without being committed; the start after that goes back."""
MOST_WHY = 300


@dataclass(frozen=True, slots=True)
class Standing:
    """How one bundle stands.

    previous: what is gone back to where this one is the current one. counter: its manifest's. starts: how often it was
    started on trial, less those that ended in order. sweeps, streamed_s: how far its trial has come, as of the last
    such end. why: why it was left, "" where it was not.
    """

    previous: str = PACKAGED
    counter: int = 0
    committed: bool = True
    starts: int = 0
    sweeps: int = 0
    streamed_s: float = 0.0
    why: str = ""


@dataclass(frozen=True, slots=True)
class StoreState:
    """counter, highest: the highest counter that was ever committed, and its bundle. candidate: who is shadowing."""

    counter: int = 0
    highest: str = PACKAGED
    candidate: str = PACKAGED
    standings: dict[str, Standing] = field(default_factory=dict)

    def of(self, sha: str) -> Standing:
        """How a bundle stands; one that is not in the ledger was put there by hand, and goes back to the packaged one."""
        return self.standings.get(sha, Standing())

    def changed(self, sha: str, **changes: Any) -> StoreState:
        """The ledger with these fields of one bundle's standing changed."""
        return replace(self, standings=self.standings | {sha: replace(self.of(sha), **changes)})

    def activated(self, sha: str, counter: int, now: str) -> StoreState:
        """As it must be before `sha` becomes the current one in place of `now`: on trial, and back to what is committed."""
        back = now if self.of(now).committed else self.of(now).previous
        fresh = self if sha != self.candidate else replace(self, candidate=PACKAGED)
        if sha == back:
            return fresh
        standings = fresh.standings | {sha: Standing(back, counter, committed=False)}
        return replace(fresh, standings=standings)

    def committed(self, sha: str) -> StoreState:
        """With the trial of `sha` over: what counts less than it is refused from now on."""
        made = self.changed(sha, committed=True, starts=0, why="")
        counter = self.of(sha).counter
        return replace(made, counter=counter, highest=sha) if counter >= self.counter else made

    def left(self, sha: str, why: str) -> StoreState:
        """With the trial of `sha` over for this reason; its starts are used up, should it be current for a moment more."""
        text = "".join(c if c.isprintable() else " " for c in why)
        return self.changed(sha, starts=MOST_STARTS, why=text[:MOST_WHY])

    def exchanged(self, sha: str) -> StoreState:
        """As it must be before what `sha` goes back to becomes current: a second time goes forward again."""
        return self.changed(self.of(sha).previous, previous=sha)

    def chain(self, sha: str) -> tuple[str, ...]:
        """A bundle and what it goes back to; of one on trial also what that goes back to, should the trial go wrong."""
        back = self.of(sha).previous
        return (sha, back) if self.of(sha).committed else (sha, back, self.of(back).previous)

    def only(self, *kept: str) -> StoreState:
        """With the standings of these bundles alone."""
        return replace(self, standings={sha: held for sha, held in self.standings.items() if sha in kept})

    def admit(self, sha: str, counter: int) -> None:
        """Raises BundleError where the bundle is older than one that was committed."""
        if counter <= self.counter and sha != self.highest:
            raise BundleError(
                f"bundle has counter {counter}, and {self.counter} was committed here before; sign it with a higher one "
                "(palpate-train sign --counter), or use `palpate rollback` to go back"
            )

    def json(self) -> bytes:
        """As it is written."""
        return (json.dumps(asdict(self), indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def parse(cls, text: bytes) -> StoreState:
        """Read it. Raises ValueError or TypeError naming what is wrong."""
        raw = json.loads(text)
        if isinstance(raw, dict) and "standings" not in raw:
            raise TypeError("it has no standings")
        return typed(cls, raw)
