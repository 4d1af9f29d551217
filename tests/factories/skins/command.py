"""The command line of the box with emulators of makers' skins: `python -m
tests.factories.skins.command record --sim skin --skin flexitac ...`."""

import argparse
import sys
from itertools import islice

import pytest

from palpate.cli import devices as of_command
from palpate.cli import main as command
from palpate.core.clock import Clock
from palpate.core.config import Config
from palpate.core.types import SweepFormat
from palpate.io import skins
from palpate.sim import script
from tests.factories.skins import devices, sweeps


def emulated(
    name: str,
    format: SweepFormat | None,
    args: argparse.Namespace,
    settings: Config,
    clock: Clock,
    *,
    remember: bool,
    spread: bool,
) -> devices.PlayedDevices:
    """A robot with the emulated skin of the settings on a terminal."""
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
        patch.setattr(of_command, "emulated", emulated)
        return command.main(words)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
