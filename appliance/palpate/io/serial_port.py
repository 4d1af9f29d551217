"""Serial ports, of the robot and of skins: lists them and opens one for this program alone."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import termios
from dataclasses import dataclass
from typing import Any

import serial

from palpate.core.errors import ConfigError
from palpate.core.text import printable

if not hasattr(serial, "Serial"):  # the package "serial" hides pyserial, which has the same module
    raise ConfigError(
        "the package serial is installed in place of pyserial; run `pip uninstall serial`, then"
        " `pip install --force-reinstall pyserial`"
    )

PSEUDO_TERMINALS = range(136, 144)
"""Major device numbers of pseudo-terminals."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port of this machine. vendor_id, product_id: USB ids, 0 if it is not on USB. serial:
    USB serial number. name: product name of its maker."""

    path: str
    vendor_id: int = 0
    product_id: int = 0
    serial: str = ""
    name: str = ""

    def __str__(self) -> str:
        ids = f" ({self.vendor_id:04x}:{self.product_id:04x} {self.name})"
        return self.path + ids * bool(self.vendor_id)


def ports() -> list[PortInfo]:
    """The serial ports of this machine, from /sys; none is opened."""
    from serial.tools.list_ports import comports

    found = sorted(comports(), key=lambda p: str(p.device))
    return [PortInfo(p.device, p.vid or 0, p.pid or 0, *_named(p)) for p in found]


def _named(port: Any) -> tuple[str, str]:
    """Serial number and name of a port of pyserial."""
    return printable(port.serial_number or ""), printable(port.product or port.description or "")


def open_alone(path: str, baud: int) -> Any:
    """The open port at `path`, non-blocking, with an empty buffer, and closed to other programs.
    Raises OSError, or ValueError for an unsupported baud rate; `is_held` tells whether another
    program has it."""
    port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    try:
        # The kernel refuses any further open, except by root: another reader would take bytes away,
        # and a lock only binds programs that check it. A pseudo-terminal would stay locked, also
        # for us, if we were killed while its other end is open.
        if os.major(os.fstat(port.fileno()).st_rdev) not in PSEUDO_TERMINALS:
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    except OSError:
        port.close()
        raise
    return port


def close(port: Any) -> None:
    """Close a port from `open_alone`, also if it is gone."""
    with contextlib.suppress(OSError):
        # if another program opened the port earlier, the exclusive mode would remain and lock us
        # out
        fcntl.ioctl(port.fileno(), termios.TIOCNXCL)
    with contextlib.suppress(OSError):
        port.close()


def is_held(e: Exception) -> bool:
    """Whether a port could not be opened because another program has it."""
    return getattr(e, "errno", None) in (errno.EBUSY, errno.EAGAIN)
