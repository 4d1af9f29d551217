"""A feed on a virtual clock, and plain sockets that read it."""

import json
import select
import socket
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from palpate.core.observer import Health
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict
from palpate.service.feed import PERIOD_NS, FeedServer
from palpate.sim import rig, skin
from tests.factories.simulated_box import SECOND, numbered

NOTHING = (
    *("time_ns", "garbage_bytes", "dropped", "stale_frames", "overflows", "fifo_overflows"),
    *("glitches", "lost_edges", "storms"),
)
HEALTH = Health(
    **{"skin": "streaming", "trouble": "", "streams": True, "sweeping": False, "ready": True},
    **{"answered": 7, "frames": 5_000_000, "lost_frames": 3, "enumerations": 1},
    **{"bundle": "9f3c2a1b", "source": "usb"},
    **dict.fromkeys(NOTHING, 0),
)
OK = Verdict(
    **{"sweep": 7, "time_ns": 0, "status": Status.OK, "label": "plastic rough"},
    **{"probability": 0.987, "margin": 0.9, "scores": np.array([0.987, 0.013]), "fused": 1},
    **{"lost": 0, "latency_ns": 1_200_000, "bundle": "9f3c2a1b", "displacement": "moved 2 mm"},
)


def health(time_s: float, streams: bool = True, sweeping: bool = False) -> Health:
    """Health of the box at this time."""
    at_ns = round(time_s * SECOND)
    return HEALTH._replace(time_ns=at_ns, streams=streams, sweeping=sweeping)


def frames(n: int = 6, format: SweepFormat = skin.FORMAT, first: int = 0) -> Frames:
    """Numbered frames."""
    at = np.arange(first, first + n)
    return Frames(at * 1000, at, numbered(n, format, first))


def cut(format: SweepFormat = skin.FORMAT) -> Sweep:
    """A sweep with a window."""
    return Sweep(7, 5, 6, Status.OK, frames(format.window, format))


class FeedPeer:
    """A reader of the feed, as a separate program would be."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.settimeout(30)
        self.socket.connect(str(path))
        self.ended, self._rest = False, b""

    def ask(self, text: str | bytes) -> None:
        """Send a request or any other text."""
        self.socket.sendall(text.encode() + b"\n" if isinstance(text, str) else text)

    def lines(self) -> list[dict[str, Any]]:
        """The lines so far. `ended` is set when the box has closed the connection."""
        while select.select([self.socket], [], [], 0)[0]:
            try:
                data = self.socket.recv(1 << 16)
            except ConnectionResetError:  # the box had not read all sent bytes
                data = b""
            if not data:
                self.ended = True
                break
            self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        return [json.loads(line) for line in lines]


class Offered:
    """A feed whose turns a test takes. cost_ns: of each look at the sockets."""

    def __init__(
        self,
        path: Path,
        format: SweepFormat = skin.FORMAT,
        known: Mapping[str, Any] = MappingProxyType({}),
        **facts: Any,
    ) -> None:
        self.path, self.clock = path, rig.VirtualClock()
        labels = ["plastic rough", "wood"]
        usual = {"source": "usb", "bundle": "9f3c2a1b", "labels": labels, "skin": "palpate"}
        known = usual | known
        self.cost_ns = self._spent_ns = 0
        told = {name: lambda value=value: value for name, value in facts.items()}
        self.feed = FeedServer(path, format, known, self.clock, told, self._spent)

    def turns(
        self, n: int = 1, health: Health = HEALTH, step_s: float = PERIOD_NS / SECOND
    ) -> None:
        """Take `n` turns, `step_s` apart. By default the feed works in each of them."""
        for _ in range(n):
            self.feed.turn(health)
            self.clock.sleep_until(self.clock.now_ns() + round(step_s * SECOND))

    def _spent(self) -> int:
        """Processor time; the feed reads it before and after each look."""
        self._spent_ns += self.cost_ns
        return self._spent_ns

    def peer(self) -> FeedPeer:
        """A connected reader that the box has accepted."""
        self.turns()
        peer = FeedPeer(self.path)
        self.turns(2)
        return peer
