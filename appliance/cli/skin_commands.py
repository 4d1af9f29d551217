"""The commands `palpate skin ...`: the skin by itself, without a bundle.

In: arguments, and a way to the devices, which `main` chooses. Out: lines on standard output, exit codes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing

from appliance.cli.commands import OpenDevices, load_settings
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.errors import ConfigError
from appliance.io import serial_port, skin_profile, skins
from appliance.io.serial_port import PortInfo
from appliance.io.skin_profile import DEFAULT, SkinProfile


def run_check(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate skin check`: each part of PROTOCOL.md, one line each; 1 where any fails."""
    from appliance.tools import skin_check

    devices = open_devices(None)
    settings = devices.wire(load_settings(args))
    failed, port = 0, settings.sensor.link == "serial"
    with closing(skins.open_board(settings, devices)) as link:
        for found in skin_check.check(link, devices.clock, args.seconds, port=port):
            print(f"{found.verdict:<7}  {found.part:<9} {found.detail}", flush=True)
            failed += found.verdict == "FAIL"
    return 1 if failed else 0


def run_list(args: argparse.Namespace) -> int:
    """`palpate skin list`: all profiles, one line each; 1 where one cannot be read."""
    from appliance.tools import skin_detect

    broken = 0
    for name, profile in _profiles(load_settings(args)):
        broken += isinstance(profile, ConfigError)
        print(f"{name:<14} {profile}" if isinstance(profile, ConfigError) else skin_detect.listed(name, profile))
    return 1 if broken else 0


def run_detect(args: argparse.Namespace) -> int:
    """`palpate skin detect`: what is plugged in, and which profile fits; 1 where none does."""
    from appliance.io.serial_link import SerialLink
    from appliance.tools import skin_detect

    if args.write and not args.port:
        raise ConfigError("--write writes commands to a port, so it has to be named: add --port /dev/...")
    settings, clock = load_settings(args), SystemClock()
    profiles = {name: p for name, p in _profiles(settings) if not isinstance(p, ConfigError)}
    there = serial_port.ports()
    if args.port:
        there = [port for port in there if port.path == args.port] or [PortInfo(args.port)]
    # a port that is soldered on may lead to the robot, or to nothing: only the named one is opened
    usb = [port for port in there if port.vendor_id or args.port]
    found = 0
    for line in skin_detect.on_usb(settings.sensor):
        print(line, flush=True)
        found += 1
    for one in skin_detect.detect(
        usb, profiles, lambda path, baud: SerialLink(path, baud, clock), clock,
        write=args.write, seconds=skin_detect.LISTEN_S,
    ):  # fmt: skip
        print(f"{one.port}: {one.profile or 'no profile fits'}: {one.detail}", flush=True)
        found += bool(one.profile)
    if not found and not usb:
        others = ", ".join(port.path for port in there) or "none"
        print(f"no skin on USB; plug it in, or name another port with --port (there are: {others})")
    return 0 if found else 1


def _profiles(settings: Config) -> Iterator[tuple[str, SkinProfile | ConfigError]]:
    """All profiles by name; the error of one that cannot be read."""
    folders = skins.folders(settings)
    for name in sorted({DEFAULT, *skin_profile.names(folders)}):
        try:
            yield name, skin_profile.load(name, folders)
        except ConfigError as e:
            yield name, e


WITH_DEVICES = {"skin check": run_check}
RUNS = {"skin list": run_list, "skin detect": run_detect}
