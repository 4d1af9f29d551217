"""Memory and processor share, for the bench, each measured in a process of its own:
`python -m tests.campaigns.bench_process PART ACTS`.

This module does not load the simulated skin, which is not part of the box. It must load the
simulated board, and loads it last, so that its memory can be measured.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpiod  # noqa: F401 - the box's, which the simulated lines import as well
import numpy as np

from palpate.bundle import bundle as bundles
from palpate.bundle.bundle import Bundle
from palpate.core import config
from palpate.core.clock import Clock, SystemClock
from palpate.core.devices import Devices
from palpate.core.observer import Observer
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.runtime.loop import Box
from palpate.tools import pseudo_terminal

if TYPE_CHECKING:
    from palpate.sim import devices, rig

MEMORY_SWEEPS, STREAM_S = 1000, 15.0


def box(
    bundle: Bundle, simulated: Devices, stack: ExitStack, observers: Iterable[Observer] = ()
) -> tuple[Box, int]:
    """The box on simulated devices, and the robot's end of its line; `stack` closes both."""
    far_end, name = stack.enter_context(pseudo_terminal.pair())
    settings = config.load(None, [f"serial.port={name}", "trigger.mode=two-lines"])
    port = SerialSink(settings.serial, simulated.clock)
    return assembly.box(settings, bundle, simulated, port, stack, observers=observers), far_end


def write_acts(path: Path, acts: Iterable[rig.Act]) -> None:
    """Write acts to a file for the parts."""
    frames: dict[str, Any] = {f"{i} {a.start} {a.stop}": a.frames for i, a in enumerate(acts)}
    np.savez(path, **frames)


def _board(bundle: Bundle, path: Path, clock: Clock | None = None) -> devices.SimDevices:
    """Devices that play the acts in `path`; in virtual time without a clock."""
    from palpate.sim import devices, rig

    with np.load(path, allow_pickle=False) as z:
        played = ((z[key], *map(int, key.split()[1:])) for key in z)
        acts = [rig.Act(frames, start, stop, "") for frames, start, stop in played]
    # the simulator's memory of acts is not part of the box
    clock = clock or rig.VirtualClock()
    return devices.build(bundle.format, cycle(acts), clock, "sim", remember=False)


def drain(far_end: int) -> None:
    """Read and drop the box's output, so that the serial line does not fill up."""
    with suppress(BlockingIOError):
        os.read(far_end, 65536)


def memory(bundle: Bundle, path: Path) -> dict[str, Any]:
    """Resident memory (2**20 bytes, as ps and systemd count) after MEMORY_SWEEPS sweeps.

    without_board: minus the memory for loading the simulated board and its acts; the board's memory
    while it plays is still included. growth_last_900: since a tenth of the sweeps, with the
    allocator's first growth. growth_next_900: growth over as many further sweeps.
    """
    n, rss_mb = MEMORY_SWEEPS, {}
    board = -_rss_mb()
    simulated = _board(bundle, path)
    board += _rss_mb()
    with ExitStack() as stack:
        measured, far_end = box(bundle, simulated, stack)
        while measured.answered < n * 19 // 10:
            if measured.step() and measured.answered in (n // 10, n, n * 19 // 10):
                rss_mb[measured.answered] = _rss_mb()
            drain(far_end)
    first, after, later = rss_mb.values()
    figures = {"after_1000": after, "without_board": after - board}
    figures |= {"growth_last_900": after - first, "growth_next_900": later - after}
    return {"rss_mb": {name: round(value, 2) for name, value in figures.items()}}


def _rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def stream(bundle: Bundle, path: Path) -> dict[str, Any]:
    """Share of one core while the skin streams, without and with the simulated board."""
    simulated = _board(bundle, path, SystemClock())
    board_ns = 0

    def timed(read: Callable[..., int]) -> Callable[..., int]:
        def timed_read(*args: Any) -> int:
            nonlocal board_ns
            start = time.thread_time_ns()
            try:
                return read(*args)
            finally:
                board_ns += time.thread_time_ns() - start

        return timed_read

    bus = simulated.backend
    bus.bulk_read = timed(bus.bulk_read)  # type: ignore[method-assign]
    with ExitStack() as stack:
        measured, far_end = box(bundle, simulated, stack)
        measured.step()
        board_ns, wall_ns, cpu_ns = 0, -time.monotonic_ns(), -time.process_time_ns()
        while time.monotonic_ns() + wall_ns < STREAM_S * 1e9:
            measured.step()
            drain(far_end)
        wall_ns, cpu_ns = wall_ns + time.monotonic_ns(), cpu_ns + time.process_time_ns()
    shares = (cpu_ns - board_ns) / wall_ns, cpu_ns / wall_ns
    box_alone, whole = (round(share, 4) for share in shares)
    return {"cpu_share_streaming": box_alone, "cpu_share_with_simulated_board": whole}


PARTS: dict[str, Callable[[Bundle, Path], dict[str, Any]]] = {"memory": memory, "stream": stream}

if __name__ == "__main__":
    print(json.dumps(PARTS[sys.argv[1]](bundles.load(bundles.DEFAULT), Path(sys.argv[2]))))
