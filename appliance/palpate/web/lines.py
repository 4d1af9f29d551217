"""`palpate watch` without a page: a line for each event of the running box, or the feed's lines
unchanged."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, TextIO

from palpate.client.feed import Feed
from palpate.core.clock import Clock
from palpate.core.errors import FormatError
from palpate.core.text import printable
from palpate.core.types import Status
from palpate.service import status

FRAMES_HZ = 10.0
"""Rate of the frames among the unchanged lines."""
READ_S = 0.5
"""Longest wait for a line of the feed."""


def event(line: Mapping[str, Any], displays: Mapping[str, str], now_ns: int) -> str:
    """A line of the feed in words; "" if it is no event for a person. displays: names of labels for
    people. Raises FormatError for a line that PROTOCOL.md does not allow."""
    try:
        return printable(_event(line, displays, now_ns))
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise FormatError(
            f"the feed's line {line['type']} is malformed ({e!r}); update palpate"
        ) from e


def _event(line: Mapping[str, Any], displays: Mapping[str, str], now_ns: int) -> str:
    if line["type"] == "hello":
        origin = {"usb": "", "replay": "REPLAYED "}.get(line["source"], "SIMULATED ")
        return f"box {line['pid']}: {origin}{line['skin']}, bundle {line['bundle'] or 'none'}"
    if line["type"] == "verdict":
        label = displays.get(line["label"], line["label"])
        return status.verdict_line(
            {**line, "label": label, "status": Status(line["status"])}, now_ns
        )
    if line["type"] == "state":
        not_ready = f"NOT READY: skin {line['skin']} {line['trouble']}"
        return "SWEEPING" if line["sweeping"] else "READY" if line["ready"] else not_ready
    return f"{line['lines']} lines missed" if line["type"] == "lost" else ""


class LineWatch:
    """`palpate watch`: reads the feed at `path`, also after restarts of the box."""

    def __init__(self, path: str, out: TextIO, clock: Clock) -> None:
        self._feed = Feed(path, clock=clock)
        self._out, self._clock, self._trouble = out, clock, ""
        self._displays: dict[str, str] = {}

    def run(self, stopped: Callable[[], bool]) -> None:
        with self._feed:
            while not stopped():
                self.step()

    def step(self) -> None:
        """Print the next line, and the trouble of a missing feed once."""
        line, text = self._feed.read(READ_S), ""
        if line is not None:
            if line["type"] == "hello":
                self._displays = dict(line.get("displays") or {})
            try:
                text = event(line, self._displays, self._clock.now_ns())
            except FormatError as e:
                self._feed.lose(str(e))
        trouble = "" if self._feed.connected else self._feed.trouble
        if trouble and trouble != self._trouble:
            text = printable(f"NO FEED: {trouble}")
        self._trouble = trouble
        if text:
            print(text, file=self._out, flush=True)


def pass_on(
    path: str, out: TextIO, clock: Clock, stopped: Callable[[], bool], report: Callable[[str], None]
) -> None:
    """Write the feed's lines unchanged, with frames at FRAMES_HZ, until `stopped()`. report: gets
    the trouble of a missing feed."""
    with Feed(path, frames_hz=FRAMES_HZ, clock=clock) as feed:
        while not stopped():
            if (line := feed.read(READ_S)) is not None:
                print(json.dumps(line), file=out, flush=True)
            report("" if feed.connected else feed.trouble)
