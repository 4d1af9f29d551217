"""`palpate watch`: the running box in a terminal.

A terminal gets a picture that is drawn again and again, another output a line for each event, or
the feed's lines unchanged.
"""

from __future__ import annotations

import json
import re
from binascii import a2b_base64
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import zip_longest
from textwrap import wrap
from typing import Any, TextIO

import numpy as np

from palpate.alignment.heat_map import Map, side_by_side, uncoloured
from palpate.alignment.terminal import ASCII, BLOCKS, BOLD, PLAIN, LiveScreen
from palpate.client.feed import Feed
from palpate.core.clock import Clock
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.types import DATA_TYPES, Status, SweepFormat
from palpate.service import status
from palpate.web import sweep_text

FRAMES_HZ = 10.0
DRAW_NS = 100_000_000
"""Time between two pictures."""
READ_S = 0.5
"""Longest wait for a line of the feed, so that the ages of the verdicts go on."""
LATENCIES = 100
"""Latest answers in the summary of the latency."""
LABELS, BAR, NAME = 8, 12, 16
"""Most labels with a probability; characters of a bar, and of a label."""
_SEQUENCE = re.compile("\033\\[[0-9;]*m")


class WatchedBox:
    """State of the box, from the lines of the feed. trouble: why the feed is missing, "" with a
    feed."""

    def __init__(self) -> None:
        self.trouble = ""
        self.hello: dict[str, Any] = {}
        self._displays: dict[str, str] = {}
        self.health: dict[str, Any] = {}
        self.verdicts: deque[dict[str, Any]] = deque(maxlen=status.VERDICTS)
        self.load: tuple[Map, ...] = ()
        self.full = 1.0
        self.missed = 0
        self.window: Any = None
        """Raw counts of the last sweep, None before the first sweep."""
        self.rate_hz = 1.0
        self._latencies_ms: deque[float] = deque(maxlen=LATENCIES)
        self._lowest: dict[str, Any] = {}  # by finger, as _loads
        self._loads: dict[str, tuple[Any, ...]] = {}

    def take(self, line: Mapping[str, Any]) -> None:
        """Take a line of the feed. Lines of an unknown type are ignored: a later version may send
        them. Raises FormatError for a line that PROTOCOL.md does not allow."""
        take = _TAKERS.get(line["type"])
        if not take:
            return
        try:
            take(self, line)
        except (KeyError, TypeError, ValueError, AttributeError, FormatError) as e:
            raise FormatError(
                f"the feed's line {line['type']} is malformed ({e!r}); update palpate"
            ) from e

    def report(self) -> dict[str, Any]:
        """The state as `status.lines` shows it."""
        facts: dict[str, str] = {}
        if self._latencies_ms:
            values = sorted(self._latencies_ms)
            facts["latency"] = (
                f"{self._latencies_ms[-1]:.1f} ms; median {values[len(values) // 2]:.1f} ms, most"
                f" {values[-1]:.1f} ms "
                f"of {len(values)}"
            )
        if self.missed:
            facts["feed"] = f"{self.missed:,} lines missed: they were not read in time"
        return {**self.health, **facts, "running": True, "verdicts": list(self.verdicts)}

    @property
    def headline(self) -> str:
        """The state in a few words."""
        if self.trouble or not self.health:
            return f"NO FEED: {self.trouble or 'waiting for the box'}"
        if self.health["sweeping"]:
            return "SWEEPING"
        return (
            "READY"
            if self.health["ready"]
            else f"NOT READY: skin {self.health['skin']} {self.health['trouble']}"
        )

    def _take_hello(self, line: Mapping[str, Any]) -> None:
        format, displays = typed(SweepFormat, dict(line["format"])), line.get("displays") or {}
        self._displays = dict(displays)
        self.hello = {
            **line,
            "format": str(format),
            "labels": [str(displays.get(label, label)) for label in line["labels"]],
        }
        self.load, self.full, self._lowest, self._loads = (), 1.0, {}, {}
        self.window, self.rate_hz = None, format.rate_hz

    def _take_health(self, line: Mapping[str, Any]) -> None:
        health = {name: value for name, value in line.items() if name != "type"}
        status.lines(
            {**health, "running": True, "verdicts": []}, 0
        )  # raises for a line that cannot be shown
        self.health = health

    def _take_state(self, line: Mapping[str, Any]) -> None:
        self.health |= {name: line[name] for name in ("skin", "trouble", "sweeping", "ready")}

    def _take_verdict(self, line: Mapping[str, Any]) -> None:
        verdict = {
            **line,
            "label": str(self._displays.get(line["label"], line["label"])),
            "status": Status(line["status"]),
            "scores": [float(p) for p in line["scores"]],
        }
        status.verdict_line(verdict, 0)
        self.verdicts.append(verdict)
        if verdict["status"].classified:
            self._latencies_ms.append(line["latency_ns"] / 1e6)

    def _take_frame(self, line: Mapping[str, Any]) -> None:
        counts = np.array(line["taxels"], np.float64)  # None becomes NaN
        if counts.ndim not in (2, 3) or not counts.size:
            raise ValueError(f"taxels of shape {counts.shape}")
        counts, finger = counts.reshape(*counts.shape[:2], -1), str(line.get("finger", ""))
        lowest = self._lowest[finger] = np.fmin(self._lowest.get(finger, counts), counts)
        load = np.nan_to_num(counts - lowest)
        self.full = max(self.full, float(load.max()))
        self._loads[finger] = tuple(np.moveaxis(load, -1, 0).tolist())
        self.load = tuple(one for maps in self._loads.values() for one in maps)

    def _take_sweep(self, line: Mapping[str, Any]) -> None:
        if line["dtype"] not in DATA_TYPES or len(line["shape"]) not in (3, 4):
            raise ValueError(f"a window of {line['shape']} {line['dtype']}")
        data = np.frombuffer(a2b_base64(line["data"]), np.dtype(line["dtype"]).newbyteorder("<"))
        window = data.reshape(line["shape"])
        sweep_text.picture(
            window, self.rate_hz, 80, colours=False
        )  # raises for a line that cannot be shown
        self.window = window

    def _take_lost(self, line: Mapping[str, Any]) -> None:
        self.missed += int(line["lines"])


