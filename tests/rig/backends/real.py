"""The shared part of backends in real time: the machine's clock and libraries."""

import threading
from collections.abc import Callable
from contextlib import ExitStack

import gpiod
import usb.core
import usb.util

from palpate.core.clock import SystemClock
from palpate.core.config import SkinConfig
from palpate.core.types import SweepFormat
from palpate.sim import skin


class Real:
    """libusb and libgpiod of this machine, and its monotonic clock."""

    gpio = gpiod
    backend = None  # None: pyusb picks libusb
    slack_s = 30.0  # a busy machine may stall for seconds
    pulse_s = 0.02
    sensor: SkinConfig
    format: SweepFormat = skin.FORMAT

    def __init__(self, stack: ExitStack) -> None:
        self.clock = SystemClock()
        self._rival: usb.core.Device | None = None
        self._later: list[threading.Timer] = []
        stack.callback(self.settle)

    def settle(self) -> None:
        """Cancel all planned controls and release the skin that another program claimed."""
        for timer in self._later:
            timer.cancel()
            timer.join()
        self._later.clear()
        self.hold(False)

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now_ns() + round(seconds * 1e9))

    def after(self, seconds: float, control: Callable[[], None]) -> None:
        """Run it in a thread of its own."""
        self._later.append(threading.Timer(seconds, control))
        self._later[-1].start()

    def hold(self, on: bool) -> None:
        """Claim the skin through a separate file, as another program would."""
        if self._rival:
            usb.util.dispose_resources(self._rival)
            self._rival = None
        if on:
            self._rival = usb.core.find(
                idVendor=self.sensor.vendor_id, idProduct=self.sensor.product_id
            )
            assert self._rival, "no skin is plugged in"
            usb.util.claim_interface(self._rival, 0)
