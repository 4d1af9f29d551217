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


def reports(
    settings: Config, format: SweepFormat, source: str, model: Mapping[str, Any], facts: Facts
) -> list[Observer]:
    """The writer of the status file and the server of the feed, if the settings name them. The
    default folder exists in a service only. model: facts about the bundle for the first line of
    the feed."""
    status, feed, made = settings.store.status, settings.store.feed, list[Observer]()
    if status and os.access(status.parent, os.W_OK):
        made.append(StatusFile(status, SystemClock(), facts))
    default = settings.sources["store.runtime"] == "code"
    if feed and (not default or os.access(feed.parent, os.W_OK)):
        from palpate.service.feed import FeedServer

        known = {"source": source, "skin": settings.skin.profile, **model}
        known["unit"] = skins.profile(settings).unit
        made.append(FeedServer(feed, format, known, SystemClock(), facts))
    return made
