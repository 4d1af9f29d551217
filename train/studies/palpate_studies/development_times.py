"""Costs of a sweep with each method, all timed in turns in one process.

Features and graph are timed in a session like the box's, a method without a graph in its own
library. The box checks every sweep before that, whatever the model; `box` has the time of the
packaged bundle with these checks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.bundle import bundle
from palpate.core.errors import BundleError, FormatError
from palpate.core.provenance import processor
from palpate.inference.session import session
from palpate_studies import cost, precisions
from palpate_studies.development_chart import SERIES, TACTILE
from palpate_studies.development_experiment import CASES, OURS
from palpate_studies.precisions import Packed
from palpate_studies.study import StudyCase
from palpate_train.data.progress import Progress
from palpate_train.data.sets import Dataset
from palpate_train.export import measure
from palpate_train.metrics import score
from palpate_train.models import methods
from palpate_train.models.methods import FULL_EFFORT, Effort, Method, model_inputs

Array = NDArray[Any]
Json = dict[str, Any]
Log = Callable[[str], None]
TIMED = StudyCase(("sim:T-REAL/level-blind:1",))
"""The sweeps that every method is trained on and timed with."""
PANELS = {
    TACTILE: CASES["7 fabrics, a repetition out"],
    SERIES: CASES["OSULeaf, published split"],
}
"""For each panel of the chart the sweeps with which its methods are timed. Which views a model of
ours has, and so its time, depends on the sweeps."""
CHARTED = ("method", "form", "precision", "ms_p50")
"""The keys of an entry that the chart reads."""
ROUNDS = 10
"""Rounds of timing. The slowest methods take a thousand times as long as the quickest."""
EVERY, SHARE = 5, 0.25
"""A peer of a library is trained on every fifth sweep, a network of a peer for a quarter of its
iterations: training does not change the time of a sweep. Ours are trained as always, because
training chooses their size."""
BOX = "box"
"""Name of the packaged bundle among the timed calls."""


def measured(
    names: Sequence[str],
    sweeps: Dataset,
    seed: int,
    cache: Path | None,
    log: Log,
    effort: Effort = FULL_EFFORT,
    rounds: int = ROUNDS,
) -> Json:
    """`entries` with the costs of a sweep, which docs/reference/file-formats.md describes, and the
    methods that are `left_out`.

    Bundles are cached in `cache`.
    """
    entries: list[Json] = []
    calls: dict[str, measure.Call] = {}
    left_out: dict[str, str] = {}
    some = sweeps.samples[:: max(len(sweeps) // measure.TIMED_SWEEPS, 1)]
    with tempfile.TemporaryDirectory() as work:
        progress = Progress(len(names), log)
        for method in [_briefly(name, effort) for name in names]:
            progress.begin(f"{method.name} is trained for its time")
            try:
                for entry, call in _callable(method, sweeps, some, seed, cache or Path(work)):
                    calls[str(len(entries))] = call
                    entries.append(entry)
            except (FormatError, BundleError) as e:
                left_out[method.name] = str(e)
        if bundle.load(bundle.DEFAULT).format == sweeps.format:
            calls[BOX] = measure.load(bundle.DEFAULT)
        log(f"{len(calls)} models take turns")
        took = measure.timed(calls, some, rounds)
    box = _quantiles(took.pop(BOX)) if BOX in took else {}
    for entry, times in zip(entries, took.values(), strict=True):
        entry |= _quantiles(times)
    return {
        "set": sweeps.source,
        "format": str(sweeps.format),
        "processor": processor(),
        "box": box,
        "entries": entries,
        "left_out": left_out,
    } | score.provenance()


def of_panels(
    names: Sequence[str], data: Path | None, seed: int, cache: Path | None, log: Log, effort: Effort
) -> Json:
    """`measured` for each panel of the chart, with the keys CHARTED alone. Panels of real sweeps
    need the folder `data`."""
    found = {}
    for kind, case in PANELS.items():
        if (sweeps := case.load(data)) is not None:
            log(f"times of {kind}")
            sweeps = sweeps.without_means() if case.means_removed else sweeps
            times = measured(names, sweeps, seed, cache, log, effort)
            shown = [{key: one[key] for key in CHARTED} for one in times["entries"]]
            found[kind] = times | {"entries": shown}
    return found


def _quantiles(times: Array) -> dict[str, float]:
    return {f"ms_p{q}": round(float(np.percentile(times, q)), 4) for q in (50, 99)}


def _briefly(name: str, effort: Effort) -> Method:
    """The method, for a peer with SHARE of its iterations, unless the effort is smaller anyway."""
    return methods.find(
        [name],
        effort if name in OURS else replace(effort, share=min(SHARE, effort.share)),
    )[0]


def _callable(
    method: Method, sweeps: Dataset, some: Array, seed: int, cache: Path
) -> list[tuple[Json, measure.Call]]:
    """The method in each precision of the box, or in its own library; MiniRocket in both. A model
    that the box refuses is timed all the same. some: raw counts [n, T, R, C] for its memory."""
    few = sweeps.take(np.arange(0, len(sweeps), EVERY))
    alone = {"method": method.name, "form": "", "precision": "float", "runs_on_box": False}
    if method.library:
        model = method.train(few, model_inputs(method.input, few), seed)
        return [(alone | {"runtime": method.library}, lambda counts: model.logits(counts[None])[0])]
    folder = precisions.kept_folder(method, sweeps, seed, cache)
    try:
        made = precisions.packed(method, sweeps, seed, folder)
    except BundleError as e:
        return list(_refused(method, sweeps, seed, str(e)))
    found: list[tuple[Json, measure.Call]] = [
        (
            _entry(one, some),
            _graph(method, (one.folder / measure.MODEL).read_bytes(), sweeps.rate_hz),
        )
        for one in made
    ]
    if method.name == "minirocket":
        from palpate_studies.peers import minirocket  # only here: scikit-learn

        found.append((alone | {"runtime": "aeon"}, minirocket.in_aeon(few, seed)))
    return found


def _entry(one: Packed, some: Array) -> Json:
    """The costs of a packed model but its time."""
    return {
        "method": one.method,
        "form": one.form,
        "precision": one.precision,
        "runtime": "onnx",
        "runs_on_box": True,
        "weights": one.weights,
        "macs": one.macs,
        "file_kb": measure.sizes(one.folder)[0] / 1000,
        "rss_mb": measure.memory(one.folder, some),
    }


def _refused(
    method: Method, sweeps: Dataset, seed: int, why: str
) -> Iterator[tuple[Json, measure.Call]]:
    """Yield each precision of a method that the box refuses."""
    few = sweeps.take(np.arange(0, len(sweeps), EVERY))
    model = method.train(few, model_inputs(method.input, few), seed)
    for form, one in {"": model, **getattr(model, "precisions", {})}.items():
        graph = one.graph()
        about = {"method": method.name, "form": form, "precision": cost.precision(graph)}
        counts = {"weights": cost.weights(graph), "macs": cost.macs(graph)}
        data = graph.SerializeToString()
        more = {"runtime": "onnx", "runs_on_box": False, "refused": why}
        entry = about | more | counts | {"file_kb": len(data) / 1000}
        yield entry, _graph(method, data, sweeps.rate_hz)


def _graph(method: Method, graph: bytes, rate_hz: float) -> measure.Call:
    """Features and graph, which answer raw counts [T, R, C]."""
    run = session(graph)
    name = run.get_inputs()[0].name
    return lambda counts: run.run(
        None, {name: features.graph_input(method.input, counts, rate_hz)[None]}
    )
