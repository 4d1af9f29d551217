"""A real board as a backend, wired to itself: spare pins drive its inputs and watch its outputs.

It needs a Raspberry Pi with the loops below, and a skin on USB for the sensor's tests. Run it on
that board, as root or in the groups gpio, dialout and plugdev, with the service stopped: `systemctl
stop palpate; make test-hw`.

There are ten loops of 1 kohm each; the resistor limits the current to 3 mA if two outputs fight.
Pins of the 40-pin header are in brackets:

    driver            the box's input             the box's output              watcher
    GPIO18 (12) --1k-- GPIO17 (11) start          GPIO23 (16) ready        --1k-- GPIO8  (24)
    GPIO9  (21) --1k-- GPIO27 (13) stop           GPIO24 (18) busy         --1k-- GPIO7  (26)
    GPIO10 (19) --1k-- GPIO22 (15) new_object     GPIO25 (22) result_valid --1k-- GPIO11 (23)
                                                  GPIO12 (32) fault        --1k-- GPIO6  (31)
    the box's serial port    the far end          GPIO13 (33) decided      --1k-- GPIO19 (35)
    GPIO14 (8)  TXD0 --1k-- GPIO5 (29) RXD2       GPIO16 (36) class_bits 0 --1k-- GPIO26 (37)
    GPIO15 (10) RXD0 --1k-- GPIO4 (7)  TXD2       GPIO20 (38) class_bits 1 --1k-- GPIO21 (40)

Class bits 2 and 3 are not driven here, because their pins (40, 37) are watchers. SPI must be off,
because it would hold pins 19 to 26. The far end is the header's second serial port:
`dtoverlay=uart2-pi5` in /boot/firmware/config.txt makes it /dev/ttyAMA2. On a Raspberry Pi 4 use
`dtoverlay=uart3`, PALPATE_BOARD=rpi4 and PALPATE_FAR_END=/dev/ttyAMA3. Without the second port the
serial tests are skipped, without a skin those of the sensor.
"""

import errno
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import gpiod
import serial
import usb.core
from gpiod.line import Bias, Direction, Value

from palpate.core import config
from tests.rig.backends import BackendMissing, real

DRIVERS = {"GPIO17": "GPIO18", "GPIO27": "GPIO9", "GPIO22": "GPIO10"}
WATCHERS = {
    "GPIO23": "GPIO8",
    "GPIO24": "GPIO7",
    "GPIO25": "GPIO11",
    "GPIO12": "GPIO6",
    "GPIO13": "GPIO19",
    "GPIO16": "GPIO26",
    "GPIO20": "GPIO21",
}
"""The spare line that is wired to each line of the box."""


class Wired(real.Real):
    """The board's own kernel, pins and ports."""

    name = "wired"

    def __init__(self, stack: ExitStack) -> None:
        super().__init__(stack)
        settings = config.load(os.environ.get("PALPATE_BOARD", "rpi5"))
        self.sensor, self.trigger, self.serial = settings.skin, settings.trigger, settings.serial
        self.output = replace(settings.output, class_bits=settings.output.class_bits[:2])
        out = gpiod.LineSettings(direction=Direction.OUTPUT, output_value=Value.INACTIVE)
        self._drivers = stack.enter_context(_request(DRIVERS.values(), out))
        seen = gpiod.LineSettings(direction=Direction.INPUT, bias=Bias.PULL_DOWN)
        self._watchers = stack.enter_context(_request(WATCHERS.values(), seen))
        can = {"lines", "overrun"}
        with suppress(usb.core.NoBackendError):
            if usb.core.find(idVendor=self.sensor.vendor_id, idProduct=self.sensor.product_id):
                can |= {"skin", "hold"}
        far_end = os.environ.get("PALPATE_FAR_END", "/dev/ttyAMA2")
        if Path(far_end).exists() and Path(self.serial.port).exists():
            self._far = stack.enter_context(
                serial.Serial(far_end, self.serial.baud, timeout=0, write_timeout=2)
            )
            can.add("serial")
        self.can = frozenset(can)

    def reset(self) -> None:
        self.settle()
        for line in DRIVERS:
            self.drive(line, False)
        if "serial" in self.can:
            self.wait(0.05)
            self.hear()

    def drive(self, line: str, level: bool) -> None:
        """Drive it with the spare pin."""
        self._drivers.set_value(DRIVERS[line], Value.ACTIVE if level else Value.INACTIVE)

    def storm(self, line: str, edges: int) -> None:
        """Toggle it as fast as Python drives a pin: about ten microseconds from edge to edge."""
        for i in range(edges):
            self.drive(line, i % 2 == 0)

    def level(self, line: str) -> bool:
        """Read it with the spare pin."""
        return self._watchers.get_value(WATCHERS[line]) is Value.ACTIVE

    def say(self, data: bytes) -> None:
        """Send from the second serial port."""
        self._far.write(data)

    def hear(self) -> bytes:
        """Read from the second serial port."""
        return bytes(self._far.read(65536))


def _request(names: Any, settings: gpiod.LineSettings) -> gpiod.LineRequest:
    """The spare lines, all on one chip. Raises BackendMissing if they are missing or in use."""
    names = tuple(names)
    for path in sorted(map(str, Path("/dev").glob("gpiochip*"))):
        try:
            with gpiod.Chip(path) as chip:
                for name in names:
                    chip.line_offset_from_id(name)
            return gpiod.request_lines(path, {names: settings}, consumer="palpate-loops")
        except OSError as e:
            if e.errno in (errno.EACCES, errno.EBUSY):
                raise BackendMissing(
                    f"{path}: {e.strerror}; join group gpio, stop the service and turn SPI off"
                ) from e
    raise BackendMissing(
        f"no gpio chip has {', '.join(names)}; "
        "run this on a board wired as tests/rig/backends/wired.py draws"
    )


@contextmanager
def opened() -> Iterator[Wired]:
    """This board. Raises BackendMissing if it is not a Raspberry Pi or not wired."""
    with ExitStack() as stack:
        yield Wired(stack)
