"""A box that is counted apart from its own counters: `python -m tests.campaigns.full_load_inside
FILE FOLDER STATE_S COMMAND...`. COMMAND is the command line of `palpate`. FOLDER is for recordings,
"" for none. STATE_S is the time between two STA sentences. Writes FILE, whose lines of JSON say
what came in and went out.

The recording is that of `palpate record`; here a box records and classifies at once, which is more
than any command asks of it.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.__main__ import main
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.health import Health
from palpate.core.types import Edge, EdgeKind, Sweep, Verdict
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.runtime.loop import Box
from palpate.sweeps.recording import Labels, RecordingSession
from tests.skins.load import FrameCheck

EVERY_NS = 500_000_000
"""Time between two lines of counts."""


class InsideCount(FrameCheck):
    """Writes to `file`: a line of counts twice a second, and a line for each answer. It is the
    first observer, so an answer's time does not include the recordings after it."""

    def __init__(self, file: Path) -> None:
        super().__init__(SystemClock())
        self._file = file.open("w", buffering=1)
        self._counts = dict.fromkeys(("stops", "answered", "said"), 0)
        self._before_ns = self._due_ns = time.monotonic_ns()
        self._turn_ns = 0
        self._health: Health | None = None

    def listen(self, port: SerialSink) -> None:
        """From now on, count the sentences that are sent to this port."""
        plain = port.say

        def say(line: bytes) -> None:
            self._counts["said"] += 1
            plain(line)

        port.say = say  # type: ignore[method-assign]  # only of this port

    def edges(self, t_ns: int, edges: Sequence[Edge]) -> None:
        """As Observer."""
        self._counts["stops"] += sum(edge.kind is EdgeKind.STOP for edge in edges)

    def answered(self, verdict: Verdict) -> None:
        """As Observer."""
        self._counts["answered"] += 1

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """As Observer."""
        super().sweep(sweep, verdict, circumstances)
        self._write(
            sweep=sweep.id, status=self.statuses.pop(), answer_ms=round(self.answer_ms.pop(), 3)
        )

    def turn(self, health: Health) -> None:
        """As Observer."""
        self._health = health
        now = time.monotonic_ns()
        self._turn_ns = max(self._turn_ns, now - self._before_ns)
        self._before_ns = now
        if now >= self._due_ns:
            self._due_ns = now + EVERY_NS
            self.write_counts()

    def write_counts(self) -> None:
        """Write the present counts. turn_ms: the longest turn since the previous line."""
        health = self._health
        self._write(
            **self._counts,
            came=self.came,
            missing=self.missing,
            turn_ms=round(self._turn_ns / 1e6, 1),
            counted=health.lost_frames if health else 0,
            dropped=health.dropped if health else 0,
            found=health.enumerations if health else 0,
            loss_known=health.loss_known if health else True,
        )
        self._turn_ns = 0

    def _write(self, **line: Any) -> None:
        self._file.write(json.dumps({"at_s": time.monotonic(), **line}) + "\n")


def attach(file: Path, folder: str, state_s: float) -> None:
    """From now on, each box that is assembled is counted, records to `folder`, and sends its state
    every `state_s`."""
    plain = assembly.box

    def box(
        settings: Config,
        bundle: Bundle,
        devices: Devices,
        port: SerialSink,
        stack: ExitStack,
        *,
        observers: Sequence[Any] = (),
        **more: Any,
    ) -> Box:
        settings = replace(settings, serial=replace(settings.serial, state_s=state_s))
        count = InsideCount(file)
        count.listen(port)
        stack.callback(count.write_counts)  # after open sweeps were answered
        recordings = []
        if folder:
            labels = Labels("wood", "p1", "load")
            recordings.append(
                RecordingSession(Path(folder), bundle.format, labels, devices.clock, port.say)
            )
            stack.callback(recordings[0].close)
        return plain(
            settings,
            bundle,
            devices,
            port,
            stack,
            observers=[count, *observers, *recordings],
            **more,
        )

    assembly.box = box  # type: ignore[assignment]


if __name__ == "__main__":
    attach(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
    sys.exit(main(sys.argv[5:]))  # without the name of this program
