"""A simulated USB bus: a pyusb backend with one readout board. It gives descriptors, replies,
transfers and the errnos of libusb, and can simulate faults.

libusb and everything below it is simulated; usb.core, usb.util and the drivers above are real.
"""

from __future__ import annotations

import errno
import heapq
from array import array
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from palpate.core.clock import Clock
from palpate.io import packets
from palpate.sim.rig import ReadoutBoard

VENDOR_ID, PRODUCT_ID = 0x1209, 0x7AC7
MAX_PACKET = 64
SPEED_FULL = 2


class RigBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A pyusb backend with one readout board.

    errors: errno that all calls of a kind raise, by name ("claim", "open", "read" and so on).
    mangle: changes the bytes of a transfer, as a bad cable does. halted: the bulk endpoint stalls
    until it is cleared. kernel_driver: cdc_acm holds the device. dtr: the host has signalled that
    it reads (CDC-ACM).
    """

    def __init__(self, board: ReadoutBoard, clock: Clock, *, acm: bool = False) -> None:
        self.board = board
        self.errors: dict[str, int] = {}
        self.mangle: Callable[[bytes], bytes] = lambda data: data
        self.halted = False
        self.kernel_driver = acm
        self.dtr = False
        self.acm = acm
        self._clock = clock
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._pending = b""

    def at(self, t_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self._agenda, (t_ns, len(self._agenda), action))

    def unplug(self) -> None:
        """Unplug the cable; the readout board loses its power."""
        self.board.present = self.board.running = False

    def plug(self) -> None:
        self.board.present = True

    def _touch(self, what: str = "") -> None:
        """Do the scheduled actions that are due, then raise the error that the bus would give."""
        while self._agenda and self._agenda[0][0] <= self._clock.now_ns():
            heapq.heappop(self._agenda)[2]()
        if what in self.errors:
            raise usb.core.USBError("simulated failure", -1, self.errors[what])
        if not self.board.present:
            raise usb.core.USBError("No such device", -4, errno.ENODEV)

    def _wait(self, t_ns: int) -> None:
        """Sleep until `t_ns` or until the next scheduled action."""
        self._clock.sleep_until(min(t_ns, self._agenda[0][0]) if self._agenda else t_ns)

    def enumerate_devices(self) -> Iterator[str]:
        try:
            self._touch()
        except usb.core.USBError:
            return iter(())
        return iter(("board",))

    def get_device_descriptor(self, dev: str) -> SimpleNamespace:
        return SimpleNamespace(
            **dict(bLength=18, bDescriptorType=1, bcdUSB=0x200, bcdDevice=0x100),
            **dict(bDeviceClass=0xEF if self.acm else 0, bDeviceSubClass=0, bDeviceProtocol=0),
            **dict(idVendor=VENDOR_ID, idProduct=PRODUCT_ID, bMaxPacketSize0=64),
            **dict(iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1),
            **dict(bus=1, address=1, port_number=1, port_numbers=(1,), speed=SPEED_FULL),
        )

    def get_configuration_descriptor(self, dev: str, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            **dict(bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1 + self.acm),
            **dict(bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=50),
            extra_descriptors=[],
        )

    def get_interface_descriptor(
        self, dev: str, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """pyusb: vendor class, or the two interfaces of CDC-ACM."""
        classes = (2, 10) if self.acm else (255,)
        if intf >= len(classes) or alt:
            raise IndexError
        return SimpleNamespace(
            **dict(bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0),
            **dict(bInterfaceClass=classes[intf], bInterfaceSubClass=0, bInterfaceProtocol=0),
            **dict(bNumEndpoints={2: 0, 10: 2, 255: 1}[classes[intf]], iInterface=0),
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: str, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """pyusb: bulk IN 0x81, and bulk OUT 0x02 of CDC-ACM."""
        addresses = (0x81, 0x02) if self.acm and intf else () if self.acm else (0x81,)
        return SimpleNamespace(
            **dict(bLength=7, bDescriptorType=5, bEndpointAddress=addresses[ep], bmAttributes=2),
            **dict(wMaxPacketSize=MAX_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0),
            extra_descriptors=[],
        )

    def open_device(self, dev: str) -> str:
        self._touch("open")
        self._pending = b""
        return "handle"

    def close_device(self, handle: str) -> None:
        """pyusb: nothing to release."""

    def get_configuration(self, handle: str) -> int:
        self._touch("open")
        return 1

    def claim_interface(self, handle: str, intf: int) -> None:
        """pyusb: refuse while the kernel's driver holds the device, as Linux does."""
        self._touch("claim")
        if self.kernel_driver:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)

    def release_interface(self, handle: str, intf: int) -> None:
        self._touch()

    def is_kernel_driver_active(self, handle: str, intf: int) -> bool:
        """pyusb: True for a CDC-ACM device that cdc_acm holds."""
        return self.kernel_driver

    def detach_kernel_driver(self, handle: str, intf: int) -> None:
        self.kernel_driver = False

    def clear_halt(self, handle: str, ep: int) -> None:
        self._touch("clear")
        self.halted = False

    def ctrl_transfer(
        self, handle: str, kind: int, request: int, value: int, index: int, data: Any, ms: int
    ) -> int:
        """pyusb: standard string descriptors and the requests of PROTOCOL.md."""
        self._touch("control")
        if self.acm and (kind, request) == (0x21, 0x22):
            self.dtr = bool(value & 1)
            return 0
        if kind == 0x80 and request == 6 and value >> 8 == 3:
            board = self.board.identity
            text = ("", "Palpate", board.board, board.serial)[value & 0xFF]
            body = b"\x09\x04" if value & 0xFF == 0 else text.encode("utf-16-le")
            reply: bytes | None = bytes([len(body) + 2, 3]) + body
        else:
            reply = None if self.acm else self.board.request(request)
        if reply is None:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        n = min(len(reply), len(data)) if kind & 0x80 else 0
        data[:n] = array("B", reply[:n])
        return n

    def bulk_write(self, handle: str, ep: int, intf: int, data: array[int], ms: int) -> int:
        """pyusb: request bytes of a CDC-ACM device."""
        self._touch("write")
        for request in bytes(data):
            reply = self.board.request(request)
            if reply:
                self._pending += packets.pack_reply(packets.Request(request), reply)
        return len(data)

    def bulk_read(self, handle: str, ep: int, intf: int, buff: array[int], ms: int) -> int:
        """pyusb: one transfer, at the time of its arrival."""
        deadline_ns = self._clock.now_ns() + ms * 1_000_000
        while True:
            self._touch("read")
            if self.halted:
                raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
            due_ns = self.board.due_ns()
            if self._pending or (due_ns is not None and due_ns <= self._clock.now_ns()):
                return self._deliver(buff)
            if self._clock.now_ns() >= deadline_ns:
                raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
            self._wait(deadline_ns if due_ns is None else min(due_ns, deadline_ns))

    def _deliver(self, buff: array[int]) -> int:
        data, self._pending = self._pending or self.mangle(self.board.take()), b""
        if len(data) > len(buff):
            raise usb.core.USBError("Overflow", -8, errno.EOVERFLOW)
        buff[: len(data)] = array("B", data)
        return len(data)
