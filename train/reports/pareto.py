"""The Pareto front of the chart, and its axes. In: dots, as chart.json lists them. Out: which of them no other dominates.

scatter draws them, chart_page lets a reader choose among them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Dot = Mapping[str, Any]


@dataclass(frozen=True)
class Axis:
    """A figure that can be on an axis. short: its name; about: what it is; unit: "" for shares and counts."""

    short: str
    about: str
    unit: str = ""


COSTS = {
    "ms_p50": Axis("time, median", "processor time of a sweep, features and model, one thread", "ms"),
    "ms_p99": Axis("time, 99 %", "the time that 99 % of the sweeps do not exceed", "ms"),
    "macs": Axis(
        "multiply-adds", "multiply-accumulates of a sweep: the graph's, and the Fourier transforms of features"
    ),
    "file_kb": Axis("model file", "the model alone, 1000 bytes each", "KB"),
    "rss_mb": Axis("memory", "resident memory of a process that only classifies, 2^20 bytes each", "MB"),
    "touch_s": Axis(
        "touch time", "mean part of the sweep that is needed where deciding early may cost half a point", "s"
    ),
    "weights": Axis("weights", "numbers found by training"),
}
"""Less is better."""
ACCURACIES = {
    "development": Axis("mean of development sets", "mean over real and published sets, each under its protocol"),
    "speed": Axis("FabricSlide, speed", "seven real fabrics without each window's means, leave a speed out"),
    "force": Axis("FabricSlide, force", "seven real fabrics without each window's means, leave a force out"),
    "lopo": Axis("T-REAL, simulated", "leave one position out"),
    "hard": Axis("T-HARD, simulated", "trained on T-REAL, tested on twenty attachments of the skin not in training"),
    "stress": Axis("worst stress", "the stress that costs it most accuracy, mean over severities"),
    "stress:none": Axis("no stress", "the same sweeps without stress"),
    "stress:noise": Axis("noise", "white noise of 0.3 of each taxel's standard deviation"),
    "stress:dead": Axis("a dead taxel", "one taxel reads 0"),
    "stress:noisy": Axis("a noisy taxel", "white noise on one taxel, of four of the set's standard deviations"),
    "stress:gain": Axis("gain ± 20 %", "all gains 20 % lower or higher, the worse of both"),
    "stress:lost": Axis("lost frames", "5 % of the frames lost"),
    "stress:drift": Axis("drift", "the offset drifts by a tenth of full load within a sweep"),
    "stress:hum": Axis("hum", "50 Hz on all taxels, of one standard deviation of the signal"),
    "stress:shift": Axis("shift", "the skin one row of taxels further along"),
}
"""More is better; real ones first."""


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of `points` (cost, accuracy) no other dominates, that is, costs no more, is no less accurate, and better in one.

    Equal points are all on the front or all behind it.
    """
    return [not any(c <= cost and a >= accuracy and (c, a) != (cost, accuracy) for c, a in points)
            for cost, accuracy in points]  # fmt: skip


def placed(dots: Sequence[Dot], x: str, y: str) -> list[tuple[Dot, float, float, bool]]:
    """The dots that have both figures: (dot, cost, accuracy, whether it is on the front), cheapest first."""
    those = [dot for dot in dots if dot.get(x) is not None and y in dot["accuracy"]]
    at = [(float(dot[x]), float(dot["accuracy"][y]["mean"])) for dot in those]
    found = zip(those, at, front(at), strict=True)
    return sorted(((dot, *xy, best) for dot, xy, best in found), key=lambda p: (p[1], -p[2], name(p[0])))


def name(dot: Dot) -> str:
    """A dot's name, unique in a chart."""
    return f"{dot['method']} {dot['precision']}" + ("" if dot["runtime"] == "onnx" else f" in {dot['runtime']}")
