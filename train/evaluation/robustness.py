"""The room of stress tests: where does each method fail? In: methods, a training set, a EvaluationSweeps. Out: curves and tables.

One task is one method and one seed: `one` trains it and puts it under every stress, `merge` makes a result of many
tasks, wherever they ran. What a task returns, and the result, are plain numbers and text that JSON can hold.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Bundle
from appliance.core.config import SweepConfig
from appliance.core.errors import FormatError
from appliance.core.statistics import wilson
from appliance.core.storage import put
from appliance.core.types import Edge, EdgeKind, Frames, SweepFormat, Verdict
from appliance.inference.classifier import Classifier
from appliance.recording.sweep_window import SweepCutter
from appliance.sim.rig import VirtualClock
from train.data.sets import Dataset, digest
from train.evaluation import parallel
from train.evaluation.corruptions import Corruption, EvaluationSweeps, usual
from train.evaluation.evaluate import Where
from train.evaluation.fold import fingerprint
from train.models import methods
from train.models.methods import FULL_EFFORT, Effort, Method, Model, model_inputs

Array = NDArray[Any]
Json = dict[str, Any]
POINTS = 0.05
"""A method has fallen where it lost so much of its own accuracy."""


def one(
    method: Method, train: Dataset, trial: EvaluationSweeps, stresses: Sequence[Corruption] | None, seed: int
) -> Json:
    """A task: train `method` and put it under stress; None stands for all stresses that make sense.

    Where the method cannot work with this set, the reason stands under `refused`. Raises FormatError where train and
    trial differ in format or materials: that is the caller's mistake.
    """
    if (train.format, train.materials) != (trial.sweeps.format, trial.sweeps.materials):
        raise FormatError(f"{trial.sweeps.source} ({trial.sweeps.format}, {len(trial.sweeps.materials)} materials) is "
                          f"not of the kind of {train.source} ({train.format}, {len(train.materials)} materials); "
                          "test on what the methods are trained for")  # fmt: skip
    try:
        model = method.train(train, model_inputs(method.input, train), seed)
    except FormatError as e:
        return {"method": method.name, "seed": seed, "set": trial.sweeps.source, "refused": str(e)}
    return score(method, model, trial, stresses, seed)


def score(
    method: Method, model: Model, trial: EvaluationSweeps, stresses: Sequence[Corruption] | None, seed: int
) -> Json:
    """What `one` gives, of a model that is trained. The sweeps depend on trial, stress, severity and seed alone."""
    curves = {}
    clean = _right(method, model, trial.sweeps, trial.sweeps.samples)
    for stress in usual(trial) if stresses is None else stresses:
        under = [clean]
        for severity in stress.severities[1:]:
            under.append(_right(method, model, trial.sweeps, stress.apply(trial, severity, seed)))
        right, broken = zip(*under, strict=True)
        curves[stress.name] = {
            "unit": stress.unit, "about": stress.about, "severities": [float(s) for s in stress.severities],
            "right": list(right), "broken": list(broken),
        }  # fmt: skip
    return {"method": method.name, "seed": seed, "set": trial.sweeps.source, "refused": "", "total": len(trial.sweeps),
            "ran": getattr(model, "ran", ""), "curves": curves, "trouble": trouble(method, model, trial)}  # fmt: skip


def run(
    names: Sequence[str],
    train: Dataset,
    trial: EvaluationSweeps,
    where: Where,
    *,
    seeds: Sequence[int] = (1,),
    effort: Effort = FULL_EFFORT,
    log: Callable[[str], None] = lambda line: None,
) -> Json:
    """All methods and seeds under all stresses that make sense, merged; tasks that are kept are not done again.

    Raises FormatError as `one`, and for an unknown method.
    """
    about = [digest(train), digest(trial.sweeps), trial.scene is not None]
    tasks = {(method.name, seed): fingerprint([*about, method.name, method.effort, seed], methods.module_of(method.name), "train.evaluation.robustness")
             for method in methods.find(names, effort) for seed in seeds}  # fmt: skip
    paths = {task: where.cache / f"{key}.json" for task, key in tasks.items() if where.cache}
    done = {task: json.loads(path.read_text()) for task, path in paths.items() if path.exists()}
    left = [task for task in tasks if task not in done and not where.kept]
    progress = parallel.Progress(len(left), log)
    for task, told in parallel.results(_one, left, (train, trial, effort), where.jobs, where.scheduler):
        done[task] = told
        if where.cache:
            put(paths[task], json.dumps(told).encode(), parents=True)
        progress(f"{task[0]} under stress, seed {task[1]}")
    return merge(done.values())


def _one(task: tuple[str, int], train: Dataset, trial: EvaluationSweeps, effort: Effort) -> Json:
    (method,) = methods.find([task[0]], effort)
    return one(method, train, trial, None, task[1])


def merge(tasks: Iterable[Json]) -> Json:
    """The result of tasks, in whatever order they ended: {"sets": [...], "methods": {name: entry}}.

    An entry holds seeds, refused ("" or why), ran, clean (accuracy), curves and trouble. A curve holds unit,
    about, severities, right and total (sums), accuracy, low and high, broken (answers that were no numbers; they count
    as wrong), falls and lost. low to high is the wider of Wilson's 95 % interval for the sweeps of one task and the
    spread of the tasks: seeds see the same sweeps, and their sum would be too sure.
    """
    tasks = sorted(tasks, key=lambda t: (t["set"], t["seed"]))
    names = sorted({t["method"] for t in tasks})
    entries = {name: _entry([t for t in tasks if t["method"] == name]) for name in names}
    return {"sets": sorted({t["set"] for t in tasks}), "methods": entries}


def falls(curve: Json, points: float = POINTS) -> float | None:
    """The severity at which accuracy is `points` below the unstressed one, on the line between two severities.

    None where it never is.
    """
    severity, accuracy = curve["severities"], curve["accuracy"]
    limit = accuracy[0] - points + 1e-9  # .9 - .05 is less than .85
    for i in range(1, len(accuracy)):
        if accuracy[i] <= limit:
            part = (accuracy[i - 1] - limit) / (accuracy[i - 1] - accuracy[i])
            return round(severity[i - 1] + part * (severity[i] - severity[i - 1]), 6)
    return None


def worst(result: Json, method: str, n: int = 5) -> list[Json]:
    """The `n` stresses under which `method` loses most: accuracy lost, the mean over the severities above 0."""
    found = result["methods"][method]["curves"]
    names = sorted(found, key=lambda name: (-found[name]["lost"], name))[:n]
    return [{"stress": name, **{k: found[name][k] for k in ("lost", "falls", "unit")}} for name in names]


def table(result: Json) -> str:
    """Markdown: stresses x methods, at which severity each has lost five points; then each method's five worst, and what
    becomes of sweeps that tell nothing: on the desktop, and on the box where `result` holds `box_trouble` as "box"."""
    entries = {name: entry for name, entry in result["methods"].items() if entry["curves"]}
    rows = [["accuracy lost by .05 at", *entries], ["---"] + ["---:"] * len(entries)]
    rows.append(["*no stress: accuracy*", *(f"{entry['clean']:.3f}" for entry in entries.values())])
    every = {k: curve for entry in entries.values() for k, curve in entry["curves"].items()}
    for stress, curve in every.items():
        cells = [_cell(entry["curves"].get(stress)) for entry in entries.values()]
        rows.append([f"{stress} ({curve['unit']})", *cells])
    lines = [f"| {' | '.join(row)} |" for row in rows] + [""]
    for name in entries:
        hardest = ", ".join(f"{w['stress']} −{w['lost']:.2f}" for w in worst(result, name))
        lines.append(f"- {name}: worst, by the mean loss over all severities: {hardest}")
    lines += [f"- {name}: {entry['refused']}" for name, entry in result["methods"].items() if entry["refused"]]
    lines += ["", "Sweeps that tell nothing:", ""]
    for name in dict.fromkeys(name for entry in entries.values() for name in entry["trouble"]):
        said = Counter(entry["trouble"][name].split(":")[0] for entry in entries.values())
        desk = ", ".join(f"{n} methods {what}" for what, n in said.items())
        lines.append(f"- {name}: {desk}" + (f"; the box: {result['box'][name]}" if "box" in result else ""))
    return "\n".join(lines) + "\n"


def trouble(method: Method, model: Model, trial: EvaluationSweeps) -> dict[str, str]:
    """What becomes of sweeps that are none, on the desktop: "finite", "refused: why", "not finite" or "crashed: why".

    They go the way that all sweeps go: into a checked set, then to the method's input, then to the model.
    """
    found = {}
    for name, taxels in _spoiled(trial.sweeps.format, trial.load).items():
        try:
            spoiled = Dataset(taxels[None], np.zeros(1, int), trial.sweeps.materials, trial.sweeps.rate_hz, {}, name)
            if spoiled.format != trial.sweeps.format:
                raise FormatError(f"{spoiled.format} instead of {trial.sweeps.format}")
            logits = model.logits(model_inputs(method.input, spoiled))
            found[name] = "finite" if np.isfinite(logits).all() else "not finite"
        except FormatError as e:
            found[name] = f"refused: {e}"
        except Exception as e:  # whatever a method's libraries raise: the table is there to show it
            found[name] = f"crashed: {type(e).__name__}: {e}"
    return found


def box_trouble(bundle: Bundle) -> dict[str, str]:
    """The same on the box: the status of each verdict, and whether what it says is "not finite"."""
    limits = bundle.manifest.thresholds
    found = {}
    for name, taxels in _spoiled(bundle.format, limits.full_scale).items():
        verdict = answer(bundle, taxels)
        sane = np.isfinite([verdict.probability, verdict.margin, *verdict.scores]).all()
        found[name] = verdict.status.value + ("" if sane else ": not finite")
    return found


def answer(bundle: Bundle, taxels: Array) -> Verdict:
    """The box's verdict on frames [n, R, C] that come while the trigger says that a sweep is going on, and no longer."""
    form, n, clock = bundle.format, np.arange(len(taxels)), VirtualClock()
    first_ns = clock.now_ns()
    recorder = SweepCutter(form, SweepConfig())
    t_ns = first_ns + np.rint(n * form.period_ns).astype(np.int64)
    end_ns = first_ns + round(len(taxels) * form.period_ns) + 1
    clock.sleep_until(end_ns + 10 * SweepConfig().late_ms * 1_000_000)
    recorder.put(Frames(t_ns, n, taxels), end_ns)
    recorder.trigger([Edge(EdgeKind.START, first_ns), Edge(EdgeKind.STOP, end_ns)], True, end_ns)
    (sweep,) = recorder.finished(clock.now_ns())
    return Classifier(bundle, clock)(sweep)


