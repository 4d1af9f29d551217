"""The box as seen by a bridge: a BoxView, and commands if the connection carries them.

The connection is the box's serial line, a pseudo-terminal that the box opens, or its feed.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import select
import struct
import termios
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from palpate.client.answers import Answer, BoxState
from palpate.client.box import BAUD, Heard, Palpate
from palpate.client.feed import Feed
from palpate.client.line import READ_S, open_port
from palpate.core.clock import Clock, SystemClock
from palpate.core.errors import ApplianceError, CommandRefused, ConfigError, TemporaryError, passes
from palpate.core.log import log
from palpate.core.status import Status
from palpate.tools import pseudo_terminal

STALE_S = 3.5
"""Without a sentence for this long the box counts as dead; it sends a state once a second."""
COMMANDS: Mapping[str, Callable[..., str | None]] = {
    "START": Palpate.start,
    "STOP": Palpate.stop,
    "NEW": Palpate.new_object,
    "TARE": Palpate.tare,
    "ABORT": Palpate.abort,
}
"""Commands that a bridge may pass on to the box."""
EVERY_S = 1.0
"""Time between two looks whether the box has other labels."""
OF_VERDICT = (
    *("sweep", "label", "probability", "margin", "fused", "lost", "bundle", "share", "detail"),
    *("measured_mm_s", "direction"),
)
"""Fields of an answer that a verdict line has under the same names."""


@dataclass(frozen=True, slots=True)
class BoxView:
    """The last news of the box.

    answers, beats: number of answers and of states so far. heard_ns: time of the last of either, 0
    for never. labels: of the bundle `bundle`; empty while unknown. missed, damaged: as in Palpate;
    with the feed, missed counts its lost lines. trouble: the reason why nothing is heard, "" for
    none.
    """

    state: BoxState | None = None
    answer: Answer | None = None
    answers: int = 0
    beats: int = 0
    heard_ns: int = 0
    labels: tuple[str, ...] = ()
    bundle: str = ""
    missed: int = 0
    damaged: int = 0
    trouble: str = ""

    def alive(self, now_ns: int) -> bool:
        return self.heard_ns > 0 and now_ns - self.heard_ns < STALE_S * 1e9

    def code(self, label: str) -> int:
        """The code of a label on the class bits, 0 if it is unknown."""
        return self.labels.index(label) + 1 if label in self.labels else 0


class LineSource:
    """The box over its serial line. name: for messages. heard: is called with each answer and
    state, in the reading thread."""

    def __init__(
        self,
        name: str,
        opener: Callable[[], Any] | None = None,
        *,
        baud: int = BAUD,
        heard: Callable[[Heard], None] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.name = name
        self._clock, self._also = clock or SystemClock(), heard
        self._view = BoxView()
        self._named = "", tuple[str, ...]()  # a bundle and its labels
        self._box = Palpate(name, baud=baud, listener=self._heard, opener=opener, clock=self._clock)
        self._ending = threading.Event()
        threading.Thread(target=self._tend, daemon=True, name="palpate-labels").start()

    def view(self) -> BoxView:
        (bundle, labels), box = self._named, self._box
        view = replace(self._view, missed=box.missed, damaged=box.damaged, trouble=box.trouble)
        return replace(view, bundle=bundle, labels=labels)

    def send(self, command: str, **slide: float) -> str:
        """Carry out one of COMMANDS; the box's reply. slide: speed_mm_s and force_n, for START
        only. Raises ApplianceError."""
        return COMMANDS[command](self._box, **slide) or "done"

    def client(self) -> Palpate:
        """The box, for a sweep by command."""
        return self._box

    def close(self) -> None:
        self._ending.set()
        self._box.close()

    def _heard(self, news: Heard) -> None:
        self._view = noted(self._view, news, self._clock.now_ns())
        if self._also:
            self._also(news)

    def _tend(self) -> None:
        """Ask for the labels of each new bundle."""
        while not self._ending.wait(EVERY_S):
            state = self._view.state
            if state and state.bundle and state.bundle != self._named[0]:
                with suppress(ApplianceError):  # the next time is another chance
                    self._named = state.bundle, self._box.labels()


class FeedSource:
    """The box over its feed, on the box itself: read-only next to a robot that has the serial line.

    frame: is called with each frame line of the feed, `frames_hz` times a second.
    """

    def __init__(
        self,
        path: str,
        *,
        heard: Callable[[Heard], None] | None = None,
        frame: Callable[[Mapping[str, Any]], None] | None = None,
        frames_hz: float = 0,
        clock: Clock | None = None,
    ) -> None:
        self.name = path
        self.format: Mapping[str, Any] = {}
        self._clock, self._also, self._frame = clock or SystemClock(), heard, frame
        self._view = BoxView()
        self._feed = Feed(path, frames_hz=frames_hz, clock=self._clock)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="palpate-feed")
        self._thread.start()

    def view(self) -> BoxView:
        return replace(self._view, trouble=self._feed.trouble)

    def send(self, command: str, **slide: float) -> NoReturn:
        """Raises CommandRefused: the feed is read-only."""
        self.client()

    def client(self) -> NoReturn:
        raise CommandRefused(
            "the feed is read-only; give the bridge a serial line with --port or --link"
        )

    def close(self) -> None:
        self._ending.set()
        self._thread.join(10)

    def _run(self) -> None:
        while not self._ending.is_set():
            line = self._feed.read(READ_S)
            if line is not None:
                try:
                    self._take(line)
                except (KeyError, TypeError, ValueError):  # the known facts are shown
                    self._view = replace(self._view, damaged=self._view.damaged + 1)
        self._feed.close()

    def _take(self, line: Mapping[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError for an invalid line."""
        kind = line["type"]
        if kind == "hello":
            self.format = line["format"]
            self._view = replace(self._view, labels=tuple(line["labels"]), bundle=line["bundle"])
        elif kind == "lost":
            self._view = replace(self._view, missed=self._view.missed + int(line["lines"]))
        elif kind == "frame" and self._frame:
            self._frame(line)
        elif kind in ("health", "verdict", "state"):
            news = self._news(kind, line)
            if news:
                self._view = noted(self._view, news, self._clock.now_ns())
                if self._also:
                    self._also(news)

    def _news(self, kind: str, line: Mapping[str, Any]) -> Heard | None:
        state = self._view.state
        if kind == "state":  # a change between two lines of health
            return state and replace(state, skin=line["skin"], sweeping=bool(line["sweeping"]))
        more = {"time_s": line["time_ns"] / 1e9}
        if kind == "health":
            more |= {"sweeping": bool(line["sweeping"])}
            return BoxState(**more | {n: line[n] for n in BoxState.__slots__ if n not in more})
        more |= {"latency_ms": line["latency_ns"] / 1e6, "status": Status(line["status"])}
        more |= {"source": state.source if state else ""}
        return Answer(**more | {name: line[name] for name in OF_VERDICT if name in line})


