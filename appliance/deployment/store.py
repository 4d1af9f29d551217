"""What the box runs. In: bundles that were copied to it. Out: the one for this start, old or new, whole at every moment.

In the store's folder, `bundles/SHA/` are whole, verified bundles (shelf), the symlink `current` says which of them runs
(none: the packaged one), and `ledger.json` all else. Each step is one renaming, of a file, a folder or the link, and
what it relies on is on the disk before:

- install: the bundle's folder takes its name; the ledger gets its standing, on trial and with what it goes back to; then
  `current` leads to it. The standing of what was current stays as it was, and holds if the power goes in between.
- choose, at each start: the ledger counts the start before the bundle is touched.
- commit: the ledger, with the end of the trial and the new least counter in one.
- going back: the ledger, where the trial's starts are used up, or the way forward again is kept; then `current`.

So whoever reads the link first and the ledger then needs no lock. Whoever changes them holds one on the folder.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle
from appliance.core import storage
from appliance.core.clock import Clock, SystemClock
from appliance.core.config import StoreConfig
from appliance.core.errors import ApplianceError, BundleError, ConfigError
from appliance.deployment.sandbox import apart
from appliance.deployment.shelf import SHA, Shelf, Signed
from appliance.deployment.state import MOST_STARTS, PACKAGED, StoreState
from appliance.deployment.trial import Trial
from appliance.service.journal import WARNING

LOCK_S, STEP_NS = 10.0, 20_000_000
"""How long another command is waited for, some fsyncs long on a slow card; and how often it is looked for."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a start runs. trial: None where the bundle is committed."""

    bundle: Bundle
    folder: Path
    trial: Trial | None


