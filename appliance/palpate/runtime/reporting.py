"""What every running box reports: status file, feed, capture; and the end of its loop."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.observer import Facts, Observer
from palpate.core.types import SweepFormat
from palpate.io import skins
from palpate.runtime.loop import Box
from palpate.service.status_file import StatusFile
from palpate.sweeps.capture import CaptureWriter


def capture(
    path: Path | None, settings: Config, format: SweepFormat, stack: ExitStack
) -> CaptureWriter | None:
    """The capture of `--capture`, which `stack` closes."""
    made = CaptureWriter(path, format, skins.profile(settings)) if path else None
    if made:
        stack.callback(made.close)
    return made


def done(
    wanted: int | None, box: Box, devices: Devices, stopped: Callable[[], bool]
) -> Callable[[], bool]:
    """True after a signal, after `wanted` answers, and at the end of a script."""
    most = float("inf") if wanted is None else wanted
    return lambda: box.answered >= most or stopped() or devices.finished(box.answered)


def status(settings: Config, facts: Facts) -> list[Observer]:
    """The writer of the status file, if the settings name a file that can be written."""
    path = settings.store.status
    if not path or not os.access(path.parent, os.W_OK):
        return []
    return [StatusFile(path, SystemClock(), lambda: {name: fact() for name, fact in facts.items()})]


def feed(
    settings: Config,
    format: SweepFormat,
    source: str,
    model: Mapping[str, Any],
    facts: Facts,
) -> list[Observer]:
    """The server of the feed, if the settings name its folder. The default folder exists in a
    service only. model: facts about the bundle for the first line of the feed."""
    path = settings.store.feed
    default = settings.sources["store.runtime"] == "code"
    if not path or (default and not os.access(path.parent, os.W_OK)):
        return []
    from palpate.service.feed import FeedServer

    known = {"source": source, "skin": settings.skin.profile, **model}
    known["unit"] = skins.profile(settings).unit
    more = lambda: {name: fact() for name, fact in facts.items()}  # noqa: E731
    return [FeedServer(path, format, known, SystemClock(), more)]
