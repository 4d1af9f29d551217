"""The table and the picture of the recipe's views, from the results of the study `recipe`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from palpate_train.reports.formatting import amount
from palpate_train.reports.plot_style import ACCENT, BLACK, FAINT, GREY, SMALL, WIDTH, to_svg, write

Json = Mapping[str, Any]
VIEWS = {
    "filters": (
        "log mean magnitude of random integer filters",
        "texture: which patterns in time and across taxels occur how strongly",
        "usually; as few filters as suffice",
    ),
    "shares": (
        "share of each filter's responses above a threshold",
        "stick and slip: rare strong responses, which a mean hides",
        "beside the filters, in every second discriminant",
    ),
    "distribution": (
        "shares of counts and of their differences above thresholds, of each taxel",
        "roughness and friction of fast and slow skins",
        "unless held-out sweeps are named better without it",
    ),
    "spectrum": (
        "log power in bands, averaged over taxels",
        "vibration; it carries over to a skin that was put back",
        "unless held-out sweeps are named better without it",
    ),
    "relations": (
        "deviations of taxels and correlations of their pairs, at up to seven time scales",
        "how taxels move together: a new force, speed or direction",
        "only if held-out groups show a gain, and several taxels exist",
    ),
    "loads": (
        "mean count of each taxel; the change of all in the first and the last tenth",
        "hardness, which the level shows",
        "only if held-out groups show a gain",
    ),
    "stages": (
        "log mean responses of three trained convolutions",
        "patterns that no fixed filter has",
        "from 25 sweeps of each material on, unless held-out sweeps are named worse",
    ),
}
"""Features, purpose and condition of each view."""
LOW, HIGH = 0.0, 3.1


def table(results: Json) -> str:
    """A row for each view: features, purpose, cost, condition, sets."""
    costs = {view["view"]: view for view in results["views"]}
    rows = [
        "| view | features | what it is for | alone: features, time, bytes | when chosen | on |",
        "|---|---|---|---|---|---|",
    ]
    for name, (features, purpose, when) in VIEWS.items():
        cost = costs[name]
        spent = (
            f"{cost['features']}, {amount(cost['us'], 'µs')}, {amount(cost['bytes'] / 1e3, 'KB')}"
        )
        sets = [one["set"] for one in results["sets"] if name in one["views"]]
        on = f"{len(sets)} of {len(results['sets'])}: {', '.join(sets)}" if sets else "no set"
        rows.append(f"| {name} | {features} | {purpose} | {spent} | {when} | {on} |")
    return "\n".join(rows)


def loads(results: Json) -> str:
    """A row for each world and condition, with the figures with and without the view."""
    rows = [
        "| world | condition | sweeps | with loads: label, box, wrong | "
        "without: label, box, wrong |",
        "|---|---|---|---|---|",
    ]
    for row in results["loads"]:
        told = [
            ", ".join(f"{row[which][name]:.1f} %" for name in ("label", "right", "wrong"))
            if row[which]
            else "not chosen"
            for which in ("with", "without")
        ]
        rows.append(
            f"| {row['world']} | {row['condition']} | {row['sweeps']} | {told[0]} | {told[1]} |"
        )
    return "\n".join(rows)


def draw(results: Json) -> str:
    """The way from raw counts to the answer, with the time of each view."""
    figure = Figure((WIDTH, WIDTH * 0.42))
    page = figure.add_axes((0, 0, 1, 1))
    page.set(xlim=(0, 10), ylim=(LOW, HIGH))
    page.axis("off")
    costs = {view["view"]: view["us"] for view in results["views"]}
    middle, height = HIGH / 2, 0.34
    _box(page, 0.8, middle, 1.5, 0.8, "raw counts\n[T, R, C]", BLACK)
    step = (HIGH - 0.2) / len(VIEWS)
    for i, name in enumerate(VIEWS):
        y = HIGH - 0.1 - (i + 0.5) * step
        _arrow(page, (1.55, middle), (2.25, y))
        _box(page, 3.15, y, 1.8, height, name, ACCENT)
        write(page, 4.12, y, amount(costs[name], "µs"), GREY, SMALL - 0.5, ha="left")
        _arrow(page, (5.08, y), (5.45, middle))
    _box(page, 6.4, middle, 1.9, 0.8, "discriminants\nin closed form", BLACK)
    _arrow(page, (7.35, middle), (7.95, middle))
    _box(page, 8.9, middle, 1.9, 0.8, "sum of logits,\nprobability", BLACK)
    for line, text in enumerate(("held-out groups choose", "the views of each")):
        write(page, 6.75, middle - 0.75 - 0.25 * line, text, GREY, SMALL - 0.5)
    return to_svg(figure, "The views of the recipe between raw counts and the answer")


def _box(page: Axes, x: float, y: float, width: float, height: float, text: str, edge: str) -> None:
    page.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.08",
            fc=FAINT,
            ec=edge,
            lw=1,
        )
    )
    lines = text.split("\n")
    for line, words in enumerate(lines):
        write(page, x, y + 0.13 * (len(lines) - 1) - 0.26 * line, words, BLACK, SMALL - 0.5)


def _arrow(page: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=7, color=GREY, lw=0.8)
    )
