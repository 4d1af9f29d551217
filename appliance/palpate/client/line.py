"""The robot's end of the serial line: a thread that reads sentences, and opens the port again after
it was lost.

The port is a serial device, a pseudo-terminal or `socket://host:port`.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from palpate.core import sentences
from palpate.core.clock import Clock, SystemClock
from palpate.core.errors import LinkLost
from palpate.core.sentences import Sentence

RETRY_S = 0.5
"""Time between two attempts to open a port."""
READ_S = 0.2
"""Longest wait of one read, so that the thread soon notices when it has to end."""
WRITE_S = 1.0
"""Longest wait until the port accepts a command."""
SILENT_NS = 10_000_000_000
"""A socket without a byte for this long is opened again, since the other computer may have
vanished."""


def open_port(url: str, baud: int) -> Any:
    """The port at `url`. Raises OSError or ValueError."""
    import serial  # readers of the feed do without it

    exclusive = None if "://" in url else True
    return serial.serial_for_url(
        url, baudrate=baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=exclusive
    )


class Line:
    """Calls `heard` with each sentence, and `changed` when the port was opened or lost, both in its
    own thread.

    opener: opens the port; raises OSError or ValueError. name: of the port, for errors. trouble:
    the reason why it is not open, "" if it is. losses: how often it was lost.
    """

    def __init__(
        self,
        opener: Callable[[], Any],
        heard: Callable[[Sentence], None],
        changed: Callable[[], None],
        *,
        name: str = "the line",
        clock: Clock | None = None,
    ) -> None:
        self.trouble, self.losses = "", 0
        self._opener, self._heard, self._changed, self._name = opener, heard, changed, name
        self._clock = clock or SystemClock()
        self._port: Any = self._open()
        self._writing = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="palpate-line")
        self._thread.start()

    def write(self, line: bytes) -> None:
        """Send bytes. Raises LinkLost if the port is not open or does not accept them."""
        with self._writing:
            if self._port is None:
                raise LinkLost(self.trouble)
            try:
                self._port.write(line)
            except (OSError, ValueError) as e:
                raise LinkLost(f"{self._name} does not take anything: {e}; check its cable") from e

    def close(self) -> None:
        self._ending.set()
        self._thread.join(10 * (READ_S + WRITE_S))

    def _open(self) -> Any:
        """The port, None if it cannot be opened."""
        try:
            port = self._opener()
        except (OSError, ValueError) as e:
            self.trouble = (
                f"{self._name} cannot be opened: {e}; check the name, the cable and who may use it"
            )
            return None
        self.trouble = ""
        return port

    def _run(self) -> None:
        while not self._ending.is_set():
            if self._port is not None:
                self._changed()
                why = self._read(self._port)
                self.trouble = f"{self._name} was lost: {why}; it is opened again when it is back"
                # without the lock, pyserial fails if it is closed while it writes
                with self._writing, contextlib.suppress(OSError):
                    port, self._port = self._port, None
                    port.close()
                self.losses += 1
                self._changed()
            if not self._ending.wait(RETRY_S):
                self._port = self._open()

    def _read(self, port: Any) -> str:
        """Read until the port fails or the thread has to end; the reason."""
        rest, last_ns = b"", self._clock.now_ns()
        is_socket = "://" in str(getattr(port, "port", ""))
        try:
            while not self._ending.is_set():
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
                    last_ns = self._clock.now_ns()
                    found, rest = sentences.parse(data, rest)
                    for sentence in found:
                        self._heard(sentence)
                elif is_socket and self._clock.now_ns() - last_ns > SILENT_NS:
                    return "nothing came for 10 s"
        except (OSError, TypeError) as e:  # pyserial 3.5 reads from a closed descriptor
            return str(e)
        return "closed"
