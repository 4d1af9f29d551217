"""`palpate watch --web`: reads the feed, and keeps the pages up to date: start, watch, align and
history. They show a missing box as away until its feed is back, and list the other boxes of a site,
which announce themselves on the network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from palpate.client.feed import Feed
from palpate.core.clock import Clock
from palpate.core.errors import ConfigError, FormatError
from palpate.core.log import TroubleLog
from palpate.service import network
from palpate.web.access import Access
from palpate.web.board import KEPT, PageBoard
from palpate.web.history import History
from palpate.web.server import Answer, PageServer

FRAMES_HZ = 20.0
"""Frames per second while a browser is connected: alignment averages the last third of a second."""
READ_S = 0.5
"""Longest wait for a line of the feed. The page is updated as often while the box is away, so that
browsers see that this program runs."""
KEPT_NS = 60_000_000_000
"""How long an answer of the network is kept."""


class OtherBoxes:
    """Lists the pages of other boxes, each with `name` and `address`; none without zeroconf."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._asked_ns, self._found = clock, -KEPT_NS, list[dict[str, str]]()

    def __call__(self) -> list[dict[str, str]]:
        """The list; it takes some seconds if the last one is too old."""
        now_ns = self._clock.now_ns()
        if now_ns - self._asked_ns < KEPT_NS:
            return self._found
        self._asked_ns, own, pages = now_ns, network.box_id(), {}
        with suppress(ConfigError, OSError):
            for one in reversed(network.found(self._clock)):  # the lowest port is the start's
                if one.kind == "page" and not one.box.endswith(own):
                    host = f"[{one.host}]" if ":" in one.host else one.host
                    pages[one.box] = f"https://{host}:{one.port}/"
        self._found = [{"name": box, "address": pages[box]} for box in sorted(pages)]
        return self._found


class PageWatcher:
    """The pages of `palpate watch --web` at `access`, for the feed at `path`. now_ns: the clock of
    the box's time stamps. finger: the unit of several fingers, "" for a box with one. found: lists
    other boxes, each with `name` and `address`. Raises ConfigError if the address cannot be
    used."""

    def __init__(
        self,
        path: str,
        access: Access,
        now_ns: Callable[[], int],
        history: History,
        finger: str = "",
        found: Callable[[], Sequence[Mapping[str, str]]] = tuple,
    ) -> None:
        self.feed, self.history, self._now_ns = Feed(path, sweeps=True), history, now_ns
        answers: dict[str, Answer] = {
            "sweep": lambda which: self.board.sweep(which),
            "boxes": lambda which: list(found()),
        }
        answers |= {"history": history.counted, "verdicts": history.rows}
        self.server = PageServer("watch.html", access, now_ns, KEPT, answers)
        self.board = PageBoard(self.server.publish, finger)
        self._frames = False
        self._log = TroubleLog(
            "feed", "the page shows the box as away", end="feed: it is read", known=False
        )

    def run(self, stopped: Callable[[], bool]) -> None:
        with self.server, self.feed:
            while not stopped():
                self.step()

    def step(self) -> None:
        if self.server.watched != self._frames:
            self._frames = not self._frames
            self.feed.ask(frames_hz=FRAMES_HZ if self._frames else 0)
        line, trouble = self.feed.read(READ_S), self.feed.trouble
        if line:
            try:
                self.board.take(line)
                if line["type"] == "verdict":
                    self.history.take(line, self._now_ns())
            except FormatError as e:
                self.feed.close()
                trouble = str(e)
        if trouble:
            self.board.away(trouble)
        self._log.update(trouble)
