"""The page of `palpate watch --web` without a box: a test writes the lines of its feed."""

import threading
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Self

from palpate.web.access import Access
from palpate.web.board import KEPT, PageBoard
from palpate.web.history import History
from palpate.web.server import Answer, PageServer
from tests.factories import feed_lines
from tests.factories.browser import BrowsedPage, until

NOW_S = 400.0
"""The box's clock when a page is opened."""
NO_FILE = Path("/nowhere/verdicts.db")


def four_hours_ago() -> str:
    """When the shift began."""
    return f"{datetime.now().astimezone() - timedelta(hours=4):%H:%M}"


class Shown:
    """A page whose lines a test writes; within `with` browsers learn fast of a lost box."""

    def __init__(self, access: Access, memory: Path = NO_FILE) -> None:
        self.history, self.boxes = History(memory, four_hours_ago()), list[dict[str, str]]()
        self.server = PageServer(
            "watch.html",
            access,
            lambda: round(NOW_S * feed_lines.SECOND),
            KEPT,
            self._answers(),
        )
        self.board = PageBoard(self._publish)
        self._box: object = None
        self._one_by_one = threading.Lock()  # no beat repeats the state before
        self._ended = threading.Event()
        self._beating = threading.Thread(target=self._beat)

    def __enter__(self) -> Self:
        self.server.__enter__()
        self._beating.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._ended.set()
        self._beating.join()
        self.server.__exit__(*reason)

    def _publish(self, name: str, content: object) -> None:
        with self._one_by_one:
            if name == "box":
                self._box = content
            self.server.publish(name, content)

    def _beat(self) -> None:
        while not self._ended.wait(0.5):
            with self._one_by_one:
                if self._box:
                    self.server.publish("box", self._box)

    def _answers(self) -> dict[str, Answer]:
        """The answers of `palpate watch`. History comes from the file `memory`."""
        answers: dict[str, Answer] = {"sweep": lambda which: self.board.sweep(which)}
        answers |= {"boxes": lambda which: self.boxes}
        return answers | {"history": self.history.counted, "verdicts": self.history.rows}

    def take(self, line: dict[str, Any]) -> None:
        """A line of the feed, for board and history."""
        self.board.take(line)
        if line["type"] == "verdict":
            self.history.take(line, round(NOW_S * feed_lines.SECOND))

    def shift(self) -> None:
        """A box at work: forty sweeps, one `moved`, some without a label, twenty signals."""
        self.board.take(feed_lines.hello())
        for number in range(1, 41):
            status = {5: "unsure", 11: "gap", 17: "unsure", 23: "no-contact"}.get(number, "ok")
            moved = "moved 2.2 mm too far towards row 1" if number == 29 else ""
            label = feed_lines.LABELS[number % 6]
            self.board.take(feed_lines.health(9.0 * number, lost_frames=3 * (number > 20)))
            self.take(feed_lines.verdict(number, 9.0 * number, label, status, moved=moved))
            self.board.take(feed_lines.sweep(number))
        for i in range(40):
            strength = 0 if i < 20 else 120
            self.board.take(feed_lines.frame(370 + i / 20, feed_lines.load(0.7, 1.5, strength)))


def opened(
    browser: Any, shown: Shown, width: int = 1024, height: int = 768, rows: int = 40
) -> BrowsedPage:
    """The page in a browser, with all of the shift."""
    seen = BrowsedPage(browser, shown.server.address + "/#watch", (width, height))
    until(lambda: seen.page.locator(".row").count() == rows)
    return seen
