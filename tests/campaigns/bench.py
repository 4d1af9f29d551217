"""Measures latency, inference, memory, start and processor share of this machine, with the packaged
bundle and the simulated skin: `python -m tests.campaigns bench`.

Each figure is printed in a line, and all of them are returned with plain keys. Memory, start and
processor share are measured in processes of their own, without parts of the bench.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from palpate.bundle import bundle as bundles
from palpate.bundle.bundle import Bundle
from palpate.core import storage
from palpate.core.clock import Clock, SystemClock
from palpate.core.observer import Observer
from palpate.core.provenance import commit, processor
from palpate.core.statistics import wilson
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier
from palpate.inference.session import session
from palpate.sim import devices, script, skin
from tests.campaigns import bench_process
from tests.campaigns.bench_process import box, drain
from tests.factories.paths import ROOT

RESULTS = ROOT / "docs" / "data" / "bench.json"
SWEEPS, STARTS, ROUNDS, CALLS = 60, 7, 100, 5


def run(seed: int, report: Callable[[str], None]) -> dict[str, Any]:
    """All figures. report: gets a line for each figure at once. seed: of the simulated sweeps."""
    load_before = os.getloadavg()
    figures: dict[str, Any] = {}
    bundle = bundles.load(bundles.DEFAULT)

    def add(more: dict[str, Any]) -> None:
        figures.update(more)
        for key, value in more.items():
            report(f"{key:<24} {json.dumps(value)}")

    add({"commit": commit(), "seed": seed, "machine": _machine(), "bundle": bundle.id})
    add(_whole_way(bundle, seed))
    add({"inference_ms": _inference(bundle, seed)})
    for name in bench_process.PARTS:
        add(_child(name, seed))
    add(_cold_start())
    add({"bundle_kb": _size_kb(bundle), "date": time.strftime("%Y-%m-%d", time.gmtime())})
    add({"load_average": {"before": _rounded(load_before), "after": _rounded(os.getloadavg())}})
    return figures


def _rounded(load: tuple[float, float, float]) -> list[float]:
    return [round(value, 2) for value in load]


def _size_kb(bundle: Bundle) -> dict[str, float]:
    """Size on the disk in 1000 bytes: of the model, and of all files of the bundle."""
    files = bundle.manifest.files.values()
    whole = len(bundle.manifest.json()) + sum(entry["bytes"] for entry in files)
    return {"model": round(len(bundle.model) / 1000, 1), "all": round(whole / 1000, 1)}


def _percentiles(values: list[float]) -> dict[str, float]:
    found = {f"p{q}": round(float(np.percentile(values, q)), 4) for q in (50, 99)}
    return found | {"n": len(values)}


class SkippingClock:
    """Real time without waiting, to measure the computing time of the box."""

    def __init__(self) -> None:
        self._skipped_ns = 0

    def now_ns(self) -> int:
        return time.monotonic_ns() + self._skipped_ns

    def sleep_until(self, t_ns: int) -> None:
        self._skipped_ns += max(0, t_ns - self.now_ns())


class AnswerTimes(Observer):
    """Measures the latency of answers: verdicts come here after their sentences."""

    def __init__(self, clock: Clock) -> None:
        self.verdicts: list[Verdict] = []
        self.answered_ms: list[float] = []
        self.seen_ms: list[float] = []
        self._clock = clock

    def answered(self, verdict: Verdict) -> None:
        in_hand_ns = verdict.time_ns - verdict.latency_ns
        self.verdicts.append(verdict)
        self.answered_ms.append((self._clock.now_ns() - in_hand_ns) / 1e6)

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        self.seen_ms.append((sweep.complete_ns - sweep.stop_ns) / 1e6)


def _whole_way(bundle: Bundle, seed: int) -> dict[str, Any]:
    """Latencies of SWEEPS simulated sweeps from USB bytes to sentence, at skin positions outside
    all training sets.

    Computing takes its real time, waiting is skipped. edge_to_sentence_ms: from stop edge and last
    frame of the window, both read, to the sentence at the port. edge_seen_ms: from the kernel's
    time stamp of the stop edge to the same moment (glitch filter, rest of a packet).
    """
    clock = SkippingClock()
    watch = AnswerTimes(clock)
    simulated = devices.build(
        bundle.format, script.tubes(seed, SWEEPS, skin.placements("T-REAL", seed)), clock, "sim"
    )
    with ExitStack() as stack:
        measured, far_end = box(bundle, simulated, stack, [watch])
        while not simulated.finished(measured.answered):
            measured.step()
            drain(far_end)
        lost = measured.counters.lost_frames
    pairs = zip(watch.verdicts, simulated.robot.played, strict=True)
    right = sum(v.label == act.label and v.status is Status.OK for v, act in pairs)
    interval = [round(v, 4) for v in wilson(right, SWEEPS)]
    accuracy = {"right": right, "total": SWEEPS, "interval": interval}
    times = watch.answered_ms, watch.seen_ms
    answered, seen = map(_percentiles, times)
    figures = {"edge_to_sentence_ms": answered, "edge_seen_ms": seen}
    return {"accuracy": accuracy, "frames_lost": lost, **figures}


def _inference(bundle: Bundle, seed: int) -> dict[str, Any]:
    """Times of the bundle's network, of whole answers with it, of its network in float, and of the
    paper's in int8, in turns."""
    rng, classifier = np.random.default_rng(seed), Classifier(bundle, SystemClock())
    window = rng.integers(0, 256, bundle.golden[0].shape).astype(bundle.format.numpy_type)
    times = np.arange(len(window))
    sweep = Sweep(1, 0, 0, Status.OK, Frames(times, times, bundle.golden[0]))
    calls: dict[str, Callable[[], object]] = {}
    calls["int8"] = partial(classifier.logits, window)
    calls["answer"] = partial(classifier, sweep)
    for name, model in _references():
        calls[name] = partial(session(model).run, None, {"sweep": window[None]})
    took_ms: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            call()  # fills the caches, which the other models have overwritten
            for _ in range(CALLS):
                start = time.perf_counter_ns()
                call()
                took_ms[name].append((time.perf_counter_ns() - start) / 1e6)
    return {name: _percentiles(values[len(values) // 10 :]) for name, values in took_ms.items()}


def _references() -> list[tuple[str, bytes]]:
    """Names and content of the models for comparison; none on a board without the studies."""
    if not find_spec("palpate_studies"):
        return []
    from palpate_studies import references

    with tempfile.TemporaryDirectory() as folder:
        return [(path.stem, path.read_bytes()) for path in references.write(Path(folder))]


def _child(name: str, seed: int) -> dict[str, Any]:
    """A part of the figures, measured in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        acts = Path(folder) / "acts.npz"
        bench_process.write_acts(acts, script.tubes(seed, 6))
        command = [sys.executable, "-m", bench_process.__name__, name, str(acts)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def _cold_start() -> dict[str, Any]:
    """Seconds from the start of the process to READY with a streaming skin."""
    took = []
    command = [sys.executable, "-P", "-m", "palpate", "run", "--sim", "skin"]
    for _ in range(STARTS):
        start = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as box:
            assert box.stdout
            while b",streaming," not in box.stdout.readline():
                pass
            took.append(time.monotonic() - start)
            box.terminate()
    worst = {"cold_start_worst_s": round(max(took), 3)}
    return {"cold_start_s": round(statistics.median(took), 3), **worst}


def _machine() -> dict[str, Any]:
    system = {"arch": platform.machine(), "cores": os.cpu_count(), "system": platform.system()}
    python = {"python": platform.python_version()}
    versions = {"numpy": np.__version__, "onnxruntime": ort.__version__}
    return system | python | versions | {"processor": processor()}


def main() -> None:
    """Measure, print each figure at once, and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=2000, help="of the simulated sweeps (2000)")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"({RESULTS})")
    args = parser.parse_args()
    figures = run(args.seed, lambda line: print(line, flush=True))
    storage.put(args.out, (json.dumps(figures, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
