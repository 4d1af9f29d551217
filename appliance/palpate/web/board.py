"""The content of `palpate watch --web`: lines of the feed become events of the page, and on request
the picture of a sweep.

Nothing is written to a disk: the list of the shift begins when this program starts.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.alignment.live import VIEW_NS, ContactTracker, Expected
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.status import REASONS
from palpate.core.types import SweepFormat
from palpate.web.sweep_picture import DrawnWindow, picture, window

SHIFT = 5000
"""Verdicts in the list: eight hours with a sweep every six seconds."""
SWEEPS = 20
"""Latest sweeps with a picture."""
MINUTE_NS = 60_000_000_000
KEPT = {"hello": 8, "verdict": SHIFT, "minute": 1440, "signal": SWEEPS, "note": 200}
"""Number of events that are kept for new browsers, by name; of all other names the newest event is
kept."""
FIELDS = (
    *("sweep", "time_ns", "status", "label", "probability", "margin", "fused", "lost"),
    *("latency_ns", "bundle", "detail", "share", "moved"),
)
"""Fields of a verdict."""

Publish = Callable[[str, object], None]


class PageBoard:
    """Turns lines of the feed into events, by their type.

    hello: with the `names` of its labels for people, and its `finger`, "" for the only one.
    health, state: unchanged. box: whether there is a feed. verdict: with rounded `scores`, the
    `name` of its label, the `reason` for a sweep without a label; `moved` is null in place. minute:
    frames and lost frames of the last minute. signal: a sweep's window is available. view: see
    alignment.live. note: another bundle or program.
    """

    def __init__(self, publish: Publish, finger: str = "") -> None:
        self._publish, self._finger = publish, finger
        self._hello: dict[str, Any] = {}
        self._before: dict[str, Any] = {}  # the previous hello, until the restart was noted
        self._names: dict[str, str] = {}  # of labels, for people
        self._skin, self._trouble = "", ""
        self._tracker: ContactTracker | None = None
        self._enumerations = 0
        self._view_ns = -VIEW_NS
        # time, frames and lost frames at the begin of the minute
        self._minute: tuple[int, int, int] | None = None
        self._windows: OrderedDict[int, DrawnWindow] = OrderedDict()
        self._taken = 0

    def take(self, line: Mapping[str, Any]) -> None:
        """Take a line of the feed. Lines of an unknown type are ignored: a later version may send
        them. Raises FormatError for a line that does not fit its type."""
        act = getattr(self, f"_take_{line.get('type')}", None)
        if not act:
            return
        try:
            act(line)
        except (KeyError, TypeError, ValueError, AttributeError) as e:
            what = f"the feed's line {line.get('type')!r} does not fit PROTOCOL.md: {e!r}"
            raise FormatError(f"{what}; update one of both") from e

    def away(self, why: str) -> None:
        self._minute = None
        self._publish("box", {"there": False, "why": why})

    def sweep(self, which: str) -> dict[str, Any] | None:
        """The picture of a sweep by its number in `signal`; None if its window is not kept."""
        kept = self._windows.get(int(which))
        return picture(kept) if kept else None

    def _take_hello(self, line: Mapping[str, Any]) -> None:
        rate = replace(typed(SweepFormat, dict(line["format"])), rate_hz=float(line["frames_hz"]))
        expected = Expected.read(rate, line.get("alignment") or {}, str(line["bundle"]))
        tracker = ContactTracker(expected, str(line["source"]))
        displays = {str(k): str(v) for k, v in (line.get("displays") or {}).items()}
        hello = dict(line) | {"pid": int(line["pid"]), "labels": list(map(str, line["labels"]))}
        names = [displays.get(label, label) for label in hello["labels"]]
        hello |= {"names": names, "finger": self._finger}
        self._names = dict(zip(hello["labels"], hello["names"], strict=True))
        self._before, self._hello, self._tracker, self._minute = self._hello, hello, tracker, None
        self._publish("hello", hello)
        self._publish("box", {"there": True, "why": ""})

    def _take_closed(self, line: Mapping[str, Any]) -> None:
        self.away(str(line["why"]))

    def _take_health(self, line: Mapping[str, Any]) -> None:
        self._take_state(line)
        if self._before and self._before["pid"] != self._hello["pid"]:
            other = f"bundle {self._hello['bundle']} in place of {self._before['bundle']}"
            same = self._hello["bundle"] == self._before["bundle"]
            text = f"the box was restarted, with {'the same bundle' if same else other}"
            self._publish("note", {"time_ns": line["time_ns"], "text": text})
        self._before = {}
        now = int(line["time_ns"]), int(line["frames"]), int(line["lost_frames"])
        if int(line["enumerations"]) != self._enumerations:
            self._enumerations = int(line["enumerations"])
            if self._tracker:
                self._tracker.reset()
        first = self._minute or now
        if now[0] - first[0] >= MINUTE_NS:
            counted = {"frames": now[1] - first[1], "lost": now[2] - first[2]}
            self._publish("minute", {"time_ns": now[0], **counted})
            first = now
        self._minute = first
        self._publish("health", {name: value for name, value in line.items() if name != "type"})

    def _take_state(self, line: Mapping[str, Any]) -> None:
        self._skin, self._trouble = str(line["skin"]), str(line["trouble"])
        state = {name: line[name] for name in ("skin", "trouble", "sweeping", "ready")}
        self._publish("state", state)
        if self._skin != "streaming" and self._tracker:
            self._tracker.reset()
            self._publish("view", self._tracker.view(self._skin, self._trouble).json())

    def _take_verdict(self, line: Mapping[str, Any]) -> None:
        shown = {name: line[name] for name in FIELDS} | {
            "name": self._names.get(line["label"], line["label"]),
            "scores": [round(float(p), 4) for p in line["scores"]],
            "moved": line["moved"] or None,
            "reason": REASONS.get(line["status"], ""),
            "pid": self._hello.get("pid"),
        }
        self._publish("verdict", shown)

    def _take_frame(self, line: Mapping[str, Any]) -> None:
        if not self._tracker:
            return
        format = typed(SweepFormat, dict(self._hello["format"]))
        frame = np.array(line["taxels"], np.float64)  # null, of a float skin, becomes nan
        if frame.shape != format.shape:
            raise ValueError(f"a frame of {frame.shape} instead of {format.shape}")
        self._tracker.put(frame[None])
        now_ns = int(line["time_ns"])
        if not 0 <= now_ns - self._view_ns < VIEW_NS:
            self._view_ns = now_ns
            self._publish("view", self._tracker.view(self._skin, self._trouble).json())

    def _take_sweep(self, line: Mapping[str, Any]) -> None:
        kept = window(line, float(self._hello["format"]["rate_hz"]))
        self._taken += 1
        self._windows[self._taken] = kept
        while len(self._windows) > SWEEPS:
            self._windows.popitem(last=False)
        shown = {"number": self._taken, "sweep": line["sweep"], "pid": self._hello["pid"]}
        self._publish("signal", shown)