class Store:
    """The store at work.

    prove: raises where this machine does not run a bundle as it should: golden sweeps, and whether it fits the settings.
    Its methods raise OSError for trouble with the disk, BundleError for what is not to be run, ConfigError where the
    settings leave no way to tell whom to believe, and ApplianceError where another command is in the way.
    """

    def __init__(self, how: StoreConfig, prove: Callable[[Bundle], object], clock: Clock | None = None) -> None:
        self.how, self.folder, self._prove = how, Path(how.folder), prove
        self.shelf = Shelf(self.folder / "bundles", Path(how.signers))
        self._link, self._book = self.folder / "current", self.folder / "ledger.json"
        self._clock = clock or SystemClock()

    @property
    def current(self) -> str:
        """What `current` leads to, PACKAGED where it is not there."""
        try:
            target = os.readlink(self._link)
        except FileNotFoundError:
            return PACKAGED
        place, _, sha = target.partition("/")
        if place != self.shelf.folder.name or not SHA.fullmatch(sha):
            raise BundleError(f"{self._link} leads to {target!r}, which is no bundle of the store; remove this link")
        return sha

    @property
    def ledger(self) -> StoreState:
        """What is known of the bundles; empty where nothing was ever deployed."""
        try:
            return StoreState.parse(self._book.read_bytes())
        except FileNotFoundError:
            return StoreState()
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
            raise BundleError(
                f"{self._book} cannot be read: {e}; without this file the current bundle counts as committed, and any "
                "counter is taken: remove it if you can vouch for both"
            ) from e

    def examine(self, folder: Path) -> Signed:
        """The bundle in `folder`, checked in every way but its counter; nothing is changed."""
        held = self.shelf.read(folder)
        apart(lambda: self._prove(held.bundle))
        return held

    def install(self, incoming: Path, shadow: bool = False) -> str:
        """Take the bundle in `incoming` and have it run from the next start on, on trial; its sha256.

        shadow: it becomes the candidate instead. What else lies in `incoming` is not looked at. The folder may be
        another's, who changes it meanwhile: what was checked is what is written, and it is read once.
        """
        held = self.examine(incoming)
        self.shelf.folder.mkdir(parents=True, exist_ok=True)
        with self._held() as ledger:
            ledger.admit(held.sha, held.bundle.manifest.counter)
            needed = (held.sha, *ledger.chain(self.current), ledger.candidate)
            self.shelf.keep(*needed)
            self.shelf.put(held)
            ledger = ledger.only(*needed)
            if shadow:
                self._put(replace(ledger, candidate=held.sha))
            else:
                self._activate(held, ledger)
        return held.sha

    def promote(self) -> str:
        """Have the candidate run from the next start on, on trial; its sha256."""
        sha = self.ledger.candidate
        if sha == PACKAGED:
            raise BundleError("there is no candidate; deploy one with SHADOW=1 (palpate install --shadow)")
        held = self.shelf.get(sha)
        with self._held() as ledger:
            ledger.admit(sha, held.bundle.manifest.counter)
            self._activate(held, ledger)
        return sha

    def candidate(self) -> Bundle | None:
        """The bundle that is to classify beside the current one, checked."""
        sha = self.ledger.candidate
        return None if sha == PACKAGED else self.shelf.get(sha).bundle

    def running(self) -> Bundle:
        """The current bundle, checked. No start is counted."""
        return self._settled(self.current).bundle

    def choose(self, log: Callable[[str], None]) -> Choice:
        """What this start runs, checked. A bundle on trial that was started MOST_STARTS times, or is refused, is left for
        what it goes back to."""
        sha = self.current
        if self.ledger.of(sha).committed:
            return self._settled(sha)
        try:
            why = self._count(sha)
            if not why:
                try:
                    return self._tried(sha, log)
                except BundleError as e:
                    why = str(e)
            self._leave(sha, why)
        except OSError as e:
            log(f"{WARNING}{self.folder}: {e.strerror}, so no bundle can be on trial; what was committed runs for now")
            return self._settled(self.ledger.of(sha).previous)
        chosen = self._settled(self.current)
        log(f"{WARNING}bundle {sha[:8]} has failed its trial, and {chosen.bundle.id} runs again: {why}")
        return chosen

    def commit(self, sha: str | None = None, wait_s: float = LOCK_S) -> bool:
        """End the trial of the current bundle, where it is `sha` (None: any) and on trial; whether it was."""
        with self._held(wait_s) as ledger:
            now = self.current
            if ledger.of(now).committed or sha not in (None, now):
                return False
            self._put(ledger.committed(now))
        return True

    def rollback(self) -> str:
        """Go back to what was committed before, from the next start on; its sha256 or PACKAGED. A second time goes
        forward again, but never to what did not stand its trial."""
        with self._held() as ledger:
            sha = self.current
            standing = ledger.of(sha)
            back = standing.previous
            if back == sha or not ledger.of(back).committed:
                raise BundleError("there is no committed bundle to go back to; deploy one")
            if back != PACKAGED:
                self.shelf.get(back)
            self._put(ledger.exchanged(sha) if standing.committed else ledger.left(sha, "rolled back by hand"))
            self._point(back)
        return back

    def note(self, sha: str, starts: int, sweeps: int, streamed_s: float) -> None:
        """Write down how far the trial of `sha` has come, at once; ApplianceError where another command is at work."""
        with self._held(0.0) as ledger:
            self._put(ledger.changed(sha, starts=starts, sweeps=sweeps, streamed_s=round(streamed_s, 1)))

    def _settled(self, sha: str) -> Choice:
        """A committed bundle for this start."""
        if sha == PACKAGED:
            return Choice(bundle.load(bundle.DEFAULT), bundle.DEFAULT, None)
        try:
            return Choice(self.shelf.get(sha).bundle, self.shelf.at(sha), None)
        except BundleError as e:
            raise BundleError(f"{e} (this bundle is committed; `palpate rollback` goes back to the one before)") from e

    def _tried(self, sha: str, log: Callable[[str], None]) -> Choice:
        """A bundle on trial for this start, which was counted."""
        found = self.shelf.get(sha).bundle
        try:
            self._prove(found)
        except ConfigError as e:
            raise BundleError(f"it does not fit the settings: {e}") from e
        standing = self.ledger.of(sha)
        log(f"bundle {sha[:8]} is on trial, start {standing.starts} of {MOST_STARTS}")
        return Choice(found, self.shelf.at(sha), Trial(self, sha, standing, log))

    def _count(self, sha: str) -> str:
        """Count a start of `sha`, or say why there is to be none."""
        with self._held() as ledger:
            standing = ledger.of(sha)
            if standing.starts >= MOST_STARTS:
                return standing.why or f"it was started {MOST_STARTS} times without being committed"
            self._put(ledger.changed(sha, starts=standing.starts + 1))
        return ""

    def _leave(self, sha: str, why: str) -> None:
        """Have what `sha` goes back to run instead."""
        with self._held() as ledger:
            if self.current == sha:
                self._put(ledger.left(sha, why))
                self._point(ledger.of(sha).previous)

    def _activate(self, held: Signed, ledger: StoreState) -> None:
        self._put(ledger.activated(held.sha, held.bundle.manifest.counter, self.current))
        self._point(held.sha)

    def _put(self, ledger: StoreState) -> None:
        storage.put(self._book, ledger.json())

    def _point(self, sha: str) -> None:
        """Have `current` lead to a bundle, in one step."""
        if sha != PACKAGED:
            storage.link(self._link, f"{self.shelf.folder.name}/{sha}")
        else:
            self._link.unlink(missing_ok=True)
            storage.sync(self.folder)

    @contextmanager
    def _held(self, wait_s: float = LOCK_S) -> Iterator[StoreState]:
        """The ledger, while nobody else changes it."""
        door = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if (owner := os.fstat(door).st_uid) != os.geteuid():
                raise ConfigError(f"{self.folder} belongs to user {owner}; do this as that user (sudo -u palpate ...)")
            end_ns = self._clock.now_ns() + round(wait_s * 1e9)
            while not _locked(door):
                if self._clock.now_ns() >= end_ns:
                    raise ApplianceError(f"{self.folder} is in use by another command; try again when that has ended")
                self._clock.sleep_until(self._clock.now_ns() + STEP_NS)
            yield self.ledger
        finally:
            os.close(door)


def _locked(door: int) -> bool:
    try:
        fcntl.flock(door, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
