"""The store of bundles on the box. It chooses the bundle for each start and stays consistent after
a power failure at any moment.

In the store's folder, `bundles/SHA/` (bundle.name) are complete, verified bundles. The symlink
`current` leads to the bundle that runs; without the link the packaged bundle runs. `bundles.json`
holds the state (StoreState). Each step is one atomic rename of a file, a folder or the link, and
everything that the step relies on is synced to the disk before:

- install: the bundle's folder gets its name; then its state is written, on trial and with the
  bundle to go back to; then `current` leads to it. The state of the previous bundle is unchanged,
  and holds if the power fails in between.
- choose, at each start: the start is counted before the bundle is read.
- commit: the end of the trial and the new least counter are one write.
- going back: first the state, then `current`. The state has the trial's starts at the limit after
  a failed trial, or the way forward after a rollback.

So a reader that reads first the link and then the state needs no lock. A writer locks the folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core import storage
from palpate.core.clock import SystemClock
from palpate.core.config import StoreConfig
from palpate.core.errors import (
    ApplianceError,
    BundleError,
    ConfigError,
    ModelError,
    TemporaryError,
)
from palpate.core.log import log
from palpate.deployment.enrolment_key import EnrolmentKey
from palpate.deployment.sandbox import run_limited
from palpate.deployment.signed import PACKAGER, BundleFolder, SignedBundle
from palpate.deployment.state import (
    MOST_STARTS,
    PACKAGED,
    STATE_FILE,
    Goal,
    StoreState,
    TrialProgress,
)
from palpate.deployment.trial import Trial
from palpate.inference.session import try_all

BOOT = Path("/proc/sys/kernel/random/boot_id")
"""The kernel's id of this boot (random(4))."""
SHA = re.compile(r"[0-9a-f]{64}")
LOCK_S, STEP_NS = 10.0, 20_000_000
"""Longest wait for another command, which makes several fsyncs on a slow card; and the time between
two attempts."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The bundle for a start. trial: its state, None if the bundle is committed."""

    bundle: Bundle
    folder: Path
    trial: Trial | None


