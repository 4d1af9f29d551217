"""Counts lost frames, gaps and lost recordings on a disk whose syncs take long.

A simulated skin streams in real time, with the FIFO of a readout board, while sweeps are recorded
and each `fsync` takes as long as asked: `python -m tests.campaigns slow-disk`.
"""

import argparse
import logging
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.disk_thread import DiskThread
from palpate.core.log import log
from palpate.runtime import assembly
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_check import SweepCheck
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import OnSweep


@dataclass(frozen=True, slots=True)
class SlowDiskRun:
    """Frames lost, answers by status, REC outcomes, and the longest turn of the loop in s."""

    lost_frames: int
    answers: Counter[str]
    outcomes: Counter[str]
    longest_s: float


def run(sync_s: float, fifo_s: float, seconds: float, folder: Path) -> SlowDiskRun:
    """Record on a disk whose syncs take `sync_s`, from a board whose FIFO holds `fifo_s`."""
    real_sync, said, answers = os.fsync, list[str](), Counter[str]()
    simulated = devices.build(skin.FORMAT, script.tubes(1), SystemClock(), "sim")
    simulated.backend.board = rig.ReadoutBoard(
        skin.FORMAT,
        simulated.robot,
        simulated.clock,
        fifo_frames=round(fifo_s * skin.FORMAT.rate_hz),
    )

    def sync(descriptor: int) -> None:
        time.sleep(sync_s)
        real_sync(descriptor)

    with ExitStack() as stack:
        disk = DiskThread()
        session = RecordingSession(
            folder,
            skin.FORMAT,
            Labels("cork", "1", "slow"),
            simulated.clock,
            lambda line: said.append(line.decode()),
            disk=disk,
        )
        stack.callback(session.close)
        note = OnSweep(lambda sweep, verdict: answers.update([str(verdict.status)]))
        box = assembly.assembled(
            config.load(None, site=NO_SITE),
            SweepCheck(skin.FORMAT, simulated.clock),
            simulated,
            None,
            stack,
            observers=[disk, session, note],
            commands=session.commands,
        )
        stack.enter_context(patch.object(os, "fsync", sync))
        longest_s = _turns(box.step, seconds)
        lost = box.counters.lost_frames
        disk.settle()
    return SlowDiskRun(lost, answers, Counter(line.split(",")[3] for line in said), longest_s)


def _turns(step: Callable[[], object], seconds: float) -> float:
    """Take turns for some seconds; the longest turn in s."""
    end_s, longest_s = time.monotonic() + seconds, 0.0
    while (begun_s := time.monotonic()) < end_s:
        step()
        longest_s = max(longest_s, time.monotonic() - begun_s)
    return longest_s


def main() -> None:
    """Print a line for each time of a sync and each FIFO."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns slow-disk")
    parser.add_argument("--syncs", type=float, nargs="*", default=[0.2, 0.4, 1.0, 10.0])
    parser.add_argument("--seconds", type=float, default=120)
    options = parser.parse_args()
    log.setLevel(logging.ERROR)
    print("sync    FIFO    frames lost   longest turn   answers; recordings")
    for sync_s in options.syncs:
        for fifo_s in (0.25, 1.0):
            with tempfile.TemporaryDirectory() as folder:
                found = run(sync_s, fifo_s, options.seconds, Path(folder))
            print(
                f"{sync_s:4.1f} s  {fifo_s:4.2f} s  {found.lost_frames:11}"
                f"  {found.longest_s * 1e3:10.0f} ms   {dict(found.answers)};"
                f" {dict(found.outcomes)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
