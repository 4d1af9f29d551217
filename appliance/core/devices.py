"""Clock, GPIO module and USB backend that the drivers use. Here: the real ones; `sim.devices` has
simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from appliance.core.clock import Clock, wait_readable
from appliance.core.config import Config
from appliance.core.types import SweepFormat


@dataclass(frozen=True, slots=True)
class Devices:
    """What the drivers use: the real devices, or those of a subclass (`sim.devices.SimDevices`).

    gpio: the module gpiod or its simulated double; None for gpiod, imported where a line is wired.
    backend: a pyusb backend, None for libusb. source: the name of the source in sentences ("usb",
    "sim"). wait: waits until a serial port can be read, at most so many seconds of `clock`. format:
    of the sweeps that simulated devices play, None where the skin is to be asked.
    """

    clock: Clock
    gpio: Any = None
    backend: Any = None
    source: str = "usb"
    wait: Callable[[int, float], bool] = wait_readable
    format: SweepFormat | None = None

    def wire(self, settings: Config) -> Config:
        """The settings with the lines and ids of these devices; the real ones are wired as
        configured."""
        return settings

    def finished(self, answered: int) -> bool:
        """True when nothing more will happen after `answered` sweeps; with real devices never."""
        return False
