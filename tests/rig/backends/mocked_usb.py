"""A USB socket over umockdev: usbfs ioctls and uevents of a simulated board, below real libusb."""

import errno
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from palpate.sim import rig, usb
from tests.rig.backends import mocks

SUBMIT, DISCARD, REAP = 0x550A, 0x550B, 0x550D
CLAIM, RELEASE, DRIVER, CAPABILITIES = 0x550F, 0x5510, 0x5508, 0x551A
PLAIN = {0x5504, 0x5505, 0x5514, 0x5515}
URB_CONTROL = 2
PACE_S = 0.0005
"""Pause before the answer `not yet`. A mocked file is always readable, so libusb polls without end.
"""

DEVICE = struct.pack(
    "<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, 64, usb.VENDOR_ID, usb.PRODUCT_ID, 0x0100, 1, 2, 3, 1
)
CONFIGURATION = (
    struct.pack("<BBHBBBBB", 9, 2, 25, 1, 1, 0, 0x80, 50)
    + struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 1, 255, 0, 0, 0)
    + struct.pack("<BBBBHB", 7, 5, 0x81, 2, usb.MAX_PACKET, 0)
)
ENTRY = """P: /devices/pci0000:00/usb1/1-{number}
N: bus/usb/001/{number:03}={descriptors}
E: DEVTYPE=usb_device
E: DRIVER=usb
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM={number:03}
E: DEVNAME=/dev/bus/usb/001/{number:03}
E: MAJOR=189
E: MINOR={number}
A: busnum=1
A: devnum={number}
A: speed=12
A: bConfigurationValue=1
H: descriptors={descriptors}

"""


@dataclass(slots=True, eq=False)
class Urb:
    """A pending request: the kernel's struct usbdevfs_urb [56 bytes], its buffer and its file."""

    head: Any
    buffer: Any
    length: int
    client: int

    @property
    def address(self) -> int:
        """Its address in the caller's memory."""
        return int(self.head.client_addr)


