"""`palpate watch --web`: reads the feed, and keeps the page up to date. The page shows a missing
box as away until its feed is back."""

from __future__ import annotations

from collections.abc import Callable

from palpate.client.feed import Feed
from palpate.core.errors import FormatError
from palpate.core.log import TroubleLog
from palpate.web.access import Access
from palpate.web.board import KEPT, PageBoard
from palpate.web.server import PageServer

FRAMES_HZ = 20.0
"""Frames per second while a browser is connected: alignment averages the last third of a second."""
READ_S = 0.5
"""Longest wait for a line of the feed. The page is updated as often while the box is away, so that
browsers see that this program runs."""


class PageWatcher:
    """The page of `palpate watch --web` at `access`, for the feed at `path`. now_ns: the clock of
    the box's time stamps. finger: the unit of several fingers, "" for a box with one. Raises
    ConfigError if the address cannot be used."""

    def __init__(
        self, path: str, access: Access, now_ns: Callable[[], int], finger: str = ""
    ) -> None:
        self.feed = Feed(path, sweeps=True)
        self.server = PageServer(
            "watch.html", access, now_ns, KEPT, {"sweep": lambda which: self.board.sweep(which)}
        )
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
        """Take the next line, or show that there is none."""
        if self.server.watched != self._frames:
            self._frames = not self._frames
            self.feed.ask(frames_hz=FRAMES_HZ if self._frames else 0)
        line, trouble = self.feed.read(READ_S), self.feed.trouble
        if line:
            try:
                self.board.take(line)
            except FormatError as e:
                self.feed.close()
                trouble = str(e)
        if trouble:
            self.board.away(trouble)
        self._log.update(trouble)
