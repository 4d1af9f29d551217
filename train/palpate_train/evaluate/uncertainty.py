"""Uncertainty of answers: calibration error, and detection of materials that were not trained.

All figures are of test sweeps that nothing was fitted to. Intervals are 95 %, from a bootstrap over
the placements of the skin, since the errors of sweeps at one placement are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.answer.embedding import auroc
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.uncertainty_cases import Case, CaseTask, Log, cases, train_and_test
from palpate_train.models import methods
from palpate_train.models.methods import Effort

Array = NDArray[Any]
Json = dict[str, Any]
SEED = 1
BINS = 10
"""Bins of the reliability diagram and of the calibration error."""
DRAWS = 500
"""Draws of the bootstrap."""


def trained(
    train: Dataset,
    test: Dataset,
    method: str,
    where: Where,
    log: Log,
    effort: Effort = methods.FULL_EFFORT,
) -> Case:
    """One training on all of `train`, with the sweeps of `test`. Raises FormatError if the sets do
    not fit together, or if the method has no features to judge novelty by."""
    both, seen, new = train_and_test(train, test)
    return cases([CaseTask(method, effort, SEED, seen, new)], both, where, log)[0]


def left_out(whole: Case, materials: Sequence[str]) -> Json:
    """`unknown` of the test sweeps if each material in turn is left out of heads, embedding and
    limits of a training on all. One training suffices: its features are chosen with all
    materials."""
    return unknown(map(whole.without, range(len(materials))), materials)


def error(confidence: Array, right: Array) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over sweeps of |accuracy - probability|
    of their bin."""
    bins = reliability(confidence, right)
    return float(
        sum(b["n"] * abs(b["right"] - b["said"]) for b in bins) / max(sum(b["n"] for b in bins), 1)
    )


def reliability(confidence: Array, right: Array) -> list[Json]:
    """For each non-empty bin of the highest probability [n]: its mean (`said`), the share of right
    answers, and their number."""
    which = np.minimum((confidence * BINS).astype(int), BINS - 1)
    some = [(which == b) for b in range(BINS) if (which == b).any()]
    return [
        {
            "said": round(float(confidence[i].mean()), 4),
            "right": round(float(right[i].mean()), 4),
            "n": int(i.sum()),
        }
        for i in some
    ]


def unknown(without: Iterable[Case], materials: Sequence[str]) -> Json:
    """Detection of a material that was left out of training, by material and as their mean.

    Gives the AUROC of known test sweeps against sweeps of the material, the share of known sweeps
    below the limit found in training, and of unknown sweeps that pass as known.
    """
    found: dict[str, Json] = {}
    for case in without:
        embedding, limits = case.novelty()
        scores = embedding.novelty(case.new[:, -1]) / limits.balanced
        found[materials[case.left_out]] = _detection(scores, case.known(), case.places)
    mean = {
        name: round(float(np.mean([row[name] for row in found.values()])), 4)
        for name in ("auroc", "kept", "false_known", "false_known_at_95")
    }
    return {"materials": found, "mean": mean}


def _detection(scores: Array, known: Array, places: Array) -> Json:
    """Figures of one material by its `scores` in units of the limit [n]. known: bool [n]."""
    low, high = bootstrap(partial(_auroc_of, scores, known), places)
    at = np.quantile(scores[known], 0.95)
    return {
        "auroc": round(auroc(scores[known], scores[~known]), 4),
        "low": low,
        "high": high,
        "kept": round(float(np.mean(scores[known] <= 1)), 4),
        "false_known": round(float(np.mean(scores[~known] <= 1)), 4),
        "false_known_at_95": round(float(np.mean(scores[~known] <= at)), 4),
        "known": int(known.sum()),
        "unknown": int((~known).sum()),
    }


def _auroc_of(scores: Array, known: Array, some: Array) -> float:
    return auroc(scores[some][known[some]], scores[some][~known[some]])


def bootstrap(figure: Callable[[Array], float], clusters: Array) -> tuple[float, float]:
    """The 95 % interval of `figure`, a function of sweep numbers, from a bootstrap of clusters
    [n]."""
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    rng, drawn = np.random.default_rng(0), []
    for _ in range(DRAWS):
        with suppress(FormatError):  # a draw that lacks a kind of sweep has no figure
            drawn.append(
                figure(
                    np.concatenate(
                        [members[c] for c in rng.integers(len(members), size=len(members))]
                    )
                )
            )
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (0.0, 1.0)
    return round(float(low), 4), round(float(high), 4)
