"""Finds and opens the serial port of a skin, sends bytes and reads. Errors become a SensorError
that explains the failure.

A readout board that speaks PROTOCOL.md, part 1, is used through `request`, all other skins through
`write` and `read`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
from collections.abc import Callable, Iterable
from typing import Any

from palpate.core.clock import Clock, wait_readable
from palpate.core.config import SkinConfig
from palpate.core.errors import SensorAbsent, SensorBusy, SensorDenied, SensorError, SensorLost
from palpate.io import packets, serial_port
from palpate.io.sensor import REPLY_MS, TTY_BYTES, reply_to
from palpate.io.serial_port import PortInfo

BAUD = 115200
"""Default baud rate. A microcontroller with its own USB ignores the rate."""
COLLECT_NS = 8_000_000
"""Least time between two reads, which is the time between two packets of a readout board at 750 Hz.
A port at 2 Mbaud is ready some thousand times a second, and a turn of the loop costs more than the
few bytes that it would read. Times of frames do not suffer, since the fit uses the promptest
arrivals. The pause is half as long after a read of half of the port's buffer, and left out after a
full buffer."""


class SerialLink:
    """An opened serial port: requests are bytes, replies packets. wait: see `Devices`.

    collect_ns: least time between two reads, 0 for a skin that waits for the next request.
    """

    def __init__(
        self,
        path: str,
        baud: int,
        clock: Clock,
        wait: Callable[[int, float], bool] = wait_readable,
        collect_ns: int = COLLECT_NS,
    ) -> None:
        self.path, self._clock, self._wait, self._collect_ns = path, clock, wait, collect_ns
        self._next_ns = 0  # time of the next read
        try:
            self._port = serial_port.open_alone(path, baud)
        except (OSError, ValueError, termios.error) as e:  # SerialException is an OSError
            raise _refused(path, e) from e
        _be_prompt(self._port)

    def request(self, request: packets.Request, length: int) -> bytes:
        """Send a request byte; returns the reply, b"" for length 0. Raises SensorError."""
        self.write(bytes([request]))
        return reply_to(request, self.read, self._clock) if length else b""

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises SensorLost if the port takes nothing for REPLY_MS."""
        while data:
            try:
                if not select.select([], [self._port.fileno()], [], REPLY_MS / 1000)[1]:
                    raise SensorLost(f"{self.path} takes no bytes; unplug and replug the skin")
                data = data[os.write(self._port.fileno(), data) :]
            except BlockingIOError:
                continue
            except OSError as e:
                raise _lost(self.path, e) from e

    def read(self, size: int, timeout_ms: int) -> bytes:
        """At most `size` bytes, b"" if none came in time. Raises SensorLost."""
        try:
            if not self._wait(self._port.fileno(), timeout_ms / 1000):
                return b""
            self._clock.sleep_until(self._next_ns)
            data = os.read(self._port.fileno(), size)
        except BlockingIOError:
            return b""
        except OSError as e:
            raise _lost(self.path, e) from e
        if not data:
            raise _lost(self.path, OSError(errno.ENODEV, "end of file"))
        # 2; from half of the buffer on 1; 0 for a full buffer
        parts = 2 - 2 * len(data) // TTY_BYTES
        self._next_ns = self._clock.now_ns() + max(0, parts) * self._collect_ns // 2
        return data

    def close(self) -> None:
        serial_port.close(self._port)


class ReadoutLink(SerialLink):
    """The serial port of a readout board that speaks PROTOCOL.md."""

    def close(self) -> None:
        """Ask the readout board to stop, unless it is gone, and release the port."""
        with contextlib.suppress(SensorError):
            self.request(packets.Request.STOP, 0)
        super().close()


def open_readout(
    config: SkinConfig, clock: Clock, ports: Callable[[], Iterable[PortInfo]] = serial_port.ports
) -> ReadoutLink:
    """Open the configured port, or the port with the configured USB ids. Raises SensorError."""
    path = config.port or find(((config.vendor_id, config.product_id),), config.serial, ports())
    return ReadoutLink(path, config.baud or BAUD, clock)


def find(ids: Iterable[tuple[int, int]], serial_number: str, ports: Iterable[PortInfo]) -> str:
    """The path of the first port with one of the USB `ids` (vendor, product) and this serial
    number; "" fits any. Raises SensorAbsent with a list of the existing ports."""
    ids, ports = list(ids), list(ports)
    for port in ports:
        if (port.vendor_id, port.product_id) in ids and serial_number in ("", port.serial):
            return port.path
    wanted = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in ids)
    wanted = f"with USB ids {wanted}" if ids else "named"
    number = f" and serial number {serial_number}" if serial_number else ""
    there = ", ".join(map(str, ports)) or "none"
    raise SensorAbsent(
        f"no serial port {wanted}{number}; there are: {there}; plug it in, or set skin.port"
    )


def _be_prompt(port: Any) -> None:
    """Make a USB adapter pass bytes on without collecting them for 16 ms, and leave DTR up when the
    port is closed. Many readout boards restart when DTR rises, so they would never be ready for a
    program that opens the port again and again."""
    with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
        port.set_low_latency_mode(True)
    with contextlib.suppress(termios.error, OSError):
        modes = termios.tcgetattr(port.fileno())
        modes[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, modes)


def _refused(path: str, e: Exception) -> SensorError:
    """The SensorError for a port that could not be opened."""
    code = getattr(e, "errno", None)
    if serial_port.is_held(e):
        held = f"port held by another program: {path} (errno {code})"
        return SensorBusy(f"{held}; end it, `fuser {path}` shows which")
    if code == errno.EACCES:
        denied = f"{path} may not be opened by this user (errno 13)"
        return SensorDenied(f"{denied}; join group dialout, or use sudo -u palpate")
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        absent = f"no port {path} (errno {code})"
        return SensorAbsent(f"{absent}; plug the skin in, or correct --port (skin.port)")
    # pyserial has no errno for the latter
    if code == errno.EISDIR or f"({errno.ENOTTY}," in str(e):
        return SensorLost(f"{path} is not a serial port; correct --port (skin.port)")
    return SensorLost(f"{path} cannot be opened: {e}; check skin.port and its profile's baud")


def _lost(path: str, e: OSError) -> SensorLost:
    if e.errno in (errno.ENODEV, errno.EIO, errno.ENXIO):
        gone = f"the skin on {path} was unplugged (errno {e.errno})"
        return SensorLost(f"{gone}; plug it in again, it is taken up by itself")
    return SensorLost(f"{path} failed: {e}; trying again, check its cable if this stays")
