"""Stamps of the paper's figures: reproduced or not.

Each rule was fixed before the run that it judges.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from palpate_studies.paper_values import ACCURACY, CNN, CONFUSION, COST, FIGURES, SEVERAL
from palpate_train.metrics.score import row_shares

Array = NDArray[Any]
FIVE = ("L-gauss", "L-knn", "L-svm", "H-knn", "H-svm")
BEST = "H-svm"
NEAR = 0.06
"""Greatest difference of an accuracy from the printed one, if it is reproduced."""
NEAR_SEVERAL = 0.04
"""The same after several sweeps."""
LEAST_LEAD = 0.5
"""Least share of the CNN's printed lead over BEST."""
COST_FACTOR = 3.0
"""Greatest ratio of a training cost to the printed one, either way."""
LEAST_CORRELATION = 0.5
"""Least rank correlation of our confusions with those that are printed."""
VERDICTS = {True: "reproduced", False: "not reproduced", None: "no result"}
"""The word of a stamp by `Stamp.reproduced`."""
SUBJECTS = {
    **dict.fromkeys(FIGURES.values(), "the accuracy of spectral features"),
    9: "the cost of the CNN’s training",
    10: "the accuracy of the CNN and its lead",
    11: "what the CNN takes for what",
    12: "what H-svm recognises least",
    13: "the gain by several sweeps",
}
LEAST_RECOGNISED = ("metal", "wood", "paper")
"""Fig. 12, as the text of the paper describes it."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """The stamp of a figure. reproduced: None without a result. why: the comparison, as a clause
    with its numbers."""

    figure: int
    reproduced: bool | None
    why: str

    @property
    def word(self) -> str:
        """The text of the stamp."""
        return VERDICTS[self.reproduced]


def stamps(summary: Mapping[str, Any]) -> dict[int, Stamp]:
    """The stamps of Figs. 4 to 7 and 9 to 13 by number."""
    shares = {(row["part"], row["method"]): row["share"][0] for row in summary["table"]}
    names = summary["results"][0]["materials"]
    made = [_bars(number, part, shares) for part, number in FIGURES.items()]
    if ("lopo", CNN) in shares:
        made += [
            _cost([np.array(cost) for cost in summary["costs"][CNN]]),
            _lead(shares),
            _confusions(np.array(summary["confusion"][CNN])),
        ]
    made += [_least(np.array(summary["confusion"][BEST]), names), _several(summary["several"])]
    return {stamp.figure: stamp for stamp in sorted(made, key=lambda stamp: stamp.figure)}


def by_subject(made: Mapping[int, Stamp], reproduced: bool | None) -> list[tuple[str, str]]:
    """The subjects with this result, each with its figures: ("Figs. 4, 5", subject)."""
    numbers: dict[str, list[int]] = {}
    for stamp in made.values():
        if stamp.reproduced is reproduced:
            numbers.setdefault(SUBJECTS[stamp.figure], []).append(stamp.figure)
    return [
        (f"Fig{'s' * (len(those) > 1)}. {', '.join(map(str, those))}", subject)
        for subject, those in numbers.items()
    ]


def _bars(number: int, part: str, shares: Mapping[tuple[str, str], float]) -> Stamp:
    away = [abs(shares[part, m] - ACCURACY[part][m]) for m in FIVE if (part, m) in shares]
    why = f"the five methods differ by {100 * max(away):.1f} points at most"
    return Stamp(number, max(away) <= NEAR, why)


def _cost(costs: Sequence[Array]) -> Stamp:
    """Costs [n, 2] of each training, read between its points on logarithmic axes."""
    ours = [
        float(
            np.exp(
                np.median([np.interp(np.log(at), *np.log(np.maximum(c, 1e-9)).T) for c in costs])
            )
        )
        for at, _ in COST
    ]
    if any(cost[-1, 0] < COST[-1][0] for cost in costs):
        return Stamp(9, None, "the training is not finished")
    near = all(
        1 / COST_FACTOR <= mine / printed <= COST_FACTOR
        for mine, (_, printed) in zip(ours, COST, strict=True)
    )
    why = ", ".join(
        f"after {at} iterations {mine:.2g} where {printed:g} is printed"
        for mine, (at, printed) in zip(ours, COST, strict=True)
    )
    return Stamp(9, near, "the training cost is, " + why)


def _lead(shares: Mapping[tuple[str, str], float]) -> Stamp:
    reproduced, told = True, []
    for part, name in (("lopo", "new positions"), ("hard", "T-HARD")):
        ours, printed = shares[part, CNN], ACCURACY[part][CNN]
        lead, lead_printed = ours - shares[part, BEST], printed - ACCURACY[part][BEST]
        reproduced &= abs(ours - printed) <= NEAR and lead >= LEAST_LEAD * lead_printed
        told.append(
            f"{100 * ours:.1f} % on {name} ({100 * printed:.1f} printed), "
            f"{100 * lead:.1f} points ahead of {BEST} ({100 * lead_printed:.1f} printed)"
        )
    return Stamp(10, reproduced, "the CNN has " + " and ".join(told))


def correlation(confusion: Array) -> float:
    """Spearman's rank correlation of the shares off the diagonal of counts [K, K] with Fig. 11;
    0 if nothing is confused."""
    rows = row_shares(confusion)
    off = ~np.eye(len(rows), dtype=bool)
    if np.ptp(rows[off]) == 0:
        return 0.0
    return float(spearmanr(rows[off], CONFUSION[off]).statistic)


def _confusions(confusion: Array) -> Stamp:
    rank = correlation(confusion)
    why = f"the rank correlation of what is taken for what is {rank:.2f}"
    return Stamp(11, rank >= LEAST_CORRELATION, why)


def _least(confusion: Array, names: Sequence[str]) -> Stamp:
    order = np.argsort(np.diag(row_shares(confusion)), kind="stable")
    least = [names[i] for i in order[: len(LEAST_RECOGNISED)]]
    why = f"{BEST} recognises {', '.join(least)} least"
    return Stamp(12, set(least) == set(LEAST_RECOGNISED), why)


def _several(several: Mapping[str, Any]) -> Stamp:
    """Two and three sweeps; ours by product (a vote of two cannot gain)."""
    away, told = [], []
    for method, printed in SEVERAL.items():
        if method not in several:
            return Stamp(13, None, f"{method} was not run")
        pairs = [
            (n, estimate[0], value)
            for n, (estimate, value) in enumerate(
                zip(several[method]["product"], printed, strict=True), 1
            )
            if n > 1 and value is not None
        ]
        away += [abs(ours - value) for _, ours, value in pairs]
        said = (f"{100 * o:.1f} % after {n} sweeps ({100 * v:.1f} printed)" for n, o, v in pairs)
        told.append(f"{method} has " + " and ".join(said))
    return Stamp(13, max(away) <= NEAR_SEVERAL, "; ".join(told))
