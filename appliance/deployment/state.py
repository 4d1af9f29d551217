"""What the store knows of each bundle beside its files. In: the bytes of bundles.json. Out: a
StoreState, and changed ones.

Values only; `store` reads and writes the file. A bundle is named by the sha256 of its manifest, the
packaged one by PACKAGED.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from appliance.core.errors import BundleError
from appliance.core.schema import typed

STATE_FILE, OLD_STATE_FILE = "bundles.json", "ledger.json"
"""The file of a StoreState, and its name in earlier versions."""
PACKAGED = ""
"""The bundle that comes with the program. It is never on trial."""
MOST_STARTS = 3
"""A bundle is started at most so often without being committed; the next start goes back."""
MOST_CUTS = 10
"""Nor may the computer be switched off so often while it is on trial: a bundle that did that would
else stay for ever."""
MOST_WHY = 300
"""Characters of the reason for leaving a bundle that are kept."""


@dataclass(frozen=True, slots=True)
class Standing:
    """State of one bundle in the store.

    previous: the bundle to go back to while this one is current. counter: its manifest's. starts:
    how often it was started on trial, less those that ended in order. sweeps, streamed_s: how far
    its trial has come, as of the last such end. why: why it was left, "" where it was not. boot: id
    of the boot in which the last of these starts was made, "" where it was taken back. cuts: how
    many starts ended with their boot: the power was cut, or the computer reset.
    """

    previous: str = PACKAGED
    counter: int = 0
    committed: bool = True
    starts: int = 0
    sweeps: int = 0
    streamed_s: float = 0.0
    why: str = ""
    boot: str = ""
    cuts: int = 0

    def since(self, boot: str) -> Standing:
        """As it is at a start in this boot: a start that another boot did not outlast was ended by
        no fault of the bundle."""
        if not self.boot or not boot or self.boot == boot:
            return self
        return replace(self, starts=self.starts - 1, cuts=self.cuts + 1, boot="")


@dataclass(frozen=True, slots=True)
class StoreState:
    """State of all bundles in the store.

    counter, highest: the highest counter that was ever committed, and its bundle. candidate: the
    bundle that classifies beside the current one in `palpate run --shadow`, PACKAGED where there is
    none.
    """

    counter: int = 0
    highest: str = PACKAGED
    candidate: str = PACKAGED
    standings: dict[str, Standing] = field(default_factory=dict)

    def of(self, sha: str) -> Standing:
        """State of a bundle; one that is not recorded was put there by hand, and goes back to the
        packaged one."""
        return self.standings.get(sha, Standing())

    def changed(self, sha: str, **changes: Any) -> StoreState:
        """With these fields of one bundle's state changed."""
        return replace(self, standings=self.standings | {sha: replace(self.of(sha), **changes)})

    def activated(self, sha: str, counter: int, now: str) -> StoreState:
        """As it must be before `sha` replaces the current bundle `now`: on trial, and going back to
        a committed bundle."""
        back = now if self.of(now).committed else self.of(now).previous
        fresh = self if sha != self.candidate else replace(self, candidate=PACKAGED)
        if sha == back:
            return fresh
        standings = fresh.standings | {sha: Standing(back, counter, committed=False)}
        return replace(fresh, standings=standings)

    def committed(self, sha: str) -> StoreState:
        """With the trial of `sha` passed: bundles with a lower counter are refused from now on."""
        made = self.changed(sha, committed=True, starts=0, why="", boot="", cuts=0)
        counter = self.of(sha).counter
        return replace(made, counter=counter, highest=sha) if counter >= self.counter else made

    def left(self, sha: str, why: str) -> StoreState:
        """With the trial of `sha` failed for this reason. Its starts are used up, in case the power
        goes before `current` changes."""
        text = "".join(c if c.isprintable() else " " for c in why)
        return self.changed(sha, starts=MOST_STARTS, why=text[:MOST_WHY], boot="")

    def exchanged(self, sha: str) -> StoreState:
        """As it must be before the bundle that `sha` goes back to becomes current: going back twice
        returns to `sha`."""
        return self.changed(self.of(sha).previous, previous=sha)

    def chain(self, sha: str) -> tuple[str, ...]:
        """A bundle and the one it goes back to; for one on trial also the one after that, in case
        the trial fails."""
        back = self.of(sha).previous
        return (sha, back) if self.of(sha).committed else (sha, back, self.of(back).previous)

    def only(self, *kept: str) -> StoreState:
        """With the states of these bundles alone."""
        return replace(
            self, standings={sha: one for sha, one in self.standings.items() if sha in kept}
        )

    def admit(self, sha: str, counter: int) -> None:
        """Raise BundleError where the bundle is older than one that was committed."""
        if counter <= self.counter and sha != self.highest:
            raise BundleError(
                f"bundle has counter {counter}, and {self.counter} was committed here before; sign it with a higher one "
                "(palpate-train sign --counter), or use `palpate bundles rollback` to go back"
            )

    def json(self) -> bytes:
        """The content of bundles.json."""
        return (json.dumps(asdict(self), indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def parse(cls, text: bytes) -> StoreState:
        """From the content of bundles.json. Raises ValueError or TypeError naming what is wrong.

        A field that this version does not know is left out: a newer program wrote it before it was
        gone back from, and its bundles must still start. What this version writes is then without
        it, and a newer one takes its default.
        """
        raw = json.loads(text)
        if isinstance(raw, dict):
            if "standings" not in raw:
                raise TypeError("it has no standings")
            if isinstance(raw["standings"], dict):
                raw["standings"] = {
                    sha: _known(Standing, one) for sha, one in raw["standings"].items()
                }
        return typed(cls, _known(cls, raw))


def _known(kind: type[Standing | StoreState], raw: Any) -> Any:
    """A JSON object without the fields that `kind` does not have."""
    names = {f.name for f in fields(kind)}
    return (
        {name: value for name, value in raw.items() if name in names}
        if isinstance(raw, dict)
        else raw
    )
