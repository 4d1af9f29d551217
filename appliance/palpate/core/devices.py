"""Clock, GPIO module and USB backend of the drivers; `sim.devices` has simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from palpate.core.clock import Clock, wait_readable
from palpate.core.config import Config
from palpate.core.types import SweepFormat


@dataclass(frozen=True, slots=True)
class Devices:
    """The devices of the drivers: real, or of a subclass (`sim.devices.SimDevices`).

    gpio: the module gpiod or its simulated double; None for gpiod, imported if a line is wired.
    backend: a pyusb backend, None for libusb. source: the name of the source in sentences ("usb",
    "sim"). wait: waits until a serial port can be read, at most so many seconds of `clock`. format:
    of the sweeps that simulated devices play, None if the skin has to be asked.
    """

    clock: Clock
    gpio: Any = None
    backend: Any = None
    source: str = "usb"
    wait: Callable[[int, float], bool] = wait_readable
    format: SweepFormat | None = None

    def wire(self, settings: Config) -> Config:
        """The settings with the GPIO lines and ids of these devices; real ones change nothing."""
        return settings

    def commanded(self, t_ns: int, *, start: bool) -> None:
        """START or STOP has come as a command at `t_ns`. Only a simulated finger follows."""

    def finished(self, answered: int) -> bool:
        """Whether nothing more will happen after `answered` sweeps; never with real devices."""
        return False
