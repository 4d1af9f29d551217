"""Pictures of corrupted sweeps (SVG), a small one for each corruption, from curves of robustness
and bundle_stress."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_train.evaluate.robustness import POINTS, breaks_first
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SMALL,
    WIDTH,
    add_axes,
    set_ticks,
    to_svg,
)

Json = Mapping[str, Any]
LOOKS: tuple[Mapping[str, Any], ...] = (
    {"color": ACCENT, "linewidth": 2.0},
    {"color": ORANGE, "linewidth": 1.5, "linestyle": (0, (4, 1.5))},
    {"color": PURPLE, "linewidth": 1.5, "linestyle": (0, (1.2, 1.2))},
    {"color": GREEN, "linewidth": 1.5, "linestyle": (0, (6, 1.5, 1.2, 1.5))},
    {"color": BLACK, "linewidth": 1.0},
)
"""Lines of the first methods, told apart by style as well as by colour."""
AREAS: Mapping[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "classified correctly": (("correct",), {"color": ACCENT, "alpha": 0.5}),
    "unsure, unknown": (("unsure", "unknown"), {"color": FAINT, "alpha": 0.7}),
    "refused": (("refused",), {"color": GREY, "alpha": 0.6}),
    "wrong label": (("wrong",), {"color": ORANGE}),
}
"""The kinds of answers of the box, from below."""
AREA = 8.0
"""Width of the line for an area in a legend."""
NETWORK: Mapping[str, Any] = {"color": BLACK, "linewidth": 1.0, "linestyle": (0, (3, 1.5))}
COLUMNS, HEIGHT = 3, 1.42
"""Small pictures in a row; height of each in inches, with title and labels."""
LINE, LONGEST = 0.2, 20
"""In a legend: length of a line in inches, and the letters of a text if three fit in a row."""


def methods(curves: Mapping[str, Json]) -> str:
    """Accuracy over severity: a small picture for each corruption that costs a drawn method five
    points.

    curves: by method and corruption. The first method is ours: its band is shown, and its first
    losses come first. Methods beyond LOOKS are not drawn.
    """
    looks = dict(zip(curves, LOOKS, strict=False))

    def draw(axes: Axes, name: str) -> None:
        for method in reversed(looks):
            if curve := curves[method].get(name):
                axes.plot(curve["severities"], curve["accuracy"], **looks[method])
        band = next(iter(curves.values()))[name]
        axes.fill_between(
            band["severities"], band["low"], band["high"], color=ACCENT, alpha=0.13, linewidth=0
        )

    legend = list(looks.items())
    any_curves = {name: curve for those in curves.values() for name, curve in those.items()}
    return _panels(
        {name: any_curves[name] for name in shown(curves)},
        draw,
        legend,
        "share of corrupted sweeps that each method classifies correctly",
    )


def shown(curves: Mapping[str, Json]) -> list[str]:
    """Corruptions that cost a drawn method five points; first the ones that break ours."""
    coloured = list(curves.values())[: len(LOOKS)]
    return list(dict.fromkeys(name for those in coloured for name in breaks_first(those)))


def box(curves: Mapping[str, Json]) -> str:
    """The box's answers over severity, stacked: right, unsure or unknown, refused, wrong; and its
    network alone.

    A small picture for each corruption that costs five points, or that makes as many wrong labels.
    """
    right, wrong = curves["correct"], curves["wrong"]
    named = [
        *breaks_first(right),
        *(name for name in wrong if max(wrong[name]["accuracy"]) >= POINTS),
    ]

    def draw(axes: Axes, name: str) -> None:
        x, below = right[name]["severities"], np.zeros(len(right[name]["severities"]))
        for answers, look in AREAS.values():
            above = below + np.sum([curves[answer][name]["accuracy"] for answer in answers], axis=0)
            axes.fill_between(x, below, above, linewidth=0, **look)
            below = above
        axes.plot(x, curves["network"][name]["accuracy"], **NETWORK)

    legend = [(text, look | {"linewidth": AREA}) for text, (_, look) in AREAS.items()] + [
        ("by label alone", NETWORK)
    ]
    return _panels(
        {name: right[name] for name in dict.fromkeys(named)},
        draw,
        legend,
        "what the box answers to corrupted sweeps",
    )


def _panels(
    curves: Mapping[str, Json],
    draw: Callable[[Axes, str], None],
    legend: Sequence[tuple[str, Mapping[str, Any]]],
    about: str,
) -> str:
    """A small picture for each of `curves`, below a legend. draw: draws one by its name."""
    beside = COLUMNS if max(len(text) for text, _ in legend) <= LONGEST else 2
    rows, above = -(-len(curves) // COLUMNS), 0.25 + LINE * -(-len(legend) // beside)
    figure = Figure((WIDTH, above + max(rows, 1) * HEIGHT))
    inch = 1 / figure.get_figheight()
    title: dict[str, Any] = {"y": 1 - 0.14 * inch, "va": "center", "color": GREY, "size": SMALL}
    figure.supylabel("share of sweeps upwards,", x=0.01, ha="left", rotation=0, **title)
    figure.supxlabel("how much goes wrong to the right", x=0.345, ha="left", **title)
    key = add_axes(figure, 0, 1, 1, 0)
    key.set_axis_off()
    key.set_xlim(0, 1)
    key.set_ylim(0, 1)
    for i, (text, look) in enumerate(legend):
        x, y = 0.01 + i % beside / beside, 1 - inch * (0.36 + LINE * (i // beside))
        key.plot([x, x + 0.06], [y, y], solid_capstyle="butt", **look)
        key.text(x + 0.075, y, text, color=BLACK, size=SMALL, va="center")
    for i, (name, curve) in enumerate(curves.items()):
        row, column = divmod(i, COLUMNS)
        left, top = 0.09 + 0.91 * column / COLUMNS, 1 - inch * (above + row * HEIGHT + 0.3)
        axes = add_axes(figure, left, left + 0.91 / COLUMNS - 0.045, top, top - 0.78 * inch)
        draw(axes, name)
        _frame(axes, curve, bare=column > 0)
    return to_svg(figure, about)


def _frame(axes: Axes, curve: Json, bare: bool) -> None:
    """Title, ticks and grid of one small picture. bare: without labels of shares, next to a picture
    that has them."""
    x, unit = curve["severities"], curve["unit"]
    axes.set_title(curve["title"], color=BLACK, size=SMALL + 0.5, loc="left", pad=3)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(0, 1.02)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    set_ticks(axes.yaxis, [0, 0.5, 1], percent=True, bare=bare)
    if unit.startswith(("share", "of ")):
        set_ticks(axes.xaxis, [x[0], x[-1]], f"% {unit.removeprefix('share').strip()}".strip(), 100)
    else:
        set_ticks(axes.xaxis, [x[0], x[-1]], "bits fewer" if unit.startswith("fewer") else unit)
    first, last = axes.get_xticklabels()
    first.set_horizontalalignment("left")
    last.set_horizontalalignment("right")
