"""What bundles of few sweeps answer to junk and to altered slides: `taught --junk`.

A person teaches in turn at up to four places; other places judge. Each row is the mean of seeds.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core.errors import ApplianceError
from palpate.core.types import Frames, Status, Sweep
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from palpate_train.answer.altered_sweeps import altered_copies
from palpate_train.data import sets
from palpate_train.data.corruptions import applicable
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.junk import JUNK, windows
from palpate_train.data.sets import Dataset
from palpate_train.metrics.bundle_score import first_answer
from palpate_train.teach import taught
from palpate_train.teach.lesson import Lesson
from tests.campaigns import junk

Array = NDArray[Any]
Case = tuple[str, Array, Sequence[str], int]
"""Name of a column, windows [n, T, R, C], the right label of each ("" for none), lost frames."""
EACH, PLACES, JUDGED = 10, 4, 20
COLUMNS = "right", "wrong", "junk", "altered"
"""Right and wrong labels of slides at new places, labels of junk, wrong ones of altered slides."""


def run(name: str, path: str, each: Sequence[int], seeds: int) -> None:
    """Print a line for each number of sweeps of a material."""
    for n in each:
        rows = [row for seed in range(1, seeds + 1) if (row := measured(name, path, n, seed))]
        told = [
            f"{how} " + ", ".join(f"{key} {100 * np.mean([r[how, key] for r in rows]):.1f} %"
            for key in COLUMNS) for how in ("whole", "early")
        ]  # fmt: skip
        print(f"{name}, {n} each, {len(rows)} of {seeds} taught: {'; '.join(told)}", flush=True)


def measured(name: str, path: str, each: int, seed: int) -> dict[tuple[str, str], float]:
    """Shares by "whole" or "early" and column; nothing if the sweeps are refused."""
    world = skin.WORLDS["level-blind" if "level-blind" in name else ""]
    simulated = name.startswith("sim:")
    given, others = of_world(world, each, seed) if simulated else of_set(path, each, seed)
    box = of_lesson(given)
    if box is None:
        return {}
    right = [others.materials[k] for k in others.labels]
    made = of_kinds(world, seed) if simulated else of_copies(others, seed)
    counts: dict[tuple[str, str], list[bool]] = {
        (how, key): [] for how in ("whole", "early") for key in COLUMNS
    }
    early = EarlyExit(box) if box.bundle.manifest.early else None
    for column, taxels, labels, lost in [("wrong", others.samples, right, 0), *made]:
        for x, label in zip(taxels, labels, strict=True):
            for how, answer in answers(box, early, x, lost).items():
                counts[how, column] += [answer not in ("", label)]
                counts[how, "right"] += [answer == label] * (column == "wrong")
    return {key: float(np.mean(found)) for key, found in counts.items()}


def answers(box: Classifier, early: EarlyExit | None, x: Array, lost: int) -> dict[str, str]:
    """The label of the whole sweep and of the early answer, "" for none."""
    t = (np.arange(len(x)) * box.bundle.format.period_ns).astype(np.int64)
    sweep = Sweep(1, 0, int(t[-1]), Status.OK, Frames(t, np.arange(len(x)), x), lost=lost)
    whole, first = box(sweep), first_answer(early, sweep) if early else None
    named = whole.label if whole.status is Status.OK else ""
    return {"whole": named or "", "early": (first and first.label) or ""}


def of_lesson(given: Dataset) -> Classifier | None:
    """The box with the bundle that it teaches itself; None if it refuses the sweeps."""
    lesson = Lesson(given, tuple(map(str, range(len(given)))), {})
    with tempfile.TemporaryDirectory() as folder:
        try:
            taught.teach(lesson, Path(folder) / "b", "1", {}, lambda *news: None)
        except ApplianceError as e:
            print(f"refused: {e}", flush=True)
            return None
        return Classifier(bundle.load(Path(folder) / "b"), VirtualClock())


def of_world(world: skin.World, each: int, seed: int) -> tuple[Dataset, Dataset]:
    """A lesson, and sweeps of all materials at JUDGED other places."""
    places = [skin.placements("T-REAL", 5000 + 100 * seed + i)[0] for i in range(min(each, PLACES))]
    others = [skin.placements("T-REAL", 9000 + 100 * seed + i)[0] for i in range(JUDGED)]
    return (
        slides(world, [places[i % len(places)] for i in range(each)], (seed, each, 77)),
        slides(world, others, (seed, 78)),
    )


def slides(world: skin.World, places: Sequence[skin.Placement], seed: Sequence[int]) -> Dataset:
    """A slide over each material at each place."""
    rng, n = np.random.default_rng(seed), len(skin.MATERIALS) * len(places)
    x = np.stack([skin.window(m, place, rng, world) for m in skin.MATERIALS for place in places])
    at = [places.index(place) for _ in skin.MATERIALS for place in places]
    groups = {"position": np.array(at), "recording": np.arange(n)}
    labels = np.repeat(np.arange(len(skin.MATERIALS)), len(places))
    return Dataset(x, labels, skin.MATERIALS, skin.FORMAT.rate_hz, groups, "taught")


def of_set(path: str, each: int, seed: int) -> tuple[Dataset, Dataset]:
    """Recordings of one direction: `each` of a material, and others."""
    sweeps, rng = sets.load(path).select(("direction=1",)), np.random.default_rng([seed, each])
    order = rng.permutation(len(sweeps))
    recording = sweeps.group("recording")
    first = order[np.sort(np.unique(recording[order], return_index=True)[1])]
    of = [first[sweeps.labels[first] == k][:each] for k in np.unique(sweeps.labels)]
    chosen = np.sort(np.concatenate(of))
    apart = first[~np.isin(first, chosen)][: 12 * JUDGED]
    given = sweeps.take(chosen)
    return replace(given, groups={"recording": np.arange(len(given))}), sweeps.take(apart)


def of_kinds(world: skin.World, seed: int) -> Iterator[Case]:
    """The kinds of the campaign `junk` but untaught materials."""
    for kind in (*junk.NAMELESS, *junk.ALTERED):
        made = [junk.window(kind, world, 1000 * seed + i) for i in range(EACH)]
        column = "junk" if kind in junk.NAMELESS else "altered"
        yield column, np.stack([x for x, _ in made]), [right for _, right in made], 0


def of_copies(others: Dataset, seed: int) -> Iterator[Case]:
    """Junk that is made of recorded sweeps, and their altered copies."""
    for kind in JUNK:
        x = windows(kind, others, EACH, np.zeros(others.format.shape), seed)
        yield "junk", x, [""] * len(x), 0
    given, rng = EvaluationSweeps(others), np.random.default_rng(seed)
    for corruption in applicable(given):
        source = rng.permutation(len(others))[:EACH]
        x, severity = altered_copies(corruption, given, source, seed)
        right = np.array(others.materials)[others.labels[source]]
        shares = np.unique(severity) if corruption.name == "lost" else [0.0]
        for share in shares:
            of = severity == share if corruption.name == "lost" else np.ones(len(x), bool)
            yield "altered", x[of], right[of].tolist(), round(share * others.format.window)
