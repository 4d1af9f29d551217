"""The development page. In: the figures of development_experiment. Out: results.json, pictures and a page.

Nothing is computed here but means and differences of what was measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.reports import html, scatter
from train.reports.development_experiment import EACH, OURS
from train.reports.formatting import estimate, exact_percent, points
from train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    SMALL,
    WIDTH,
    add_axes,
    set_categories,
    set_ticks,
    single_axes,
    to_svg,
)

Json = Mapping[str, Any]
Accuracies = Mapping[str, Json]
"""Entries of one case with all training sweeps, by method."""
LOOKS: tuple[Mapping[str, Any], ...] = (
    {"color": ACCENT, "linewidth": 2.0},
    {"color": BLACK, "linewidth": 1.4, "linestyle": (0, (3, 1.5))},
)
PALPATE, PEER, UNIT = scatter.OURS, "peers", "minirocket"
"""Families of the dots; the method whose time is 1."""
WANTED = {
    "7 fabrics, a force out": 0.90, "7 fabrics, a speed out": 0.93, "7 fabrics, a repetition out": 0.98,
    "4 fabrics, a direction out": 0.76, "simulated tubes, a position out": 0.985,
}  # fmt: skip
"""Accuracy that is wanted of ours, by case."""
NEAR, AHEAD, QUICKER, MOST_LOST = -0.01, 0.01, 100, 0.005
"""Wanted of ours in every case, less the best peer; on the mean; of its speed, in MiniRocket's; most that int8 may lose."""
ROUNDING = 1e-9
THIN: Mapping[str, Any] = {"color": GREY, "linewidth": 0.7, "alpha": 0.7}


def write(figures: Json, out: Path, quick: bool = False) -> Path:
    """results.json, the pictures and the page in the folder `out`; the page's path.

    Raises FormatError where there is no result of a method of ours.
    """
    page, pictures = render(figures, quick)
    put(out / "results.json", (json.dumps(figures, allow_nan=False) + "\n").encode(), parents=True)
    for name, svg in pictures.items():
        put(out / f"{name}.svg", svg.encode(), parents=True)
    put(out / "index.html", page.encode(), parents=True)
    return out / "index.html"


def render(figures: Json, quick: bool = False) -> tuple[str, dict[str, str]]:
    """The page (HTML) and its pictures (SVG) by name."""
    table = by_case(figures["results"])
    ours = subject(table)
    names = [name for name in figures["methods"] if any(name in row for row in table.values())]
    peers = [name for name in names if name not in OURS]
    there = [about for about in figures["cases"] if ours in table.get(about["case"], {})]
    cases = [about["case"] for about in there]
    real = [about["case"] for about in there if not about["simulated"]]
    pictures = {"accuracy": accuracy_picture({case: table[case] for case in cases}, ours, peers)}
    curves = learning_curves(figures["results"])
    if curves:
        pictures["curves"] = curve_picture(curves, ours, _most_accurate(table, peers))
    means = {"real and published": mean_row(table, real, ours, names, peers)}
    for what, mean in (("all, the simulated ones too", mean_row(table, cases, ours, names, peers)),
                       ("real and published that every method has", mean_row(table, real, ours, names, peers, peers))):  # fmt: skip
        if mean["shared"] and mean["shared"] not in [other["shared"] for other in means.values()]:
            means[what] = mean
    times = figures.get("times") or {"entries": [], "left_out": {}}
    if shown := dots(times["entries"], table, means["real and published"]["shared"]):
        pictures["front"] = scatter.chart(shown, ("development",))
    page = html.render(
        "development.html.j2", figures=figures, quick=quick, ours=ours, names=names, means=means, times=times,
        rows=[_row(case, table[case], ours, names, peers) for case in cases],
        precisions=list(precisions(table, means["real and published"]["shared"], names)),
        targets=list(targets(table, cases, ours, peers, means["real and published"], times["entries"])),
        curves=_curve_rows(curves, names), relative=relative_times(times["entries"], names), each=EACH,
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        about=[[one["case"], f"{one['set']}{', '.join(['', *one['only']])}", one["protocol"], one["sweeps"],
                one["materials"], one["digest"]] for one in figures["cases"] if one["case"] in table],
        costs=[[one[key] for key in ("method", "precision", "runtime", "ms_p50", "ms_p99")] for one in times["entries"]],
        fits=[[name, _fit_s(table, name)] for name in names], missing=_missing(table, cases, names, figures["left_out"]),
    )  # fmt: skip
    return page, pictures


