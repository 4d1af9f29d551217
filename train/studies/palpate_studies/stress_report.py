"""Renders the page of the study `stress`: which corruptions break each method first.

It computes nothing but differences and orders. The first method is ours; five at most are drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate.core.errors import FormatError
from palpate_studies import stress_plots
from palpate_studies.method_names import about, plain_name, short_name
from palpate_studies.study import Rendered, drawn
from palpate_train.evaluate.robustness import POINTS, breaks_first
from palpate_train.reports.formatting import exact_percent, level

Json = Mapping[str, Any]
BOX, NETWORK = "the box, as it answers", "its network alone"
SHOWN = 3
"""Corruptions of each method in the table of the first losses."""


def render(result: Json, name: str = "stress") -> Rendered:
    """The page and its pictures. name: of the file of results. Raises
    FormatError if no method has a result."""
    entries = {
        plain_name(name): entry for name, entry in result["methods"].items() if entry["curves"]
    }
    if not entries:
        raise FormatError(
            "no method has a result; run the study without --kept, or with other methods"
        )
    curves = {name: entry["curves"] for name, entry in entries.items()}
    ours, box = next(iter(curves)), result["box"]["curves"]
    paired, (falls, broken) = _columns(result, "pairs"), first(curves[ours])
    pictures = {"curves": stress_plots.methods(curves)}
    pictures |= {"box": stress_plots.box(box)} if box else {}
    return drawn(
        "stress.html.j2",
        result,
        pictures,
        r=result,
        name=name,
        command=command(result, name),
        pairs=pair_lines(paired),
        pair_heads=list(paired),
        ours=ours,
        points=exact_percent(POINTS).removesuffix(" %"),
        clean={name: _of(next(iter(those.values())), 0) for name, those in curves.items()},
        headline={"first": falls, "broken": broken, "all": len(curves[ours])},
        first=[[name, *first(those)] for name, those in _with_box(curves, result["box"]).items()],
        most_wrong=most_wrong(box["wrong"]) if box else None,
        falls=fall_lines(curves, box),
        missing=missing(curves, ours),
        methods=[[plain_name(name), about(name), name] for name in result["methods"]],
        refused={
            plain_name(k): of["refused"] for k, of in result["methods"].items() if of["refused"]
        },
    )


def _with_box(curves: Json, box: Json) -> Json:
    """The curves of methods, and of the box's right answers if there are any."""
    which = "the packaged bundle" if box["bundle"]["name"] == "default" else "its bundle"
    answered = {f"{which}, as the box answers": box["curves"]["correct"]} if box["curves"] else {}
    return {**curves, **answered}


def _columns(result: Json, kind: str) -> Json:
    """The columns of a matrix: the box as it answers, its network alone, and the methods. kind:
    "curves", or "pairs" of corruptions, which older results lack."""
    box = result["box"].get(kind)
    own = {BOX: box["correct"], NETWORK: box["network"]} if box else {}
    methods = {short_name(name): entry.get(kind) for name, entry in result["methods"].items()}
    return own | {name: curves for name, curves in methods.items() if curves}


def pair_lines(columns: Json) -> list[list[str]]:
    """For each pair of corruptions its title, and the accuracy of each column in per cent. The
    pair that costs most comes first."""
    about = {name: one for curves in columns.values() for name, one in curves.items()}
    lost = {
        name: [curves[name]["lost"] for curves in columns.values() if name in curves]
        for name in about
    }
    order = sorted(about, key=lambda name: -sum(lost[name]) / len(lost[name]))
    return [
        [
            about[name]["title"],
            *(
                f"{100 * curves[name]['accuracy'][1]:.0f}" if name in curves else ""
                for curves in columns.values()
            ),
        ]
        for name in order
    ]


def command(result: Json, name: str) -> str:
    """The command line that measures the result again."""
    words = ["python -m palpate_studies stress --set", result["train"]]
    if only := result.get("only"):
        words += ["--only", *(f"'{one}'" for one in only)]
    words += ["--split", result["split"]] if result.get("split") else []
    words += ["--method", ",".join(result["methods"]), "--seeds", str(len(result["seeds"]))]
    words += ["--out", f"docs/data/{name}.json"] if name != "stress" else []
    return " ".join(words)


def first(curves: Json) -> tuple[list[str], int]:
    """The corruptions that break a method first, in order, and the number of all that do."""
    broken = breaks_first(curves)
    falls = [curves[name] for name in broken[:SHOWN]]
    return [f"{of['title']}: {level(of, of['falls'])}" for of in falls], len(broken)


def _of(curve: Json, i: int) -> tuple[float, float, float]:
    """Share and interval at one severity."""
    return curve["accuracy"][i], curve["low"][i], curve["high"][i]


def most_wrong(curves: Json) -> Json:
    """The corruption and severity with most wrong labels of the box, and their share."""
    name, i = max(
        ((name, i) for name, curve in curves.items() for i in range(len(curve["accuracy"]))),
        key=lambda at: curves[at[0]]["accuracy"][at[1]],
    )
    curve = curves[name]
    return {
        "title": curve["title"],
        "level": level(curve, curve["severities"][i]),
        "share": _of(curve, i),
    }


def fall_lines(curves: Mapping[str, Json], box: Json) -> list[list[str]]:
    """For each corruption its description, and the severity at which each method, and the box, has
    lost five points."""
    columns = [*curves.values(), *([box["correct"]] if box else [])]
    about = {name: curve for those in columns for name, curve in those.items()}
    return [
        [f"{curve['title']}: {curve['about']}", *(_cell(those.get(name)) for those in columns)]
        for name, curve in about.items()
    ]


def _cell(curve: Json | None) -> str:
    if curve is None:
        return ""
    beyond = curve["falls"] is None
    return "> " * beyond + level(curve, curve["severities"][-1] if beyond else curve["falls"])


def missing(curves: Mapping[str, Json], ours: str) -> list[str]:
    """Corruptions without a picture: they cost no drawn method five points."""
    shown = stress_plots.shown(curves)
    return [curve["title"] for name, curve in curves[ours].items() if name not in shown]
