"""The command `palpate skin align`."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack

from palpate.alignment import live
from palpate.alignment.lines import LinePrinter, line
from palpate.alignment.live import Expected
from palpate.alignment.view import Display
from palpate.cli.common import load_bundle, load_settings, local_page
from palpate.cli.devices import open_any
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.errors import BundleError, SensorError
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.io import skins
from palpate.io.usb_sensor import fits


def run(args: argparse.Namespace) -> int:
    """Show where the contact lies, until Ctrl-C."""
    if args.sim == "skin":  # a sweep lifts the finger for a tenth of a second; here it rests
        args.sim = "rest"
    settings = load_settings(args)
    devices = open_any(args, settings)
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
    current, fingertip = None, settings.skin.fingertip
    unit = skins.profile(settings).unit
    try:
        current = load_bundle(settings, answers=False)
    except BundleError as e:
        log.warning(f"no bundle: {e}")
    try:
        format = devices.format or skins.announced(settings, devices)
    except SensorError:
        if not current:
            raise
        return Expected.by(current, fingertip, unit)  # the command waits for the skin
    if current and fits(format, current.format):
        return Expected.by(current, fingertip, unit)
    return Expected(format, fingertip=fingertip, unit=unit)