_TAKERS: Mapping[str, Callable[[WatchedBox, Mapping[str, Any]], None]] = {
    "hello": WatchedBox._take_hello,
    "health": WatchedBox._take_health,
    "state": WatchedBox._take_state,
    "verdict": WatchedBox._take_verdict,
    "frame": WatchedBox._take_frame,
    "sweep": WatchedBox._take_sweep,
    "lost": WatchedBox._take_lost,
}


class WatchScreen(LiveScreen[WatchedBox]):
    """Shows the box."""

    def _picture(self, view: WatchedBox, width: int, height: int) -> list[str]:
        return picture(
            view, self._clock.now_ns(), width, height, colours=self._colours, signs=self._signs
        )

    def _line(self, view: WatchedBox) -> str:
        return view.headline


def picture(
    state: WatchedBox, now_ns: int, width: int, height: int, *, colours: bool, signs: str = BLOCKS
) -> list[str]:
    """The box in at most `height` lines of at most `width` characters. now_ns: by the clock of the
    box."""
    says = wrap(_plain(state.headline), max(10, width - 2))
    head = [
        f" palpate watch   {_what(state)}"[:width],
        *(f" {BOLD}{text}{PLAIN}" for text in says),
        "",
    ]
    maps = [line for row in side_by_side(state.load, state.full, width // 2, signs) for line in row]
    wide = max((len(_SEQUENCE.sub("", line)) for line in maps), default=0)
    body = [
        left + " " * (wide - len(_SEQUENCE.sub("", left))) + ("   " + right if right else "")
        for left, right in zip_longest(maps, _beside(state, width - wide - 3, signs), fillvalue="")
    ]
    body = [line if colours else uncoloured(line) for line in body]
    if not state.health:
        return [*head, " Ctrl-C ends"]
    words = [f" {line}"[:width] for line in status.lines(state.report(), now_ns)]
    facts, verdicts = (
        words[: len(words) - len(state.verdicts)],
        words[len(words) - len(state.verdicts) :],
    )
    body = body[
        : height - len(head) - 4
    ]  # of a large skin the first rows, and below it skin and last answer
    room = height - len(head) - len(body) - 2 * bool(body) - 1
    most = room - min(len(verdicts), 3)
    few = facts[:most] if most > 1 else facts[1:2]  # the skin, if there is room
    return [*head, *body, *[""] * bool(body), *few, *verdicts[: room - len(few)], " Ctrl-C ends"]


def _what(state: WatchedBox) -> str:
    """The box's skin, bundle and source."""
    if not state.hello:
        return ""
    simulated = {"usb": "", "replay": "REPLAYED   "}.get(state.hello["source"], "SIMULATED   ")
    return _plain(
        f"{simulated}{state.hello['skin']} {state.hello['format']}   bundle"
        f" {state.hello['bundle'] or 'none'}"
    )


def _beside(state: WatchedBox, width: int, signs: str) -> list[str]:
    """The lines beside the skin: probabilities, or the picture of the last sweep while sweeps are
    recorded."""
    if state.hello.get("labels") and width >= NAME + BAR + 10:
        return list(probabilities(state, signs))
    if state.window is None or width < NAME + BAR:
        return []
    return sweep_text.picture(state.window, state.rate_hz, width, colours=True, signs=signs)


def probabilities(state: WatchedBox, signs: str) -> Iterator[str]:
    """The last classified verdict: its label, then all labels with their probabilities, the most
    probable first."""
    last = next((v for v in reversed(state.verdicts) if v["status"].classified), None)
    labels = state.hello.get("labels", [])
    if last is None or len(last["scores"]) != len(labels):
        return
    ranked = sorted(zip(last["scores"], labels, strict=True), reverse=True)
    full, empty = (signs[4], signs[1]) if signs != ASCII else ("#", ".")
    for p, label in ranked[:LABELS]:
        filled = round(BAR * max(0.0, min(1.0, p)))
        yield (
            f"{_plain(label)[:NAME]:<{NAME}} {full * filled}{empty * (BAR - filled)}"
            f" {100 * p:5.1f} %"
        )


def events(state: WatchedBox, line: Mapping[str, Any], now_ns: int) -> Iterable[str]:
    """The lines for an output without a terminal: connections, verdicts, changes of the state."""
    if line["type"] == "hello":
        return [f"box {line['pid']}: {_what(state)}"]
    if line["type"] == "verdict":
        return [_plain(status.verdict_line(state.verdicts[-1], now_ns))]
    if line["type"] == "state":
        return [_plain(state.headline)]
    if line["type"] == "lost":
        return [f"{line['lines']} lines missed"]
    return []


def _plain(text: str) -> str:
    """Text of a device or a file without control characters of a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


class TerminalWatch:
    """`palpate watch` in a terminal: reads the feed at `path`, also after restarts of the box."""

    def __init__(self, path: str, out: TextIO, clock: Clock) -> None:
        self._screen = WatchScreen(out, clock)
        live = self._screen.live
        self._feed = Feed(path, frames_hz=FRAMES_HZ if live else 0, sweeps=live, clock=clock)
        self._out, self._clock, self._state = out, clock, WatchedBox()
        self._next_ns = clock.now_ns()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Show the box until `stopped()`."""
        with self._feed, self._screen:
            while not stopped():
                self.step()

    def step(self) -> None:
        """Take the next line, and show the changes."""
        line = self._feed.read(READ_S)
        if line:
            try:
                self._state.take(line)
            except FormatError as e:
                self._feed.lose(str(e))
                line = None
        self._put_trouble("" if self._feed.connected else self._feed.trouble)
        if not self._screen.live:
            self._print(events(self._state, line, self._clock.now_ns()) if line else [])
        elif (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + DRAW_NS
            self._screen.show(self._state)

    def _put_trouble(self, trouble: str) -> None:
        if trouble == self._state.trouble:
            return
        self._state.trouble = trouble
        if trouble and not self._screen.live:
            self._print([_plain(self._state.headline)])

    def _print(self, lines: Iterable[str]) -> None:
        for line in lines:
            self._out.write(line + "\n")
            self._out.flush()


def pass_on(
    path: str, out: TextIO, clock: Clock, stopped: Callable[[], bool], report: Callable[[str], None]
) -> None:
    """Write the feed's lines unchanged, with frames at FRAMES_HZ, until `stopped()`. report: gets
    the trouble of a missing feed."""
    with Feed(path, frames_hz=FRAMES_HZ, clock=clock) as feed:
        while not stopped():
            if line := feed.read(READ_S):
                out.write(json.dumps(line) + "\n")
                out.flush()
            report("" if feed.connected else feed.trouble)
