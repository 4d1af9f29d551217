"""Pictures of the development page (SVG) from accuracies by case and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WIDTH,
    add_axes,
    set_categories,
    set_ticks,
    single_axes,
    to_svg,
)
from train.studies import accuracy_axis
from train.studies.development_chart import Accuracies, Json, plain_case
from train.studies.development_experiment import EACH, OURS
from train.studies.method_names import plain_name

LOOKS: tuple[Mapping[str, Any], ...] = (
    {"color": ACCENT, "linewidth": 2.0, "marker": "o", "markersize": 4},
    {"color": BLACK, "linewidth": 1.4, "linestyle": (0, (3, 1.5)), "marker": "o", "markersize": 3},
)
THIN: Mapping[str, Any] = {"color": GREY, "linewidth": 0.7, "alpha": 0.7}
FEW = (0, 0.5, 0.8, 0.9, 0.95, 1)
"""Number of ticks in small plots."""


def lines(
    cases: Sequence[Json], table: Mapping[str, Accuracies], ours: str, peers: Sequence[str]
) -> str:
    """A line for each case: every peer a grey dot, the best peer dark and named, ours in the accent
    colour with its interval."""
    figure, axes = single_axes(0.36 * len(cases) + 1.0, left=0.56, right=0.95, top=0.42, bottom=0.5)
    lows: list[float] = []
    for y, case in enumerate(cases):
        row, chance = table[case["case"]], 1 / case["materials"]
        there = {name: float(row[name]["mean"]) for name in peers if name in row}
        best = max(there, key=lambda name: there[name], default="")
        axes.plot(list(there.values()), [y] * len(there), "o", color=GREY, markersize=4, alpha=0.6)
        axes.plot([chance] * 2, [y - 0.3, y + 0.3], color=GREY, linewidth=1)
        axes.plot([row[ours]["low"], row[ours]["high"]], [y, y], color=ACCENT, linewidth=1.2)
        axes.plot(row[ours]["mean"], y, "o", color=ACCENT, markersize=6, clip_on=False)
        if best:
            axes.plot(there[best], y, "o", color=BLACK, markersize=4, clip_on=False)
        beside: dict[str, Any] = {
            "ha": "right",
            "va": "center",
            "xycoords": ("axes fraction", "data"),
        }
        _text(axes, plain_case(case), (0, y), (-6, 6), BLACK, **beside)
        peer = plain_name(best) if best else "no peer"
        _text(axes, peer, (0, y), (-6, -6), GREY, **beside)
        lows += [row[ours]["low"], chance, *there.values()]
    axes.set_ylim(len(cases) - 0.5, -0.5)
    accuracy_axis.stretch(axes, "x", lows, FEW)
    axes.set_xlabel("sweeps named rightly", color=GREY, size=SMALL, labelpad=3)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    set_ticks(axes.yaxis, [])
    legend = (
        (22, -1.4, f"● {plain_name(ours)}, 95 % interval", ACCENT),
        (8, -1.4, "● best peer, named", BLACK),
        (8, -0.4, "● other peers", GREY),
        (8, 0.35, "| guessing", GREY),
    )
    for up, x, text, shade in legend:
        _text(axes, text, (x, 1), (0, up), shade)
    return to_svg(figure, f"accuracy of {plain_name(ours)} and its peers on each development set")


def _text(
    axes: Axes,
    text: str,
    at: tuple[float, float],
    offset: tuple[float, float],
    shade: str,
    **style: Any,
) -> None:
    """Write `text` at a point in shares of the axes, moved by `offset` in points."""
    look: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    look |= {"size": SMALL} | style
    axes.annotate(text, at, offset, color=shade, **look)


def curves(cases: Mapping[str, Json], found: Mapping[str, Any], ours: str) -> str:
    """A plot for each case: accuracy over training sweeps of each material. Ours and the peer with
    the best end stand out.

    found: {case: {method: {training sweeps, 0 for all: entry}}}.
    """
    each = 2.7
    figure = Figure((WIDTH, each * len(found)))
    inch = 1 / figure.get_figheight()
    at = {n: x for x, n in enumerate((*EACH, 0))}
    for number, (case, those) in enumerate(found.items()):
        top = 1 - inch * (0.65 + each * number)
        axes = add_axes(figure, 0.12, 0.97, top, top - inch * 1.5)
        peer = _leader(those, ours)
        for name in sorted(those, key=lambda name: name in (ours, peer)):
            look = LOOKS[0] if name == ours else LOOKS[1] if name == peer else THIN
            line = sorted(those[name].items(), key=lambda item: at[item[0]])
            axes.plot(
                [at[n] for n, _ in line],
                [entry["mean"] for _, entry in line],
                clip_on=False,
                **look,
            )
        chance = 1 / cases[case]["materials"]
        axes.set_ylabel(
            f"Named rightly: {plain_case(cases[case])}",
            color=BLACK,
            size=MEDIUM,
            rotation=0,
            ha="left",
            va="bottom",
        )
        axes.yaxis.set_label_coords(-0.11, 1.19)
        _text(axes, f"━ {plain_name(ours)}", (-0.11, 1), (0, 9), ACCENT)
        _text(axes, f"╍ {plain_name(peer)}" if peer else "", (0.3, 1), (0, 9), BLACK)
        _text(axes, "thin: other peers", (0.72, 1), (0, 9), GREY)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_xlim(-0.1, len(EACH) + 0.1)
        accuracy_axis.stretch(
            axes, "y", [chance, *(e["mean"] for line in those.values() for e in line.values())], FEW
        )
        accuracy_axis.draw_chance(axes, chance)
        set_categories(axes.xaxis, range(len(EACH) + 1), [*map(str, EACH), "all"])
        axes.set_xlabel("training sweeps of each material", color=GREY, size=SMALL, labelpad=3)
    return to_svg(figure, "accuracy over training sweeps of each material")


def _leader(those: Mapping[str, Mapping[int, Json]], ours: str) -> str:
    """The peer with a complete curve that is most accurate with all sweeps; "" if there are no
    peers."""
    points = max(map(len, those.values()))
    whole = [
        name for name, line in those.items() if name not in (ours, *OURS) and len(line) == points
    ]
    return max(whole, key=lambda name: float(those[name][0]["mean"]), default="")
