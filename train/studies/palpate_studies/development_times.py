"""Costs of a sweep with each method, all timed in turns in one process.

Features and graph are timed in a session like the box's, a method without a graph in its own
library. A bundle of ours is timed as the box answers, too: with its checks of the sweep and the
rules of the answer, which a peer does not have.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import BundleError, FormatError
from palpate.core.provenance import processor
from palpate.core.sweep_set import Array
from palpate.inference.session import graph_input, session
from palpate_studies import cost, precisions
from palpate_studies.development_chart import ANSWER, SERIES, TACTILE
from palpate_studies.development_experiment import CASES, OURS
from palpate_studies.precisions import Packed
from palpate_studies.study import StudyCase
from palpate_train.data.progress import Progress
from palpate_train.data.sets import Dataset
from palpate_train.export import measure
from palpate_train.metrics import score
from palpate_train.models import methods
from palpate_train.models.methods import FULL_EFFORT, Effort, Method, model_inputs

Json = dict[str, Any]
Log = Callable[[str], None]
Timed = tuple[Json, measure.Call | None, measure.Call]
"""The costs of a model, its whole answer if it is of ours, and its features and graph."""
TIMED = StudyCase(("sim:T-REAL/level-blind:1",))
"""The sweeps that every method is trained on and timed with."""
PANELS = {
    TACTILE: CASES["7 fabrics, a repetition out"],
    SERIES: CASES["OSULeaf, published split"],
}
"""For each panel of the chart the sweeps with which its methods are timed. Which views a model of
ours has, and so its time, depends on the sweeps."""
CHARTED = ("method", "form", "precision", "ms_p50", ANSWER)
"""The keys of an entry that the chart reads."""
ROUNDS = 10
"""Rounds of timing. The slowest methods take a thousand times as long as the quickest."""
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
    """`entries` with the costs of a sweep, which docs/reference/file-formats.md describes, and the
    methods that are `left_out`.

    Bundles are cached in `cache`.
    """
    entries: list[Json] = []
    calls: dict[str, measure.Call] = {}
    left_out: dict[str, str] = {}
    some = sweeps.samples[:: max(len(sweeps) // measure.ROUNDS, 1)]
    with tempfile.TemporaryDirectory() as work:
        progress = Progress(len(names), log)
        brief = replace(effort, share=min(SHARE, effort.share))
        every = (methods.find([name], effort if name in OURS else brief) for name in names)
        for (method,) in list(every):
            progress.begin(f"{method.name} is trained for its time")
            try:
                for entry, whole, call in _callable(
                    method, sweeps, some, seed, cache or Path(work)
                ):
                    calls[str(len(entries))] = call
                    calls |= {f"{len(entries)} {ANSWER}": whole} if whole else {}
                    entries.append(entry)
            except (FormatError, BundleError) as e:
                left_out[method.name] = str(e)
        log(f"{len(calls)} models take turns")
        took = measure.timed(calls, some, rounds)
    for number, entry in enumerate(entries):
        entry |= _quantiles(took[str(number)])
        if (times := took.get(f"{number} {ANSWER}")) is not None:
            entry[ANSWER] = _quantiles(times)["ms_p50"]
    return {
        "set": sweeps.source,
        "format": str(sweeps.format),
        "processor": processor(),
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
            shown = [{k: v for k, v in one.items() if k in CHARTED} for one in times["entries"]]
            found[kind] = times | {"entries": shown}
    return found


def _quantiles(times: Array) -> dict[str, float]:
    return {f"ms_p{q}": round(float(np.percentile(times, q)), 4) for q in (50, 99)}


def _callable(method: Method, sweeps: Dataset, some: Array, seed: int, cache: Path) -> list[Timed]:
    """The method in each precision of the box, or in its own library; MiniRocket in both. A model
    that the box refuses is timed all the same. some: raw counts [n, T, R, C] for its memory."""
    few = sweeps.take(np.arange(0, len(sweeps), EVERY))
    alone = {"method": method.name, "form": "", "precision": "float", "runs_on_box": False}
    if method.library:
        model = method.train(few, model_inputs(method.input, few), seed)
        call: measure.Call = lambda counts: model.logits(counts[None])[0]  # noqa: E731
        return [(alone | {"runtime": method.library}, None, call)]
    folder = precisions.kept_folder(method, sweeps, seed, cache)
    try:
        made = precisions.packed(method, sweeps, seed, folder)
    except BundleError as e:
        return list(_refused(method, sweeps, seed, str(e)))
    found: list[Timed] = [
        (
            _entry(one, some),
            measure.load(one.whole) if one.whole else None,
            _graph(method, (one.folder / measure.MODEL).read_bytes(), sweeps.rate_hz),
        )
        for one in made
    ]
    if method.name == "minirocket":
        from palpate_studies.peers import minirocket  # only here: scikit-learn

        found.append((alone | {"runtime": "aeon"}, None, minirocket.in_aeon(few, seed)))
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


def _refused(method: Method, sweeps: Dataset, seed: int, why: str) -> Iterator[Timed]:
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
        yield entry, None, _graph(method, data, sweeps.rate_hz)


def _graph(method: Method, graph: bytes, rate_hz: float) -> measure.Call:
    """Features and graph, which answer raw counts [T, R, C]."""
    run = session(graph)
    name = run.get_inputs()[0].name
    return lambda counts: run.run(None, {name: graph_input(method.input, counts, rate_hz)[None]})
