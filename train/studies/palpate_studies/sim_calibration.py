"""The study `calibrate`: the paper's baselines on simulated sweeps beside its printed accuracies.

It measures the twenty accuracies of Figs. 4 to 7, their distance from the printed ones, and the
effect of each part of the simulator. Networks are not calibrated to, so their accuracies remain a
result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.sim import skin
from palpate_train.data import sets
from palpate_train.data.splitters import Protocol
from palpate_train.evaluate import parallel
from palpate_train.models import methods
from palpate_train.models.peers import baselines

Array = NDArray[Any]
METHODS = tuple(baselines.ESTIMATORS)
ATTACHMENTS = 5
"""Attachments of T-HARD in a seed. The paper has one, but the accuracy at a single attachment
varies much, so a seed's accuracy is a mean over several."""
LAB, REAL, HARD = 0, 1, tuple(range(2, 2 + ATTACHMENTS))
"""The sets that `draw` joins, by their number in the group "set"."""


@dataclass(frozen=True)
class Figure:
    """Accuracies that the paper prints: of METHODS in this order, on `sets` under `protocol`."""

    number: int
    name: str
    sets: tuple[int, ...]
    protocol: str
    printed: tuple[float, ...]


ROW_OFF = f"split:set={REAL}->{','.join(map(str, HARD))}"
FIGURES = (
    Figure(4, "T-LAB, random 10-fold", (LAB,), "random:10", (0.85, 0.82, 0.85, 0.90, 0.96)),
    Figure(
        5, "T-REAL, leave position out", (REAL,), "leave:position", (0.78, 0.77, 0.79, 0.75, 0.86)
    ),
    Figure(6, "T-REAL, random 9-fold", (REAL,), "random:9", (0.80, 0.80, 0.83, 0.85, 0.93)),
    Figure(7, "from T-REAL to T-HARD", (REAL, *HARD), ROW_OFF, (0.57, 0.58, 0.55, 0.50, 0.70)),
)
PRINTED = np.array([figure.printed for figure in FIGURES])
"""[figures, methods]"""


def draw(
    seed: int, world: skin.World = skin.WORLD, per_material: int | None = None
) -> sets.Dataset:
    """T-LAB, T-REAL and ATTACHMENTS times T-HARD of one seed, joined in this order.

    Equal seeds draw the same positions, attachments and noise in every world, so worlds can be
    compared. per_material: sweeps of each tube at each position; None for the paper's count.
    """
    parts = []
    hard: list[tuple[skin.SetName, int]] = [
        ("T-HARD", ATTACHMENTS * seed + i) for i in range(ATTACHMENTS)
    ]
    named: list[tuple[skin.SetName, int]] = [("T-LAB", seed), ("T-REAL", seed), *hard]
    for name, its_seed in named:
        samples, labels, position = skin.sweep_set(name, its_seed, per_material, world)
        groups = {"position": position}
        parts.append(
            sets.Dataset(
                samples, labels, skin.MATERIALS, skin.FORMAT.rate_hz, groups, f"{name}:{its_seed}"
            )
        )
    return sets.join(parts)


def accuracies(sweeps: sets.Dataset, seed: int) -> Array:
    """The accuracies, float64 [figures, methods], on the sets of `draw`. seed: of the random
    folds."""
    inputs = {kind: methods.model_inputs(kind, sweeps) for kind in ("L", "H")}
    shares = np.zeros(PRINTED.shape)
    for i, figure in enumerate(FIGURES):
        inside = np.isin(sweeps.group("set"), figure.sets)
        part = sweeps.take(inside)
        folds = Protocol(figure.protocol).folds(part, seed)
        for j, name in enumerate(METHODS):
            right = _right(baselines.ESTIMATORS[name], inputs[name[0]][inside], part.labels, folds)
            shares[i, j] = right / sum(len(test) for _, test in folds)
    return shares


def _right(
    make: Callable[[], baselines.Estimator],
    features: Array,
    labels: Array,
    folds: Sequence[tuple[Array, Array]],
) -> int:
    """Number of right answers of all folds, from the estimator itself: labels need neither
    temperature nor graph."""
    features = features.astype(np.float64)
    return sum(
        int(
            (
                make().fit(features[train], labels[train]).predict(features[test]) == labels[test]
            ).sum()
        )
        for train, test in folds
    )


