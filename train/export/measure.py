"""The room of dots: one model as the box would carry it. In: a trained method. Out: its bundles, their time and memory.

A dot is a model in one precision. All dots are timed in one process and one thread, in turns, so that what slows the
machine down slows all alike; each one's memory is taken in a process of its own, which imports the box's code alone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from appliance.bundle import bundle
from appliance.core import storage
from appliance.core.errors import BundleError
from appliance.core.provenance import commit
from train.data.sets import Dataset
from train.export import measure_process, pack
from train.models import minirocket
from train.models.linear_head import hold_out
from train.models.methods import Method, model_inputs
from train.models.training import one_thread
from train.onnx_tools import cost

Array = NDArray[Any]
Call = Callable[[Array], Any]
ROUNDS, BLOCK = 60, 6
"""Turns; sweeps of a dot in one turn, after one that is not counted: the dot before has emptied the caches."""
TOLD = "dots.json"


@dataclass(frozen=True)
class Packed:
    """A model in `folder`, which alone.load reads. runtime: "onnx" is a bundle, else a peer in its own library.

    form: "" is the method itself, else the name of a form of it. precision, weights, macs: as cost.py tells them.
    window_s: length of a sweep.
    """

    method: str
    form: str
    precision: str
    runtime: str
    folder: Path
    weights: int
    macs: int
    window_s: float

    @property
    def name(self) -> str:
        """No two dots share one."""
        return f"{self.method} {self.precision}" + ("" if self.runtime == "onnx" else f" in {self.runtime}")

    def sizes(self) -> tuple[int, int]:
        """Bytes of the model's file and of all files."""
        held = {f.name: f.stat().st_size for f in self.folder.iterdir()}
        return next(held[n] for n in (bundle.MODEL, measure_process.TORCH, measure_process.AEON) if n in held), sum(
            held.values()
        )


def packed(method: Method, sweeps: Dataset, seed: int, folder: Path) -> list[Packed]:
    """Train `method` on four fifths of `sweeps` and pack all its forms; what lies in `folder` is not made again.

    Raises FormatError where the method cannot work with the set, ExportRefused where it would be no model on the box.
    """
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with storage.folder(folder) as work:
            (work / TOLD).write_text(json.dumps(list(_made(method, sweeps, seed, work))))
    told = json.loads((folder / TOLD).read_text())
    return [Packed(**one | {"method": method.name, "folder": folder / one["folder"]}) for one in told]


def _made(method: Method, sweeps: Dataset, seed: int, work: Path) -> Iterator[dict[str, Any]]:
    """Each form packed in a folder of its own; then the method as its own library runs it, where it has one."""
    train, held, by = hold_out(sweeps, seed)
    model = method.train(train, model_inputs(method.input, train), seed)
    ran = getattr(model, "ran", "")
    counted = {}
    for form, one in {"": model, **getattr(model, "forms", {})}.items():
        about = {"method": method.name, "form": form, "seed": seed, "ran": ran}
        content = pack.Content(one.graph(), method.input, train, held, by, about)
        precision = cost.precision(content.model)
        if any(precision == told["precision"] for told in counted.values()):
            continue  # nothing of it is in int8: it is its own float form
        folder = work / precision
        pack.pack(content, folder, f"{method.name}-{precision}", "1", commit())
        counted[form] = {
            "form": form, "precision": precision, "weights": cost.weights(content.model),
            "macs": cost.macs(content.model) + cost.feature_macs(method.input, train.format),
            "window_s": train.format.window / train.format.rate_hz,
        }  # fmt: skip
        yield counted[form] | {"runtime": "onnx", "folder": folder.name}
    if method.name in GUESTS:
        runtime, save = GUESTS[method.name]
        (work / runtime).mkdir()
        save(model, train, seed, work / runtime)
        yield counted[""] | {"runtime": runtime, "folder": runtime}


def _torch(model: Any, train: Dataset, seed: int, folder: Path) -> None:
    """The network as TorchScript, which needs none of our code to be read."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(model.network.eval(), torch.from_numpy(train.samples[:1])).save(folder / measure_process.TORCH)


def _aeon(model: Any, train: Dataset, seed: int, folder: Path) -> None:
    """aeon's parameters, fitted to the same sweeps once more, and the head that was trained on its features."""
    named = {f"p{i}": p for i, p in enumerate(minirocket.fitted(train.samples, seed))}
    silence = np.zeros((1, train.format.rows * train.format.cols, train.format.window), np.float32)
    np.savez_compressed(folder / measure_process.AEON, silence=silence, weight=model.weight, bias=model.bias, **named)


GUESTS: Mapping[str, tuple[str, Callable[[Any, Dataset, int, Path], None]]] = {
    "paper-cnn-centred": ("torch", _torch),
    "minirocket": ("aeon", _aeon),
}
"""Peers that are measured in their own library as well, which the box has not."""


def timed(calls: Mapping[str, Call], sweeps: Array, rounds: int = ROUNDS, block: int = BLOCK) -> dict[str, Array]:
    """Times in ms [rounds * block] of each call with `sweeps` [n, T, R, C] one by one, by name.

    All take turns, a block each; every round begins with another one. One thread, and the time that the processor gave
    to it: by the clock, slow models would be interrupted by others and quick ones would not.
    """
    names, took = list(calls), {name: np.empty(rounds * block) for name in calls}
    with one_thread():
        for turn in range(rounds):
            for name in np.roll(names, -turn).tolist():
                call = calls[name]
                call(sweeps[turn % len(sweeps)])
                for i in range(turn * block, (turn + 1) * block):
                    digits = sweeps[i % len(sweeps)]
                    start = time.process_time_ns()
                    call(digits)
                    took[name][i] = (time.process_time_ns() - start) / 1e6
    return took


def memory(one: Packed, sweeps: Array) -> dict[str, Any]:
    """`rss_mb` of a fresh process that has loaded `one` and answered some of `sweeps`, and the `foreign` packages there.

    Raises BundleError where it cannot.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweeps.npy"
        np.save(path, sweeps[: measure_process.SWEEPS])
        command = [sys.executable, "-P", measure_process.__file__, str(one.folder), str(path)]
        env = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    if done.returncode:
        raise BundleError(f"{one.name} does not run by itself: {done.stderr.strip()[-300:]}")
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def measured(all_of_them: list[Packed], sweeps: Array, rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """What each costs, in the order given: see `docs/evaluation.md`. sweeps: digits [n, T, R, C]."""
    took = timed({one.name: measure_process.load(one.folder) for one in all_of_them}, sweeps, rounds)
    return [_costs(one, took[one.name], memory(one, sweeps)) for one in all_of_them]


def _costs(one: Packed, took_ms: Array, kept: dict[str, Any]) -> dict[str, Any]:
    model, whole = one.sizes()
    return {
        "method": one.method, "precision": one.precision, "runtime": one.runtime, "weights": one.weights,
        "macs": one.macs, "file_kb": round(model / 1000, 1), "bundle_kb": round(whole / 1000, 1),
        "rss_mb": kept["rss_mb"], "ms_p50": round(float(np.percentile(took_ms, 50)), 4),
        "ms_p99": round(float(np.percentile(took_ms, 99)), 4), "touch_s": one.window_s,
        "runs_on_box": one.runtime == "onnx" and not kept["foreign"],
    }  # fmt: skip
