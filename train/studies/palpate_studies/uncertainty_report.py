"""Renders the page of the study `certainty`: how far the box's probabilities can be trusted.

It computes nothing. Every sentence with a number takes it from the results, so it is true of each
run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_studies import TEMPLATES
from palpate_train.calibration.novelty import KEPT
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports import formatting, html, provenance
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    SMALL,
    round_ticks,
    set_ticks,
    single_axes,
    to_svg,
)

Json = Mapping[str, Any]
LINE: dict[str, Any] = {"color": ACCENT, "linewidth": 2.0, "marker": "o", "markersize": 3.5}
OTHER: dict[str, Any] = {
    "color": BLACK,
    "linewidth": 1.4,
    "linestyle": (0, (3, 1.5)),
    "marker": "o",
    "markersize": 2.5,
}
PALE: dict[str, Any] = {"color": GREY, "linewidth": 0.9}
ORIGIN = {
    "set": "trained on",
    "test": "tested on",
    "protocol": "protocol",
    "method": "method",
    "seed": "seed",
    "effort": "share of the usual training",
    "folds": "folds",
    "trainings": "trainings",
    "sweeps": "sweeps in all",
    "tested": "sweeps tested",
    "format": "skin",
    "digest": "digest of the sweeps",
    "commit": "commit",
    "machine": "machine",
    "took_s": "seconds that it took",
}
"""The run: names in the results and on the page."""
FLOORS = {0.0: 0.2, 0.5: 0.1, 0.8: 0.05, 0.9: 0.02, 0.95: 0.01}
"""Possible starts of an axis of shares, and the step of its ticks."""


def render(figures: Json) -> tuple[str, dict[str, str]]:
    """The page (HTML) and its pictures (SVG) by name."""
    pictures = {
        "reliability": reliability(figures),
        "touch": touch(figures),
    }
    heat, rules = figures["calibration"]["temperature"], figures["early"]["rules"]
    page = html.render(
        "uncertainty.html.j2",
        TEMPLATES,
        header=provenance.of(figures),
        home=html.HOME,
        figures=figures,
        shipped=(PACKAGED, SHIPPED),
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        tables=_tables(figures),
        worst=_worst(figures),
        temperature=" to ".join(dict.fromkeys(f"{t:.1f}" for t in (min(heat), max(heat)))),
        rules=_distinct(rule for rule in rules if not rule["why"]),
        off=[rule["why"] for rule in rules if rule["why"]],
        kept=KEPT,
        simulated=str(figures["set"]).startswith("sim:"),
        origin=[[text, figures[name]] for name, text in ORIGIN.items() if figures[name] != ""],
    )
    return page, pictures


def _worst(figures: Json) -> str:
    """The material that is most often taken for a known one; "" if no material was left out."""
    materials: Mapping[str, Json] = figures.get("unknown", {}).get("materials", {})
    if not materials:
        return ""
    name = max(materials, key=lambda one: materials[one]["false_known"])
    return f"{name}, {formatting.percent(materials[name]['false_known'])}"


def _tables(figures: Json) -> dict[str, list[list[str]]]:
    """The rows of each table."""
    tables = {
        "sequences": [
            [
                name,
                formatting.exact_percent(p["wanted"]),
                f"{p['sweeps']:.2f}",
                _share(p, "accuracy"),
                formatting.percent(p["decided"]),
            ]
            for name, sequence in figures["sequence"].items()
            for p in sequence["points"]
            if p["wanted"]
        ],
        "always": [
            [f"{tenth} of 10", _share(p, "accuracy")]
            for tenth, p in enumerate(figures["early"]["always"], 1)
        ],
    }
    return tables | _unknown_tables(figures) if "unknown" in figures else tables


def _unknown_tables(figures: Json) -> dict[str, list[list[str]]]:
    """The rows of the tables about materials left out of training."""
    of, mean = figures["unknown"], figures["unknown"]["mean"]
    shares = ("false_known", "kept", "auroc", "false_known_at_95")
    rows = [
        [
            name,
            *(_share(m, k) if k == "auroc" else formatting.percent(m[k]) for k in shares),
            f"{m['known']} / {m['unknown']}",
        ]
        for name, m in of["materials"].items()
    ]
    return {
        "unknown": [*rows, ["mean", *(formatting.percent(mean[k]) for k in shares), ""]],
        "limits": [
            [
                f"{row['factor']:g}",
                *(
                    formatting.percent(row[k])
                    for k in ("false_known", "kept", "false_known_twice", "kept_twice")
                ),
            ]
            for row in of["limits"]
        ],
        "scores": [[name, formatting.percent(value)] for name, value in of["scores"].items()],
        "enrolment": [
            [
                p["where"],
                str(p["sweeps"]),
                _share(p, "share"),
                formatting.percent(p["accuracy"]),
                formatting.percent(p["new"]),
                formatting.points(p["old_lost"]),
                str(p["draws"]),
            ]
            for p in figures["enrolment"]["points"]
        ],
    }


def _share(of: Json, name: str) -> str:
    """A share with its interval."""
    return formatting.estimate([of[name], of["low"], of["high"]])


def _distinct(rules: Iterable[Json]) -> list[Json]:
    """Each rule once, by rising probability."""
    pairs = sorted({(rule["least"], rule["agree"]) for rule in rules})
    return [{"least": least, "agree": agree} for least, agree in pairs]


def reliability(figures: Json) -> str:
    """Predicted probability against the share right, before and after temperature scaling."""
    figure, axes = _plot(3.1)
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.2)
    for name, look in (("before", OTHER), ("after", LINE)):
        bins = figures["calibration"][name]["bins"]
        predicted, right = [b["said"] for b in bins], [b["right"] for b in bins]
        n = [6 + 60 * (b["n"] / figures["calibration"]["n"]) ** 0.5 for b in bins]
        axes.plot(predicted, right, **(look | {"marker": ""}))
        axes.scatter(predicted, right, n, color=look["color"], zorder=3)
    _legend(axes, (("● after", ACCENT), ("╍ before", BLACK)))
    _frame(axes, (0, 1), (0, 1), "predicted probability", "classified correctly", percent=True)
    return to_svg(
        figure,
        "share right against the predicted probability, before and after temperature scaling",
    )


def touch(figures: Json) -> str:
    """Accuracy against the mean share of the sweep."""
    e = figures["early"]
    figure, axes = _plot(2.9)
    for points in e["curves"].values():
        axes.plot([p["share"] for p in points], [p["accuracy"] for p in points], **PALE)
    always = [a["accuracy"] for a in e["always"]]
    axes.plot([(d + 1) / len(always) for d in range(len(always))], always, **OTHER)
    axes.plot(e["share"], e["rule"]["accuracy"], "D", color=ACCENT, markersize=7, zorder=4)
    _legend(
        axes,
        (("◆ the rules found", ACCENT), ("╍ always at a tenth", BLACK), ("— other rules", GREY)),
    )
    others = [p["accuracy"] for points in e["curves"].values() for p in points]
    _frame(
        axes,
        (0, 1),
        (_floor([*always, *others]), 1),
        "mean share of the window",
        "classified correctly",
        percent=True,
    )
    return to_svg(figure, "accuracy against touch time")


def _plot(height: float) -> tuple[Figure, Axes]:
    """A picture of this height in inches with one plot, with room for a legend and the names of
    both axes."""
    return single_axes(height, left=0.15, right=0.97, top=0.35, bottom=0.5)


def _frame(
    axes: Axes,
    x: tuple[float, float],
    y: tuple[float, float],
    across: str,
    up: str,
    *,
    percent: bool = False,
) -> None:
    """Set limits, ticks, grid and the names of both axes. The vertical axis is always a share.

    percent: the horizontal axis is a share too.
    """
    (left, right), (low, high) = x, y
    margin = 0.03 * max(right - left, 1e-3)
    axes.set_xlim(left - margin, right + margin)
    axes.set_ylim(low, high + 0.02 * (high - low))
    axes.grid(color=FAINT, linewidth=0.6)
    set_ticks(axes.xaxis, round_ticks(left, right, 5), percent=percent)
    set_ticks(axes.yaxis, _steps(low), percent=True)
    axes.set_xlabel(across, color=GREY, size=SMALL)
    axes.set_ylabel(up, color=GREY, size=SMALL)


def _legend(axes: Axes, entries: Sequence[tuple[str, str]]) -> None:
    """Write names in their colours above the plot."""
    for i, (text, colour) in enumerate(entries):
        axes.annotate(
            text,
            (i / 3, 1),
            (0, 8),
            "axes fraction",
            textcoords="offset points",
            color=colour,
            size=SMALL + 0.5,
        )


def _floor(lows: Sequence[float]) -> float:
    """Start of an axis of shares: the highest of FLOORS below all values."""
    return max(floor for floor in FLOORS if floor <= max(min(lows, default=0), 0))


def _steps(floor: float) -> list[float]:
    """Ticks of an axis of shares that begins at one of FLOORS."""
    return [
        round(floor + k * FLOORS[floor], 3) for k in range(round((1 - floor) / FLOORS[floor]) + 1)
    ]
