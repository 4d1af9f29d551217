"""The room of the front. In: dots, as chart.json lists them. Out: which of them no other beats, and what axes there are.

What is drawn (scatter.py) and what can be chosen (explorer.py) is named here once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Dot = Mapping[str, Any]


@dataclass(frozen=True)
class Axis:
    """A figure that a chart may have on an axis. short: for a line of text; about: what it is. unit: "" for shares."""

    short: str
    about: str
    unit: str = ""


COSTS = {
    "ms_p50": Axis("time, median", "processor time of a sweep, features and model, one thread", "ms"),
    "ms_p99": Axis("time, 99 %", "what 99 of 100 sweeps do not exceed", "ms"),
    "macs": Axis(
        "multiply-adds", "multiply-accumulates of a sweep: the graph's, and the Fourier transforms of features"
    ),
    "file_kb": Axis("model file", "the model alone, 1000 bytes each", "KB"),
    "rss_mb": Axis("memory", "resident memory of a process that only classifies, 2^20 bytes each", "MB"),
    "touch_s": Axis(
        "touch time", "how much of the sweep is needed; the mean, where half a point is given for deciding early", "s"
    ),
    "weights": Axis("weights", "trained numbers"),
}
"""Less is better."""
ACCURACIES = {
    "hard": Axis("T-HARD, simulated", "trained on T-REAL, tested on twenty attachments of the skin never seen"),
    "lopo": Axis("T-REAL, simulated", "leave one position out"),
    "force": Axis("FabricSlide, force", "seven real fabrics without each window's means, leave a force out"),
    "speed": Axis("FabricSlide, speed", "seven real fabrics without each window's means, leave a speed out"),
    "stress": Axis("worst stress", "the stress that hurts it most, mean over its severities"),
    "stress:none": Axis("no stress", "the sweeps that are put under stress, as they are"),
    "stress:noise": Axis("noise", "white noise of .3 of each taxel's deviation"),
    "stress:dead": Axis("a dead taxel", "one taxel reads 0"),
    "stress:gain": Axis("gain ± 20 %", "all gains a fifth lower or higher, the worse of both"),
    "stress:lost": Axis("lost frames", "5 % of the frames lost"),
    "stress:shift": Axis("shift", "the skin one row of taxels further along"),
}
"""More is better; hard ones first."""


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of `points` (cost, accuracy) no other dominates: none costs at most as much and is at least as accurate,
    and better in one. Equal points stand or fall together."""
    return [not any(c <= cost and a >= accuracy and (c, a) != (cost, accuracy) for c, a in points)
            for cost, accuracy in points]  # fmt: skip


def placed(dots: Sequence[Dot], x: str, y: str) -> list[tuple[Dot, float, float, bool]]:
    """The dots that have both figures: (dot, cost, accuracy, whether it is on the front), cheapest first."""
    those = [dot for dot in dots if dot.get(x) is not None and y in dot["accuracy"]]
    at = [(float(dot[x]), float(dot["accuracy"][y]["mean"])) for dot in those]
    found = zip(those, at, front(at), strict=True)
    return sorted(((dot, *xy, best) for dot, xy, best in found), key=lambda p: (p[1], -p[2], name(p[0])))


def name(dot: Dot) -> str:
    """What a dot is called; no two of a chart share it."""
    return f"{dot['method']} {dot['precision']}" + ("" if dot["runtime"] == "onnx" else f" in {dot['runtime']}")
