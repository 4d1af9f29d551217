"""The report on one bundle as an HTML page to hand on.

It computes only shares of the counts in the figures of bundle_experiment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from palpate.core.names import MOST_LETTERS
from palpate_train.answer import stranger_limits
from palpate_train.data.sets import Dataset
from palpate_train.reports import confusion_plot, formatting, html, provenance, sweep_plot
from palpate_train.reports.formatting import level
from palpate_train.reports.plot_style import (
    ACCENT,
    FAINT,
    GREY,
    SMALL,
    set_ticks,
    single_axes,
    to_svg,
    write,
)

Json = Mapping[str, Any]
MOST_IN_MATRIX = 12
"""Number of labels up to which the confusion matrix can be read on a phone. With more labels there
is only the table."""
NAME = 0.18, 0.1
"""Width and height of the name of a limit, as shares of the axes of its picture."""
QUARTERS = [0, 0.25, 0.5, 0.75, 1]
ANSWERS = "answered", "named"
LINES = ["-", "--", ":", "-."]
"""Of the curves of conditions."""
MOST_SHOWN = 6
"""Number of materials with an example sweep."""


def page(figures: Json, sweeps: Dataset) -> str:
    """The page (HTML)."""
    figures = _displayed(figures)
    return html.render(
        "bundle.html.j2",
        header=provenance.of(figures),
        f=figures,
        pictures=_pictures(figures),
        short=list(_in_short(figures)),
        statuses=sorted(figures["statuses"].items(), key=lambda item: -item[1]),
        materials=[_material(row) for row in figures["materials"]],
        corruptions=[_corruption(row) for row in figures["corruptions"]],
        foreign=[_foreign(*item) for item in figures["not_in_the_bundle"].items()],
        stranger_costs={
            limit: stranger_limits.lines(figures["figures"], limit)
            for limit in stranger_limits.COSTS
        },
        left_out=_left_out(figures.get("left_out")),
        held_out=[
            [name, formatting.estimate([of[k] for k in ("accuracy", "low", "high")]), of["n"]]
            for name, of in figures["figures"].items()
            if "accuracy" in of
        ],
        signals=[
            html.picture(sweep_plot.draw(sweep_plot.of_set(sweeps, i), plain=False))
            for i in _examples(sweeps)
        ],
    )


def _pictures(figures: Json) -> dict[str, Markup]:
    """The pictures of the page by name, as far as the figures allow."""
    pictures = {"calibration": html.picture(calibration(figures["calibration"]))}
    if len(figures["labels"]) <= MOST_IN_MATRIX:
        pictures["confusion"] = html.picture(confusion(figures))
    if len(figures.get("curve", ())) > 1:
        pictures["curve"] = html.picture(curve(figures["curve"]))
    found = figures["figures"].get(stranger_limits.FIGURES, {})
    if "named" in found.get("strict", {}):
        pictures["strangers"] = html.picture(strangers(found))
    return pictures


def _displayed(figures: Json) -> Json:
    """The figures with display names instead of labels."""
    displays = figures.get("displays", {})
    if not displays:
        return figures

    def shown(name: str) -> str:
        return str(displays.get(name, name))

    def given(answers: Mapping[str, int]) -> dict[str, int]:
        return {shown(answer): n for answer, n in answers.items()}

    rows = [
        row
        | {
            "name": shown(row["name"]),
            "taken_for": row["taken_for"] and [shown(row["taken_for"][0]), row["taken_for"][1]],
        }
        for row in figures["materials"]
    ]
    named: dict[str, Any] = {"labels": [*map(shown, figures["labels"])], "materials": rows}
    for kind in ("answers", "not_in_the_bundle"):
        named[kind] = {shown(name): given(of) for name, of in figures[kind].items()}
    if left_out := figures.get("left_out"):
        materials = {shown(name): of for name, of in left_out["materials"].items()}
        named["left_out"] = left_out | {"materials": materials}
    return {**figures, **named}


def _in_short(figures: Json) -> Iterator[list[str]]:
    """Rows of the summary: results, weaknesses and cost."""
    named, n = figures["named"], figures["named"]["n"]
    for what, text in (
        ("right", "classified correctly"),
        ("wrong", "wrong label"),
        ("not_named", "no label (unsure, unknown or refused)"),
    ):
        yield [text, f"{formatting.percent(named[what] / n)}, {named[what]} of {n}"]
    worst = min(
        (row for row in figures["materials"] if row["recall"]), key=lambda row: row["recall"][0]
    )
    yield [
        f"the material that is classified correctly least often: {worst['name']}",
        formatting.estimate(worst["recall"]),
    ]
    if share := figures["foreign_named"]:
        yield [
            "sweeps of materials that it does not have, with a label",
            formatting.estimate(share),
        ]
    elif found := figures.get("left_out"):
        yield [
            "sweeps of a material left out of training, with a label (mean)",
            formatting.percent(found["mean"]["false_known"]),
        ]
    if breaks := [row for row in figures["corruptions"] if row["falls"] is not None]:
        first = breaks[0]
        yield [
            "the first corruption to break it",
            f"{first['title']}: five points lost at {level(first, first['falls'])}",
        ]
    yield ["mean error of its probabilities", formatting.percent(figures["calibration"]["error"])]
    cost = figures["cost"]
    yield [
        "time of a sweep, memory, disk",
        f"{cost['ms']:.2f} ms, {cost['mib']:.0f} MiB, {cost['kb']:.0f} kB",
    ]


def _foreign(name: str, given: Mapping[str, int]) -> list[Any]:
    """A row for a material that the bundle lacks: sweeps, and those `unknown` and with a label."""
    named = sum(n for answer, n in given.items() if answer[0] != "(")
    return [name, sum(given.values()), given.get("(unknown)", 0), named]


def _left_out(found: Json | None) -> list[list[str]]:
    """A row for each material that was left out of training, and their mean."""
    if not found:
        return []
    rows = [
        [
            name,
            formatting.percent(m["false_known"]),
            formatting.percent(m["kept"]),
            formatting.estimate([m[k] for k in ("auroc", "low", "high")]),
            f"{m['known']} / {m['unknown']}",
        ]
        for name, m in found["materials"].items()
    ]
    means = [formatting.percent(found["mean"][k]) for k in ("false_known", "kept", "auroc")]
    return [*rows, ["mean", *means, ""]]


def _material(row: Json) -> list[str]:
    wrong = "{} ({})".format(*row["taken_for"]) if row["taken_for"] else ""
    shares = [formatting.estimate(row[k]) if row[k] else "–" for k in ("recall", "precision")]
    return [
        row["name"],
        str(row["sweeps"]),
        *shares,
        *(str(row[k]) for k in ("unsure", "unknown", "refused")),
        wrong,
    ]


def _corruption(row: Json) -> list[str]:
    """A row for one corruption with the answers at its largest severity."""
    most, right, wrong = row["severities"][-1], row["right"][-1], row["wrong"][-1]
    falls = "–" if row["falls"] is None else level(row, row["falls"])
    shares = " / ".join(
        f"{100 * n / row['total']:.0f}" for n in (right, wrong, row["total"] - right - wrong)
    )
    return [f"{row['title']}: {row['about']}", falls, f"{level(row, most)}: {shares} %"]


def _examples(sweeps: Dataset) -> list[int]:
    """Numbers of example sweeps: the middle sweep of each of the first materials."""
    each = (np.flatnonzero(sweeps.labels == k) for k in np.unique(sweeps.labels)[:MOST_SHOWN])
    return [int(own[len(own) // 2]) for own in each]


def confusion(figures: Json) -> str:
    """The labels that the sweeps of each material get, as shares of all its sweeps; rows are the
    true materials. A row lacks the share of answers without a label."""
    labels = figures["labels"]
    answers = [figures["answers"].get(of, {}) for of in labels]
    counts = np.array([[given.get(named, 0) for named in labels] for given in answers])
    totals = np.array([sum(given.values()) for given in answers])
    about = "materials by the labels that they get"
    most = MOST_LETTERS  # of a display name there is no room for more
    names = [name if len(name) <= most else f"{name[: most - 1]}…" for name in labels]
    return confusion_plot.draw(counts, names, about, totals=totals)


def calibration(found: Json) -> str:
    """Share of right labels over the predicted probability; a larger dot stands for more sweeps."""
    figure, axes = single_axes(3.0, left=0.14, right=0.97, top=0.15, bottom=0.5)
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.2)
    said, right = [b["said"] for b in found["bins"]], [b["right"] for b in found["bins"]]
    sizes = [6 + 60 * (b["n"] / found["n"]) ** 0.5 for b in found["bins"]]
    axes.plot(said, right, color=ACCENT, linewidth=1.4)
    axes.scatter(said, right, sizes, color=ACCENT, zorder=3)
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    set_ticks(axes.xaxis, QUARTERS, percent=True)
    _shares(axes, "predicted probability", "classified correctly")
    return to_svg(figure, "share right against the predicted probability")


def curve(points: Sequence[Json]) -> str:
    """Share of right answers over the number of training sweeps of each material."""
    figure, axes = single_axes(2.6, left=0.14, right=0.97, top=0.15, bottom=0.5)
    each, share = [p["each"] for p in points], [p["share"] for p in points]
    low, high = ([p[k] for p in points] for k in ("low", "high"))
    axes.fill_between(each, low, high, color=ACCENT, alpha=0.13, linewidth=0)
    axes.plot(each, share, color=ACCENT, linewidth=2, marker="o", markersize=4)
    axes.set_xscale("log")
    axes.set_xlim(each[0] / 1.1, each[-1] * 1.1)
    axes.set_ylim(0, 1.02)
    set_ticks(axes.xaxis, each)
    _shares(axes, "training sweeps of each material", "classified correctly")
    return to_svg(figure, "share classified correctly over the number of training sweeps")


def strangers(found: Json) -> str:
    """Share of unknown sweeps with a label over the share of known sweeps that are answered, a line
    for each condition with the points of the three limits. found: figures of stranger_limits."""
    figure, axes = single_axes(2.6, left=0.14, right=0.95, top=0.2, bottom=0.5)
    shares = {limit: [[found[limit][of][0] for of in ANSWERS]] for limit in stranger_limits.COSTS}
    total = {" or ".join(found["under"]): {"curve": found["curve"]} | shares}
    each = found.get("by condition") or total
    drawn = [pair for of in each.values() for limit in of for pair in of[limit]]
    left = min(stranger_limits.LEAST_KEPT["strict"], int(10 * min(x for x, _ in drawn)) / 10)
    highest = max(each, key=lambda condition: each[condition]["balanced"][0][1])
    for k, (style, (condition, of)) in enumerate(zip(cycle(LINES), each.items(), strict=False)):
        line: dict[str, Any] = {"color": ACCENT, "linewidth": 2, "linestyle": style}
        axes.plot(*np.transpose(of["curve"]), **line)
        key = [left + (1 - left) * share for share in (0.03, 0.1, 0.12)]
        axes.plot(key[:2], [0.97 - 0.12 * k] * 2, **line)
        write(axes, key[2], 0.94 - 0.12 * k, f"new {condition}", GREY, SMALL, ha="left")
        points = sorted((*of[limit][0], limit) for limit in stranger_limits.COSTS)
        at_x, at_y = 0.0, 0.0
        for x, y, limit in points:
            axes.plot(x, y, color=ACCENT, marker="o", markersize=5)
            if condition == highest:
                meets = x - at_x < NAME[0] * (1 - left) and abs(y + 0.05 - at_y) < NAME[1]
                at_x, at_y = x, at_y + NAME[1] if meets else y + 0.05
                write(axes, x, at_y, limit, GREY, SMALL, ha="right")
    axes.set_xlim(left, 1.005)
    axes.set_ylim(0, 1.05)
    ticks = np.arange(10, 10 * left - 0.5, -1 if left > 0.3 else -2)[::-1] / 10
    set_ticks(axes.xaxis, ticks, percent=True)
    _shares(axes, "known sweeps answered", "unknown ones with a label")
    return to_svg(figure, "unknown sweeps with a label over known sweeps answered")


def _shares(axes: Axes, x: str, y: str) -> None:
    """Grid and labels of a plot of shares."""
    axes.grid(color=FAINT, linewidth=0.6)
    set_ticks(axes.yaxis, QUARTERS, percent=True)
    axes.set_xlabel(x, color=GREY, size=SMALL)
    axes.set_ylabel(y, color=GREY, size=SMALL)
