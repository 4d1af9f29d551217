"""Renders the interactive chart from dots, the entries of chart.json, as one HTML file that needs
no other file.

Its parts are templates/chart.html.j2 and chart.js. Without scripts it shows a picture and a table.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from train.models.methods import SHIPPED
from train.reports import html as pages
from train.reports import provenance
from train.reports.formatting import estimate
from train.reports.provenance import Provenance
from train.studies import TEMPLATES, comparison, method_names, scatter
from train.studies.method_names import OURS
from train.studies.pareto import ACCURACIES, COSTS, ChartAxis, Dot, label, name, networks, subject

SCRIPT = TEMPLATES / "chart.js"


def render(
    dots: Sequence[Dot], box_on_hard: Mapping[str, Any] | None = None
) -> tuple[str, dict[str, str]]:
    """The page (HTML) of the study `chart` and its picture (SVG). Dots of a quick run have
    "quick"."""
    picture = scatter.chart(dots)
    quick = any(dot.get("quick") for dot in dots)
    return html(dots, picture, quick, box_on_hard=box_on_hard), {"chart": picture}


def html(
    dots: Sequence[Dot],
    picture: str,
    quick: bool = False,
    left_out: Mapping[str, str] | None = None,
    box_on_hard: Mapping[str, Any] | None = None,
    accuracies: Mapping[str, ChartAxis] = ACCURACIES,
    source: str = "chart.json",
    header: Provenance | None = None,
) -> str:
    """The whole file.

    picture: SVG. quick: the run was too small for figures. left_out: missing methods, each with the
    reason. box_on_hard: the box's answers to T-HARD's sweeps, see pages.box_on_hard. accuracies:
    the axes; the first is shown at first. source: the file of results beside the page. header:
    provenance, if the dots have none.
    """
    there = {
        key: axis for key, axis in accuracies.items() if any(key in dot["accuracy"] for dot in dots)
    }
    costs = {
        key: axis for key, axis in COSTS.items() if any(dot.get(key) is not None for dot in dots)
    }
    chosen, of = subject(dots), networks(dots)
    named = _named(dots, of, chosen)
    data = json.dumps(
        {"dots": named, "costs": _plain(costs), "accuracies": _plain(there)}, allow_nan=False
    )
    head, rows = _table(dots, there, costs)
    return pages.render(
        "chart.html.j2",
        TEMPLATES,
        header=header or provenance.of(list(dots)),
        home=pages.HOME,
        dots=dots,
        count=len(set(of)),
        picture=pages.picture(picture),
        quick=quick,
        shipped=chosen == SHIPPED,
        chosen=method_names.plain_name(chosen),
        lines=_lines(dots, there, chosen),
        shown=comparison.shown,
        simulated=any("simulated" in axis.short for axis in there.values()),
        put_back="hard" in there,
        methods=_who(dots),
        head=head,
        rows=rows,
        source=source,
        sheet=_sheet(dots, there, costs),
        origin=_origin(dots),
        seeds=", ".join(map(str, sorted({seed for dot in dots for seed in dot["seeds"]}))),
        left_out=left_out or {},
        box_on_hard=box_on_hard,
        data=Markup(data.replace("<", "\\u003c")),  # no name of a model can end the script
        script=Markup(SCRIPT.read_text()),
    )


def _named(dots: Sequence[Dot], of: Sequence[int], chosen: str) -> list[dict[str, Any]]:
    """The dots for the page's script, with names. of: the network of each, as `networks` numbers
    them."""
    return [
        dict(dot)
        | {
            "name": name(dot),
            "label": label(dot),
            "network": network,
            "chosen": chosen in _methods(dots, of, network),
        }
        for dot, network in zip(dots, of, strict=True)
    ]


def _origin(dots: Sequence[Dot]) -> dict[str, str]:
    """The commits, machines and sets of all dots."""
    return {
        key: " and ".join(sorted({str(dot[key]) for dot in dots}))
        for key in ("commit", "machine", "set")
    }


def _plain(axes: Mapping[str, ChartAxis]) -> dict[str, dict[str, Any]]:
    return {key: asdict(axis) for key, axis in axes.items()}


def _methods(dots: Sequence[Dot], of: Sequence[int], network: int) -> set[str]:
    return {dot["method"] for dot, one in zip(dots, of, strict=True) if one == network}


def _lines(
    dots: Sequence[Dot], accuracies: Mapping[str, ChartAxis], chosen: str
) -> list[dict[str, Any]]:
    """For each protocol the packaged recipe beside the best of the peers. Each method counts in the
    precision that is listed first."""
    own = {dot["method"]: dot for dot in reversed(dots)}
    first = {method: own[method] for method in dict.fromkeys(dot["method"] for dot in dots)}
    return [
        comparison.line(
            axis.short,
            first[chosen]["accuracy"][key],
            {
                label(dot): dot["accuracy"][key]
                for dot in first.values()
                if dot["family"] != OURS and key in dot["accuracy"]
            },
        )
        | {"about": axis.about}
        for key, axis in accuracies.items()
        if chosen and key in first[chosen]["accuracy"]
    ]


def _who(dots: Sequence[Dot]) -> list[list[str]]:
    """Each model once: its name, a description, its name in commands. Models that differ in size
    alone share a line."""
    lines: dict[str, list[Dot]] = {}
    for dot in {dot["method"]: dot for dot in dots}.values():
        about = method_names.about(dot["method"])
        lines.setdefault(about or dot["method"], []).append(dot)
    return [
        [
            _together(those),
            method_names.about(those[0]["method"]),
            ", ".join(dot["method"] for dot in those),
        ]
        for those in lines.values()
    ]


def _together(those: Sequence[Dot]) -> str:
    """The common name of models that differ in size alone."""
    return label(those[0])


def _table(
    dots: Sequence[Dot], accuracies: Mapping[str, ChartAxis], costs: Mapping[str, ChartAxis]
) -> tuple[list[str], list[list[str]]]:
    """Head and lines of the table for readers without scripts, the most accurate dot first."""
    first = next(iter(accuracies), "")
    order = sorted(dots, key=lambda dot: -dot["accuracy"].get(first, {"mean": -1})["mean"])
    head = [
        "model",
        "measured as",
        *(a.short for a in accuracies.values()),
        *(f"{c.short} {c.unit}".strip() for c in costs.values()),
    ]
    rows = [
        [
            label(dot),
            name(dot) + ("" if dot["runs_on_box"] else " ○"),
            *(_accuracy(dot["accuracy"].get(key)) for key in accuracies),
            *(_cost(dot.get(key)) for key in costs),
        ]
        for dot in order
    ]
    return head, rows


def _accuracy(figures: Mapping[str, Any] | None) -> str:
    return estimate([figures[key] for key in ("mean", "low", "high")]) if figures else "–"


def _cost(value: float | None) -> str:
    return "–" if value is None else f"{value:,.12g}"


def _sheet(
    dots: Sequence[Dot], accuracies: Mapping[str, ChartAxis], costs: Mapping[str, ChartAxis]
) -> str:
    """All figures as a data address of a CSV file. Shares are from 0 to 1."""
    text, ends = io.StringIO(), ("mean", "low", "high")
    sheet = csv.writer(text)
    sheet.writerow(
        [
            "model",
            "method",
            "precision",
            "runtime",
            *(f"{a.short}, {end}" for a in accuracies.values() for end in ends),
            *(f"{c.short} {c.unit}".strip() for c in costs.values()),
        ]
    )
    for dot in dots:
        shares = [dot["accuracy"].get(key, {}).get(end, "") for key in accuracies for end in ends]
        about = [label(dot), *(dot[key] for key in ("method", "precision", "runtime"))]
        sheet.writerow(
            [*about, *shares, *("" if dot.get(key) is None else dot[key] for key in costs)]
        )
    return "data:text/csv;charset=utf-8," + quote(text.getvalue())
