"""Time of a sweep with each method, all in turns in one process.

A method with a graph is packed as a bundle and timed in the box's classifier, with checks and
features. Other methods are timed in their own library, without checks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import BundleError, FormatError
from train.data.progress import Progress
from train.data.sets import Dataset
from train.export import measure
from train.models import methods
from train.models.methods import FULL_EFFORT, Effort, Method, Model, model_inputs
from train.studies import precisions
from train.studies.chart_experiment import kept_folder
from train.studies.development_experiment import OURS

Array = NDArray[Any]
Json = dict[str, Any]
Log = Callable[[str], None]
ROUNDS = 10
"""Rounds of timing. The slowest methods take a hundred times as long as those of the chart."""
EVERY, SHARE = 5, 0.25
"""A peer of a library is trained on every fifth sweep, a network of a peer for a quarter of its
iterations: training does not change the time of a sweep. Ours are trained as always, because
training chooses their size."""


def measured(
    names: Sequence[str],
    sweeps: Dataset,
    seed: int,
    cache: Path | None,
    log: Log,
    effort: Effort = FULL_EFFORT,
    rounds: int = ROUNDS,
) -> Json:
    """`entries` with `method`, `form`, `precision`, `runtime`, `ms_p50` and `ms_p99` of a sweep,
    for graphs also `weights`, `macs` and `file_kb`, and the methods that are `left_out`.

    Bundles are cached in `cache`, as for the chart.
    """
    entries: list[Json] = []
    calls: dict[str, measure.Call] = {}
    left_out: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as work:
        progress = Progress(len(names), log)
        for method in [_briefly(name, effort) for name in names]:
            progress.begin(f"{method.name} is trained for its time")
            try:
                for entry, call in _callable(method, sweeps, seed, cache or Path(work)):
                    calls[str(len(entries))] = call
                    entries.append(entry)
            except (FormatError, BundleError) as e:
                left_out[method.name] = str(e)
        log(f"{len(calls)} models take turns")
        some = sweeps.samples[:: max(len(sweeps) // measure.TIMED_SWEEPS, 1)]
        took = measure.timed(calls, some, rounds)
    for entry, times in zip(entries, took.values(), strict=True):
        entry |= {f"ms_p{q}": round(float(np.percentile(times, q)), 4) for q in (50, 99)}
    return {
        "set": sweeps.source,
        "format": str(sweeps.format),
        "entries": entries,
        "left_out": left_out,
    }


def _briefly(name: str, effort: Effort) -> Method:
    """The method, for a peer with SHARE of its iterations, unless the effort is smaller anyway."""
    return methods.find(
        [name], effort if name in OURS else replace(effort, share=min(SHARE, effort.share))
    )[0]


def _callable(
    method: Method, sweeps: Dataset, seed: int, cache: Path
) -> list[tuple[Json, measure.Call]]:
    """The method in each precision of the box, and in its own library."""
    if method.library:
        some = sweeps.take(np.arange(0, len(sweeps), EVERY))
        model = method.train(some, model_inputs(method.input, some), seed)
        entry = {"method": method.name, "form": "", "precision": "float", "runtime": method.library}
        return [(entry | {"runs_on_box": False}, partial(_alone, model))]
    made = precisions.packed(method, sweeps, seed, kept_folder(method, sweeps, seed, cache))
    return [
        (
            {
                "method": one.method,
                "form": one.form,
                "precision": one.precision,
                "runtime": one.runtime,
                "runs_on_box": one.runtime == "onnx",
                "weights": one.weights,
                "macs": one.macs,
                "file_kb": measure.sizes(one.folder)[0] / 1000,
            },
            measure.load(one.folder),
        )
        for one in made
    ]


def _alone(model: Model, counts: Array) -> Array:
    """Logits [K] from raw counts [T, R, C]."""
    logits: Array = model.logits(counts[None])[0]
    return logits
