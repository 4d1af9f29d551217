"""A page of a recording whose turns a test or a thread takes, and the requests of a browser."""

import json
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from palpate.core.clock import SystemClock
from palpate.core.config import TriggerConfig
from palpate.core.disk_thread import DiskWork
from palpate.core.sentences import Reply
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.io.robot_link import Command
from palpate.sim import skin
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.web.access import Access
from palpate.web.record import RecordPage
from tests.factories.feed_lines import load
from tests.factories.feeds import HEALTH, OK, cut
from tests.factories.page_client import EventReader, Page, ask, port

KIND = "application/json"
TAUGHT = {
    "teach": {
        "base": [],
        "fewest": 2,
        "materials": {"metal": 4},
        "learnt": None,
        "assessing": False,
        "using": None,
        "trouble": "",
    },
    "good": 8,
}
"""State of a session of teaching."""


def ordered(page: Page, key: str, body: bytes | Mapping[str, str], **changed: str | None) -> bytes:
    """The answer to an order of the page. changed: other headers (None: without this header)."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    headers = {
        "Origin": f"http://localhost:{port(page)}",
        "Content-Type": KIND,
        "X-Palpate-Key": key,
        "Content-Length": str(len(content)),
        **{name.replace("_", "-"): value for name, value in changed.items()},
    }
    head = "".join(f"{name}: {value}\r\n" for name, value in headers.items() if value is not None)
    return ask(page, "/order", "POST", f"localhost:{port(page)}", head, body=content)


def key_of(page: Page) -> str:
    """The key that a page receives with its events."""
    reader = EventReader(page)
    key = reader.until("key")
    reader.socket.close()
    return str(key)


class RecordedPage:
    """A recording and its page, without a box; a thread takes its turns. teaching: its page."""

    def __init__(
        self,
        folder: Path,
        labels: Labels,
        target: int = 3,
        access: Access | None = None,
        *,
        disk: DiskWork | None = None,
        teaching: bool = False,
    ) -> None:
        clock = SystemClock()
        self.health, self.sweeps = HEALTH._replace(bundle="", source="sim"), 0
        self.recording = RecordingSession(
            folder, skin.FORMAT, labels, clock, lambda line: None, target, disk
        )
        self.done: list[str] = []
        self.more: dict[str, Any] = {}  # further content of the page
        self.page = RecordPage(
            access or Access(0),
            skin.FORMAT,
            "sim",
            TriggerConfig(mode="serial"),
            lambda: self.recording.about() | (TAUGHT if teaching else {}) | self.more,
            self.obey,
            clock,
            named=self.recording.names.label,
            teaching=teaching,
        )
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._going = threading.Thread(target=self._go)

    def obey(self, command: Command) -> Reply:
        """Carry out a command of the recording. START and STOP change only the state."""
        self.done.append(command.line)
        if command.name in ("START", "STOP"):
            sweeping = command.name == "START"
            self.health = self.health._replace(sweeping=sweeping, ready=not sweeping)
            return []
        return self.recording.commands[command.name](command.text)

    def turn(self) -> None:
        """Take one turn, with frames of a finger that rests on the skin."""
        with self._lock:
            n = np.arange(20)
            taxels = np.broadcast_to(load(1.5, 1.5), (20, 4, 4)).astype(np.uint8)
            self.page.frames(Frames(n, n, taxels))
            self.page.turn(self.health)

    def sweep(self, status: Status = Status.RECORDED, detail: str = "") -> int:
        """Answer a sweep; returns its number."""
        with self._lock:
            answered = self.answered(status, detail)
            for observer in (self.recording, self.page):
                observer.sweep(*answered, {})
        return self.sweeps

    def answered(self, status: Status, detail: str = "") -> tuple[Sweep, Verdict]:
        """The next sweep and its answer. The sweep has a window if its status has one."""
        self.sweeps += 1
        frames = Frames.empty(skin.FORMAT) if status in (Status.SHORT, Status.GAP) else cut().frames
        one = replace(cut(), id=self.sweeps, start_ns=SystemClock().now_ns(), frames=frames)
        return one, replace(
            OK, sweep=self.sweeps, status=status, label="", detail=detail, scores=np.empty(0)
        )

    def __enter__(self) -> Self:
        self.page.__enter__()
        self._going.start()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._ended.set()
        self._going.join()
        self.page.__exit__(*reason)
        self.recording.close()

    def _go(self) -> None:
        while not self._ended.wait(0.02):
            self.turn()