class Device:
    """One device on the bus, from plugging in to pulling out.

    mangle: change of the bytes of each transfer by the cable. All methods run in the mocks' thread.
    """

    def __init__(self, board: rig.ReadoutBoard) -> None:
        self.board = board
        self.mangle: Callable[[bytes], bytes] = lambda data: data
        self.gone = False
        self._waiting: list[Urb] = []
        self._done: list[Urb] = []
        self._claimed = 0  # the open file that claimed it

    def answer(self, number: int, argument: Any, client: int) -> None:
        """Answer one ioctl of usbfs."""
        if number == REAP:
            self._reap(argument, client)
        elif number == DISCARD:
            self._discard(argument, client)
        elif self.gone:
            raise OSError(errno.ENODEV, "unplugged")
        elif number == SUBMIT:
            self._submit(argument, client)
        elif number == CLAIM:
            if self._claimed not in (0, client):
                raise OSError(errno.EBUSY, "claimed")
            self._claimed = client
        elif number == RELEASE:
            self._claimed = 0
        elif number == CAPABILITIES:
            argument.resolve(0, 4).update(
                0, bytes(4)
            )  # libusb's first ioctl on a file: nothing is pending
            self._waiting = [urb for urb in self._waiting if urb.client != client]
            self._done = [urb for urb in self._done if urb.client != client]
        elif number == DRIVER:
            raise OSError(errno.ENODATA, "no driver")
        elif number not in PLAIN:
            raise OSError(errno.ENOTTY, "unknown")

    def unbind(self, on: bool) -> None:
        """Fail all requests and drop the claim, or work again."""
        self.gone, self._claimed = on, 0

    def _submit(self, argument: Any, client: int) -> None:
        head = argument.resolve(0, 56)
        kind, _, length = struct.unpack_from("<BB22xi", head.retrieve())
        urb = Urb(head, head.resolve(16, length), length, client)
        if kind == URB_CONTROL:
            self._control(urb)
        else:
            self._waiting.append(urb)

    def _control(self, urb: Urb) -> None:
        kind, request, value, _, length = struct.unpack_from("<BBHHH", urb.buffer.retrieve())
        if kind == 0x80 and request == 6 and value >> 8 == 3:
            text = ("", "Palpate", self.board.identity.board, self.board.identity.serial)[
                value & 0xFF
            ]
            body = text.encode("utf-16-le") if text else b"\x09\x04"
            reply: bytes | None = bytes([len(body) + 2, 3]) + body
        else:
            reply = self.board.request(request)
        if reply is None:
            self._finish(urb, -errno.EPIPE, b"", 8)
        else:
            self._finish(urb, 0, reply[:length] if kind & 0x80 else b"", 8)

    def _discard(self, argument: Any, client: int) -> None:
        (address,) = struct.unpack("<Q", bytes(argument.retrieve()))
        for urb in self._of(client, self._waiting):
            if urb.address == address:
                self._waiting.remove(urb)
                self._finish(urb, -errno.ENOENT, b"")
                return
        raise OSError(errno.EINVAL, "it is done already")

    def _reap(self, argument: Any, client: int) -> None:
        for urb in self._of(client, self._waiting)[:1]:
            due_ns = self.board.due_ns()
            if self.gone:
                self._waiting.remove(urb)
                self._finish(urb, -errno.ESHUTDOWN, b"")
            elif due_ns is not None and due_ns <= time.monotonic_ns():
                self._waiting.remove(urb)
                self._deliver(urb)
        for urb in self._of(client, self._done)[:1]:
            self._done.remove(urb)
            argument.resolve(0, 8).set_ptr(0, urb.head)
            return
        time.sleep(PACE_S)
        raise OSError(errno.ENODEV if self.gone else errno.EAGAIN, "not yet")

    @staticmethod
    def _of(client: int, urbs: list[Urb]) -> list[Urb]:
        """The requests of one open file. The memory of other files must not be touched."""
        return [urb for urb in urbs if urb.client == client]

    def _deliver(self, urb: Urb) -> None:
        data = self.mangle(self.board.take())
        if len(data) > urb.length:
            self._finish(urb, -errno.EOVERFLOW, b"")
        else:
            self._finish(urb, 0, data)

    def _finish(self, urb: Urb, status: int, data: bytes, at: int = 0) -> None:
        if data:
            urb.buffer.update(at, data)
        urb.head.update(4, struct.pack("<i", status))
        urb.head.update(28, struct.pack("<i", len(data)))
        self._done.append(urb)


class Socket:
    """A socket for skins. Each skin gets the next number on the bus, as on Linux."""

    def __init__(self, bench: mocks.MockedDevices) -> None:
        self.device: Device | None = None
        self._bench, self._number = bench, 1

    @property
    def name(self) -> str:
        """Device node below /dev of the last skin that was plugged in."""
        return f"bus/usb/001/{self._number:03}"

    def plug(self, board: rig.ReadoutBoard) -> None:
        """Replace the previous board by this board, and send the kernel's uevent."""
        self.unplug()
        self._number += 1
        device = self.device = Device(board)
        descriptors = (DEVICE + CONFIGURATION).hex().upper()
        self._bench.testbed.add_from_string(
            ENTRY.format(number=self._number, descriptors=descriptors)
        )
        self._bench.attach(self.name, device.answer)

    def unplug(self) -> None:
        """Pull the board out: requests fail, the kernel sends a uevent, the node disappears."""
        if not self.device:
            return
        self.device.gone, self.device = True, None
        where = f"/sys/devices/pci0000:00/usb1/1-{self._number}"
        self._bench.testbed.uevent(where, "remove")
        self._bench.testbed.remove_device(where)

    def unbind(self, on: bool) -> None:
        """Fail requests and remove the node without a uevent, or restore both.

        Linux keeps the node and ends its open files with POLLERR. umockdev cannot do that. libusb
        takes both for an unplugged device.
        """
        assert self.device
        self.device.unbind(on)
        self._bench.take_away(self.name, on)
