"""Renders the page of the study `certainty`: how far the box's probabilities can be trusted.

It computes nothing. Every sentence with a number takes it from the results, so it is true of each
run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
TARGETS = {
    "unknown": 0.97,
    "kept": 0.97,
    "false_known": 0.10,
    "enrolment": 0.90,
    "early": 0.5,
    "lost": 0.005,
}
"""Targets: AUROC; shares of known sweeps kept and of unknown sweeps let through at the limit; share
of the full accuracy after five sweeps of enrolment; share of the sweep for early answers, and their
loss of accuracy."""
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
        "sweeps": sweeps(figures),
        "touch": touch(figures),
    }
    if "unknown" in figures:
        pictures |= {"unknown": unknown(figures), "enrolment": enrolment(figures)}
    heat, rules = figures["calibration"]["temperature"], figures["early"]["rules"]
    targets = list(_targets(figures))
    page = html.render(
        "uncertainty.html.j2",
        TEMPLATES,
        header=provenance.of(figures),
        home=html.HOME,
        figures=figures,
        shipped=(PACKAGED, SHIPPED),
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        tables=_tables(figures),
        targets=targets,
        reached=sum(row["met"] for row in targets),
        missed=[
            f"{row['what']}, {row['here']} (wanted {row['target']})"
            for row in targets
            if not row["met"]
        ],
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


def _targets(figures: Json) -> Iterator[Json]:
    """Each target with the measured figure."""
    before, after = (figures["calibration"][when]["error"] for when in ("before", "after"))
    yield {
        "what": "calibration error after temperature scaling",
        "target": f"≤ {formatting.percent(before)}, that before",
        "here": formatting.percent(after),
        "met": after <= before,
    }
    if "unknown" in figures:
        yield from _unknown_targets(figures)
    early = figures["early"]
    yield {
        "what": "part of the window that is needed, mean, with early answers",
        "target": "≤ 50 %",
        "here": formatting.percent(early["share"]),
        "met": early["share"] <= TARGETS["early"],
    }
    yield {
        "what": "points of accuracy that early answers cost",
        "target": "≤ 0.5",
        "here": formatting.points(early["lost"]),
        "met": early["lost"] <= TARGETS["lost"],
    }


def _unknown_targets(figures: Json) -> Iterator[Json]:
    """The targets for materials left out of training."""
    mean = figures["unknown"]["mean"]
    yield {
        "what": "unknown and known sweeps told apart, AUROC, mean of the materials",
        "target": "≥ 97 %",
        "here": formatting.percent(mean["auroc"]),
        "met": mean["auroc"] >= TARGETS["unknown"],
    }
    yield {
        "what": "known sweeps kept: not called unknown",
        "target": "≥ 97 %",
        "here": formatting.percent(mean["kept"]),
        "met": mean["kept"] >= TARGETS["kept"],
    }
    yield {
        "what": "sweeps of unknown materials that get a known name",
        "target": "≤ 10 %",
        "here": formatting.percent(mean["false_known"]),
        "met": mean["false_known"] <= TARGETS["false_known"],
    }
    (limit,) = (one for one in figures["unknown"]["limits"] if one["factor"] == 1)
    yield {
        "what": "the same where two sweeps must agree "
        f"({formatting.percent(limit['kept_twice'])} of known ones kept)",
        "target": "≤ 10 %",
        "here": formatting.percent(limit["false_known_twice"]),
        "met": limit["false_known_twice"] <= TARGETS["false_known"],
    }
    for point in figures["enrolment"]["points"]:
        if point["sweeps"] == 5:
            yield {
                "what": f"a material enrolled from five sweeps, {point['where']}: share of "
                "the accuracy of full training",
                "target": "≥ 90 %",
                "met": point["share"] >= TARGETS["enrolment"],
                "here": formatting.estimate([point["share"], point["low"], point["high"]]),
            }


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
    _frame(axes, (0, 1), (0, 1), "predicted probability", "named rightly", percent=True)
    return to_svg(
        figure,
        "share right against the predicted probability, before and after temperature scaling",
    )


def sweeps(figures: Json) -> str:
    """Mean sweeps against accuracy."""
    figure, axes = _plot(2.7)
    lows = []
    for sequence, look in zip(figures["sequence"].values(), (LINE, OTHER), strict=False):
        _banded(axes, sequence["points"], "sweeps", "accuracy", look)
        lows += [p["low"] for p in sequence["points"]]
    _legend(
        axes,
        tuple(zip((f"● {name}" for name in figures["sequence"]), (ACCENT, BLACK), strict=False)),
    )
    most = max([p["sweeps"] for h in figures["sequence"].values() for p in h["points"]] or [1])
    _frame(axes, (1, most), (_floor(lows), 1), "mean sweeps of an object", "named rightly")
    return to_svg(figure, "accuracy against the mean number of sweeps")


def unknown(figures: Json) -> str:
    """AUROC of each material left out, with its interval."""
    materials = figures["unknown"]["materials"]
    figure, axes = single_axes(
        0.29 * len(materials) + 0.75, left=0.28, right=0.86, top=0.12, bottom=0.55
    )
    for y, (name, m) in enumerate(materials.items()):
        axes.plot([m["low"], m["high"]], [y, y], color=ACCENT, linewidth=1.6)
        axes.plot(m["auroc"], y, "o", color=ACCENT, markersize=5)
        axes.annotate(
            name,
            (0, y),
            (-8, 0),
            ("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            va="center",
            color=BLACK,
            size=SMALL + 0.5,
        )
        axes.annotate(
            formatting.percent(m["auroc"]),
            (1, y),
            (8, 0),
            ("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            color=ACCENT,
            size=SMALL + 0.5,
        )
    lowest = _floor([m["low"] for m in materials.values()])
    axes.axvline(TARGETS["unknown"], color=GREY, linewidth=1, linestyle=(0, (2, 2)))
    axes.set_ylim(len(materials) - 0.5, -0.5)
    axes.set_xlim(lowest, 1.002)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    set_ticks(axes.xaxis, _steps(lowest), percent=True)
    set_ticks(axes.yaxis, [])
    axes.set_xlabel("AUROC with its 95 % interval", color=GREY, size=SMALL)
    return to_svg(figure, "AUROC of unknown materials, each left out of training")


def enrolment(figures: Json) -> str:
    """Share of the fully trained accuracy against sweeps."""
    figure, axes = _plot(2.7)
    points, lows, legend = figures["enrolment"]["points"], [TARGETS["enrolment"]], []
    for where, look in (("same place", LINE), ("other places", OTHER)):
        if there := [p for p in points if p["where"] == where]:
            _banded(axes, there, "sweeps", "share", look)
            lows += [p["low"] for p in there]
            legend.append((f"● {where}", look["color"]))
    axes.axhline(TARGETS["enrolment"], color=GREY, linewidth=1, linestyle=(0, (2, 2)))
    _legend(axes, tuple(legend))
    top = max([1.01, *(p["high"] for p in points)])
    _frame(axes, (1, 10), (_floor(lows), top), "sweeps enrolled from", "share of full training")
    return to_svg(figure, "accuracy with an enrolled material as a share of the fully trained one")


def touch(figures: Json) -> str:
    """Accuracy against the mean share of the sweep."""
    e = figures["early"]
    figure, axes = _plot(2.9)
    for points in e["curves"].values():
        axes.plot([p["share"] for p in points], [p["accuracy"] for p in points], **PALE)
    always = [a["accuracy"] for a in e["always"]]
    axes.plot([(d + 1) / len(always) for d in range(len(always))], always, **OTHER)
    axes.plot(e["share"], e["rule"]["accuracy"], "D", color=ACCENT, markersize=7, zorder=4)
    axes.axhline(
        e["whole"]["accuracy"] - TARGETS["lost"], color=GREY, linewidth=1, linestyle=(0, (2, 2))
    )
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
        "named rightly",
        percent=True,
    )
    return to_svg(figure, "accuracy against touch time")


def _banded(axes: Axes, points: Sequence[Json], x: str, y: str, look: Json) -> None:
    """A line with its 95 % band."""
    at = [p[x] for p in points]
    axes.fill_between(
        at,
        [p["low"] for p in points],
        [p["high"] for p in points],
        color=look["color"],
        alpha=0.12,
        linewidth=0,
    )
    axes.plot(at, [p[y] for p in points], **look)


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
