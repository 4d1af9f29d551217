"""The devices of a command, real or simulated. Simulated devices are chosen by name, and only in
this module. Each of their sentences says so."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import islice
from typing import TYPE_CHECKING

from palpate.cli.common import load_bundle, load_settings
from palpate.core.clock import Clock, SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.errors import BundleError, ConfigError, FormatError
from palpate.core.types import SweepFormat
from palpate.io import skins

if TYPE_CHECKING:
    from palpate.sim.devices import RobotDevices


def open_devices(args: argparse.Namespace, format: Callable[[], SweepFormat] | None) -> Devices:
    """The real devices, or simulated devices with `--sim`. format: gives the format of a simulated
    skin; None for the format of its script."""
    if args.sim:
        settings = load_settings(args)
        return simulated(args.sim, format() if format else None, args, settings, remember=False)
    if args.virtual:
        raise ConfigError("--virtual needs --sim; real devices run in real time")
    return Devices(SystemClock())


def open_any(args: argparse.Namespace, settings: Config) -> Devices:
    """The devices. A simulated skin has the format of the bundle if there is one and it fits."""
    try:
        return open_devices(args, lambda: load_bundle(settings, answers=False).format)
    except (BundleError, FormatError):
        return open_devices(args, None)


def simulated(
    name: str,
    format: SweepFormat | None,
    args: argparse.Namespace,
    settings: Config,
    *,
    remember: bool = True,
    spread: bool = False,
    demo: bool = False,
) -> RobotDevices:
    """A simulated robot with a readout board on USB. demo: it plays the sweeps of the demo."""
    from palpate.sim import demo_script, devices, rig, script

    clock: Clock = rig.VirtualClock() if args.virtual else SystemClock()
    follows = settings.trigger.mode == "serial"
    profile = skins.profile(settings)
    if profile.codec != "palpate":  # tests replace this function to play emulators of such skins
        raise ConfigError(
            f'--sim plays a readout board, not the skin "{settings.skin.profile}"; leave --skin'
            " out, or connect this skin"
        )
    acts, source, format = script.named(name, format, args.seed, spread=spread, follows=follows)
    acts = islice(demo_script.acts(format, args.seed) if demo else acts, args.sweeps)
    return devices.build(format, acts, clock, source, remember=remember, follows=follows)