def by_case(results: Iterable[Json]) -> dict[str, dict[str, Json]]:
    """Entries with all training sweeps: {case: {method: entry}}."""
    table: dict[str, dict[str, Json]] = {}
    for entry in results:
        if not entry["each"]:
            table.setdefault(entry["case"], {})[entry["method"]] = entry
    return table


def subject(table: Mapping[str, Accuracies]) -> str:
    """The first of OURS with a result. Raises FormatError where there is none."""
    for name in OURS:
        if any(name in row for row in table.values()):
            return name
    raise FormatError(f"no result of {' or '.join(OURS)}; run the command without --kept, or with one of them")


def best(row: Accuracies, peers: Sequence[str]) -> str:
    """The most accurate peer of a case; "" where none has a result."""
    return max((name for name in peers if name in row), key=lambda name: float(row[name]["mean"]), default="")


def _row(case: str, row: Accuracies, ours: str, names: Sequence[str], peers: Sequence[str]) -> Json:
    """A line of the table. difference: ours less the best peer, in points."""
    leader = best(row, peers)
    difference = points(row[ours]["mean"] - row[leader]["mean"], sign=True) if leader else "–"
    return {"case": case, "cells": [row.get(name) for name in names], "best": leader, "difference": difference,
            "leader": row.get(leader), "ours": row[ours]}  # fmt: skip


def mean_row(
    table: Mapping[str, Accuracies], cases: Sequence[str], ours: str, names: Sequence[str], peers: Sequence[str],
    of: Sequence[str] = (),
) -> Json:  # fmt: skip
    """Means over the cases (`shared`) that ours and the peers `of` have; None of a method that lacks one.

    Without `of` it is those peers and cases that make the largest table without gaps. best: the peer with the highest mean.
    """
    has = {name: {case for case in cases if name in table[case] and ours in table[case]} for name in peers}
    whole = of or max(([name for name in peers if has[name] >= has[peer]] for peer in peers),
                      key=lambda those: (len(those) * (lines := min(len(has[name]) for name in those)), lines), default=())  # fmt: skip
    shared = [case for case in cases if all(name in table[case] for name in (ours, *whole))]
    means = {name: float(np.mean([table[case][name]["mean"] for case in shared])) for name in names
             if shared and all(name in table[case] for case in shared)}  # fmt: skip
    leader = max((name for name in peers if name in means), key=lambda name: means[name], default="")
    return {
        "shared": shared, "best": leader, "cells": [means.get(name) for name in names], "leader": means.get(leader),
        "ours": means.get(ours), "gap": means[ours] - means[leader] if leader else None,
        "difference": points(means[ours] - means[leader], sign=True) if leader else "–",
    }  # fmt: skip


def targets(
    table: Mapping[str, Accuracies], cases: Sequence[str], ours: str, peers: Sequence[str], mean: Json, times: Sequence[Json]
) -> Iterator[Json]:  # fmt: skip
    """What was wanted of ours, and what it has: a line each, reached or not."""
    gaps = [table[c][ours]["mean"] - table[c][b]["mean"] for c in cases if (b := best(table[c], peers))]
    if gaps:
        near = sum(gap >= NEAR - ROUNDING for gap in gaps)
        yield {"what": "lines in which it is no more than one point below the best peer", "target": f"{len(gaps)} of {len(gaps)}",
               "here": f"{near} of {len(gaps)}", "met": near == len(gaps)}  # fmt: skip
    if mean["best"]:
        yield {"what": f"points ahead of {mean['best']}, the best peer on the mean of {len(mean['shared'])} real and published lines",
               "target": f"≥ {points(AHEAD)}", "here": mean["difference"], "met": mean["gap"] >= AHEAD - ROUNDING}  # fmt: skip
    for case, wanted in WANTED.items():
        if case in cases:
            entry = table[case][ours]
            yield {"what": case, "target": f"≥ {exact_percent(wanted)}", "met": entry["mean"] >= wanted - ROUNDING,
                   "here": estimate([entry["mean"], entry["low"], entry["high"]])}  # fmt: skip
    for one in precisions(table, mean["shared"], [ours]):
        yield {"what": "points that int8 loses of its own float, on the mean", "target": f"≤ {points(MOST_LOST)}",
               "here": points(one["float"] - one["int8"]), "met": one["float"] - one["int8"] <= MOST_LOST + ROUNDING}  # fmt: skip
    if (quick := quickest(times)).keys() >= {ours, UNIT}:
        ratio = quick[ours] / quick[UNIT]
        yield {"what": "time of a sweep, MiniRocket’s = 1", "target": f"≤ 1/{QUICKER}", "here": _ratio(ratio),
               "met": ratio * QUICKER <= 1}  # fmt: skip