def _right(method: Method, model: Model, sweeps: Dataset, samples: Array) -> tuple[int, int]:
    """How many of `samples` are named rightly, and how many answers are no numbers (those are wrong)."""
    logits = np.asarray(model.logits(model_inputs(method.input, replace(sweeps, samples=samples))))
    sane = np.isfinite(logits).all(axis=1)
    return int(np.sum(sane & (logits.argmax(axis=1) == sweeps.labels))), int(np.sum(~sane))


def _entry(tasks: list[Json]) -> Json:
    """One method of the result, of all its tasks."""
    done = [t for t in tasks if not t["refused"]]
    refused = next((t["refused"] for t in tasks if t["refused"]), "")
    entry: Json = {"seeds": sorted({t["seed"] for t in done}), "refused": refused, "clean": None, "curves": {},
                   "ran": next((t["ran"] for t in done), ""), "trouble": {}}  # fmt: skip
    for name in done[0]["curves"] if done else ():
        entry["curves"][name] = _curve([t["curves"][name] for t in done], np.array([t["total"] for t in done]))
        entry["clean"] = entry["curves"][name]["accuracy"][0]
    for t in done:  # of several answers the worst is told
        for name, status in t["trouble"].items():
            entry["trouble"][name] = max(entry["trouble"].get(name, status), status, key=_badness)
    return entry


