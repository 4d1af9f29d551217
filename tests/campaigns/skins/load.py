"""The load of a skin on the box at its full rate, in real time.

The emulator runs in a process of its own. Each frame carries its number in two taxels, so lost
frames are detected with every skin, up to 10,000 at once, or ten seconds at 1 kHz. The box
classifies one sweep after the other. Both run under real-time scheduling if that is allowed, so
other programs of the machine are not measured.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core import config
from palpate.core.clock import Clock, SystemClock
from palpate.core.devices import Devices
from palpate.core.observer import Observer
from palpate.core.types import Frames, Sweep, SweepFormat, Verdict
from palpate.io import skin_profile
from palpate.io.robot_link import SerialSink
from palpate.io.skin_profile import SkinProfile
from palpate.runtime import assembly
from palpate.runtime.loop import Box
from palpate.sim import script
from palpate.tools import pseudo_terminal
from tests.campaigns.bench_process import drain
from tests.campaigns.skins.subjects import PROFILES
from tests.factories.skins import sweeps
from tests.factories.skins.devices import on_wire
from tests.factories.skins.player import Player
from tests.factories.skins.wires import wire

SETTLE_S = 3.0
"""Time before the measurement, in which the skin is found and its rate measured."""
PAUSE_S, LEAD_S = 1.0, 0.5
"""Time between two sweeps, and the time by which each is longer than the window."""
NUMBERS = 100
"""Each of the two taxels has this many values of the frame's number, the lower part first."""
EMULATOR, BOX = 20, 10
"""Real-time priorities: a skin does not wait for the box."""
DRAIN = 50
"""Turns between two reads of the far end of the serial line, which is not part of the box."""
START_S = 20
"""Longest wait for the emulator."""
SEED = 7
"""Seed of the simulated sweep that is played."""


class Sliding:
    """The middle of a simulated sweep, repeated, with numbers in two taxels."""

    def __init__(self, name: str, profile: SkinProfile, format: SweepFormat) -> None:
        self._profile = profile
        act = next(iter(script.tubes(SEED, 1, seen=sweeps.view(name, format))))
        margin = round(format.rate_hz * LEAD_S / 2)
        self._frames = act.frames[act.start + margin : act.stop - margin].copy()

    def frame(self, i: int, frame_ns: Callable[[int], int]) -> NDArray[Any]:
        """See FrameSource."""
        taxels = self._frames[i % len(self._frames)]
        taxels.flat[:2] = i % NUMBERS, i // NUMBERS % NUMBERS
        return on_wire(taxels, self._profile)


