"""A simulated robot whose skin is an emulated one on a terminal."""

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from palpate.core.clock import Clock
from palpate.core.config import Config
from palpate.core.types import SweepFormat
from palpate.io.skin_profile import SkinProfile
from palpate.sim import rig
from palpate.sim.devices import RobotDevices, robot_on_lines
from tests.factories.skins.player import Player, PlayerClock
from tests.factories.skins.wires import wire


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedDevices(RobotDevices):
    """Simulated GPIO lines and a played skin; its link in `folder` goes with it."""

    name: str
    player: Player
    folder: tempfile.TemporaryDirectory[str]

    def wire(self, settings: Config) -> Config:
        """The settings with the simulated GPIO lines, and with the terminal as the skin's port."""
        skin_config = replace(settings.skin, profile=self.name, port=str(self.player.path))
        return replace(RobotDevices.wire(self, settings), skin=skin_config)


def on_wire(taxels: NDArray[Any], profile: SkinProfile) -> NDArray[Any]:
    """A frame in the order of the skin's own grid, before the profile turns it."""
    for turn in reversed(profile.orientation):  # each turn is its own inverse
        taxels = {
            "transpose": taxels.swapaxes(0, 1),
            "flip-rows": taxels[::-1],
            "flip-columns": taxels[:, ::-1],
        }[turn]
    return taxels


class Reel:
    """A robot's acts as frames for a wire."""

    def __init__(self, film: rig.Film, profile: SkinProfile) -> None:
        self._film, self._profile = film, profile

    def frame(self, i: int, frame_ns: Callable[[int], int]) -> NDArray[Any]:
        """See FrameSource."""
        return on_wire(self._film.frames(i, 1, frame_ns)[0], self._profile)


def build(
    name: str,
    profile: SkinProfile,
    format: SweepFormat,
    acts: Iterable[rig.Act],
    clock: Clock,
    source: str,
    *,
    remember: bool = True,
    follows: bool = False,
) -> PlayedDevices:
    """Devices on which a robot plays `acts`, sweeps of `format`, with the skin of this profile.
    source, remember, follows: see `sim.devices.build`.

    Raises ConfigError for a skin without an emulator.
    """
    playing = PlayerClock(clock)
    robot, lines = robot_on_lines(acts, playing, remember=remember, follows=follows)
    folder = tempfile.TemporaryDirectory()
    reel = Reel(rig.Film(robot, format), profile)
    player = Player(wire(name, format.rate_hz), reel, playing, Path(folder.name) / "ttySkin")
    playing.player = player
    return PlayedDevices(
        clock=playing,
        gpio=lines,
        source=source,
        robot=robot,
        wait=playing.wait_readable,
        format=format,
        name=name,
        player=player,
        folder=folder,
    )