def _badness(status: str) -> int:
    return ("finite", "refused", "not finite", "crashed").index(status.split(":")[0])


def _curve(parts: list[Json], totals: Array) -> Json:
    """Tasks' curves of one method and stress as one. totals [tasks]: sweeps of each."""
    right = np.array([part["right"] for part in parts])  # [tasks, severities]
    shares = right / totals[:, None]
    accuracy = right.sum(axis=0) / totals.sum()
    band = [wilson(float(a * totals.mean()), float(totals.mean())) for a in accuracy]
    low = np.minimum([low for low, _ in band], shares.min(axis=0))
    high = np.maximum([high for _, high in band], shares.max(axis=0))
    curve = {k: parts[0][k] for k in ("unit", "about", "severities")} | {
        "right": right.sum(axis=0).tolist(), "total": int(totals.sum()), "accuracy": accuracy.round(6).tolist(),
        "low": low.round(4).tolist(), "high": high.round(4).tolist(),
        "broken": np.sum([part["broken"] for part in parts], axis=0).tolist(),
        "lost": round(float(np.mean(accuracy[0] - accuracy[1:])), 4),
    }  # fmt: skip
    return curve | {"falls": falls(curve)}


def _cell(curve: Json | None) -> str:
    if curve is None:
        return ""
    return f"> {curve['severities'][-1]:g}" if curve["falls"] is None else f"{curve['falls']:.2g}"


def _spoiled(form: SweepFormat, top: float) -> dict[str, Array]:
    """Windows [T, R, C] that tell nothing, one of a single frame. top: the highest digit where their type sets none."""
    level = np.full((form.window, form.rows, form.cols), top / 2).astype(form.digits)
    whole = form.digits.kind != "f"
    found = {"silent": 0 * level, "constant": level, "one-frame": level[:1],
             "saturated": np.full_like(level, np.iinfo(form.digits).max if whole else top)}  # fmt: skip
    for name, value in () if whole else (("nan", np.nan), ("inf", np.inf)):
        found[name] = level * (1 + np.arange(len(level)).reshape(-1, 1, 1) % 2 / 8).astype(level.dtype)  # it moves
        found[name][len(level) // 2, 0, 0] = value
    return found
