"""From recorded sweeps to a bundle of this box: fitted by a process of its own, signed with the
box's key, installed on trial."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

from appliance.bundle import bundle
from appliance.core import fingers
from appliance.core.clock import Clock
from appliance.core.config import Config
from appliance.core.errors import ApplianceError, ConfigError
from appliance.deployment.enrolment_key import TAUGHT, EnrolmentKey
from appliance.deployment.store import Store
from appliance.teaching.process import News, TeachingProcess, check_installed, learning
from appliance.teaching.state import TeachingState

POLL_NS = 50_000_000
"""Time between two looks at the process."""


class TeachingFailed(ApplianceError):
    """No bundle was made; the bundle in service stays."""


def check_allowed(settings: Config) -> None:
    """Raises ConfigError if this box may not or cannot be taught."""
    fingers.refuse(settings.skins, "teach")
    if not settings.teach.allow:
        raise ConfigError(
            "teach.allow = false forbids teaching on this box; set it to true, or deploy a bundle"
        )
    if settings.classifier.bundle:
        raise ConfigError(
            "classifier.bundle names the bundle of this box, so a taught one would not run; remove "
            "this setting"
        )
    check_installed()


def use(
    settings: Config, store: Store, by: str, clock: Clock, tell: Callable[[News], object]
) -> str:
    """Teach all recorded sweeps. The bundle runs on trial from the next start on; returns its name
    in the store.

    by: the person or program that asked. tell: gets each news of the process. Raises ConfigError if
    the box may not be taught or its key does not sign, TeachingFailed if the process gives no
    bundle, and errors as Store.install.
    """
    check_allowed(settings)
    key = EnrolmentKey(settings.store.enrolment_key)
    key.check(TAUGHT)
    folder = Path(settings.store.folder)
    scratch = folder / "teaching"
    shutil.rmtree(scratch, ignore_errors=True)  # of a process that a power cut ended
    try:
        out = scratch / "bundle"
        day = time.strftime("%Y-%m-%d %H:%M", time.gmtime())
        options = ("--out", str(out), "--version", version(store), "--by", by, "--at", day)
        forgotten = TeachingState.load(folder).forgotten
        _wait(
            learning(folder / "sweeps", forgotten, settings.teach.memory_mb, *options),
            settings.teach.limit_s,
            clock,
            tell,
        )
        files = bundle.files(out)
        files[bundle.TAUGHT_SIGNATURE] = key.sign(files[bundle.MANIFEST], TAUGHT)
        return store.learn(files)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def assessed(settings: Config, clock: Clock) -> str:
    """The lesson of the recorded sweeps, for a person. Raises TeachingFailed if they are too
    few."""
    folder = Path(settings.store.folder)
    forgotten = TeachingState.load(folder).forgotten
    found: News = {}
    words = learning(folder / "sweeps", forgotten, settings.teach.memory_mb)
    _wait(words, settings.teach.limit_s, clock, found.update)
    return "\n".join([found["text"], *_suspected(found), f"next: {found['advice']}"])


def _suspected(found: News) -> list[str]:
    return [one["text"] for one in found["suspects"]]


def version(store: Store) -> str:
    """The version of the next bundle: one above the taught bundle in service."""
    try:
        running = store.running()
    except ApplianceError:  # a damaged bundle is replaced
        return "1"
    held = running.bundle.manifest.version
    return str(int(held) + 1) if running.taught and held.isdecimal() else "1"


def command(options: list[str], by: str) -> list[str]:
    """The command of a process that does all of `use`. options: of the settings."""
    return [
        sys.executable,
        "-P",
        "-m",
        "appliance",
        "teach",
        *options,
        "--use",
        "--json",
        "--by",
        by,
    ]


def _wait(words: list[str], limit_s: float, clock: Clock, tell: Callable[[News], object]) -> None:
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
