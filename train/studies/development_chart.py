"""The results of `development` as a chart: dots and axes, as pareto has them.

Times are from development_times, for which all models took turns in one process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from train.studies import differences
from train.studies.differences import Estimate
from train.studies.method_names import family
from train.studies.pareto import COSTS, ChartAxis

Json = Mapping[str, Any]
Accuracies = Mapping[str, Json]
"""Entries of one case with all training sweeps, by method."""
MEAN = "development"
"""Key of the mean of lines, among a dot's accuracies."""
SHOWN = ("mean", "low", "high", "n", "seeds")
"""Decimals of an accuracy on the chart."""
UNIT = "minirocket"
"""The method whose time is 1."""
PROTOCOLS = {
    "leave:force": (
        "a force it never felt",
        "trained on sweeps of all forces but one, tested on that one, for each force in turn",
    ),
    "leave:speed": (
        "a speed it never felt",
        "trained on sweeps of all speeds but one, tested on that one, for each speed in turn",
    ),
    "leave:rep": (
        "a repetition it never felt",
        "trained on all recordings of a movement but one, tested on that one, for each in turn",
    ),
    "leave:direction": (
        "a direction it never felt",
        "trained on sweeps in all directions but one, tested on that one, for each in turn",
    ),
    "leave:position": (
        "a position it never felt",
        "trained on all positions of the skin but one, tested on that one, for each in turn",
    ),
    "split:split=0->1": (
        "published test part",
        "trained and tested on the parts that its publishers set",
    ),
}
"""By protocol: the question in few words, and the test in a sentence."""
PUBLISHED = {
    "ACSF1": "power drawn by household appliances",
    "OSULeaf": "outlines of leaves",
    "BasicMotions": "six signals of a wrist at rest, walking, running and playing badminton",
    "ArrowHead": "outlines of arrowheads",
    "GunPoint": "a hand that draws a gun or only points",
}
"""The published series, each in a few words."""


def plain_case(case: Json) -> str:
    """The test of a case in words: "7 fabrics: a force it never felt"."""
    protocol = PROTOCOLS.get(case["protocol"], (case["protocol"],))[0]
    return f"{case['case'].partition(', ')[0]}: {protocol}"


def about_case(case: Json) -> str:
    """The test of a case as a sentence without a full stop."""
    name = case["case"].partition(", ")[0]
    what = "simulated sweeps" if case["simulated"] else PUBLISHED.get(name, "real sweeps")
    return (
        f"{what}, {case['materials']} "
        f"classes: {PROTOCOLS.get(case['protocol'], ('', case['protocol']))[1]}"
    )


def axes(cases: Sequence[Json], shared: Sequence[str]) -> dict[str, ChartAxis]:
    """An axis of accuracy for the mean of the cases `shared` (by name), if there are any, and for
    each case."""
    of = {case["case"]: case for case in cases}
    mean = (
        {
            MEAN: ChartAxis(
                f"mean of {len(shared)} tests on real data",
                f"mean of {'; '.join(plain_case(of[name]) for name in shared)}",
                chance=float(np.mean([1 / of[name]["materials"] for name in shared])),
            )
        }
        if shared
        else {}
    )
    return mean | {
        name: ChartAxis(plain_case(case), about_case(case), chance=1 / case["materials"])
        for name, case in of.items()
    }


def dots(
    times: Iterable[Json],
    table: Mapping[str, Accuracies],
    cases: Sequence[Json],
    shared: Sequence[str],
) -> list[dict[str, Any]]:
    """A dot for each timed method and precision, with its accuracy on each of its cases and the
    mean over `shared`.

    Only a method with all of `shared` has a mean. A method without any accuracy gets no dot.
    """
    sets = {case["case"]: case["set"] for case in cases}
    found = []
    for one in times:
        rows = {
            case: _form(table.get(case, {}).get(one["method"]), one.get("form")) for case in sets
        }
        accuracy: dict[str, Json] = {
            case: {key: figures[key] for key in SHOWN} for case, figures in rows.items() if figures
        }
        if shared and all(case in accuracy for case in shared):
            accuracy[MEAN] = differences.entry(
                mean({case: accuracy[case] for case in shared}, sets)
            )
        if accuracy:
            found.append(
                {
                    **dict.fromkeys(COSTS),
                    **one,
                    "family": family(one["method"]),
                    "accuracy": accuracy,
                }
            )
    return found


def _form(figures: Json | None, form: str | None) -> Json | None:
    """Accuracy of a method, or of its other precision `form`; None if it is missing."""
    return figures["forms"].get(form) if figures and form else figures


def mean(entries: Mapping[str, Json], sets: Mapping[str, str]) -> Estimate:
    """Mean of a method's accuracies by case, with its interval. sets: the set of each case. Errors
    of cases on one set are correlated."""
    groups: dict[str, list[Estimate]] = {}
    for case, figures in entries.items():
        groups.setdefault(sets[case], []).append(differences.of(figures))
    return differences.mean(groups)


def quickest(times: Iterable[Json]) -> dict[str, float]:
    """Median time of a sweep in ms by method, in the precision and library in which it is
    quickest."""
    ms: dict[str, float] = {}
    for one in times:
        ms[one["method"]] = min(float(one["ms_p50"]), ms.get(one["method"], np.inf))
    return ms


def relative_times(times: Iterable[Json], names: Sequence[str]) -> dict[str, str]:
    """Time of a sweep with each method, relative to MiniRocket: "1/94" or "11"."""
    ms = quickest(times)
    unit = ms.get(UNIT)
    return {name: ratio(ms[name] / unit) for name in names if name in ms} if unit else {}


def ratio(value: float) -> str:
    """A ratio as a fraction or a whole number: "1/94" or "11"."""
    return f"1/{1 / value:.0f}" if value < 0.5 else f"{value:.2g}"
