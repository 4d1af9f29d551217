"""The box's command line with makers' skins: `... record --sim skin --skin flexitac`."""

import argparse
import sys
from itertools import islice

import pytest

from palpate.cli import devices as of_command
from palpate.cli import main as command
from palpate.cli import simulated_commands
from palpate.core.clock import Clock, SystemClock
from palpate.core.config import Config
from palpate.core.types import SweepFormat
from palpate.io import skins
from palpate.sim import rig, script
from palpate.sim.devices import RobotDevices
from tests.factories.skins import devices, sweeps

BY_BOARD = of_command.simulated
"""The devices of the box itself, with a readout board."""


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
    """A robot with the emulated skin of the settings on a terminal."""
    if skins.profile(settings).codec == "palpate":
        more = {"remember": remember, "spread": spread, "demo": demo}
        return BY_BOARD(name, format, args, settings, **more)
    clock: Clock = rig.VirtualClock() if args.virtual else SystemClock()
    profile, follows = skins.profile(settings), settings.trigger.mode == "serial"
    seen = sweeps.view(settings.skin.profile, profile.format)
    acts, source, format = script.named(
        name, format, args.seed, spread=spread, seen=seen, follows=follows
    )
    return devices.build(
        *(settings.skin.profile, profile, format, islice(acts, args.sweeps), clock, source),
        remember=remember,
        follows=follows,
    )


def main(words: list[str]) -> int:
    """The exit code of a command of the box with emulators."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (of_command, simulated_commands):
            patch.setattr(module, "simulated", simulated)
        return command.main(words)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
