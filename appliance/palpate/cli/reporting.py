"""Parts that `run` and `record` share: status file, feed, capture, and the end of the loop."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.observer import Facts, Observer
from palpate.core.types import SweepFormat
from palpate.io import skins
from palpate.service.status_file import StatusFile
from palpate.sweeps.capture import CaptureWriter

if TYPE_CHECKING:
    from palpate.runtime.loop import Box


def capture(
    args: argparse.Namespace, settings: Config, format: SweepFormat, stack: ExitStack
) -> CaptureWriter | None:
    capture = CaptureWriter(args.capture, format, skins.profile(settings)) if args.capture else None
    if capture:
        stack.callback(capture.close)
    return capture


def done(
    args: argparse.Namespace, box: Box, devices: Devices, stopped: Callable[[], bool]
) -> Callable[[], bool]:
    """True after a signal, after `--sweeps` answers, and at the end of a script."""
    wanted = args.sweeps
    done = devices.finished
    return lambda: (
        (wanted is not None and box.answered >= wanted) or stopped() or done(box.answered)
    )


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
