"""The interactive chart. In: dots, as chart.json lists them, and their picture. Out: one HTML file that needs nothing else.

It is made of templates/chart.html.j2 and chart.js, and shows the picture and a table where scripts do not run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from markupsafe import Markup

from train.models.methods import SHIPPED
from train.reports import html as pages
from train.reports.formatting import estimate
from train.reports.pareto import ACCURACIES, COSTS, Axis, Dot, name
from train.reports.scatter import label

SCRIPT = pages.TEMPLATES / "chart.js"


def html(
    dots: Sequence[Dot],
    picture: str,
    quick: bool = False,
    left_out: Mapping[str, str] | None = None,
    box_on_hard: Mapping[str, Any] | None = None,
) -> str:
    """The whole file. picture: SVG. quick: the figures mean nothing. left_out: what is missing, and why. box_on_hard: what
    the box answers to T-HARD's sweeps, see chart_report.box_on_hard."""
    accuracies = {key: axis for key, axis in ACCURACIES.items() if any(key in dot["accuracy"] for dot in dots)}
    named = [dict(dot) | {"name": name(dot), "label": label(dot)} for dot in dots]
    data = json.dumps({"dots": named, "costs": _plain(COSTS), "accuracies": _plain(accuracies)}, allow_nan=False)
    head, rows = _table(dots, accuracies)
    return pages.render(
        "chart.html.j2",
        dots=dots,
        picture=pages.picture(picture),
        quick=quick,
        shipped=any(dot["method"] == SHIPPED for dot in dots),
        head=head,
        rows=rows,
        origin={key: " and ".join(sorted({str(dot[key]) for dot in dots})) for key in ("commit", "machine", "set")},
        seeds=", ".join(map(str, sorted({seed for dot in dots for seed in dot["seeds"]}))),
        left_out=left_out or {},
        box_on_hard=box_on_hard,
        data=Markup(data.replace("<", "\\u003c")),  # no name of a model can end the script
        script=Markup(SCRIPT.read_text()),
    )


def _plain(axes: Mapping[str, Axis]) -> dict[str, dict[str, str]]:
    return {key: asdict(axis) for key, axis in axes.items()}


def _table(dots: Sequence[Dot], accuracies: Mapping[str, Axis]) -> tuple[list[str], list[list[str]]]:
    """Head and lines of the table for readers without scripts: all figures, the most accurate dot first."""
    first = next(iter(accuracies), "")
    order = sorted(dots, key=lambda dot: -dot["accuracy"].get(first, {"mean": -1})["mean"])
    head = ["model", *(a.short for a in accuracies.values()), *(f"{c.short} {c.unit}".strip() for c in COSTS.values())]
    rows = [[name(dot) + ("" if dot["runs_on_box"] else " ○"),
             *(_accuracy(dot["accuracy"].get(key)) for key in accuracies), *(f"{dot[key]:,g}" for key in COSTS)]
            for dot in order]  # fmt: skip
    return head, rows


def _accuracy(figures: Mapping[str, Any] | None) -> str:
    return estimate([figures[key] for key in ("mean", "low", "high")]) if figures else "–"