def precisions(table: Mapping[str, Accuracies], cases: Sequence[str], names: Iterable[str]) -> Iterator[Json]:
    """Of each method that was run in int8 and in float: the means of both over those `cases` that it has."""
    for name in names:
        entries = [table[case][name] for case in cases if name in table[case] and table[case][name]["forms"]]
        if not entries:
            continue
        (form,) = entries[0]["forms"]
        own, other = (
            float(np.mean([e["mean"] for e in those])) for those in (entries, [e["forms"][form] for e in entries])
        )
        yield {"method": name, "lines": len(entries), form: other, "int8" if form == "float" else "float": own}


def dots(times: Iterable[Json], table: Mapping[str, Accuracies], cases: Sequence[str]) -> list[dict[str, Any]]:
    """Dots for scatter: the time of each method or form, and the mean of its accuracies and of the ends of their intervals.

    Of `cases` that it has all; without one there is no dot.
    """
    found = []
    for one in times:
        entries = [table[case][one["method"]] for case in cases if one["method"] in table[case]]
        if form := one.get("form"):
            entries = [entry["forms"][form] for entry in entries if form in entry["forms"]]
        if not entries or len(entries) < len(cases):
            continue
        accuracy = {key: float(np.mean([entry[key] for entry in entries])) for key in ("mean", "low", "high")}
        family = PALPATE if one["method"] in OURS else PEER
        found.append({**one, "family": family, "accuracy": {"development": accuracy}})
    return found


def quickest(times: Iterable[Json]) -> dict[str, float]:
    """Median time of a sweep in ms by method, of the form and library in which it is quickest."""
    ms: dict[str, float] = {}
    for one in times:
        ms[one["method"]] = min(float(one["ms_p50"]), ms.get(one["method"], np.inf))
    return ms


def relative_times(times: Iterable[Json], names: Sequence[str]) -> dict[str, str]:
    """Time of a sweep with each method, in those of MiniRocket where it is quickest: "1/94" or "11"."""
    ms = quickest(times)
    unit = ms.get(UNIT)
    return {name: _ratio(ms[name] / unit) for name in names if name in ms} if unit else {}


def _ratio(value: float) -> str:
    return f"1/{1 / value:.0f}" if value < 0.5 else f"{value:.2g}"


def _missing(
    table: Mapping[str, Accuracies], cases: Sequence[str], names: Sequence[str], left_out: Mapping[str, str]
) -> dict[str, list[str]]:
    """Of each method the cases in which it has no result, and for which no other reason is given."""
    lacks = {
        name: [case for case in cases if name not in table[case] and f"{name}, {case}" not in left_out]
        for name in names
    }
    return {name: those for name, those in lacks.items() if those}


def learning_curves(results: Iterable[Json]) -> dict[str, dict[str, dict[int, Json]]]:
    """{case: {method: {training sweeps of each material, 0 for all: entry}}} of cases that have more than one."""
    curves: dict[str, dict[str, dict[int, Json]]] = {}
    for entry in results:
        curves.setdefault(entry["case"], {}).setdefault(entry["method"], {})[entry["each"]] = entry
    return {case: lines for case, lines in curves.items() if any(set(line) & set(EACH) for line in lines.values())}


def _curve_rows(curves: Mapping[str, Any], names: Sequence[str]) -> list[Json]:
    """Lines of the table of learning curves. cells: an entry or None for each of EACH, and for all."""
    return [
        {"case": case, "method": name, "cells": [lines[name].get(each) for each in (*EACH, 0)]}
        for case, lines in curves.items() for name in names if name in lines
    ]  # fmt: skip


