"""Commands that show the box to a person: check, status, watch, align, replay, config."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack

from palpate.alignment import live
from palpate.alignment.lines import LinePrinter, line
from palpate.alignment.live import Expected
from palpate.alignment.view import Display
from palpate.cli.common import (
    StopFlag,
    load_bundle,
    load_settings,
    local_page,
    status_file,
)
from palpate.cli.devices import open_devices
from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.errors import BundleError, ConfigError, FormatError, SensorError
from palpate.core.log import TroubleLog, log, printable
from palpate.core.patience import patiently
from palpate.io import skins
from palpate.io.usb_sensor import fits
from palpate.runtime.replay import replay
from palpate.runtime.selftest import check, check_hand
from palpate.service import status


def _open_any(args: argparse.Namespace, settings: Config) -> Devices:
    """The devices. A simulated skin has the format of the bundle, if there is a bundle and the skin
    can send this format."""
    try:
        return open_devices(args, lambda: load_bundle(settings, answers=False).format)
    except (BundleError, FormatError):
        return open_devices(args, None)


def run_check(args: argparse.Namespace) -> int:
    """Check each component by itself; 1 if any fails."""
    settings = load_settings(args)
    devices = _open_any(args, settings)
    failed, answers = 0, not args.sim
    results = check(devices.wire(settings), lambda: load_bundle(settings, answers=answers), devices)
    if settings.skins:
        results = check_hand(
            devices.wire(settings),
            lambda finger: load_bundle(settings.finger(finger), answers=answers),
            devices,
        )
    for result in results:
        line = f"{'ok  ' if result.ok else 'FAIL'}  {result.component:<14} {result.detail}"
        print(printable(line), flush=True)
        failed += not result.ok
    return 1 if failed else 0


def run_align(args: argparse.Namespace) -> int:
    """Show where the contact lies, until Ctrl-C."""

    if (
        args.sim == "skin"
    ):  # a sweep lifts the finger for a tenth of a second; here the finger rests
        args.sim = "rest"
    settings = load_settings(args)
    devices = _open_any(args, settings)
    expected = _expected(devices.wire(settings), devices)
    stopped = StopFlag()  # before anybody can read the page's address
    with ExitStack() as stack:
        pages = local_page("watch.html", args.web, stack)
        displays: list[Display] = [LinePrinter(sys.stdout, devices.clock, line), *pages]
        live.run(devices.wire(settings), expected, devices, displays, stopped)
    return stopped.exit_code


def _expected(settings: Config, devices: Devices) -> Expected:
    """The expected contact. A bundle that fits the skin gives it, or any bundle before a skin is
    found."""
    from palpate.alignment.live import Expected

    current, fingertip = None, settings.skin.fingertip
    unit = skins.profile(settings).unit
    try:
        current = load_bundle(settings, answers=False)
    except BundleError as e:
        log.warning(f"no bundle: {e}")
    try:
        format = skins.part_of(settings, devices.format or skins.announced(settings, devices))
    except SensorError:
        if not current:
            raise
        return Expected.by(current, fingertip, unit)  # the command waits for the skin
    if current and fits(format, current.format):
        return Expected.by(current, fingertip, unit)
    return Expected(format, fingertip=fingertip, unit=unit)


def run_replay(args: argparse.Namespace) -> int:
    """Print the sentences of a capture, a kept sweep or a folder of them; 1 if a verdict
    differs."""

    settings = load_settings(args)
    bundle = load_bundle(settings, answers=False)
    return replay(args.file, settings, bundle, lambda text: print(text, end="", flush=True))


def run_config(args: argparse.Namespace) -> int:
    """Print each value with its source."""
    print(config.describe(load_settings(args)))
    return 0


def run_status(args: argparse.Namespace) -> int:
    """Print the state of the service; 69 if it waits for the skin, 1 if it does not run."""

    now_ns = SystemClock().now_ns()
    report = status.read(status_file(load_settings(args)), now_ns)
    print(json.dumps(report, indent=1) if args.json else "\n".join(status.lines(report, now_ns)))
    return status.exit_code(report)


def run_watch(args: argparse.Namespace) -> int:
    """Show the running box until Ctrl-C or SIGTERM."""
    settings, clock = load_settings(args), SystemClock()
    socket, stopped = settings.store.feed, StopFlag()
    if not socket:
        raise ConfigError(
            'store.runtime = "" turns the feed off, so there is nothing to watch; set it to a'
            " folder"
        )
    path = str(socket)
    if args.web is not None:
        from palpate.web.access import Access
        from palpate.web.web import PageWatcher

        access = Access.configured(settings.watch, args.web)
        watcher = patiently(lambda: PageWatcher(path, access, clock.now_ns), clock, stopped)
        log.info(f"page: {watcher.server.address}")
        watcher.run(stopped)
        return stopped.exit_code
    from palpate.web import lines

    if args.json:
        trouble = TroubleLog("feed", end="feed: it is read", known=False)
        lines.pass_on(path, sys.stdout, clock, stopped, trouble.update)
    else:
        lines.LineWatch(path, sys.stdout, clock).run(stopped)
    return stopped.exit_code
