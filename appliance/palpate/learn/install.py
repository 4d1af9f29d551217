"""From recorded sweeps to a bundle of this box, signed with the box's key and installed on trial.

New materials are taught into a delivered bundle (materials.py). Without one, a process of its own
fits all sweeps.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from palpate.bundle import bundle
from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.config import Config
from palpate.core.errors import ApplianceError, BundleError, ConfigError
from palpate.core.log import log
from palpate.core.types import SweepFormat
from palpate.deployment.enrolment_key import TAUGHT, EnrolmentKey
from palpate.deployment.signed import SignedBundle
from palpate.deployment.store import Store
from palpate.io.usb_sensor import fits
from palpate.learn import enrolment, materials
from palpate.learn.process import News, TeachingProcess, check_installed, learning
from palpate.sweeps import sweep_folder

POLL_NS = 50_000_000
"""Time between two looks at the process."""


class TeachingFailed(ApplianceError):
    """No bundle was made; the bundle in service stays."""


def check_allowed(settings: Config) -> None:
    """Raises ConfigError if this box may not or cannot be taught."""
    if not settings.teach.allow:
        raise ConfigError("teach.allow = false forbids teaching on this box; set it to true")
    if settings.classifier.bundle:
        raise ConfigError("classifier.bundle chooses the bundle that runs; remove this setting")
    check_installed()


Tell = Callable[[News], object]
"""Gets each news of the process that learns."""


def install(settings: Config, store: Store, by: str, clock: Clock, tell: Tell) -> str:
    """Teach all recorded sweeps. The bundle runs on trial from the next start on; returns its name
    in the store.

    The fit has a process of its own; materials for a delivered bundle are learnt here. by: the
    person or program that asked. tell: gets each news of the process. Raises ConfigError if the box
    may not be taught or its key does not sign, TeachingFailed without a new bundle, and errors as
    Store.install.
    """
    check_allowed(settings)
    sweeps, key = settings.kept("sweeps"), EnrolmentKey(settings.store.enrolment_key)
    before = store.current
    if running := base(store, sweep_folder.last_format(sweeps)):
        return _into(settings, store, running, key, tell)
    key.check(TAUGHT)
    with _scratch(store) as scratch:
        out = scratch / "bundle"
        day = time.strftime("%Y-%m-%d %H:%M", time.gmtime())
        options = ("--out", str(out), "--version", version(store), "--by", by, "--at", day)
        words = learning(sweeps, settings.teach, *options)
        _wait(words, settings.teach.limit_s, clock, tell)
        files = bundle.files(out)
        files[bundle.TAUGHT_SIGNATURE] = key.sign(files[bundle.MANIFEST], TAUGHT)
        return store.learn(files, before)


@contextmanager
def _scratch(store: Store) -> Iterator[Path]:
    """A new folder in the store for one process that teaches. Raises TeachingFailed while another
    has it."""
    folder, bundles = store.folder / "teaching", store.bundles.folder
    bundles.mkdir(parents=True, exist_ok=True)
    lock = os.open(bundles, os.O_RDONLY | os.O_DIRECTORY)  # the store locks its own folder
    try:
        if not storage.locked(lock):
            raise TeachingFailed("another bundle is being made here; wait until it is there")
        shutil.rmtree(folder, ignore_errors=True)  # of a process that a power cut ended
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def base(store: Store, format: SweepFormat | None) -> SignedBundle | None:
    """The delivered bundle in service that materials are taught into, if it fits the format."""
    try:
        running = store.running()
    except (ApplianceError, OSError):  # a damaged bundle is replaced
        return None
    suits = format is None or fits(format, running.bundle.format)
    return running if suits and materials.delivered(running) else None


def _into(
    settings: Config, store: Store, running: SignedBundle, key: EnrolmentKey, tell: Tell
) -> str:
    """Teach the new materials among the recorded sweeps into a delivered bundle, as `install`."""
    materials.check_settings(settings)
    key.check()
    try:
        found = materials.recorded(running.bundle, sweeps := settings.kept("sweeps"))
        gone = tuple(sweep_folder.forgotten_in(sweeps))
        new = materials.taught(running, found.windows, gone, found.displays)
        if new.disagreement:
            raise BundleError(new.disagreement)
    except (ApplianceError, OSError) as e:
        raise TeachingFailed(f"{e}; the bundle in service stays") from e
    for warning in new.warnings:
        log.warning(f"teach: {warning}")
    sha = store.learn(enrolment.files(running.files, new, key.sign(new.file)), running.sha)
    labels = [*new.bundle.manifest.labels]
    no_slides = [asdict(one) for one in found.no_slides]
    tell({"type": "taught", "no_slides": no_slides, "labels": labels, "figures": {}})
    return sha


def assessed(settings: Config, store: Store, clock: Clock) -> News:
    """The assessment of the sweeps, as news. Raises TeachingFailed if they are too few."""
    sweeps = settings.kept("sweeps")
    if running := base(store, sweep_folder.last_format(sweeps)):
        try:
            held = materials.recorded(running.bundle, sweeps)
            return {"type": "assessed", **materials.assessed(running, held).json()}
        except (ApplianceError, OSError) as e:
            raise TeachingFailed(f"{e}; the bundle in service stays") from e
    found: News = {}
    words = learning(sweeps, settings.teach)
    _wait(words, settings.teach.limit_s, clock, found.update)
    return found


def described(found: News) -> str:
    suspected = [one["text"] for one in (*found["no_slides"], *found["suspects"])]
    return "\n".join([found["text"], *suspected, f"next: {found['advice']}"])


def version(store: Store) -> str:
    """The version of the next bundle: one above the taught bundle in service."""
    try:
        running = store.running()
    except ApplianceError:  # a damaged bundle is replaced
        return "1"
    held = running.bundle.manifest.version
    return str(int(held) + 1) if running.taught and held.isdecimal() else "1"


def command(options: Sequence[str], by: str = "") -> list[str]:
    """The command of a process that does `install`, without `by` `assessed`."""
    asked = ["--use", "--by", by] if by else []
    return [sys.executable, "-P", "-m", "palpate", "teach", *options, *asked, "--json"]


def _wait(words: list[str], limit_s: float, clock: Clock, tell: Tell) -> None:
    process = TeachingProcess(words, limit_s, clock)
    try:
        while not process.ended:
            for one in process.news():
                if one["type"] == "error":
                    raise TeachingFailed(f"{one['text']}; the bundle in service stays")
                tell(one)
            clock.sleep_until(clock.now_ns() + POLL_NS)
    finally:
        process.close()
