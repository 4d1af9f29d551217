"""What the drivers stand on: clock, GPIO module, USB backend. In: these. Out: Devices, which the simulator's replace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from appliance.core.clock import Clock
from appliance.core.config import Config


@dataclass(frozen=True, slots=True)
class Devices:
    """What the drivers stand on. These are the real devices; the rig's world says otherwise.

    gpio: the module gpiod or its double. backend: a pyusb backend, None for libusb. source: as sentences name it.
    """

    clock: Clock
    gpio: Any
    backend: Any = None
    source: str = "usb"

    def wire(self, settings: Config) -> Config:
        """The configuration as it fits this world."""
        return settings

    def finished(self, answered: int) -> bool:
        """True when nothing more will happen; a robot never says so."""
        return False
