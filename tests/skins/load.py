"""What a skin costs the box at its full rate, in real time. In: the name of a profile, its bundle, seconds. Out: figures.

The emulator plays in the same process, and its processor time is subtracted; the box classifies a sweep every 3.5 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from appliance.bundle import bundle
from appliance.core import config
from appliance.core.clock import Clock, SystemClock
from appliance.core.observer import Observer
from appliance.core.types import Sweep, Verdict
from appliance.io import skins
from appliance.io.robot_link import SerialSink
from appliance.runtime import assembly
from appliance.sim import script
from appliance.sim.skins import devices, sweeps
from appliance.tools import pseudo_terminal
from appliance.tools.bench_process import drain

SETTLE_S = 3.0
"""Time before figures are taken: the skin is found, its rate measured."""


class AnswerTimes(Observer):
    """answer_ms: from each stop edge to the sentence at the port. statuses: of all answers."""

    def __init__(self, clock: Clock) -> None:
        self.answer_ms: list[float] = []
        self.statuses: list[str] = []
        self._clock = clock

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """The sentence is out before observers of sweeps are told."""
        self.answer_ms.append((self._clock.now_ns() - sweep.stop_ns) / 1e6)
        self.statuses.append(str(verdict.status))


class _Meter:
    """Processor time of this thread inside a function."""

    def __init__(self) -> None:
        self.ns = 0

    def timed(self, call: Callable[[], None]) -> Callable[[], None]:
        def measured() -> None:
            begin = time.thread_time_ns()
            call()
            self.ns += time.thread_time_ns() - begin

        return measured


def measure(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Let a box with the bundle in `folder` run so long on the skin `name`."""
    settings = config.load(None, [f"sensor.skin={name}"], site=Path("/dev/null"))
    current, profile = bundle.load(folder), skins.profile(settings)
    acts = list(script.tubes(7, 60, seen=sweeps.view(name, profile.format)))
    played = devices.build(name, profile, current.format, cycle(acts), SystemClock(), "sim", remember=False)
    meter, times = _Meter(), AnswerTimes(played.clock)
    played.player.step = meter.timed(played.player.step)  # type: ignore[method-assign]
    with ExitStack() as stack:
        far_end, port = stack.enter_context(pseudo_terminal.pair())
        sink = SerialSink(replace(settings.serial, port=port), played.clock, played.source)
        box = assembly.box(settings, current, played, sink, stack, observers=[times])

        def turns(until_ns: int) -> None:
            while time.monotonic_ns() < until_ns:
                box.step()
                drain(far_end)

        turns(time.monotonic_ns() + round(SETTLE_S * 1e9))
        meter.ns, begin, cpu = 0, time.monotonic_ns(), -time.process_time_ns()
        before = box.counters.frames, played.player.frames
        turns(begin + round(seconds * 1e9))
        wall, cpu = time.monotonic_ns() - begin, cpu + time.process_time_ns() - meter.ns
        counters = box.counters
    sent, came = played.player.frames - before[1], counters.frames - before[0]
    return {
        "skin": name, "format": str(current.format), "seconds": round(wall / 1e9, 1), "share": round(cpu / wall, 4),
        "sent": sent, "came": came, "counted_lost": counters.lost_frames, "garbage": counters.garbage_bytes,
        "thrown": played.player.thrown, "answers": len(times.answer_ms),
        "statuses": {status: times.statuses.count(status) for status in sorted(set(times.statuses))},
        "answer_ms": {f"p{q}": round(float(np.percentile(times.answer_ms, q)), 2) for q in (50, 99)},
    }  # fmt: skip
