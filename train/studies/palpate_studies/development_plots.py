"""Pictures of the page "Speed against accuracy" (SVG)."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_studies import comparison, label_places
from palpate_studies.development_chart import ChartPanel, Json, Spot, finding, plain_case
from palpate_studies.development_experiment import EACH, OURS
from palpate_studies.label_places import Label
from palpate_studies.method_names import plain_name, short_name
from palpate_studies.ranks import Ranking
from palpate_train.models.methods import PACKAGED
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WHITE,
    WIDTH,
    add_axes,
    round_ticks,
    set_categories,
    set_ticks,
    single_axes,
    to_svg,
)

LOOKS: tuple[Mapping[str, Any], ...] = (
    {"color": ACCENT, "linewidth": 2.0, "marker": "o", "markersize": 4},
    {"color": BLACK, "linewidth": 1.4, "linestyle": (0, (3, 1.5)), "marker": "o", "markersize": 3},
)
RING: Mapping[str, Any] = {
    "marker": "o",
    "markersize": 13,
    "markerfacecolor": "none",
    "markeredgewidth": 1.3,
    "color": ACCENT,
    "clip_on": False,
}
THIN: Mapping[str, Any] = {"color": GREY, "linewidth": 0.7, "alpha": 0.7}
MARKERS = {"int8": "o", "float": "s"}
HEAD, HEIGHT, FOOT = 0.56, 2.2, 0.42
"""Inches above a panel, of its plot, and below it."""
TOUCHED = (0.1, 0.2, 0.5, 1, 2, 4)
"""Ticks of seconds of touch."""
STEPS = 40
"""Points between two marks of a line that keep names away from it."""
SPAN = 0.22
"""Longest axis of accuracy. What is less accurate is drawn at its end and named below."""
LETTERS = 74
"""Most letters of a line of small text."""
KEY = "━ Pareto front of all forms   ● int8   ■ float   ◯ ships   ╷ not run here"


def speed(panels: Sequence[ChartPanel], machine: str) -> str:
    """Mean accuracy over the time of a sweep: a panel for each kind of tests, on one axis.

    machine: processor and threads, in words.
    """
    spots = [spot.ms for panel in panels for spot in panel.spots]
    ends = min(spots) / 1.7, max(spots) * 1.7
    said = (_below(panels), _gaps(panels), machine)
    lines = [KEY, *(line for text in said for line in textwrap.wrap(text, LETTERS))]
    each, below = HEAD + HEIGHT + FOOT, 0.17 * len(lines) + 0.08
    height = each * len(panels) + below
    figure = Figure((WIDTH, height), dpi=72)
    for number, panel in enumerate(panels):
        top = height - each * number - HEAD
        axes = add_axes(figure, 0.11, 0.97, top / height, (top - HEIGHT) / height)
        _panel(axes, panel, ends)
    for number, line in enumerate(reversed(lines)):
        figure.text(0.012, (0.07 + 0.17 * number) / height, line, color=GREY, size=SMALL)
    return to_svg(figure, "; ".join(f"{panel.kind}: {finding(panel)}" for panel in panels))


def _below(panels: Sequence[ChartPanel]) -> str:
    """The marks at the lower end of the axis, with their accuracies."""
    parts = []
    for panel in panels:
        bottom, _ = _ends(panel)
        those = [_label(spot) for spot in panel.spots if spot.mean < bottom and not spot.form]
        if those:
            parts.append(f"{panel.kind}: {' · '.join(those)}")
    return f"▾ less than the axis shows ({'; '.join(parts)})" if parts else ""


def _label(spot: Spot) -> str:
    return f"{short_name(spot.method)} {100 * spot.mean:.1f}"


def _gaps(panels: Sequence[ChartPanel]) -> str:
    """The hollow marks: methods that were not run in every test, with the number of their tests."""
    parts = []
    for panel in panels:
        count = len(panel.cases)
        those = [f"{short_name(name)} {count - n}" for name, n in panel.lacking().items()]
        if those:
            parts.append(f"{panel.kind}: {' · '.join(those)} of {count}")
    return f"Hollow: not run in all tests ({'; '.join(parts)})" if parts else ""


def _panel(axes: Axes, panel: ChartPanel, ends: tuple[float, float]) -> None:
    """One panel with its finding as title."""
    low, high = _ends(panel)
    room = 0.09 * max(high - low, 0.02)
    axes.set_xscale("log")
    axes.set_xlim(*ends)
    axes.set_ylim(low - 1.5 * room, high + room)
    axes.grid(color=FAINT, linewidth=0.6)
    tens = [10.0**n for n in range(-4, 5) if ends[0] <= 10.0**n <= ends[1]]
    set_ticks(axes.xaxis, tens or [float(f"{ends[0]:.1g}")], "ms")
    set_ticks(axes.yaxis, round_ticks(low - room, high + room, 6), percent=True)
    shape, frames = panel.sweep.partition(" ")[0], panel.sweep.rpartition(" ")[2]
    timed = f"← faster: processor time of a sweep of {shape} taxels, {frames} frames"
    axes.set_xlabel(timed, color=GREY, size=SMALL, labelpad=3)
    about = f"named rightly, mean of {len(panel.cases)} tests: {panel.kind}"
    axes.set_ylabel(about, color=GREY, size=SMALL, rotation=0, ha="left", va="bottom")
    axes.yaxis.set_label_coords(-0.115, 1.03)
    _text(axes, finding(panel), (-0.115, 1.03), (0, 13), BLACK, weight="bold", size=MEDIUM)
    front = [(spot.ms, spot.mean) for spot in panel.front]
    corners = [(x, y) for a, b in pairwise(front) for x, y in (a, (b[0], a[1]))]
    stairs = [*corners, *front[-1:], *((ends[1], y) for _, y in front[-1:])]
    line = [(spot.ms, spot.mean) for spot in panel.line]
    for path, shade, width in ((stairs, BLACK, 1.1), (line, ACCENT, 1.8)):
        axes.plot([x for x, _ in path], [y for _, y in path], color=shade, linewidth=width)
    labels = [*_marks(axes, panel), *_absent(axes, panel)]
    label_places.write(axes, labels, _between(line) + _between(stairs))


def _ends(panel: ChartPanel) -> tuple[float, float]:
    """Lowest and highest accuracy on the axis."""
    means = [spot.mean for spot in panel.spots]
    return max(min(means), max(means) - SPAN), max(means)


def _marks(axes: Axes, panel: ChartPanel) -> Iterator[Label]:
    """Draw the spots; yield their names, the most important first. All forms of a method have the
    same name."""
    names: dict[str, str] = {}
    shown = [s for s in panel.spots if not (s.method in OURS and s.form) or s in panel.front]
    bottom, _ = _ends(panel)
    for spot in shown:
        y, mark = max(spot.mean, bottom), MARKERS[spot.precision]
        mark = "v" if spot.mean < bottom else mark
        shade = _shade(panel, spot)
        face = WHITE if spot.lacks else shade
        look: dict[str, Any] = {"markeredgecolor": shade, "markerfacecolor": face, "clip_on": False}
        axes.plot(spot.ms, y, mark, markersize=5.5, zorder=4, **look)
        if spot.method == PACKAGED and not spot.form:
            axes.plot(spot.ms, y, **RING)
    order = sorted(shown, key=lambda s: (s.method != PACKAGED, s not in panel.front, -s.mean))
    for spot in order:
        text = "" if spot.mean < bottom else names.setdefault(spot.method, _label(spot))
        yield spot.ms, max(spot.mean, bottom), text, _shade(panel, spot), spot.method in OURS


def _shade(panel: ChartPanel, spot: Spot) -> str:
    return ACCENT if spot.method in OURS else BLACK if spot in panel.front else GREY


def _absent(axes: Axes, panel: ChartPanel) -> Iterator[Label]:
    """Draw a stroke on the axis at the time of each method that has no accuracy; yield their
    names."""
    low, high = axes.get_ylim()
    for method, ms in panel.absent.items():
        at = low + 0.035 * (high - low)
        axes.plot([ms, ms], [low, at], color=GREY, linewidth=1.2)
        yield ms, at, short_name(method), GREY, False


def _between(line: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points along a line, where no name may stand."""
    return [
        (float(np.exp((1 - t) * np.log(a[0]) + t * np.log(b[0]))), float((1 - t) * a[1] + t * b[1]))
        for a, b in pairwise(line)
        for t in np.linspace(0, 1, STEPS)
    ]


