"""A GPIO chip over umockdev: the kernel's v2 ioctls below an unmodified libgpiod.

The file of each request is a named pipe that answers ioctls. libgpiod polls it and reads events
from it, as it does with the kernel. A full pipe drops its oldest event, as the kernel's queue does,
but after 1360 events instead of 1024.
"""

import errno
import os
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tests.rig.backends import mocks

CHIP_INFO, LINE_INFO, REQUEST, GET, SET = 0xB401, 0xB405, 0xB407, 0xB40E, 0xB40F
ACTIVE_LOW, OUTPUT, RISING, FALLING = 1 << 1, 1 << 3, 1 << 4, 1 << 5
USED = 1
OUTPUT_VALUES = 2
EVENT = struct.Struct("<QIIII24x")
REQUESTS = 12


@dataclass(slots=True)
class Held:
    """One request of GPIO lines: offsets in the requested order, flags, consumer, file and
    counters.

    pipe: the same file, opened by the mock.
    """

    file: int
    offsets: tuple[int, ...]
    flags: int
    consumer: bytes
    pipe: int
    number: int = 0
    numbers: dict[int, int] = field(default_factory=dict)


class Chip:
    """A chip with these lines at /dev/gpiochip0."""

    def __init__(self, bench: mocks.MockedDevices, names: Sequence[str]) -> None:
        self._levels = dict.fromkeys(names, False)
        self._names = list(names)
        self._held: dict[int, Held] = {}
        testbed = bench.testbed
        testbed.add_from_string(
            "P: /devices/platform/rig-gpio/gpiochip0\nN: gpiochip0\n"
            "E: SUBSYSTEM=gpio\nE: DEVNAME=/dev/gpiochip0\n"
            "E: MAJOR=254\nE: MINOR=0\nA: dev=254:0\n\n"
        )
        bench.attach("gpiochip0", self._answer)
        for i in range(REQUESTS):
            testbed.add_from_string(
                f"P: /devices/virtual/rig/lines{i}\nN: lines{i}\n"
                f"E: SUBSYSTEM=misc\nE: DEVNAME=/dev/lines{i}\n"
                f"E: MAJOR=10\nE: MINOR={i}\n\n"
            )
            os.unlink(bench.node(f"lines{i}"))
            os.mkfifo(bench.node(f"lines{i}"))
            bench.attach(f"lines{i}", partial(self._of_request, i))

    def level(self, name: str) -> bool:
        """Level of a GPIO line, as seen from outside."""
        self._look()
        return self._levels[name]

    def drive(self, name: str, level: bool) -> None:
        """Set an input. If a request watches for this edge, it gets an event."""
        t_ns = time.monotonic_ns()
        if self._levels[name] == level:
            return
        self._levels[name] = level
        offset = self._names.index(name)
        for held in self._held.values():
            rises = level != bool(held.flags & ACTIVE_LOW)
            if offset in held.offsets and held.flags & (RISING if rises else FALLING):
                held.number += 1
                held.numbers[offset] = held.numbers.get(offset, 0) + 1
                put(
                    held.pipe,
                    EVENT.pack(t_ns, 1 if rises else 2, offset, held.number, held.numbers[offset]),
                )

    def _answer(self, number: int, argument: Any, _: int) -> None:
        """Answer an ioctl of the chip."""
        self._look()
        if number == CHIP_INFO:
            info = struct.pack("<32s32sI", b"gpiochip0", b"palpate-mock", len(self._names))
            argument.resolve(0, len(info)).update(0, info)
        elif number == LINE_INFO:
            self._line_info(argument.resolve(0, 256))
        elif number == REQUEST:
            self._request(argument.resolve(0, 592))
        else:
            raise OSError(errno.ENOTTY, "unknown")

    def _line_info(self, info: Any) -> None:
        """Fill struct gpio_v2_line_info."""
        (offset,) = struct.unpack_from("<I", bytes(info.retrieve()), 64)
        holder = next((held for held in self._held.values() if offset in held.offsets), None)
        consumer, flags = (holder.consumer, holder.flags | USED) if holder else (b"", 0)
        info.update(
            0, struct.pack("<32s32sIIQ", self._names[offset].encode(), consumer, offset, 0, flags)
        )

    def _request(self, asked: Any) -> None:
        """Answer struct gpio_v2_line_request."""
        raw = bytes(asked.retrieve())
        (n,) = struct.unpack_from("<I", raw, 560)
        offsets = struct.unpack_from(f"<{n}I", raw)
        consumer, flags, attributes = struct.unpack_from("<32sQI", raw, 256)
        if any(o in held.offsets for o in offsets for held in self._held.values()):
            raise OSError(errno.EBUSY, "held")
        slot = next(i for i in range(REQUESTS) if i not in self._held)
        file = os.open(f"/dev/lines{slot}", os.O_RDWR | os.O_NONBLOCK)
        self._held[slot] = Held(file, offsets, flags, consumer, os.dup(file))
        if flags & OUTPUT:
            self._set(offsets, flags, 0, (1 << n) - 1)
        for i in range(attributes):
            kind, values, mask = struct.unpack_from("<I4xQQ", raw, 320 + 24 * i)
            if kind == OUTPUT_VALUES:
                self._set(offsets, flags, values, mask)
        asked.update(588, struct.pack("<i", file))

    def _of_request(self, slot: int, number: int, argument: Any, _: int) -> None:
        """Answer an ioctl of a request's file: struct gpio_v2_line_values."""
        held = self._held[slot]
        values = argument.resolve(0, 16)
        bits, mask = struct.unpack("<QQ", bytes(values.retrieve()))
        if number == GET:
            low = bool(held.flags & ACTIVE_LOW)
            levels = (self._levels[self._names[offset]] != low for offset in held.offsets)
            values.update(0, struct.pack("<Q", sum(level << i for i, level in enumerate(levels))))
        elif number == SET and held.flags & OUTPUT:
            self._set(held.offsets, held.flags, bits, mask)
        else:
            raise OSError(errno.EPERM, "an input")

    def _set(self, offsets: Sequence[int], flags: int, bits: int, mask: int) -> None:
        for i, offset in enumerate(offsets):
            if mask >> i & 1:
                self._levels[self._names[offset]] = bool(bits >> i & 1) != bool(flags & ACTIVE_LOW)

    def _look(self) -> None:
        """Forget closed requests. Outputs keep their level, as some drivers leave them."""
        for slot, held in list(self._held.items()):
            with suppress(OSError):
                if os.path.sameopenfile(held.file, held.pipe):
                    continue
            del self._held[slot]
            os.close(held.pipe)


def put(pipe: int, event: bytes) -> None:
    """Write an event. If the pipe is full, drop the oldest event first."""
    while True:
        try:
            os.write(pipe, event)
        except BlockingIOError:
            os.read(pipe, EVENT.size)
        else:
            return
