"""Finds, opens and claims a readout board on USB, sends requests and reads bulk transfers
(PROTOCOL.md, part 1). Errors of libusb become a SensorError that explains the errno."""

from __future__ import annotations

import contextlib
import errno
import weakref
from collections.abc import Iterator
from typing import Any

import usb.core
import usb.util
from usb.backend import libusb1

from palpate.core.clock import Clock
from palpate.core.config import SkinConfig
from palpate.core.errors import (
    SensorAbsent,
    SensorBusy,
    SensorDenied,
    SensorError,
    SensorLost,
    SensorMismatch,
    SensorOverflow,
)
from palpate.core.text import printable
from palpate.io import packets
from palpate.io.sensor import REPLY_MS, reply_to

CDC_CONTROL = 2
DTR, RTS = 1, 2
_UDEV = "install the udev rule, join group plugdev"


class UsbContext(libusb1._LibUSB):  # type: ignore[misc]
    """A libusb context that lives as long as the devices that it has found. libusb frees devices
    with their context, and pyusb does not prevent that.

    libusb removes a device from its context's list when it fails with ENODEV. It lists the device
    again when it is plugged in, but not when only its driver was detached and attached. So
    `open_readout` searches through a new context after each failure. pyusb alone keeps one context
    for ever.
    """

    newest: UsbContext | None = None

    @classmethod
    def chosen(cls) -> UsbContext | None:
        """The newest context, made if there is none; None if libusb is not installed."""
        if cls.newest is None and (loaded := libusb1.get_backend()):
            cls.newest = cls(loaded.lib)
        return cls.newest

    def enumerate_devices(self) -> Iterator[Any]:
        found = super().enumerate_devices()
        self._outlive(found)
        for device in found:
            self._outlive(device)
            yield device

    def _outlive(self, owned: object) -> None:
        weakref.finalize(owned, id, self).atexit = False


class VendorLink:
    """An opened readout board of the vendor class: control requests and one bulk IN endpoint."""

    def __init__(self, device: usb.core.Device, interface: Any, clock: Clock) -> None:
        self._device, self._number, self._clock = device, interface.bInterfaceNumber, clock
        self._in = _endpoint(interface, usb.util.ENDPOINT_IN)
        for number in self._claimed():
            if device.is_kernel_driver_active(number):
                device.detach_kernel_driver(number)
            usb.util.claim_interface(device, number)

    def _claimed(self) -> list[int]:
        return [self._number]

    def request(self, request: packets.Request, length: int) -> bytes:
        """Send a request; returns at most `length` bytes. Raises SensorError."""
        kind = usb.util.CTRL_TYPE_VENDOR | usb.util.CTRL_RECIPIENT_INTERFACE
        kind |= 0x80 if length else 0
        what = request, 0, self._number, length or None, REPLY_MS
        with _explained():
            reply = self._device.ctrl_transfer(kind, *what)
        return bytes(reply) if length else b""

    def read(self, size: int, timeout_ms: int) -> bytes:
        """One bulk transfer of at most `size` bytes; b"" if none came within `timeout_ms`. Raises
        SensorOverflow for a larger transfer, else SensorError. A stalled endpoint is cleared for
        the next read."""
        try:
            return bytes(self._device.read(self._in, size, timeout_ms))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as e:
            if e.errno == errno.EPIPE:
                with contextlib.suppress(usb.core.USBError):
                    self._device.clear_halt(self._in)
            raise _explain(e) from e

    def close(self) -> None:
        """Ask the readout board to stop, unless it is gone, and release it."""
        with contextlib.suppress(SensorError):
            self.request(packets.Request.STOP, 0)
        _let_go(self._device)


class AcmLink(VendorLink):
    """An opened board of the class CDC-ACM: requests are bytes, replies come as packets."""

    def __init__(self, device: usb.core.Device, interface: Any, clock: Clock) -> None:
        self._out = _endpoint(interface, usb.util.ENDPOINT_OUT)
        super().__init__(device, interface, clock)
        self._raise_dtr()

    def _claimed(self) -> list[int]:
        # the kernel's cdc_acm holds both the control and the data interface
        found = self._device.get_active_configuration()
        return [i.bInterfaceNumber for i in found if i.bInterfaceClass in (2, 10)]

    def _raise_dtr(self) -> None:
        """Signal that the host reads, as the kernel's driver does (SET_CONTROL_LINE_STATE, USB PSTN
        1.2, 6.3.12). Without this signal TinyUSB, and so MicroPython, overwrites unsent data. A
        readout board may refuse the request."""
        configuration = self._device.get_active_configuration()
        control = [i.bInterfaceNumber for i in configuration if i.bInterfaceClass == CDC_CONTROL]
        to = control[0] if control else self._number
        with contextlib.suppress(usb.core.USBError):
            self._device.ctrl_transfer(0x21, 0x22, DTR | RTS, to, None, REPLY_MS)

    def request(self, request: packets.Request, length: int) -> bytes:
        """Send a request byte; returns the reply, b"" for length 0. Raises SensorError."""
        with _explained():
            self._device.write(self._out, bytes([request]), REPLY_MS)
        return reply_to(request, self.read, self._clock) if length else b""