def measure(
    seeds: Sequence[int],
    ablate: bool,
    log: Callable[[str], None] = lambda line: None,
    world: skin.World = skin.WORLD,
    jobs: int = -1,
    per_material: int | None = None,
) -> dict[str, Any]:
    """The twenty accuracies, means over `seeds`, ready for JSON; with `ablate` also without each
    effect.

    jobs: processes, -1 for one on each core; results do not depend on it.
    """
    worlds = {"": world} | {
        e: replace(world, off=world.off | {e}) for e in (skin.EFFECTS if ablate else ())
    }
    tasks = [(without, seed) for without in worlds for seed in seeds]
    progress = parallel.Progress(len(tasks), log)
    done: dict[tuple[str, int], Array] = {}
    for task, shares in parallel.results(_accuracies, tasks, (worlds, per_material), jobs):
        done[task] = shares
        progress(f"seed {task[1]}" + (f" without {task[0]}" if task[0] else ""))
    by_seed = {without: np.array([done[without, seed] for seed in seeds]) for without in worlds}
    ours = by_seed[""].mean(axis=0)
    return {
        "seeds": list(seeds),
        "attachments": ATTACHMENTS,
        "methods": list(METHODS),
        "figures": [figure.name for figure in FIGURES],
        "printed": PRINTED.tolist(),
        "ours": ours.tolist(),
        "spread": by_seed[""].std(axis=0).tolist(),
        **_match(ours),
        "without": {
            effect: {
                "ours": without.mean(axis=0).tolist(),
                **_match(without.mean(axis=0)),
                "change": (without.mean(axis=0) - ours).tolist(),
                "error": _standard_error(without - by_seed[""]).tolist(),
            }
            for effect, without in by_seed.items()
            if effect
        },
    }


def _accuracies(
    task: tuple[str, int], worlds: dict[str, skin.World], per_material: int | None
) -> Array:
    without, seed = task
    return accuracies(draw(seed, worlds[without], per_material), seed)


def _match(ours: Array) -> dict[str, Any]:
    away = ours - PRINTED
    return {
        "difference": away.tolist(),
        "largest": float(abs(away).max()),
        "mean": float(abs(away).mean()),
    }


def _standard_error(values: Array) -> Array:
    """Standard error of the mean over the first axis; 0 for a single value."""
    error: Array = values.std(axis=0) / np.sqrt(max(len(values) - 1, 1))
    return error


def table(result: dict[str, Any]) -> str:
    """The results of `measure` for a person: each accuracy as printed, ours with its spread over
    seeds, and the difference.

    Below, for effects that were switched off: the change of each accuracy, in hundredths.
    """
    names = [name.ljust(20) for name in result["methods"]]
    text = [(" " * 32 + "".join(names)).rstrip()]
    for name, *rows in zip(
        *(result[k] for k in ("figures", "printed", "ours", "spread", "difference")), strict=True
    ):
        cells = [
            f"{_short(p, '.2f')} {_short(o, '.3f')}±{_short(s, '.3f')} {_short(d, '+.2f')}"
            for p, o, s, d in zip(*rows, strict=True)
        ]
        text.append((name.ljust(32) + "".join(cell.ljust(20) for cell in cells)).rstrip())
    text.append(
        f"{_difference(result)}; {len(result['seeds'])} seeds, {result['attachments']} "
        "attachments of T-HARD each"
    )
    if result["without"]:
        text += [
            "",
            ("without".ljust(12) + "".join(name.ljust(28) for name in result["figures"])).rstrip(),
        ]
    for effect, entry in result["without"].items():
        changes = "".join(
            "".join(f"{100 * v:+4.0f}" for v in row).ljust(28) for row in entry["change"]
        )
        text.append(f"{effect:<12}{changes}{_difference(entry)}")
    return "\n".join(text)


def _short(value: float, form: str) -> str:
    return f"{value:{form}}".replace("0.", ".", 1)


def _difference(match: dict[str, Any]) -> str:
    return (
        f"largest difference {_short(match['largest'], '.3f')}, mean {_short(match['mean'], '.3f')}"
    )