def dumbbells(lines: Sequence[Json]) -> str:
    """Ours and the best peer in each test, joined by a bar, with their difference and its interval.

    lines: of comparison.line, with a peer each.
    """
    figure, axes = single_axes(0.36 * len(lines) + 0.85, left=0.53, right=0.72, top=0.3, bottom=0.5)
    beside: dict[str, Any] = {"va": "center", "xycoords": ("axes fraction", "data")}
    for y, line in enumerate(lines):
        ours, peer = line["ours"]["mean"], line["leader"]["mean"]
        axes.plot([peer, ours], [y, y], color=ACCENT if ours >= peer else GREY, linewidth=2.2)
        axes.plot(peer, y, "o", color=BLACK, markersize=5, clip_on=False)
        axes.plot(ours, y, "o", color=ACCENT, markersize=6.5, clip_on=False)
        _text(axes, line["what"], (0, y), (-8, 6), BLACK, ha="right", **beside)
        _text(axes, line["best"], (0, y), (-8, -6), GREY, ha="right", **beside)
        _text(axes, comparison.shown(line["gap"]), (1, y), (8, 0), BLACK, ha="left", **beside)
    low = min(min(line["ours"]["mean"], line["leader"]["mean"]) for line in lines)
    axes.set_xlim(low - 0.02, 1.005)
    axes.set_ylim(len(lines) - 0.5, -0.5)
    set_ticks(axes.xaxis, round_ticks(low - 0.02, 1, 4), percent=True)
    axes.set_xlabel("sweeps named rightly", color=GREY, size=SMALL, labelpad=3)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    set_ticks(axes.yaxis, [])
    _text(axes, "● ours", (0, 1), (-132, 8), ACCENT)
    _text(axes, "● best peer of the test", (0, 1), (-98, 8), BLACK)
    _text(axes, "points ahead", (1, 1), (8, 8), GREY)
    return to_svg(figure, "our accuracy and the best peer’s in each test")


