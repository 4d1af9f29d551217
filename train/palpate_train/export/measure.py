"""The cost of a packed model on this machine: time, size and memory.

Run by its path, this file is also the separate process in which the memory of a model is read. It
therefore imports at its top only packages that the box has.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import palpate
from palpate.core.errors import BundleError

Array = NDArray[Any]
Call = Callable[[Array], Any]
ROUNDS, BLOCK = 60, 6
"""Number of rounds, and of sweeps of a model in a round. One more sweep before them is not counted,
because the model before it has emptied the caches."""
SWEEPS_BEFORE_MEMORY = 20
"""Number of sweeps that a process answers before its memory is read."""
MEMORY_S = 600
"""Longest time in s of that process."""
MODEL = "model.onnx"
"""The model's file in a bundle."""


@dataclass(frozen=True)
class BundleCost:
    """The cost of a bundle on this machine.

    ms, ms_p99: median and 99th percentile of the processor time in ms of one sweep through the
    box's classifier, with its checks and features, in one thread. kb: size of all files in units of
    1000 bytes, golden sweeps included. mb: resident memory (VmRSS) in MiB of a separate process
    that has loaded the model and answered SWEEPS_BEFORE_MEMORY sweeps.
    """

    ms: float
    kb: float
    mb: float
    ms_p99: float


def measure_all(folders: Sequence[Path], sweeps: Array, rounds: int = ROUNDS) -> list[BundleCost]:
    """The cost of the bundle in each of `folders`, in their order; all are timed in turns,
    with about ROUNDS different sweeps.

    sweeps: raw counts [n, T, R, C], in the format of all models. Raises BundleError if a model does
    not run.
    """
    some = sweeps[:: max(len(sweeps) // ROUNDS, 1)]
    took = timed({str(folder): load(folder) for folder in folders}, some, rounds)
    return [_cost(folder, took[str(folder)], memory(folder, some)) for folder in folders]


def _cost(folder: Path, took_ms: Array, mb: float) -> BundleCost:
    p50, p99 = (round(float(np.percentile(took_ms, q)), 4) for q in (50, 99))
    return BundleCost(p50, round(sizes(folder)[1] / 1000, 2), mb, p99)


def sizes(folder: Path) -> tuple[int, int]:
    """Bytes of the model's file, and of all files in its folder."""
    files = {file.name: file.stat().st_size for file in folder.iterdir()}
    return files[MODEL], sum(files.values())


def timed(
    calls: Mapping[str, Call], sweeps: Array, rounds: int = ROUNDS, block: int = BLOCK
) -> dict[str, Array]:
    """Times in ms [rounds * block] of each call with `sweeps` [n, T, R, C] one by one, by name.

    All calls take turns, a block each, and every round begins with another call, so a slow machine
    slows all of them alike. The time is processor time of one thread: in real time, slow models
    would be interrupted by other programs and quick ones would not.
    """
    # here: the process of `memory` loads only what the box has
    from threadpoolctl import threadpool_limits

    names, took = list(calls), {name: np.empty(rounds * block) for name in calls}
    with threadpool_limits(1):
        for turn in range(rounds):
            for name in np.roll(names, -turn).tolist():
                call = calls[name]
                call(sweeps[turn % len(sweeps)])
                for i in range(turn * block, (turn + 1) * block):
                    counts = sweeps[i % len(sweeps)]
                    start = time.process_time_ns()
                    call(counts)
                    took[name][i] = (time.process_time_ns() - start) / 1e6
    return took


def memory(folder: Path, sweeps: Array) -> float:
    """Resident memory in MiB of a fresh process that has loaded the model in `folder` and answered
    some of `sweeps`.

    Raises BundleError if the model does not run in a process of its own.
    """
    with tempfile.TemporaryDirectory() as aside:
        path = Path(aside) / "sweeps.npy"
        np.save(path, sweeps[:SWEEPS_BEFORE_MEMORY])
        # -P: the modules next to this file do not hide packages of their names
        command = [sys.executable, "-P", __file__, str(folder), str(path)]
        env = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        env |= {"PYTHONPATH": str(Path(palpate.__file__).parents[1])}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, env=env, timeout=MEMORY_S
            )
        except subprocess.TimeoutExpired as e:
            raise BundleError(
                f"the model in {folder} gave no answers within {MEMORY_S} s; pack it again"
            ) from e
    if done.returncode:
        raise BundleError(
            f"the model in {folder} does not run in a process of its own: "
            f"{done.stderr.strip()[-300:]}; pack it again"
        )
    return float(done.stdout)


def load(folder: Path) -> Call:
    """The box's classifier of a bundle. It gets one sound sweep, raw counts [T, R, C], after
    another, each of another object. Raises BundleError for an incomplete bundle."""
    from palpate.bundle import bundle
    from palpate.core.clock import SystemClock
    from palpate.core.types import Frames, Status, Sweep
    from palpate.inference.classifier import Classifier

    classifier = Classifier(bundle.load(folder), SystemClock())
    format = classifier.bundle.format
    seq = np.arange(format.window)
    t_ns = (seq * format.period_ns).astype(np.int64)

    def answer(counts: Array) -> Any:
        return classifier(Sweep(0, 0, int(t_ns[-1]), Status.OK, Frames(t_ns, seq, counts)))

    return answer


def main(folder: str, sweeps: str) -> None:
    """Answer some sweeps, and print the resident memory in MiB."""
    answer = load(Path(folder))
    counts = np.load(sweeps)
    for i in range(SWEEPS_BEFORE_MEMORY):
        answer(counts[i % len(counts)])
    resident = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{os.getpid()}/status").read_text())
    assert resident
    print(round(int(resident[1]) / 1024, 1))


if __name__ == "__main__":
    main(*sys.argv[1:])