class FrameCheck(Observer):
    """An observer of frames and answers. came, missing: number of frames, and of the numbers
    missing between them. answer_ms: from each stop edge to the sentence at the port. statuses: of
    all answers."""

    def __init__(self, clock: Clock) -> None:
        self.clear()
        self._clock = clock

    def clear(self) -> None:
        """Start again from zero."""
        self.came = self.missing = 0
        self._last: NDArray[np.int64] = np.empty(0, np.int64)
        self.answer_ms: list[float] = []
        self.statuses: list[str] = []

    def frames(self, frames: Frames) -> None:
        """Count the frames of one turn."""
        low, high = frames.taxels.reshape(len(frames), -1)[:, :2].astype(np.int64).T
        numbers = low + NUMBERS * high
        self.came += len(numbers)
        self.missing += int(((np.diff(numbers, prepend=self._last) - 1) % NUMBERS**2).sum())
        self._last = numbers[-1:]

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Note an answer; its sentence is sent before observers get the sweep."""
        self.answer_ms.append((self._clock.now_ns() - sweep.stop_ns) / 1e6)
        self.statuses.append(str(verdict.status))


class PromptClock(SystemClock):
    """The real clock. latest_ns: the largest delay after a sleep."""

    latest_ns = 0

    def sleep_until(self, t_ns: int) -> None:
        """Sleep until `t_ns`."""
        super().sleep_until(t_ns)
        self.latest_ns = max(self.latest_ns, self.now_ns() - t_ns)


def hurry(priority: int) -> bool:
    """Schedule this process before all normal processes; False if that is not allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def measure(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Run a box with the bundle in `folder` on the skin `name` for this long."""
    current, clock = bundle.load(folder), SystemClock()
    check = FrameCheck(clock)
    with ExitStack() as stack:
        link = Path(stack.enter_context(TemporaryDirectory())) / "ttySkin"
        player = stack.enter_context(playing(name, current.format.rate_hz, link))
        real_time = hurry(BOX)
        chosen = [f"skin.profile={name}", f"skin.port={link}", "trigger.mode=timed"]
        chosen += [f"skin.rate_hz={current.format.rate_hz}"]
        settings = config.load(None, chosen, site=Path("/dev/null"))
        sweep_s = current.format.window / current.format.rate_hz + LEAD_S
        trigger = replace(settings.trigger, sweep_s=sweep_s, every_s=sweep_s + PAUSE_S)
        settings = replace(settings, trigger=trigger)
        far_end, port = stack.enter_context(pseudo_terminal.pair())
        sink = SerialSink(replace(settings.serial, port=port), clock)
        box = assembly.box(settings, current, Devices(clock), sink, stack, observers=[check])
        _turns(box, far_end, SETTLE_S)
        check.clear()
        lost, begin, cpu = box.counters.lost_frames, time.monotonic_ns(), time.process_time_ns()
        _turns(box, far_end, seconds)
        wall, cpu = time.monotonic_ns() - begin, time.process_time_ns() - cpu
        if box.health.skin != "streaming" or box.counters.enumerations != 1:
            raise SystemExit(f"{name}: the skin was lost: {box.health}")
        player.send_signal(signal.SIGTERM)
        emulator = json.loads(player.communicate()[0])
    return {
        "skin": name,
        "format": str(current.format),
        "seconds": round(wall / 1e9, 1),
        "share": round(cpu / wall, 4),
        "real_time": real_time,
        "came": check.came,
        "missing": check.missing,
        "counted_lost": box.counters.lost_frames - lost,
        "garbage": box.counters.garbage_bytes,
        **emulator,
        "answers": len(check.answer_ms),
        "statuses": dict(sorted(Counter(check.statuses).items())),
        "answer_ms": {f"p{q}": round(np.percentile(check.answer_ms, q), 2) for q in (50, 99)},
    }


def _turns(box: Box, far_end: int, seconds: float) -> None:
    until_ns = time.monotonic_ns() + round(seconds * 1e9)
    while time.monotonic_ns() < until_ns:
        for _ in range(DRAIN):
            box.step()
        drain(far_end)


def playing(name: str, rate_hz: float, link: Path) -> subprocess.Popen[str]:
    """Run the emulator in a process of its own; starts when its terminal exists."""
    command = [sys.executable, "-m", "tests.campaigns.skins.load", name, str(rate_hz), str(link)]
    player = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    until = time.monotonic() + START_S
    while not link.exists():
        if player.poll() is not None or time.monotonic() > until:
            player.kill()
            raise SystemExit(f"the emulator of {name} did not start: exit code {player.wait()}")
        time.sleep(0.01)
    return player


def play(name: str, rate_hz: float, link: Path) -> None:
    """Play a skin at `link` until SIGTERM; prints unread bytes and its largest delay."""
    stop = Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    profile = replace(skin_profile.load(name, [PROFILES]), rate_hz=rate_hz)
    source = Sliding(name, profile, profile.format)
    hurry(EMULATOR)
    clock = PromptClock()
    player = Player(wire(name, rate_hz), source, clock, link)
    player.step()
    clock.latest_ns = 0
    player.run(stop.is_set)
    player.close()
    late_ms = round(clock.latest_ns / 1e6, 1)
    print(json.dumps({"thrown": player.thrown, "emulator_late_ms": late_ms}))


if __name__ == "__main__":
    play(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3]))