def ranks(rankings: Mapping[str, Ranking]) -> str:
    """Mean rank of each method; bars join methods that the tests cannot tell apart.

    rankings: by the kind of tests.
    """
    heights = [0.2 * len(one.ranks) + 0.85 for one in rankings.values()]
    figure = Figure((WIDTH, sum(heights)))
    top = sum(heights)
    for (kind, one), height in zip(rankings.items(), heights, strict=True):
        whole = figure.get_figheight()
        axes = add_axes(figure, 0.42, 0.93, (top - 0.35) / whole, (top - height + 0.45) / whole)
        top -= height
        names = list(one.ranks)
        for y, (name, rank) in enumerate(one.ranks.items()):
            shade = ACCENT if name in OURS else GREY
            axes.plot(rank, y, "o", color=shade, markersize=5, clip_on=False)
            place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "center"}
            _text(axes, plain_name(name), (0, y), (-6, 0), shade, **place)
        for number, group in enumerate(one.cliques):
            ends = names.index(group[0]) - 0.2, names.index(group[-1]) + 0.2
            look: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "clip_on": False}
            axes.plot([1 + 0.03 * number] * 2, ends, color=BLACK, linewidth=2, **look)
        axes.set_xlim(0.8, len(names) + 0.6)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.grid(axis="x", color=FAINT, linewidth=0.6)
        set_ticks(axes.xaxis, range(1, len(names) + 1, 2))
        set_ticks(axes.yaxis, [])
        title = f"mean rank in {one.tests} tests; below {one.difference:.1f} apart: chance"
        axes.set_xlabel(title, color=GREY, size=SMALL, labelpad=3)
        _text(axes, kind, (-0.72, 1), (0, 8), BLACK, weight="bold")
    return to_svg(figure, "mean ranks of methods, with cliques")


