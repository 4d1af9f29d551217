"""The room of the interactive chart. In: dots, as chart.json lists them, and their still picture. Out: one HTML file.

The file needs nothing else and works from a folder without a network; chart_page.html and chart_page.js are what it is made
of. Without scripts it shows the picture and a table.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

from train.reports import html as page
from train.reports.pareto import ACCURACIES, COSTS, Axis, Dot, name
from train.reports.plot_style import FONT, ROLES, share
from train.reports.scatter import label

TEMPLATE, SCRIPT = (Path(__file__).with_name(f"chart_page.{kind}") for kind in ("html", "js"))


def html(dots: Sequence[Dot], picture: str, quick: bool = False, left_out: Mapping[str, str] | None = None) -> str:
    """The whole file. picture: SVG. quick: the figures mean nothing. left_out: what is missing, and why."""
    accuracies = {key: axis for key, axis in ACCURACIES.items() if any(key in dot["accuracy"] for dot in dots)}
    named = [dict(dot) | {"name": name(dot), "label": label(dot)} for dot in dots]
    told = {"dots": named, "costs": _plain(COSTS), "accuracies": _plain(accuracies)}
    roles = (" ".join(f"--{k}: {v};" for k, v in those.items()) for those in (ROLES, page.DARK))
    parts = dict(zip(("light", "dark"), roles, strict=True)) | {
        "font": FONT, "picture": picture, "notes": "\n".join(_notes(dots, quick)), "table": _table(dots, accuracies),
        "origin": escape(_origin(dots, left_out or {})), "script": SCRIPT.read_text(),
        "data": json.dumps(told, allow_nan=False).replace("<", "\\u003c"),
    }  # fmt: skip
    text = TEMPLATE.read_text()
    for key, value in parts.items():
        text = text.replace("{{" + key + "}}", value)
    return text


def _plain(axes: Mapping[str, Axis]) -> dict[str, dict[str, str]]:
    return {key: asdict(axis) for key, axis in axes.items()}


def _notes(dots: Sequence[Dot], quick: bool) -> list[str]:
    """What this is, before any figure."""
    stop = page.text(
        "This is a quick run: few sweeps, hardly any training. It shows that every part works; none of its figures means "
        "anything.", kind="stop")  # fmt: skip
    return [stop] * quick + [
        page.text(
            f"{len(dots)} models that name a material, each packed as a bundle, loaded and timed as on the box, with the "
            "cost of its own features: all in turns, in one run, on one thread. What is hollow ran in its own library."
        ),
        page.text(
            "T-REAL, T-HARD and the stresses are simulated, and the simulator is a stand-in for a skin: read margins, "
            "not accuracies. FabricSlide is real; its windows are shorter, and the costs are those of a simulated sweep "
            "there too."
        ),
    ]


def _table(dots: Sequence[Dot], accuracies: Mapping[str, Axis]) -> str:
    """For readers without scripts: everything, the most accurate first."""
    first = next(iter(accuracies), "")
    order = sorted(dots, key=lambda dot: -dot["accuracy"].get(first, {"mean": -1})["mean"])
    head = ["model", *(a.short for a in accuracies.values()), *(f"{c.short} {c.unit}".strip() for c in COSTS.values())]
    rows = [[name(dot) + ("" if dot["runs_on_box"] else " ○"),
             *(_estimate(dot["accuracy"].get(key)) for key in accuracies), *(f"{dot[key]:,g}" for key in COSTS)]
            for dot in order]  # fmt: skip
    return page.table(head, rows)


def _estimate(told: Mapping[str, float] | None) -> str:
    return f"{share(told['mean'])} ({share(told['low'])} – {share(told['high'])})" if told else "–"


def _origin(dots: Sequence[Dot], left_out: Mapping[str, str]) -> str:
    """Where it comes from, and what is missing."""
    of = {key: " and ".join(sorted({str(dot[key]) for dot in dots})) for key in ("commit", "machine", "set")}
    seeds = sorted({seed for dot in dots for seed in dot["seeds"]})
    text = f"Measured on {of['machine']}, commit {of['commit']}; bundles of {of['set']}, training seeds {seeds}."
    missing = "; ".join(f"{what} ({why})" for what, why in left_out.items())
    return text + (f" Left out: {missing}." if missing else "")