def open_readout(config: SkinConfig, backend: Any, clock: Clock) -> VendorLink:
    """Find and claim the configured readout board. Raises SensorError."""
    ids = f"{config.vendor_id:04x}:{config.product_id:04x}"
    vendor, product = config.vendor_id, config.product_id
    try:
        bus = backend or UsbContext.chosen()
        found = list(usb.core.find(True, bus, idVendor=vendor, idProduct=product))
    except usb.core.NoBackendError as e:
        raise SensorAbsent("libusb-1.0 is missing; apt install libusb-1.0-0") from e
    except usb.core.USBError as e:
        UsbContext.newest = None  # the next search uses a new context
        raise _explain(e) from e
    device = next((d for d in found if not config.serial or _serial(d) == config.serial), None)
    if device is None:
        serial = f" with serial number {config.serial}" if config.serial else ""
        others = f"{len(found)} with other numbers"
        raise SensorAbsent(
            f"no skin {ids}{serial} on USB ({others}); check cable, power and udev rule"
        )
    link, wanted = (AcmLink, 10) if config.link == "acm" else (VendorLink, 255)
    try:
        interface = usb.util.find_descriptor(_configuration(device), bInterfaceClass=wanted)
        if interface is None:
            missing = f"skin {ids} has no {config.link} interface (class {wanted})"
            raise SensorMismatch(f"{missing}; see skin.link")
        return link(device, interface, clock)
    except usb.core.USBError as e:
        _let_go(device)
        raise _explain(e) from e
    except Exception:  # a descriptor that pyusb cannot read, for example
        _let_go(device)
        raise


def _let_go(device: usb.core.Device) -> None:
    UsbContext.newest = None
    with contextlib.suppress(usb.core.USBError):  # it is gone
        usb.util.dispose_resources(device)


def _serial(device: usb.core.Device) -> str:
    try:
        return printable(device.serial_number or "")
    except usb.core.USBError as e:
        raise _explain(e) from e
    except UnicodeDecodeError as e:
        raise SensorMismatch(
            f"the skin's serial number is not text ({e}); check its firmware"
        ) from e
    except ValueError as e:  # pyusb raises it if the string descriptors may not be read
        raise SensorDenied(f"the skin's serial number cannot be read ({e}); {_UDEV}") from e


def _configuration(device: usb.core.Device) -> Any:
    """The active configuration, set only if there is none: setting it resets the device."""
    try:
        return device.get_active_configuration()
    except usb.core.USBError:
        device.set_configuration()
        return device.get_active_configuration()


def _endpoint(interface: Any, direction: int) -> int:
    kinds = direction, usb.util.ENDPOINT_TYPE_BULK

    def wanted(e: Any) -> bool:
        address, kind = usb.util.endpoint_direction(e.bEndpointAddress), e.bmAttributes
        return (address, usb.util.endpoint_type(kind)) == kinds

    endpoint = usb.util.find_descriptor(interface, custom_match=wanted)
    if endpoint is None:
        which = "IN" if direction else "OUT"
        raise SensorMismatch(f"the skin has no bulk endpoint {which}; check its firmware")
    return int(endpoint.bEndpointAddress)


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except usb.core.USBError as e:
        raise _explain(e) from e


def _explain(e: usb.core.USBError) -> SensorError:
    """The SensorError that explains an errno of libusb."""
    if e.errno == errno.EOVERFLOW:
        return SensorOverflow("a USB transfer was larger than a read (errno 75); send less at once")
    if e.errno == errno.EACCES:
        return SensorDenied(f"the skin may not be opened by this user (errno 13); {_UDEV}")
    if e.errno == errno.EBUSY:
        return SensorBusy("another program holds the skin (errno 16); stop it, or replug the skin")
    if e.errno == errno.ENODEV:
        again = "plug it in again, it is taken up by itself"
        return SensorLost(f"the skin was unplugged (errno 19); {again}")
    why = f"the skin failed ({e.strerror or e}, errno {e.errno})"
    return SensorLost(f"{why}; trying again, check its cable if this stays")
