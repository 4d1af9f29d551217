"""The serial line of backends without a serial port: a pseudo-terminal with a stable name."""

import os
import select
import tempfile
from contextlib import ExitStack
from pathlib import Path

from palpate.tools import pseudo_terminal

DELIVERY_S = 0.02
"""Time in which the kernel delivers bytes. A virtual clock cannot skip this wait."""


class PseudoTerminalEnd:
    """The robot's end. path: the name that the box opens; it exists while the port is there."""

    def __init__(self, stack: ExitStack) -> None:
        self.path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "ttyPalpate"
        self._port = stack.enter_context(ExitStack())
        self._far = self._near = -1

    def put(self) -> None:
        """Add a new port under the old name."""
        self._far, name = self._port.enter_context(pseudo_terminal.pair())
        self._near = os.open(name, os.O_RDWR | os.O_NOCTTY)
        self._port.callback(os.close, self._near)
        self.path.symlink_to(name)

    def pull(self) -> None:
        """Remove the port and all bytes that it holds."""
        self._port.close()
        self.path.unlink(missing_ok=True)

    def say(self, data: bytes) -> None:
        """Send, and wait until the near end can read."""
        os.write(self._far, data)
        assert select.select([self._near], [], [], 1)[0], "the pseudo-terminal does not deliver"

    def hear(self) -> bytes:
        """Bytes that have arrived."""
        heard = b""
        while select.select([self._far], [], [], DELIVERY_S)[0]:
            heard += os.read(self._far, 65536)
        return heard
