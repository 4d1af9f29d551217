"""The commands `palpate skin ...`: the skin by itself, without a bundle.

In: arguments, and a way to the devices, which `main` chooses. Out: lines on standard output, exit codes.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, closing
from functools import partial

from appliance.cli.commands import OpenDevices, load_settings, stop_flag
from appliance.core import storage
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.errors import ConfigError
from appliance.core.log import log
from appliance.io import skin_profile, skins


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


def run_show(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate skin show`: the skin live, in the terminal and on a page, until Ctrl-C."""
    from appliance.alignment.web import Page
    from appliance.tools import skin_show
    from appliance.tools.skin_screen import SkinScreen

    devices = open_devices(None)
    settings = devices.wire(load_settings(args))
    fmt = devices.format or skins.announced(settings, devices)
    if slow := skin_profile.warning(fmt):
        log.warning(f"warning: {slow}")
    stopped = stop_flag()
    with ExitStack() as stack:
        pages = [] if args.web is None else [stack.enter_context(Page(args.web, devices.clock, skin_show.PAGE))]
        screen = stack.enter_context(SkinScreen(sys.stdout, devices.clock, *(page.address for page in pages)))
        sensor = stack.enter_context(closing(skins.sensor(settings, fmt, devices)))
        name = settings.sensor.skin
        skin_show.run(sensor, fmt, name, devices.source, devices.clock, [screen, *pages], stopped)
    return 0


def run_new(args: argparse.Namespace) -> int:
    """`palpate skin new`: listens to a port, and writes a profile where the grid is named; else says how it can be."""
    from appliance.io import serial_port
    from appliance.io.serial_link import SerialLink
    from appliance.tools import skin_new

    settings = load_settings(args)
    path = (args.out or skins.OWN) / f"{_new_name(args, settings)}.toml"
    port, clock = settings.sensor.port, SystemClock()
    bauds = (settings.sensor.baud,) if settings.sensor.baud else skin_new.BAUDS
    heard = skin_new.listen(partial(SerialLink, port, clock=clock), bauds, args.seconds, clock)
    for number, proposal in enumerate(heard.proposals, 1):
        print(f"{number}: {skin_new.words(proposal)}")
    if not args.grid:
        print(f"at {heard.baud} baud; give the same command with --grid, and --proposal if the first is not right")
        return 0
    chosen, grid = skin_new.choose(heard, args.grid, args.proposal or 0)
    there = next((one for one in serial_port.ports() if one.path == port), serial_port.PortInfo(port))
    text = skin_new.profile(chosen, grid, heard.baud, there)
    frames, garbage = skin_new.decoded(text, heard.reads)
    path.parent.mkdir(parents=True, exist_ok=True)
    storage.put_all({path: text.encode()}, mode=0o644)
    print(
        f'{path}: {frames} frames of what was heard, {garbage} bytes in none; use it with sensor.skin = "{path.stem}"'
    )
    return 0


def _new_name(args: argparse.Namespace, settings: Config) -> str:
    """The name of the new profile. Raises ConfigError where it cannot be used, or no port is named."""
    name: str = args.name
    if not skin_profile.NAME.fullmatch(name):
        raise ConfigError(f"{name!r} cannot name a profile; use up to 32 small letters, digits and hyphens")
    folders = [args.out] if args.out else skins.folders(settings)
    if name in skin_profile.names(folders) and not args.replace:
        raise ConfigError(f"there is a profile {name} already; take another name, or --replace")
    if not settings.sensor.port:
        raise ConfigError(
            "no port is named; use --set sensor.port=/dev/serial/by-id/..., `palpate skin detect` lists them"
        )
    return name


WITH_DEVICES = {"skin check": run_check, "skin show": run_show}
RUNS = {"skin new": run_new}
