"""Tests inside the guest: a folder for its second disk, and controls outside."""

import shutil
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

from tests.rig.backends import Skin, skins
from tests.rig.emulated_machines import ROOT
from tests.rig.machine import Guest

RUNNER = ("pytest", "pluggy", "iniconfig", "pygments")
"""Pure Python packages, so this machine's installation also works in the guest; `packaging` is in
the box's lock."""
SETTLE_S = 0.2


def pack(folder: Path, tests: Iterable[str]) -> None:
    """Copy parts of the checkout, and the packages that run them, to `folder`."""
    for name in tests:
        source, place = ROOT / name, folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, place, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, place)
    for name in RUNNER:
        made = distribution(name)
        for file in made.files or []:
            if ".." not in file.parts and "__pycache__" not in file.parts:
                place = folder / "site" / file
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(made.locate_file(file), place)


class GuestControls:
    """The controls of a Backend, applied to a guest from outside."""

    def __init__(self, machine: Guest) -> None:
        self._machine, self._clock, self._told = machine, machine.clock, 0

    def able(self) -> list[str]:
        """The controls that work here, like `can` of a Backend."""
        return ["skin", "numbered", "plug", "garble", "silence", "lines", "serial", "stall"]

    def reset(self) -> None:
        """As Backend.reset; the cable stays. Other methods: see Backend."""
        self.garble(False)
        for line in ("START", "STOP"):
            self.drive(line, False)
        self.hear()

    def plug(self, what: Skin) -> None:
        """Connect another board to the cable."""
        self._machine.skin.unplug()
        self._machine.skin.plug(skins.board(what, self._clock))

    def unplug(self) -> None:
        self._machine.skin.unplug()

    def garble(self, on: bool) -> None:
        """On the cable."""
        self._machine.skin.mangle = skins.garbler() if on else bytes

    def silence(self) -> None:
        """The board sends nothing until it is started again."""
        cable = self._machine.skin
        cable.do(lambda: setattr(cable.board, "running", False))

    def drive(self, line: str, level: bool) -> None:
        """Drive an input of the box."""
        self._machine.lines.set(line, level)

    def storm(self, line: str, edges: int) -> None:
        """Edges as fast as QEMU takes them."""
        self._machine.lines.run_through((line, i % 2 == 0) for i in range(edges))

    def level(self, line: str) -> bool:
        """The level of an output, as the robot sees it."""
        return self._machine.lines.levels[line]

    def say(self, data: bytes) -> None:
        """Send to the guest's serial port."""
        self._machine.serial.say(data)

    def hear(self) -> bytes:
        """Bytes since the last call. Between calls nobody reads, so a port may fill up."""
        port = self._machine.serial
        port.deaf = False
        self._clock.sleep(SETTLE_S)
        port.deaf = True
        lines, self._told = port.heard[self._told :], len(port.heard)
        return b"".join(line.encode() + b"\r\n" for _, line in lines)
