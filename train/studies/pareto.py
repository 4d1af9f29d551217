"""The Pareto front of the chart, and its axes.

A network may be measured in several forms: in float and in int8, by the box's runtime and by its
own library. It is shown once, in the cheapest form. scatter draws the spots; chart_page lets a
reader choose axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

from appliance.sim.skin import MATERIALS
from train.models.methods import SHIPPED
from train.studies.method_names import OURS, plain_name

Dot = Mapping[str, Any]


@dataclass(frozen=True)
class ChartAxis:
    """A figure that can be on an axis.

    short: its name. about: its meaning in a sentence. unit: "" for shares and counts. chance: of an
    accuracy, that of guessing.
    """

    short: str
    about: str
    unit: str = ""
    chance: float = 0.0


COSTS = {
    "ms_p50": ChartAxis(
        "time per sweep, one core",
        "processor time, checks and features included; the median sweep",
        "ms",
    ),
    "ms_p99": ChartAxis("longest time", "processor time that 99 of 100 sweeps stay within", "ms"),
    "macs": ChartAxis(
        "multiply-adds",
        "multiplications of a sweep, each with its addition: the graph's, and the Fourier "
        "transforms of features",
    ),
    "file_kb": ChartAxis("model file", "the model alone, 1000 bytes each", "KB"),
    "rss_mb": ChartAxis(
        "memory", "resident memory of a process that only names sweeps, 2^20 bytes each", "MB"
    ),
    "touch_s": ChartAxis(
        "how long it must touch",
        "the part of a sweep that it needs: all of it, or less where it may answer early at a "
        "loss of half a point",
        "s",
    ),
    "weights": ChartAxis("weights", "numbers found by training"),
}
"""Costs: less is better."""
TUBES, FABRICS = 1 / len(MATERIALS), 1 / 7
"""Accuracy of guessing on the simulated tubes, and on the fabrics of FabricSlide in the chart."""
ACCURACIES = {
    "speed": ChartAxis(
        "a speed it never felt",
        "seven real fabrics (FabricSlide): trained on sweeps of all speeds but one, tested on "
        "that one, for each in turn",
        chance=FABRICS,
    ),
    "force": ChartAxis(
        "a force it never felt",
        "seven real fabrics (FabricSlide): trained on sweeps of all forces but one, tested on "
        "that one, for each in turn",
        chance=FABRICS,
    ),
    "lopo": ChartAxis(
        "a position it never felt (simulated)",
        "six simulated tubes (T-REAL): the skin sits in nine slightly different positions, each "
        "left out of training in turn",
        chance=TUBES,
    ),
    "hard": ChartAxis(
        "skin taken off and put back (simulated)",
        "six simulated tubes (T-HARD): trained on one skin, tested after it was taken off and "
        "put back, twenty times",
        chance=TUBES,
    ),
    "stress": ChartAxis(
        "the disturbance that hurts it most (simulated)",
        "six simulated tubes, new positions: of each method its own worst disturbance, mean from "
        "mild to severe",
        chance=TUBES,
    ),
} | {
    f"stress:{key}": ChartAxis(
        f"{short} (simulated)", f"six simulated tubes, new positions: {about}", chance=TUBES
    )
    for key, (short, about) in {
        "none": ("no disturbance", "the same sweeps as in the next lines, undisturbed"),
        "noise": ("noise", "white noise of 0.3 of each taxel's standard deviation"),
        "dead": ("a dead taxel", "one taxel reads 0"),
        "noisy": (
            "a noisy taxel",
            "white noise on one taxel, four times the standard deviation of the set",
        ),
        "gain": (
            "20 % more or less gain",
            "all signals 20 % weaker or stronger, the worse of both",
        ),
        "lost": ("lost frames", "5 % of the frames are lost"),
        "drift": ("drift", "the offset drifts by a tenth of full load within a sweep"),
        "hum": ("mains hum", "50 Hz on all taxels, as strong as the signal's standard deviation"),
        "shift": ("skin shifted by a row", "the skin sits one row of taxels further along"),
    }.items()
}
"""Accuracies: more is better. Real sets come first."""


@dataclass(frozen=True)
class Spot:
    """A network on the chart.

    dot: the cheapest form. x: its cost. y: its accuracy. best: whether it is on the front. methods:
    all methods with this network. on_box: whether the box can run a form of it. other: cost and
    accuracy in the other precision, float or int8, if it was measured.
    """

    dot: Dot
    x: float
    y: float
    methods: frozenset[str]
    on_box: bool
    other: tuple[float, float] | None = None
    best: bool = False


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """For each of `points` (cost, accuracy), whether it is on the Pareto front.

    A point is dominated by another point that is not worse in both figures and better in one. Equal
    points are all on the front, or all behind it.
    """
    return [
        not any(c <= cost and a >= accuracy and (c, a) != (cost, accuracy) for c, a in points)
        for cost, accuracy in points
    ]


def placed(dots: Sequence[Dot], x: str, y: str) -> list[Spot]:
    """A spot for each network with both figures, the cheapest first."""
    forms: dict[int, list[Dot]] = {}
    for network, dot in zip(networks(dots), dots, strict=True):
        if dot.get(x) is not None and y in dot["accuracy"]:
            forms.setdefault(network, []).append(dot)
    spots = [_spot(there, x, y) for there in forms.values()]
    best = front([(spot.x, spot.y) for spot in spots])
    made = [replace(spot, best=leads) for spot, leads in zip(spots, best, strict=True)]
    return sorted(made, key=lambda spot: (spot.x, -spot.y, name(spot.dot)))


def _spot(forms: Sequence[Dot], x: str, y: str) -> Spot:
    """The spot of one network, whose forms all have both figures."""
    by_cost = sorted(forms, key=lambda dot: (dot[x], dot["precision"] != "int8"))
    other = next((dot for dot in by_cost if dot["precision"] != by_cost[0]["precision"]), None)
    return Spot(
        by_cost[0],
        *_at(by_cost[0], x, y),
        frozenset(dot["method"] for dot in forms),
        any(dot["runs_on_box"] for dot in forms),
        _at(other, x, y) if other else None,
    )


def _at(dot: Dot, x: str, y: str) -> tuple[float, float]:
    return float(dot[x]), float(dot["accuracy"][y]["mean"])


def networks(dots: Sequence[Dot]) -> list[int]:
    """For each dot the number of the first dot of the same network.

    Forms of a method are one network. Two methods of ours are one network if they have the same
    weights and operations, and equal counts of right answers under every common protocol.
    """
    first: dict[str, int] = {}
    of = [first.setdefault(dot["method"], i) for i, dot in enumerate(dots)]
    for i, j in combinations(range(len(dots)), 2):
        if of[i] < of[j] and _same(dots[i], dots[j]):
            of = [of[i] if network == of[j] else network for network in of]
    return of


def _same(one: Dot, other: Dot) -> bool:
    both = one["accuracy"].keys() & other["accuracy"].keys()
    return (
        one["family"] == other["family"] == OURS
        and all(
            one.get(key) is not None and one[key] == other.get(key)
            for key in ("weights", "macs", "precision")
        )
        and bool(both)
        and all(one["accuracy"][key]["mean"] == other["accuracy"][key]["mean"] for key in both)
    )


def subject(dots: Sequence[Dot]) -> str:
    """The method that stands out: ours with all views; "" if it is not there."""
    return SHIPPED if any(dot["method"] == SHIPPED for dot in dots) else ""


def name(dot: Dot) -> str:
    """A dot's name in commands, unique in a chart."""
    return f"{dot['method']} {dot['precision']}" + (
        "" if dot["runtime"] == "onnx" else f" in {dot['runtime']}"
    )


def label(dot: Dot, short: bool = False) -> str:
    """A network's name for people. short: without "Palpate", for pictures in which colour marks
    ours."""
    full = plain_name(str(dot["method"]))
    return full.removeprefix(f"{OURS}, ") if short else full
