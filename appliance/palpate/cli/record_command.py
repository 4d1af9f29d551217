"""The command `palpate record`."""

from __future__ import annotations

import argparse
import select
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from palpate.cli.common import load_settings
from palpate.cli.devices import open_devices
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.disk_thread import DiskThread
from palpate.core.errors import ConfigError, SensorError
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.core.observer import Facts, Observer
from palpate.core.sentences import Reply
from palpate.core.types import Sweep, SweepFormat, Verdict
from palpate.io import skin_profile, skins
from palpate.io.robot_link import Command
from palpate.runtime import assembly
from palpate.service.systemd import Notifier
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_check import SlidesBefore, SweepCheck

if TYPE_CHECKING:
    from palpate.web.record import RecordPage


def run(args: argparse.Namespace) -> int:
    """Keep each sweep with its label. No bundle is needed: the skin announces its format."""
    labels = Labels(args.material, args.position, args.session)
    settings, stopped = load_settings(args), StopFlag()
    with ExitStack() as stack:
        devices, format = open_skin(args, settings)
        port = assembly.port(settings, devices, terminal=False)
        folder, disk = args.out or settings.kept("sweeps"), DiskThread()
        say = port.say if port else lambda line: None
        recording = RecordingSession(folder, format, labels, devices.clock, say, args.target, disk)
        stack.callback(recording.close)
        obey: Callable[[Command], Reply] = lambda command: box.obey(command)  # noqa: E731
        talk = recording.about, obey, recording.names.label
        pages = page(args.web, settings, format, devices, *talk)
        _announce(format, folder)
        reports = _observers(settings, format, devices.source, recording)
        check = SweepCheck(format, devices.clock, SlidesBefore(format, recording))
        box = assembly.assembled(
            *(settings, check, devices, port, stack),
            capture=assembly.capture(args.capture, settings, format, stack),
            observers=[disk, *reports, *pages],
            commands=recording.commands,
            ordered=bool(pages),
        )
        for shown in pages:
            stack.enter_context(shown)
        box.run(assembly.done(args.sweeps, box, devices, stopped))
    return stopped.exit_code


def open_skin(args: argparse.Namespace, settings: Config) -> tuple[Devices, SweepFormat]:
    """The devices, and the format of the sweeps. Raises ConfigError for too long a window."""
    given, window = getattr(args, "format", None), getattr(args, "window", None)
    asked = skins.described(given) if given else None
    devices = open_devices(args, (lambda: asked) if asked else None)
    format = asked or devices.format or _announced(settings, devices)
    if window is not None:
        format = replace(format, window=round(window * format.rate_hz))
    _check_length(format, settings)
    return devices, format


def _announce(format: SweepFormat, folder: Path) -> None:
    """Log format and folder, and warn if the skin is too slow for textures."""
    window_s = format.window / format.rate_hz
    log.info(f"record: {format}, to {folder}; slide for longer than {window_s:.3g} s")
    if slow := skin_profile.warning(format):
        log.warning(f"record: {slow}")


def _observers(
    settings: Config, format: SweepFormat, source: str, recording: RecordingSession
) -> list[Observer]:
    facts: Facts = {
        "model": lambda: "none: sweeps are recorded",
        "recorded": lambda: recording.about()["missing"],
        "recording": recording.about,
    }
    return [
        Notifier(SystemClock()),
        recording,
        *([SweepPrinter(sys.stdout, recording.about)] if sys.stdout.isatty() else []),
        *assembly.reports(settings, format, source, {"bundle": "", "labels": []}, facts),
    ]


class SweepPrinter(Observer):
    """Prints the counts of a recording (`about`) after each sweep, for a person."""

    def __init__(self, out: TextIO, about: Callable[[], Mapping[str, Any]]) -> None:
        self._out, self._about = out, about

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Print a line, unless the terminal accepts no output."""
        if not select.select([], [self._out], [], 0)[1]:
            return
        counts = [f"{m}{f' at {p}' * bool(p)}: {n}" for m, p, n in self._about()["counts"]]
        print(f"sweep {sweep.id}; {', '.join(counts) or 'none kept'}", file=self._out, flush=True)


def page(
    port: int | None,
    settings: Config,
    format: SweepFormat,
    devices: Devices,
    about: Callable[[], Mapping[str, Any]],
    obey: Callable[[Command], Reply],
    named: Callable[[str], str],
    *,
    teaching: bool = False,
) -> list[RecordPage]:
    """The page of `--web`, if there is a port. about, obey, named, teaching: see RecordPage."""
    if port is None:
        return []
    from palpate.web.access import Access
    from palpate.web.record import RecordPage

    shown = RecordPage(
        Access.configured(settings.watch, port),
        format,
        devices.source,
        devices.wire(settings).trigger,
        about,
        obey,
        SystemClock(),
        skins.profile(settings).unit,
        named,
        teaching=teaching,
    )
    log.info(f"page: {shown.server.address}")
    return [shown]


def _announced(settings: Config, devices: Devices) -> SweepFormat:
    """The format that the skin announces. Raises SensorError with advice if it announces none."""
    try:
        return skins.announced(devices.wire(settings), devices)
    except SensorError as e:
        how = "or name its format with --format 4x4:uint8:750; then the command waits for it"
        raise type(e)(f"{e}; {how}") from e


def _check_length(format: SweepFormat, settings: Config) -> None:
    """Raises ConfigError if no sweep could be as long as the window."""
    window_s, most_s = format.window / format.rate_hz, settings.sweep.max_duration_s
    if window_s > most_s:
        longer = f"a window of {window_s:g} s is longer than any sweep may last ({most_s:g} s)"
        raise ConfigError(f"{longer}; use a shorter --window, or raise sweep.max_duration_s")