class Store:
    """The bundles on this box, and the choice of the bundle that runs.

    prove: raises if a bundle fails its golden sweeps on this machine or does not fit the settings.
    boot: the file with the id of this boot. taught: as in BundleFolder. The methods raise OSError
    for trouble with the disk, BundleError for a bundle that must not run, ConfigError if the
    settings have no trusted signers, and ApplianceError if another command holds the lock.
    """

    def __init__(
        self,
        settings: StoreConfig,
        prove: Callable[[Bundle], object],
        boot: Path = BOOT,
        *,
        taught: bool = True,
    ) -> None:
        self.settings, self.folder, self._prove = settings, Path(settings.folder), prove
        key = EnrolmentKey(settings.enrolment_key)
        self.bundles = BundleFolder(self.folder / "bundles", settings.signers, key, taught=taught)
        self._link, self._state_file = self.folder / "current", self.folder / STATE_FILE
        self._clock, self._boot_file = SystemClock(), boot

    @property
    def current(self) -> str:
        """The bundle that `current` leads to, PACKAGED if the link does not exist."""
        try:
            target = os.readlink(self._link)
        except FileNotFoundError:
            return PACKAGED
        parent, _, sha = target.partition("/")
        if parent != self.bundles.folder.name or not SHA.fullmatch(sha):
            raise BundleError(
                f"{self._link} leads to {target!r}, which is not a bundle of the store; remove "
                "this link"
            )
        return sha

    @property
    def state(self) -> StoreState:
        """The state of the bundles; empty if nothing was ever deployed. Raises BundleError for
        invalid content."""
        path = self._state_file
        try:
            return StoreState.parse(path.read_bytes())
        except FileNotFoundError:
            return StoreState()
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
            raise BundleError(
                f"{path} cannot be read: {e}; without this file the current bundle counts as "
                "committed, and only root's counter is known: remove it if you can vouch for both"
            ) from e

    def examine(self, folder: Path) -> SignedBundle:
        """The bundle in `folder`, after all checks except that of its counter. Changes nothing."""
        return self._proven(self.bundles.read(folder))

    def _proven(self, signed: SignedBundle) -> SignedBundle:
        def tried() -> None:
            try_all(signed.bundle)
            self._prove(signed.bundle)

        run_limited(tried)
        return signed

    def install(
        self,
        incoming: Path,
        shadow: bool = False,
        admit: Callable[[Bundle], object] = lambda bundle: None,
    ) -> str:
        """Install the bundle in `incoming`, so that it runs on trial from the next start on.
        Returns its name.

        shadow: it becomes the candidate instead. admit: raises BundleError for a bundle that is not
        wanted now. Other files in `incoming` are ignored. Another user may own the folder and
        change it meanwhile, so the files are read once and the checked bytes are written.
        """
        signed = self.examine(incoming)
        admit(signed.bundle)
        return self._install(signed, shadow=shadow)

    def learn(self, files: Mapping[str, bytes], before: str | None = None) -> str:
        """Install, as `install`, the files of a bundle that this box has taught, or into which it
        has enrolled a label. Returns its name. before: the current bundle when teaching began,
        None for any. Raises BundleError if another one was put into service meanwhile."""
        signed = self._proven(self.bundles.checked(files, self.folder))
        return self._install(signed, before=before)

    def _install(
        self, signed: SignedBundle, *, shadow: bool = False, before: str | None = None
    ) -> str:
        self._warn_of_removed_state()
        self.bundles.folder.mkdir(parents=True, exist_ok=True)
        with self._locked() as state:
            if before not in (None, self.current):
                raise BundleError(
                    f"bundle {self.current[:8] or 'packaged'} was put into service meanwhile, and "
                    "stays; teach again"
                )
            self._admit(signed, state)
            needed = (signed.sha, *state.chain(self.current), state.candidate)
            self.bundles.keep(*needed)
            self.bundles.put(signed)
            state = state.only(*needed)
            if shadow:
                self._write(replace(state, candidate=signed.sha))
            else:
                self._activate(signed, state)
        return signed.sha

    def promote(self) -> str:
        """Make the candidate run on trial from the next start on. Returns its name."""
        sha = self.state.candidate
        if sha == PACKAGED:
            raise BundleError(
                "there is no candidate; deploy one with SHADOW=1 (palpate bundles install --shadow)"
            )
        signed = self.bundles.get(sha)
        with self._locked() as state:
            self._admit(signed, state)
            self._activate(signed, state)
        return sha

    def candidate(self) -> Bundle | None:
        """The checked candidate for shadow mode, None without a candidate."""
        sha = self.state.candidate
        return None if sha == PACKAGED else self.bundles.get(sha).bundle

    def running(self) -> SignedBundle:
        """The current bundle, checked. The call does not count as a start."""
        return self._kept(self.current)

    def choose(self) -> Choice:
        """The checked bundle for this start. A bundle on trial that was started MOST_STARTS times,
        or is refused, is replaced by the bundle that it goes back to."""
        sha = self.current
        self._warn_of_removed_state()
        if self.state.of(sha).committed:
            return self._committed(sha)
        try:
            why = self._count(sha)
            if not why:
                try:
                    return self._on_trial(sha)
                except TemporaryError:
                    self._uncount(sha)
                    raise
                except ModelError:  # memory may be there at the next start; this one counts
                    raise
                except BundleError as e:
                    why = str(e)
            self._go_back(sha, why)
        except OSError as e:
            log.warning(
                f"{self.folder}: {e.strerror}, so no bundle can be on trial; the committed bundle "
                "runs for now"
            )
            return self._committed(self.state.of(sha).previous)
        chosen = self._committed(self.current)
        log.warning(
            f"bundle {sha[:8]} has failed its trial, and {chosen.bundle.id} runs again: {why}"
        )
        return chosen

    def commit(self, sha: str | None = None, wait_s: float = LOCK_S) -> bool:
        """End the trial of the current bundle, if that is `sha` (None: any) and on trial. Returns
        whether it was on trial."""
        with self._locked(wait_s) as state:
            now = self.current
            if state.of(now).committed or sha not in (None, now):
                return False
            self._write(state.committed(now))
        return True

    def rollback(self) -> str:
        """Go back to the previous committed bundle from the next start on. Returns its name or
        PACKAGED.

        A second rollback returns to the first bundle, unless that had failed its trial.
        """
        with self._locked() as state:
            sha = self.current
            standing = state.of(sha)
            back = standing.previous
            if back == sha or not state.of(back).committed:
                raise BundleError("there is no committed bundle to go back to; deploy one")
            if back != PACKAGED:
                self.bundles.get(back)
            self._write(
                state.exchanged(sha)
                if standing.committed
                else state.left(sha, "rolled back by hand")
            )
            self._set_current(back)
        return back

    @property
    def goal(self) -> Goal:
        """The end of a trial."""
        return Goal(self.settings.trial_sweeps, self.settings.trial_s)

    def note(self, sha: str, progress: TrialProgress, *, counted: bool) -> None:
        """Record the progress of the trial of `sha`, and whether this start counts in its starts.
        Does not wait: raises ApplianceError if another command holds the lock."""
        boot = self._boot if counted else ""
        with self._locked(0.0) as state:
            self._write(state.changed(sha, **asdict(state.of(sha).noted(progress, boot))))

    def _committed(self, sha: str) -> Choice:
        """A committed bundle for this start."""
        folder = bundle.DEFAULT if sha == PACKAGED else self.bundles.at(sha)
        return Choice(self._kept(sha).bundle, folder, None)

    def _kept(self, sha: str) -> SignedBundle:
        """A bundle that is or was current, checked."""
        if sha == PACKAGED:
            files = bundle.files(bundle.DEFAULT)
            return SignedBundle(bundle.from_files(files, str(bundle.DEFAULT)), PACKAGER, files)
        try:
            return self.bundles.get(sha)
        except BundleError as e:
            raise BundleError(
                f"{e} (this bundle is committed; `palpate bundles rollback` goes back to the "
                "previous bundle)"
            ) from e

    def _on_trial(self, sha: str) -> Choice:
        """A bundle on trial for this start, which is counted already."""
        loaded = self.bundles.get(sha).bundle
        try:
            self._prove(loaded)
        except ConfigError as e:
            raise BundleError(f"it does not fit the settings: {e}; change one of them") from e
        standing = self.state.of(sha)
        log.info(f"bundle {sha[:8]} is on trial, start {standing.starts} of {MOST_STARTS}")
        return Choice(loaded, self.bundles.at(sha), Trial(self, sha, f"bundle {sha[:8]}", standing))

    def _count(self, sha: str) -> str:
        """Count a start of `sha`. Returns why it must not be started again, "" if it may."""
        with self._locked() as state:
            standing = state.of(sha).since(self._boot)
            if why := standing.spent(f"it was started {MOST_STARTS} times without being committed"):
                return why
            self._write(state.changed(sha, **asdict(standing.begun(self._boot))))
        return ""

    @property
    def _least(self) -> int:
        """The counter of the last delivery, by root's file; 0 if nothing was delivered. User
        palpate can remove the state, but not this file."""
        path = self.settings.least_counter
        try:
            return int(path.read_text("ascii"))
        except FileNotFoundError:
            return 0
        except ValueError as e:
            raise ConfigError(
                f"{path} holds no number, so it is not known which bundles are too old; write the "
                "counter of the last delivery there"
            ) from e

    def _warn_of_removed_state(self) -> None:
        """Say so if bundles were deployed and their state is gone."""
        if os.path.lexists(self._link) and not os.path.lexists(self._state_file):
            log.warning(
                f"{self._state_file} is missing although bundles were deployed: it is not known"
                " which counters were committed, so older bundles are accepted again, down to the"
                f" counter in {self.settings.least_counter}; find out who removed it"
            )

    def _uncount(self, sha: str) -> None:
        """Do not count this start, which says nothing about the bundle."""
        with self._locked() as state:
            self._write(state.changed(sha, starts=max(0, state.of(sha).starts - 1), boot=""))

    @property
    def _boot(self) -> str:
        """The id of this boot, "" if it cannot be read; then each start counts."""
        try:
            return self._boot_file.read_text().strip()
        except OSError:
            return ""

    def _go_back(self, sha: str, why: str) -> None:
        """Make the bundle that `sha` goes back to the current bundle."""
        with self._locked() as state:
            if self.current == sha:
                self._write(state.left(sha, why))
                self._set_current(state.of(sha).previous)

    def _admit(self, signed: SignedBundle, state: StoreState) -> None:
        """Raises BundleError if the bundle is older than a committed bundle. The current bundle
        with other enrolled labels is always accepted, and so is a bundle that was taught here: it
        has no counter."""
        if signed.taught:
            return
        with suppress(BundleError, ConfigError):  # a damaged current bundle may be replaced
            new, running = signed.bundle, self.running().bundle
            if new.base == running.base and (new.added or running.added):
                return
        state.admit(signed.sha, signed.bundle.manifest.counter, self._least)

    def _activate(self, signed: SignedBundle, state: StoreState) -> None:
        self._write(state.activated(signed.sha, signed.bundle.manifest.counter, self.current))
        self._set_current(signed.sha)

    def _write(self, state: StoreState) -> None:
        storage.put(self._state_file, state.json())

    def _set_current(self, sha: str) -> None:
        """Make `current` lead to a bundle, in one step."""
        if sha != PACKAGED:
            storage.link(self._link, f"{self.bundles.folder.name}/{sha}")
        else:
            self._link.unlink(missing_ok=True)
            storage.sync(self.folder)

    @contextmanager
    def _locked(self, wait_s: float = LOCK_S) -> Iterator[StoreState]:
        """The state, while no other command can change it."""
        folder = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if (owner := os.fstat(folder).st_uid) != os.geteuid():
                raise ConfigError(
                    f"{self.folder} belongs to user {owner}; do this as that user (sudo -u palpate "
                    "...)"
                )
            end_ns = self._clock.now_ns() + round(wait_s * 1e9)
            while not storage.locked(folder):
                if self._clock.now_ns() >= end_ns:
                    raise ApplianceError(
                        f"{self.folder} is in use by another command; try again when that has ended"
                    )
                self._clock.sleep_until(self._clock.now_ns() + STEP_NS)
            yield self.state
        finally:
            os.close(folder)
