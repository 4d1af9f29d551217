"""Speed against accuracy, from the results of `development`: panels of tests of one kind, with the
time and the mean accuracy of every form of every method.

development_times measures the times: all models take turns in one process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate_studies import differences
from palpate_studies.development_experiment import LINE, OURS
from palpate_studies.differences import Estimate
from palpate_studies.method_names import plain_name
from palpate_train.models.methods import PACKAGED
from palpate_train.reports.formatting import percent, points

Json = Mapping[str, Any]
Accuracies = Mapping[str, Json]
"""Entries of one case by method."""
UNIT = "minirocket"
"""The method whose time is 1."""
ANSWER = "answer_ms"
"""Key of the median time of the box's whole answer, which peers do not have."""
LEAST_SHARE = 0.5
"""A method is on a panel if it was run in this share of its tests."""
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
TACTILE, SERIES = "real tactile sets", "published series that are not tactile"
"""The kinds of tests that have a panel. Simulated tests have none."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A method in one precision on a panel.

    form: "" for the method itself, else the name of its other precision. ms: median time of a
    sweep, of ours as the box answers it. accuracy: the mean over the tests that it was run in.
    lacks: names of the others. alone: the time of features and network.
    """

    method: str
    form: str
    precision: str
    ms: float
    accuracy: Estimate
    lacks: tuple[str, ...] = ()
    alone: float | None = None

    @property
    def mean(self) -> float:
        """Its mean accuracy."""
        return self.accuracy[0]


def _front(spots: Iterable[Spot]) -> list[Spot]:
    """The Pareto front of time and accuracy, the quickest first."""
    best: list[Spot] = []
    for spot in sorted(spots, key=lambda s: (s.ms, -s.mean)):
        if not best or spot.mean > best[-1].mean:
            best.append(spot)
    return best


@dataclass(frozen=True, slots=True)
class ChartPanel:
    """The methods on tests of one kind. cases: the tests as in the results. sweep: format of the
    sweeps that the methods were timed with."""

    kind: str
    cases: tuple[Json, ...]
    spots: tuple[Spot, ...]
    sweep: str = ""

    @property
    def whole(self) -> list[Spot]:
        """The spots of methods that were run in every test, the quickest first."""
        return sorted((spot for spot in self.spots if not spot.lacks), key=lambda s: s.ms)

    @property
    def answered(self) -> bool:
        """Whether our models were timed as the box answers."""
        return any(spot.alone for spot in self.spots)

    @property
    def front(self) -> list[Spot]:
        """The Pareto front of all forms."""
        return _front(self.whole)

    @property
    def sizes(self) -> list[Spot]:
        """The sizes of our family, the smallest first."""
        own = {spot.method: spot for spot in self.whole if not spot.form}
        return [own[name] for name in LINE if name in own]

    @property
    def line(self) -> list[Spot]:
        """The Pareto front of the packaged recipe and the sizes of our family."""
        packaged = [s for s in self.whole if s.method == PACKAGED and not s.form]
        return _front([*self.sizes, *packaged])

    @property
    def ours(self) -> Spot | None:
        """The largest of our family; None if it was not run in every test."""
        return self.sizes[-1] if self.sizes else None

    @property
    def peer(self) -> Spot | None:
        """The most accurate of the peers, chosen in hindsight."""
        peers = [spot for spot in self.whole if spot.method not in OURS]
        return max(peers, key=lambda s: s.mean, default=None)

    def lacking(self) -> dict[str, int]:
        """By method the number of tests that it was not run in, of the spots with gaps."""
        return {spot.method: len(spot.lacks) for spot in self.spots if spot.lacks}


def by_case(results: Iterable[Json]) -> dict[str, dict[str, Json]]:
    """{case: {method: entry}}."""
    table: dict[str, dict[str, Json]] = {}
    for entry in results:
        table.setdefault(entry["case"], {})[entry["method"]] = entry
    return table


