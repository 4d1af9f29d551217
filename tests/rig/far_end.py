"""The robot's end of the guest's serial port. Sentences that arrive have times of the guest."""

import socket
import threading
from pathlib import Path

from tests.rig.guest_clock import GuestClock

ADAPTER = "/dev/serial/by-id/usb-QEMU_QEMU_USB_SERIAL_R1-if00-port0"
"""The guest's path of an emulated USB serial adapter with the serial number R1."""


class FarEnd:
    """heard: (ns, line) of all. While `deaf`, nothing is read and the port fills up."""

    def __init__(self, path: Path, clock: GuestClock) -> None:
        self.heard: list[tuple[int, str]] = []
        self._path, self._clock = path, clock
        self._reading = threading.Event()
        self._reading.set()
        self._socket: socket.socket | None = None
        self.open()

    def open(self) -> None:
        """Connect the cable."""
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(self._path))
        threading.Thread(target=self._listen, args=(self._socket,), daemon=True).start()

    def close(self) -> None:
        """Pull the cable out."""
        if self._socket:
            self._reading.set()
            self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self._socket = None

    @property
    def deaf(self) -> bool:
        """True while nothing is read."""
        return not self._reading.is_set()

    @deaf.setter
    def deaf(self, value: bool) -> None:
        (self._reading.clear if value else self._reading.set)()

    def say(self, data: bytes) -> None:
        """Send bytes to the box."""
        if not self._socket:
            raise RuntimeError("the cable is pulled out; open it first")
        self._socket.sendall(data)

    def ask(self, command: str, timeout_s: float = 10) -> str:
        """Send a command; returns the sentence that answers it."""
        since = len(self.heard)
        self.say(command.encode() + b"\r\n")
        return self.wait_for("$PPLP,ANS,", timeout_s, since)

    def wait_for(self, start: str, timeout_s: float, since: int = 0) -> str:
        """The first line with this `start`, from number `since` on. Raises AssertionError."""
        found: list[str] = []

        def there() -> bool:
            found[:] = [line for _, line in self.heard[since:] if line.startswith(start)]
            return bool(found)

        if not self._clock.until(there, timeout_s):
            last = [line for _, line in self.heard[since:]][-5:]
            raise AssertionError(
                f"no line {start}… within {timeout_s} s; the last ones were {last}"
            )
        return found[0]

    def _listen(self, port: socket.socket) -> None:
        rest = b""
        try:
            while True:
                self._reading.wait()
                data = port.recv(4096)
                if not data:
                    return
                *lines, rest = (rest + data).split(b"\n")
                now_ns = self._clock.now_ns()
                self.heard += [
                    (now_ns, line.decode("ascii", "replace").rstrip("\r")) for line in lines
                ]
        except OSError:
            return  # the cable was pulled