def touch(curves: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]]) -> str:
    """Accuracy over seconds of touch: a plot for each test.

    curves: by title and by the name of a line its points (s, accuracy). The first line is ours. A
    line of one point is a ring.
    """
    each = 2.35
    figure = Figure((WIDTH, each * len(curves)), dpi=72)
    inch = 1 / figure.get_figheight()
    for number, (title, lines) in enumerate(curves.items()):
        top = 1 - inch * (0.5 + each * number)
        axes = add_axes(figure, 0.1, 0.95, top, top - inch * 1.35)
        every = [point for line in lines.values() for point in line]
        axes.set_xscale("log")
        axes.set_xlim(min(x for x, _ in every) / 1.15, max(x for x, _ in every) * 1.15)
        low, high = min(y for _, y in every), max(y for _, y in every)
        room = 0.12 * max(high - low, 0.02)
        axes.set_ylim(low - room, high + room)
        axes.grid(color=FAINT, linewidth=0.6)
        set_ticks(
            axes.xaxis, [s for s in TOUCHED if axes.get_xlim()[0] <= s <= axes.get_xlim()[1]], "s"
        )
        set_ticks(axes.yaxis, round_ticks(low - room, high + room, 4), percent=True)
        axes.set_xlabel("seconds of touch", color=GREY, size=SMALL, labelpad=3)
        axes.set_ylabel(title, color=BLACK, size=MEDIUM, rotation=0, ha="left", va="bottom")
        axes.yaxis.set_label_coords(-0.1, 1.07)
        labels: list[Label] = []
        for i, (name, line) in enumerate(lines.items()):
            look = RING if len(line) == 1 else LOOKS[min(i, 1)]
            axes.plot(*zip(*line, strict=True), **look)
            x, y = line[len(line) // 2]
            labels.append((x, y, name, str(look["color"]), i == 0))
        label_places.write(axes, labels, [p for line in lines.values() for p in _between(line)])
    return to_svg(figure, "accuracy over seconds of touch")


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
    each = 2.5
    figure = Figure((WIDTH, each * len(found)))
    inch = 1 / figure.get_figheight()
    at = {n: x for x, n in enumerate((*EACH, 0))}
    for number, (case, those) in enumerate(found.items()):
        top = 1 - inch * (0.65 + each * number)
        axes = add_axes(figure, 0.12, 0.97, top, top - inch * 1.35)
        peer = _leader(those, ours)
        for name in sorted(those, key=lambda name: name in (ours, peer)):
            look = LOOKS[0] if name == ours else LOOKS[1] if name == peer else THIN
            line = sorted(those[name].items(), key=lambda item: at[item[0]])
            places = [at[n] for n, _ in line]
            axes.plot(places, [entry["mean"] for _, entry in line], clip_on=False, **look)
        title = f"Named rightly: {plain_case(cases[case])}"
        axes.set_ylabel(title, color=BLACK, size=MEDIUM, rotation=0, ha="left", va="bottom")
        axes.yaxis.set_label_coords(-0.11, 1.19)
        _text(axes, f"━ {plain_name(ours)}", (-0.11, 1), (0, 9), ACCENT)
        _text(axes, f"╍ {plain_name(peer)}" if peer else "", (0.3, 1), (0, 9), BLACK)
        _text(axes, "thin: other peers", (0.72, 1), (0, 9), GREY)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_xlim(-0.1, len(EACH) + 0.1)
        low = min(e["mean"] for line in those.values() for e in line.values()) - 0.03
        axes.set_ylim(low, 1.01)
        set_ticks(axes.yaxis, round_ticks(low, 1, 5), percent=True)
        set_categories(axes.xaxis, range(len(EACH) + 1), [*map(str, EACH), "all"])
        axes.set_xlabel("training sweeps of each material", color=GREY, size=SMALL, labelpad=3)
    return to_svg(figure, "accuracy over training sweeps of each material")


def _leader(those: Mapping[str, Mapping[int, Json]], ours: str) -> str:
    """The peer with a complete curve that is most accurate with all sweeps; "" without peers."""
    most = max(map(len, those.values()))
    whole = [
        name for name, line in those.items() if name not in (ours, *OURS) and len(line) == most
    ]
    return max(whole, key=lambda name: float(those[name][0]["mean"]), default="")