def panels(figures: Json) -> list[ChartPanel]:
    """A panel for each kind of tests that has a timed method. Its times are of sweeps of its own
    kind; without these, of the simulated ones."""
    table, found = by_case(figures["results"]), []
    for kind in (TACTILE, SERIES):
        of_kind = (
            figures.get("panel_times", {}).get(kind) or figures.get("times") or {"entries": []}
        )
        timed = of_kind["entries"]
        cases = tuple(case for case in figures["cases"] if kind_of(case) == kind)
        spots = _spots(timed, table, cases)
        if spots:
            found.append(ChartPanel(kind, cases, tuple(spots), of_kind["format"]))
    return found


def kind_of(case: Json) -> str:
    """The kind of a test; "" for a simulated one."""
    name = case["case"].partition(", ")[0]
    return "" if case["simulated"] else SERIES if name in PUBLISHED else TACTILE


def _spots(
    timed: Iterable[Json], table: Mapping[str, Accuracies], cases: Sequence[Json]
) -> list[Spot]:
    """A spot for each timed form with an accuracy in enough of the cases, in the library in which
    it is quickest. A form of ours that does not ship has no whole answer, and no spot."""
    forms: dict[tuple[str, str], Json] = {}
    for one in sorted(timed, key=answer_ms):
        if not (one["method"] in OURS and one["form"]):
            forms.setdefault((one["method"], one["form"]), one)
    sets = {case["case"]: case["set"] for case in cases}
    found = []
    for (method, form), one in forms.items():
        entries = {
            case: entry
            for case in sets
            if (entry := _form(table.get(case, {}).get(method), form)) is not None
        }
        if entries and len(entries) >= LEAST_SHARE * len(sets):
            lacks = tuple(case for case in sets if case not in entries)
            middle = mean(entries, sets)
            about = method, form, one["precision"], answer_ms(one), middle, lacks
            found.append(Spot(*about, one["ms_p50"] if ANSWER in one else None))
    return found


def answer_ms(one: Json) -> float:
    """Median time of a sweep in ms: the whole answer of the box, or what a peer computes."""
    return float(one.get(ANSWER, one["ms_p50"]))


def _form(entry: Json | None, form: str) -> Json | None:
    """Accuracy of a method, or of its other precision `form`; None if it is missing."""
    return entry["forms"].get(form) if entry and form else entry


def mean(entries: Mapping[str, Json], sets: Mapping[str, str]) -> Estimate:
    """Mean of a method's accuracies by case, with its interval. sets: the set of each case. Errors
    of cases on one set are correlated."""
    groups: dict[str, list[Estimate]] = {}
    for case, figures in entries.items():
        groups.setdefault(sets[case], []).append(differences.of(figures))
    return differences.mean(groups)


def finding(panel: ChartPanel) -> str:
    """The panel in a sentence: our accuracy, and its distance to the best peer."""
    ours, peer = panel.ours, panel.peer
    if not ours:
        return "our largest size was not run in every test"
    said = f"Palpate {percent(ours.mean)}"
    if not peer:
        return said
    gap = ours.mean - peer.mean
    word = "ahead of" if gap >= 0 else "behind"
    return f"{said}, {points(abs(gap))} points {word} {plain_name(peer.method)}"


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


def quickest(times: Iterable[Json]) -> dict[str, float]:
    """Median time of a sweep in ms by method, in the precision and library in which it is
    quickest."""
    ms: dict[str, float] = {}
    for one in times:
        ms[one["method"]] = min(answer_ms(one), ms.get(one["method"], np.inf))
    return ms


def relative_times(times: Iterable[Json], names: Sequence[str]) -> dict[str, str]:
    """Time of a sweep with each method, relative to MiniRocket: "1/94" or "11"."""
    ms = quickest(times)
    unit = ms.get(UNIT)
    return {name: ratio(ms[name] / unit) for name in names if name in ms} if unit else {}


def ratio(value: float) -> str:
    """A ratio as a fraction or a whole number: "1/94" or "11"."""
    return f"1/{1 / value:.0f}" if value < 0.5 else f"{value:.2g}"
