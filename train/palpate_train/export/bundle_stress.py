"""Answers of a bundle to corrupted sweeps, through the classifier of the box, as curves like the
curves of robustness."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate_train.data.corruptions import Corruption, applicable
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.progress import Progress
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import robustness
from palpate_train.metrics import bundle_score

Array = NDArray[Any]
Json = dict[str, Any]
ANSWERS = ("correct", "wrong", "unsure", "unknown", "refused", "network")
"""The outcomes of a sweep: a label with status ok, or one of three ways to get none; and whether
the network alone is right, whose most probable label counts without the checks of the box."""


def under_corruptions(
    box: Classifier,
    test: EvaluationSweeps,
    seeds: Sequence[int],
    log: Callable[[str], None] = lambda line: None,
    corruptions: Sequence[Corruption] | None = None,
    wanted: Sequence[str] = ANSWERS,
) -> Json:
    """Curves by answer (wanted, of ANSWERS) and corruption, see robustness.merge; `falls` is of
    correctly classified sweeps.

    seeds: of the corruptions. corruptions: None for all that apply. Raises FormatError if the
    sweeps are not of the bundle's format, or have a material that it lacks.
    """
    manifest, sweeps = box.bundle.manifest, test.sweeps
    lacking = sorted({sweeps.materials[k] for k in np.unique(sweeps.labels)} - set(manifest.labels))
    if sweeps.format != manifest.format or lacking:
        raise FormatError(
            f"bundle {box.bundle.id} "
            f"({manifest.format}{', without ' * bool(lacking)}{', '.join(lacking)}) "
            f"cannot answer {sweeps.source} ({sweeps.format}); name another with --bundle"
        )
    alone = "network" in wanted
    clean, tasks = answers(box, sweeps, alone=alone), []
    corruptions = applicable(test) if corruptions is None else corruptions
    progress = Progress(len(seeds) * len(corruptions), log)
    for seed in seeds:
        trials = {answer: robustness.CorruptionCounts(test) for answer in wanted}
        for corruption in corruptions:
            progress.begin(f"{corruption.name} as the box answers, seed {seed}")
            found = [clean]
            for severity in corruption.severities[1:]:
                samples = corruption.apply(test, severity, seed)
                lost = round(severity * sweeps.format.window) * (corruption.name == "lost")
                altered = replace(sweeps, samples=samples)
                found.append(answers(box, altered, lost, alone=alone))
            for answer, counted in trials.items():
                counted.add(corruption, [given[answer] for given in found])
        tasks += [counted.task(answer, seed) for answer, counted in trials.items()]
    return {name: entry["curves"] for name, entry in robustness.merge(tasks)["methods"].items()}


def answers(
    box: Classifier, sweeps: Dataset, lost: int = 0, *, alone: bool = True
) -> dict[str, Array]:
    """The sweeps that get each of ANSWERS, bool [N] each; every sweep gets exactly one of the first
    five. lost: frames of each sweep that never arrived. alone: whether to ask the network alone,
    too."""
    given = bundle_score.outcomes_of(box, sweeps, lost=lost)
    given["correct"] = given.pop("right")
    if alone:
        labels, truth = np.array(box.bundle.manifest.labels), np.array(sweeps.materials)
        named = [int(box.logits(sweep).argmax()) for sweep in sweeps.samples]
        given["network"] = labels[named] == truth[sweeps.labels]
    return given
