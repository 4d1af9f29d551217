"""The command `palpate skin`: the skin by itself, without a bundle."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

from palpate.cli.common import load_bundle, load_settings, local_page
from palpate.cli.devices import open_any, open_devices
from palpate.core import storage
from palpate.core.clock import SystemClock
from palpate.core.config import Config, SkinConfig
from palpate.core.devices import Devices
from palpate.core.errors import BundleError, ConfigError, SensorError, SensorMismatch
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.core.text import shown
from palpate.io import serial_port, skin_profile, skins
from palpate.io.serial_port import PortInfo
from palpate.io.skin_profile import DEFAULT, SkinProfile
from palpate.io.usb_sensor import fits

if TYPE_CHECKING:
    from palpate.alignment.live import Expected

CHECK_S = 10.0
"""Default of `palpate skin check --seconds`."""
BYTES_S = 2.0
"""The same for a skin with a profile."""


def run_check(args: argparse.Namespace) -> int:
    """Check each part of PROTOCOL.md, or the bytes of a skin with a profile; 1 if any fails."""
    from palpate.tools import skin_check

    devices = open_devices(args, None)
    settings = devices.wire(load_settings(args))
    profile = skins.profile(settings)
    if profile.codec != DEFAULT:
        return _check_bytes(settings, profile, devices, args.seconds or BYTES_S)
    failed, port = 0, settings.skin.link == "serial"
    seconds = args.seconds or CHECK_S
    with closing(skins.open_readout(settings, devices)) as link:
        more = "about half a minute" if port else "some seconds"
        log.info(
            f"listening to frames for {seconds:g} s; stopping, requests and overflow take {more}"
            " more"
        )
        for found in skin_check.check(link, devices.clock, seconds, port=port):
            print(f"{found.verdict:<7}  {found.part:<9} {found.detail}", flush=True)
            failed += found.verdict == "FAIL"
    return 1 if failed else 0


def _check_bytes(settings: Config, profile: SkinProfile, devices: Devices, seconds: float) -> int:
    """Print the first frames of a skin with a profile next to their bytes; 1 if a byte misfits."""
    from palpate.io.serial_link import find
    from palpate.io.serial_sensor import opener
    from palpate.tools import skin_bytes, skin_detect

    path = settings.skin.port or find(profile.ids, settings.skin.serial, serial_port.ports())
    log.info(f"listening at {path}: {seconds:g} s at {profile.baud} baud")
    ports = skin_detect.Ports(opener(devices.clock, devices.wait), devices.clock)
    heard = ports.listen(path, profile.baud, profile, seconds)
    lines, good = skin_bytes.report(profile, heard.data)
    print(*lines, sep="\n")
    return 0 if good else 1


def run_list(args: argparse.Namespace) -> int:
    """Print all profiles as a table; 1 if a profile cannot be read."""
    from palpate.tools import skin_detect

    every = dict(_profiles(load_settings(args)))
    good = {name: one for name, one in every.items() if not isinstance(one, ConfigError)}
    print(*skin_detect.table(good), sep="\n")
    for name, one in every.items():
        if isinstance(one, ConfigError):
            print(f"{name}: {one}")
    return 1 if len(good) < len(every) else 0


def run_detect(args: argparse.Namespace) -> int:
    """Print the connected skins and the profiles that fit; 1 if none fits."""
    from palpate.tools import skin_detect

    if args.write and not args.skin_port:
        raise ConfigError("--write sends commands to a port; name the port with --port /dev/...")
    settings, port = load_settings(args), args.skin_port
    there = serial_port.ports()
    if port:
        there = [one for one in there if one.path == port] or [PortInfo(port)]
    # a port that is soldered on may lead to the robot, or to nothing: only the named port is opened
    usb = [one for one in there if one.vendor_id or port]
    found = 0
    for line in skin_detect.on_usb(settings.skin):
        print(line, flush=True)
        found += 1
    found += _listen(usb, settings, args.write)
    if not found and not usb:
        others = ", ".join(one.path for one in there) or "none"
        print(f"no skin on USB; plug it in, or name another port with --port (there are: {others})")
    return 0 if found else 1


def _listen(ports: list[PortInfo], settings: Config, write: bool) -> int:
    """Listen at each port and print the profiles that fit; the number of ports where one fits."""
    from palpate.io.serial_sensor import opener
    from palpate.tools import skin_detect

    clock, fitting = SystemClock(), 0
    profiles = {name: p for name, p in _profiles(settings) if not isinstance(p, ConfigError)}
    if ports:
        names = ", ".join(port.path for port in ports)
        log.info(f"listening at {names}; some seconds at each")
    for one in skin_detect.Ports(opener(clock), clock).detect(ports, profiles, write=write):
        print(f"{one.port}: {one.profile or 'no profile fits'}: {one.detail}", flush=True)
        if one.proposal:
            print(one.proposal, flush=True)
        fitting += bool(one.profile)
    return fitting


def run_new(args: argparse.Namespace) -> int:
    """Write a profile for the lines of numbers at a port. Raises ConfigError for a name or a grid
    that cannot be used, and SensorMismatch for other bytes."""
    from palpate.io.serial_sensor import opener
    from palpate.tools import skin_detect, skin_text

    if not skin_profile.NAME.fullmatch(args.name):
        raise ConfigError(f"{shown(args.name)} is no name of a profile; use a-z, 0-9 and -")
    path = (args.out or skins.OWN) / f"{args.name}.toml"
    if path.exists():
        raise ConfigError(f"{path} exists; take another name, or delete it")
    asked = SkinProfile(codec="text", about="lines", source="lines")
    wire = skin_profile.adapted(asked, SkinConfig(grid=args.grid or ""))
    clock, port = SystemClock(), args.skin_port
    log.info(f"listening at {port}")
    grid = (wire.rows, wire.cols) if args.grid else None
    bauds = (args.baud,) if args.baud else skin_detect.BAUDS
    text, sample = skin_detect.Ports(opener(clock), clock).propose(port, {}, grid, bauds)
    if not text:
        line = skin_text.odd_line(sample.data)
        what = repr(line) if line else f"{len(sample.data)} bytes, and no text"
        raise SensorMismatch(f"{port} sends {what}; {skin_detect.LINES}; check --grid and --baud")
    storage.put(path, f"{text}\n".encode(), parents=True, mode=0o644)
    print(f"{text}\n{path} is written; check it with `palpate skin check --skin {path}`")
    return 0


def _profiles(settings: Config) -> Iterator[tuple[str, SkinProfile | ConfigError]]:
    """All profiles by name, or the error of a profile that cannot be read."""
    folders = skins.folders(settings)
    for name in sorted({DEFAULT, *skin_profile.names(folders)}):
        try:
            yield name, skin_profile.load(name, folders)
        except ConfigError as e:
            yield name, e


def run_show(args: argparse.Namespace) -> int:
    """Show the skin live, a line a second and on a page, until Ctrl-C."""
    from palpate.alignment import live
    from palpate.tools import skin_monitor

    devices = open_devices(args, None)
    settings = devices.wire(load_settings(args))
    format = devices.format or skins.announced(settings, devices)
    if slow := skin_profile.warning(format):
        log.warning(f"warning: {slow}")
    stopped = StopFlag()
    with ExitStack() as stack:
        pages = local_page("skin.html", args.web, stack)
        lines = live.LinePrinter(sys.stdout, devices.clock, skin_monitor.line)
        sensor = stack.enter_context(closing(skins.sensor(settings, format, devices)))
        names = settings.skin.profile, devices.source, skins.profile(settings).unit
        monitor = skin_monitor.SkinMonitor(format, names)
        live.run(sensor, monitor, [lines, *pages], devices.clock, stopped)
    return stopped.exit_code


def run_align(args: argparse.Namespace) -> int:
    """Show where the contact lies, until Ctrl-C."""
    from palpate.alignment import live

    if args.sim == "skin":  # a sweep lifts the finger for a tenth of a second; here it rests
        args.sim = "rest"
    given = load_settings(args)
    devices = open_any(args, given)
    settings = devices.wire(given)
    expected = _expected(settings, devices)
    stopped = StopFlag()  # before anybody can read the page's address
    with ExitStack() as stack:
        pages = local_page("watch.html", args.web, stack)
        lines = live.LinePrinter(sys.stdout, devices.clock, live.line)
        sensor = stack.enter_context(closing(skins.sensor(settings, expected.format, devices)))
        tracker = live.ContactTracker(expected, devices.source)
        live.run(sensor, tracker, [lines, *pages], devices.clock, stopped)
    return stopped.exit_code


def _expected(settings: Config, devices: Devices) -> Expected:
    """The expected contact, of a bundle that fits the skin, or of any before a skin is found."""
    from palpate.alignment.live import Expected

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
