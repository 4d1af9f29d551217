"""Names next to the marks of a picture, each at the first place that is free."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.axes import Axes

from palpate_train.reports.plot_style import GREY, SMALL

PLACES = [
    (dx, dy, side)
    for right, up in ((7, 0), (0, 10), (5, 12), (0, 20), (8, 18), (16, 26), (24, 34))
    for dx, dy in dict.fromkeys(((right, up), (-right, up), (right, -up), (-right, -up)))
    for side in (("left" if dx > 0 else "right" if dx < 0 else "center"),)
]
"""Places of a name relative to its mark, in units, and its alignment; the best first."""
FAR = 15
"""From this distance on a stroke joins name and mark."""
SIDES = {"left": 0.0, "center": 0.5, "right": 1.0}
"""The side of a name at which its mark is."""
LETTER = 0.55
"""Width of a letter, as a share of its size."""
GAP = 3.0
"""Least distance from a name to the next on its line, and to a mark, in units."""
MARK = 4.0
"""Half the width of a mark, in units."""
LEADER: dict[str, Any] = {"arrowstyle": "-", "color": GREY, "linewidth": 0.6, "shrinkB": MARK}
Box = tuple[float, float, float, float]
Label = tuple[float, float, str, str, bool]
"""A mark (x, y in the plot's units), its name or "", the name's colour, and whether it is bold."""


def write(axes: Axes, labels: Sequence[Label], taken: Sequence[tuple[float, float]] = ()) -> None:
    """Write names next to their marks, the most important first. A name is written once, at the
    first of its marks with a free place; without one it is left out.

    taken: points in the plot's units where lines run. The axes have their final limits.
    """
    at = [axes.transData.transform(label[:2]) for label in labels]
    boxes: list[Box] = [(x - MARK, y - MARK, x + MARK, y + MARK) for x, y in at]
    boxes += [(x - 1, y - 1, x + 1, y + 1) for x, y in map(axes.transData.transform, taken)]
    left, bottom, right, top = map(float, axes.get_window_extent().extents)
    written: set[str] = set()
    for i, (x, y, text, colour, bold) in enumerate(labels):
        width = LETTER * SMALL * len(text) * (1.1 if bold else 1.0)
        for dx, dy, side in PLACES if text and text not in written else ():
            start = at[i][0] + dx - SIDES[side] * width
            middle = at[i][1] + dy
            box = (start - GAP, middle - 0.5 * SMALL, start + width + GAP, middle + 0.5 * SMALL)
            inside = (
                box[0] >= left and box[2] <= right + 6 and box[1] >= bottom and box[3] <= top + 6
            )
            parts = [box, *(_stroke(at[i], (at[i][0] + dx, middle)) if abs(dy) > FAR else ())]
            others = [other for k, other in enumerate(boxes) if k != i]
            if inside and not any(_meet(part, other) for part in parts for other in others):
                boxes += parts
                written.add(text)
                axes.annotate(
                    text,
                    (x, y),
                    (dx, dy),
                    textcoords="offset points",
                    size=SMALL,
                    va="center",
                    ha=side,
                    color=colour,
                    weight="bold" if bold else "normal",
                    annotation_clip=False,
                    zorder=6,
                    arrowprops=LEADER | {"relpos": (SIDES[side], 0.5)} if abs(dy) > FAR else None,
                )
                break


def _stroke(begin: Iterable[float], end: Iterable[float]) -> list[Box]:
    """Boxes along the stroke from a mark to its name."""
    (x, y), (to_x, to_y) = begin, end
    along = [(x + t * (to_x - x), y + t * (to_y - y)) for t in (0.3, 0.45, 0.6, 0.75, 0.9)]
    return [(px - 1, py - 1, px + 1, py + 1) for px, py in along]


def _meet(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