def _most_accurate(table: Mapping[str, Accuracies], peers: Sequence[str]) -> str:
    """The peer that is the best one of the most cases."""
    wins = [best(row, peers) for row in table.values()]
    return max(peers, key=wins.count, default="")


def _fit_s(table: Mapping[str, Accuracies], name: str) -> str:
    """Time to train a fold in s: the median over all cases."""
    return f"{float(np.median([row[name]['fit_s'] for row in table.values() if name in row])):.2f}"


def accuracy_picture(table: Mapping[str, Accuracies], ours: str, peers: Sequence[str]) -> str:
    """A line for each case: every peer a grey dot, ours in the accent colour with its interval."""
    figure, axes = single_axes(0.29 * len(table) + 0.75, left=0.43, right=0.93, top=0.35, bottom=0.3)
    lows = []
    for y, (case, row) in enumerate(table.items()):
        there = [float(row[name]["mean"]) for name in peers if name in row]
        axes.plot(there, [y] * len(there), "o", color=GREY, markersize=4, alpha=0.6)
        axes.plot([row[ours]["low"], row[ours]["high"]], [y, y], color=ACCENT, linewidth=1.2)
        axes.plot(row[ours]["mean"], y, "o", color=ACCENT, markersize=6)
        axes.annotate(case, (0, y), (-8, 0), ("axes fraction", "data"), textcoords="offset points", ha="right",
                      va="center", color=BLACK, size=SMALL)  # fmt: skip
        lows += [row[ours]["low"], *there]
    axes.set_ylim(len(table) - 0.5, -0.5)
    _shares(axes, lows)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    set_ticks(axes.yaxis, [])
    for text, x, colour in ((f"● {ours}, 95 %", 0.0, ACCENT), ("● peers", 0.55, GREY)):
        axes.annotate(text, (x, 1), (0, 8), "axes fraction", textcoords="offset points", color=colour, size=SMALL + 0.5)
    return to_svg(figure, f"accuracy of {ours} and its peers on each development set")


def _shares(axes: Axes, lows: Sequence[float]) -> None:
    """The horizontal axis, in per cent, from the next fifth below all to 1."""
    low = np.floor(5 * min(lows, default=0) - 1e-9) / 5
    axes.set_xlim(low, 1.005)
    set_ticks(axes.xaxis, np.arange(low, 1.01, 0.1 if low > 0.5 else 0.2), percent=True)


def curve_picture(curves: Mapping[str, Any], ours: str, peer: str) -> str:
    """A plot for each case: accuracy over training sweeps of a material; ours and one peer stand out."""
    figure, each = Figure((WIDTH, 0.3 + 2.1 * len(curves))), 2.1
    inch = 1 / figure.get_figheight()
    at = {n: x for x, n in enumerate((*EACH, 0))}
    for i, (text, look) in enumerate([(f"━ {ours}", LOOKS[0]), (f"╍ {peer}", LOOKS[1]), ("thin: the others", THIN)]):
        figure.text(0.01 + 0.33 * i, 1 - 0.18 * inch, text, color=look["color"], size=SMALL + 0.5)
    for number, (case, lines) in enumerate(curves.items()):
        top = 1 - inch * (0.55 + each * number)
        axes = add_axes(figure, 0.12, 0.97, top, top - inch * 1.45)
        for name in sorted(lines, key=lambda name: name in (ours, peer)):
            look = LOOKS[0] if name == ours else LOOKS[1] if name == peer else THIN
            line = sorted(lines[name].items(), key=lambda item: at[item[0]])
            axes.plot([at[n] for n, _ in line], [entry["mean"] for _, entry in line], **look)
        axes.set_title(case, color=BLACK, size=SMALL + 0.5, loc="left", pad=4)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_xlim(-0.1, len(EACH) + 0.1)
        axes.set_ylim(0, 1.02)
        set_ticks(axes.yaxis, [0, 0.25, 0.5, 0.75, 1], percent=True)
        set_categories(axes.xaxis, range(len(EACH) + 1), [*map(str, EACH), "all"])
    return to_svg(figure, "accuracy over training sweeps of each material")
