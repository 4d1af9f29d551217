"""A board of PROTOCOL.md on a pseudo-terminal, answered in a thread of this process."""

import os
import select
import tempfile
import threading
from contextlib import ExitStack, suppress
from pathlib import Path

from palpate.core.clock import SystemClock
from palpate.io import packets
from palpate.sim import rig
from palpate.tools import pseudo_terminal

TURN_S = 0.002


class SerialBoard:
    """A board behind a port, which `path` shows; `board` may be exchanged while unplugged."""

    def __init__(self, board: rig.ReadoutBoard, stack: ExitStack) -> None:
        self.board = board
        self.path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "ttySkin"
        self._plugged = ExitStack()
        stack.callback(self.unplug)

    def plug(self) -> None:
        self.board.running = False
        far, name = self._plugged.enter_context(pseudo_terminal.pair())
        self.path.symlink_to(name)
        self._plugged.callback(self.path.unlink)
        ended = threading.Event()
        thread = threading.Thread(target=self._serve, args=(far, ended), daemon=True)
        thread.start()
        self._plugged.callback(thread.join)
        self._plugged.callback(ended.set)

    def unplug(self) -> None:
        """Remove the port, also for programs that have it open."""
        self._plugged.close()

    def _serve(self, far: int, ended: threading.Event) -> None:
        clock = SystemClock()
        while not ended.is_set():
            for request in self._heard(far):
                reply = self.board.request(request)
                if reply:
                    self._send(far, packets.pack_reply(packets.Request(request), reply))
            due_ns = self.board.due_ns()
            while due_ns is not None and due_ns <= clock.now_ns():
                self._send(far, self.board.take())
                due_ns = self.board.due_ns()

    def _heard(self, far: int) -> bytes:
        if not select.select([far], [], [], TURN_S)[0]:
            return b""
        with suppress(OSError):  # no program has the port open
            return os.read(far, 64)
        return b""

    def _send(self, far: int, data: bytes) -> None:
        """Send bytes. Frames that do not fit are lost, as on a board without a FIFO."""
        with suppress(BlockingIOError):
            os.write(far, data)