Source = LineSource | FeedSource
"""A bridge's connection to the box."""


def noted(view: BoxView, news: Heard, now_ns: int) -> BoxView:
    """The view with this news."""
    if isinstance(news, Answer):
        return replace(view, answer=news, answers=view.answers + 1, heard_ns=now_ns)
    return replace(view, state=news, beats=view.beats + 1, heard_ns=now_ns)


class LinkPort:
    """A port that the box on this machine opens by a name: one end of a pseudo-terminal, with a
    link to it at `path`.

    For a box whose serial port is not wired: `serial.port = "PATH"`. Programs of this process's
    group may open it, the box among them. Raises ConfigError if `path` is taken.
    """

    def __init__(self, path: Path) -> None:
        self._stack = ExitStack()
        self._far, name = self._stack.enter_context(pseudo_terminal.pair())
        try:
            os.chown(name, -1, os.getgid())
            os.chmod(name, 0o660)
            if path.is_symlink():  # of a bridge that was killed
                path.unlink()
            path.symlink_to(name)
        except OSError as e:
            self._stack.close()
            raise (TemporaryError if passes(e) else ConfigError)(
                f"--link {path}: {str(e.strerror).lower()}; name a path that is free"
            ) from e
        self._stack.callback(path.unlink, missing_ok=True)

    @property
    def in_waiting(self) -> int:
        return int(struct.unpack("i", fcntl.ioctl(self._far, termios.FIONREAD, bytes(4)))[0])

    def read(self, size: int) -> bytes:
        """Up to `size` bytes; waits READ_S for the first."""
        ready = size and select.select([self._far], [], [], READ_S)[0]
        return os.read(self._far, size) if ready else b""

    def write(self, data: bytes) -> None:
        """Send bytes. Raises BlockingIOError if nobody reads them."""
        if os.write(self._far, data) < len(data):
            raise BlockingIOError("the box does not read")

    def close(self) -> None:
        """Remove the name and the pseudo-terminal."""
        self._stack.close()


def source_of(
    args: argparse.Namespace, heard: Callable[[Heard], None] | None = None
) -> FeedSource | LineSource:
    """The box at the feed or the serial line of a bridge's options."""
    if args.feed:
        return FeedSource(args.feed, heard=heard)
    return LineSource(*port_of(args), baud=args.baud, heard=heard)


def port_of(args: argparse.Namespace) -> tuple[str, Callable[[], Any]]:
    """Name of the box's serial line, and a function that opens it. Raises ConfigError."""
    if args.link:
        link = LinkPort(args.link)  # now, so that a wrong path is reported at once
        return str(args.link), lambda: link
    return args.port, partial(open_port, args.port, args.baud)


def warn_of(args: argparse.Namespace) -> None:
    """Warn about a serial line or feed that is not there: it may come later."""
    if args.port and "://" not in args.port and not Path(args.port).exists():
        log.warning(f"--port {args.port} does not exist; trying again until it does, or correct it")
    if args.feed and not Path(args.feed).exists():
        log.warning(f"--feed {args.feed} does not exist; waiting until palpate runs there")
