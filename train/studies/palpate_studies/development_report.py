"""Renders the page "Speed against accuracy" from the results of the study `development`.

It computes nothing but means, differences and ranks of the measured figures.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_studies import TEMPLATES, comparison, development_plots, differences
from palpate_studies.comparison import ROUNDING
from palpate_studies.development_chart import (
    SERIES,
    TACTILE,
    UNIT,
    Accuracies,
    ChartPanel,
    Json,
    about_case,
    by_case,
    finding,
    panels,
    plain_case,
    quickest,
    ratio,
    relative_times,
)
from palpate_studies.development_experiment import EACH, LINE, OURS, PEERS
from palpate_studies.method_names import about, plain_name, short_name
from palpate_studies.ranks import Ranking, ranking
from palpate_train.models.methods import PACKAGED
from palpate_train.reports import html, provenance
from palpate_train.reports.formatting import amount, estimate, exact_percent, percent, points

WANTED = {
    "7 fabrics, a force out": 0.91,
    "7 fabrics, a speed out": 0.94,
    "7 fabrics, a repetition out": 0.985,
    "4 fabrics, a direction out": 0.84,
    "4 fabrics, a force out": 0.87,
    "4 fabrics, a speed out": 0.90,
}
"""Target accuracy of our largest size, by case."""
NEAREST, SIZES = 0.01, 6
"""Targets: largest distance to the best peer on published series; sizes of the family."""
PAPER_CNN = "paper-cnn-centred"
FASTER = (
    ("smallest", PAPER_CNN, 80),
    ("packaged", PAPER_CNN, 40),
    ("packaged", UNIT, 100),
    ("largest", UNIT, 20),
)
"""Targets of time: a size, the method that it is compared with, and how many times faster it is."""
BUDGETS_MS = (0.2, 0.5, 1.0, 10.0, 100.0, 1000.0)
"""Times of a sweep for which the page names the best model."""
SIZES_OF = (("file_kb", "KB"), ("rss_mb", "MB"))
"""Costs of a model in bytes, with their units."""
WINDOW = re.compile(r"at ([\d.]+) Hz, window (\d+)")


def render(figures: Json, early: Json | None = None) -> tuple[dict[str, str], dict[str, str]]:
    """The page (HTML) and its pictures (SVG) by name.

    early: results of the study certainty, for the time of early answers. Raises FormatError without
    a result of a method of ours.
    """
    table = by_case(figures["results"])
    ours = subject(table)
    names = [name for name in figures["methods"] if any(name in row for row in table.values())]
    cases = {case["case"]: case for case in figures["cases"] if ours in table.get(case["case"], {})}
    lines = [comparison_line(one, table[case], ours, names) for case, one in cases.items()]
    shown = panels(figures)
    pictures = _pictures(figures, cases, lines, early, ours)
    page = html.render(
        "development.html.j2",
        TEMPLATES,
        header=provenance.of(figures),
        home=html.HOME,
        figures=figures,
        quick=bool(figures.get("quick")),
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        panels=[[panel.kind, finding(panel), len(panel.cases)] for panel in shown],
        budgets=budgets(shown),
        targets=list(targets(table, cases, shown, _times(figures)["entries"])),
        ours=ours,
        names=names,
        table=table,
        lines=lines,
        best_of={case: line["best"] for case, line in zip(cases, lines, strict=True)},
        shown=comparison.shown,
        means=_mean_rows(shown, names),
        precisions=list(precisions(table, shown, names)),
        curves=_curve_rows(learning_curves(figures["results"], ours), names),
        each=EACH,
        **_costs(figures, table, names),
        **_words(cases, names, _missing(table, cases, names, figures["left_out"])),
    )
    return {"index": page}, pictures


def front(figures: Json) -> str:
    """The picture of README."""
    return development_plots.speed(panels(figures), machine(figures))


def caption(figures: Json) -> str:
    """The text of README below the picture."""
    older = provenance.of(figures).older
    said = [f"{panel.kind.capitalize()}: {finding(panel)}." for panel in panels(figures)]
    return "\n\n".join(([f"*{older}*"] if older else []) + [" ".join(said)])


def machine(figures: Json) -> str:
    """Processor and threads of the measured times."""
    where = _times(figures).get("processor") or figures["runs"][0]["machine"]
    return f"{where}, one thread, all methods in turns in one process"


def _times(figures: Json) -> Json:
    """The measured times; empty if nothing was timed."""
    return figures.get("times") or {"entries": [], "left_out": {}}


def _pictures(
    figures: Json, cases: Mapping[str, Json], lines: Sequence[Json], early: Json | None, ours: str
) -> dict[str, str]:
    """All pictures that the results allow."""
    shown, pictures = panels(figures), {}
    if shown:
        pictures["front"] = front(figures)
    if beside := [line for line in lines if line["best"]]:
        pictures["accuracy"] = development_plots.dumbbells(beside)
    table = by_case(figures["results"])
    if ordered := {panel.kind: one for panel in shown if (one := rank(panel, table))}:
        pictures["ranks"] = development_plots.ranks(ordered)
    if touched := touch_curves(figures, early):
        pictures["touch"] = development_plots.touch(touched)
    if curves := learning_curves(figures["results"], ours):
        pictures["curves"] = development_plots.curves(cases, curves, ours)
    return pictures


def subject(table: Mapping[str, Accuracies]) -> str:
    """The first of OURS with a result. Raises FormatError if none has one."""
    for name in OURS:
        if any(name in row for row in table.values()):
            return name
    raise FormatError(
        f"no result of {' or '.join(OURS)}; run the command without --kept, or with one of them"
    )


def comparison_line(case: Json, row: Accuracies, ours: str, names: Sequence[str]) -> dict[str, Any]:
    """Ours beside the best peer in one test."""
    peers = {plain_name(name): row[name] for name in names if name not in OURS and name in row}
    return comparison.line(plain_case(case), row[ours], peers)


def rank(panel: ChartPanel, table: Mapping[str, Accuracies]) -> Ranking | None:
    """The ranking of our two recipes and of the peers that were run in every test; None for fewer
    than two."""
    names = {spot.method for spot in panel.whole} - set(LINE[:-1])
    cases = [case["case"] for case in panel.cases]
    accuracies = {
        name: [float(table[case][name]["mean"]) for case in cases] for name in sorted(names)
    }
    return ranking(accuracies) if len(accuracies) > 1 else None


def touch_curves(figures: Json, early: Json | None) -> dict[str, Any]:
    """Accuracy over seconds of touch by test and method: shorter windows, ours with all views
    first, then the peers; and in simulation windows of different length, and the early answers of
    the box."""
    found: dict[str, Any] = {}
    known = {case["case"]: case for case in figures["cases"]}
    shorter = {(e["case"], e["method"]) for e in figures["results"] if e.get("frames")}
    shown = [name for name in (OURS[0], *PEERS) if name in {name for _, name in shorter}]
    for case, name in ((case, name) for case in known for name in shown):
        if (case, name) not in shorter:
            continue
        window = int(known[case]["format"].rpartition(" ")[2])
        line = sorted(
            ((e.get("frames") or window) / known[case]["rate_hz"], e["mean"])
            for e in figures["results"]
            if (e["case"], e["method"], e["each"]) == (case, name, 0)
        )
        found.setdefault(plain_case(known[case]), {})[plain_name(name)] = line
    if early and (format := WINDOW.search(early["format"])):
        window_s = int(format[2]) / float(format[1])
        parts, rule = early["early"]["always"], early["early"]["rule"]
        found["simulated tubes: other skins than in training"] = {
            "after a set time": [
                (window_s * (i + 1) / len(parts), one["accuracy"]) for i, one in enumerate(parts)
            ],
            "early answers": [(window_s * early["early"]["share"], rule["accuracy"])],
        }
    return found


def budgets(shown: Sequence[ChartPanel]) -> list[list[str]]:
    """Rows of a table: a time of a sweep, and for each panel the best model within it."""
    rows = []
    for ms in BUDGETS_MS:
        cells = []
        for panel in shown:
            best = panel.within(ms)
            cells.append(
                f"{plain_name(best.method)}, {best.precision}: "
                f"{percent(best.mean)} in {amount(best.ms, 'ms')}"
                if best
                else "none"
            )
        rows.append([amount(ms, "ms"), *cells])
    return rows


def targets(
    table: Mapping[str, Accuracies],
    cases: Mapping[str, Json],
    shown: Sequence[ChartPanel],
    times: Sequence[Json],
) -> Iterator[Json]:
    """A line for each target: wanted, reached, and whether it is met."""
    for case, wanted in WANTED.items():
        if case in cases and (one := table[case].get(OURS[0])):
            yield {
                "what": f"{plain_case(cases[case])}, {_seeds(one)}",
                "target": f"≥ {exact_percent(wanted)}",
                "met": one["mean"] >= wanted - ROUNDING,
                "here": estimate(differences.of(one)),
            }
    for panel in shown:
        if panel.kind == SERIES and panel.ours and panel.peer:
            gap = differences.difference(panel.ours.accuracy, panel.peer.accuracy)
            yield {
                "what": f"points ahead of {short_name(panel.peer.method)}, mean of {SERIES}",
                "target": f"≥ {points(-NEAREST)}",
                "met": gap[0] >= -NEAREST - ROUNDING,
                "here": comparison.shown(gap),
            }
        elif panel.kind == TACTILE and panel.sizes:
            beaten = panel.dominated
            yield {
                "what": f"sizes on {TACTILE} than which no peer is faster and more accurate",
                "target": f"all of {SIZES} or more",
                "met": not beaten and len(panel.sizes) >= SIZES,
                "here": f"{len(panel.sizes) - len(beaten)} of {len(panel.sizes)}",
            }
    yield from time_targets(times)


def _seeds(entry: Json) -> str:
    count = len(entry["seeds"])
    return f"{count} seed" if count == 1 else f"{count} seeds"


def time_targets(times: Sequence[Json]) -> Iterator[Json]:
    """Lines for the targets of time whose methods were timed. The paper's CNN counts in int8."""
    ms, whole = quickest(times), quickest(times, "int8")
    sizes = {name: ms[name] for name in OURS if name in ms and name != PACKAGED}
    own = {"packaged": ms.get(PACKAGED)}
    if sizes:
        own |= {"smallest": min(sizes.values()), "largest": max(sizes.values())}
    for size, peer, wanted in FASTER:
        other, mine = (whole if peer == PAPER_CNN else ms).get(peer), own.get(size)
        if other and mine:
            yield {
                "what": f"time of our {size} model, {short_name(peer)}’s = 1",
                "target": f"≤ 1/{wanted}",
                "met": mine * wanted <= other,
                "here": ratio(mine / other),
            }


def _mean_rows(shown: Sequence[ChartPanel], names: Sequence[str]) -> list[Json]:
    """For each panel the means of the methods that were run in every test."""
    rows: list[Json] = []
    for panel in shown:
        entries = {
            spot.method: differences.entry(spot.accuracy) for spot in panel.whole if not spot.form
        }
        peers = {name: entries[name]["mean"] for name in entries if name not in OURS}
        best = max(peers, key=lambda name: peers[name], default="")
        rows.append({"what": panel.kind, "n": len(panel.cases), "entries": entries, "best": best})
    return rows


def _costs(figures: Json, table: Mapping[str, Accuracies], names: Sequence[str]) -> dict[str, Any]:
    """Times and costs of all methods, in words."""
    times = _times(figures)
    return {
        "times": times,
        "box": times.get("box"),
        "machine": machine(figures),
        "relative": relative_times(times["entries"], names),
        "costs": [_cost(one) for one in times["entries"]],
        "fits": [[plain_name(name), _fit_s(table, name)] for name in names],
    }


def _cost(one: Json) -> list[str]:
    """A row of the table of costs."""
    counts = [f"{one[key]:,}" if one.get(key) else "–" for key in ("weights", "macs")]
    sizes = [amount(one[key], unit) if one.get(key) else "–" for key, unit in SIZES_OF]
    times = [amount(one[key], "ms") for key in ("ms_p50", "ms_p99")]
    name = plain_name(one["method"])
    return [name, one["precision"], one["runtime"], *times, *counts, *sizes]


def precisions(
    table: Mapping[str, Accuracies], shown: Sequence[ChartPanel], names: Iterable[str]
) -> Iterator[list[str]]:
    """Rows of a table: for each panel and method with results in int8 and in float, the means of
    both."""
    for panel in shown:
        for name in names:
            entries = [
                table[case["case"]][name]
                for case in panel.cases
                if table[case["case"]].get(name, {}).get("forms")
            ]
            if not entries:
                continue
            (form,) = entries[0]["forms"]
            own, other = (
                float(np.mean([e["mean"] for e in those]))
                for those in (entries, [e["forms"][form] for e in entries])
            )
            int8, whole = (own, other) if form == "float" else (other, own)
            yield [
                plain_name(name),
                panel.kind,
                *map(percent, (int8, whole)),
                points(whole - int8),
                str(len(entries)),
            ]


def _words(
    cases: Mapping[str, Json], names: Sequence[str], missing: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Names of cases and methods in words. missing: by method the cases without a result."""
    plain = {case: plain_case(one) for case, one in cases.items()}
    return {
        "plain": plain,
        "name_of": plain_name,
        "about": {name: about(name) for name in names},
        "missing": {name: [plain[case] for case in those] for name, those in missing.items()},
        "sets": [[plain[case], about_case(one), one["sweeps"]] for case, one in cases.items()],
        "files": [
            [plain[case], ", ".join([one["set"], *one["only"]]), one["protocol"], one["digest"]]
            for case, one in cases.items()
        ],
    }


def _missing(
    table: Mapping[str, Accuracies],
    cases: Iterable[str],
    names: Sequence[str],
    left_out: Mapping[str, str],
) -> dict[str, list[str]]:
    """By method the cases without a result and without another reason; methods without any result
    come last."""
    every = [*names, *(name for name in PEERS if name not in names)]
    lacks = {
        name: [
            case for case in cases if name not in table[case] and f"{name}, {case}" not in left_out
        ]
        for name in every
    }
    return {name: those for name, those in lacks.items() if those}


def learning_curves(results: Iterable[Json], ours: str) -> dict[str, dict[str, dict[int, Json]]]:
    """{case: {method: {training sweeps of each material, 0 for all: entry}}} of the cases in which
    ours has all sweeps and another point."""
    curves: dict[str, dict[str, dict[int, Json]]] = {}
    for entry in results:
        if not entry.get("frames"):
            line = curves.setdefault(entry["case"], {}).setdefault(entry["method"], {})
            line[entry["each"]] = entry
    return {
        case: lines
        for case, lines in curves.items()
        if 0 in (own := lines.get(ours, {})) and set(own) & set(EACH)
    }


def _curve_rows(curves: Mapping[str, Any], names: Sequence[str]) -> list[Json]:
    """Lines of the table of learning curves. cells: an entry or None for each of EACH, and for
    all."""
    return [
        {"case": case, "method": name, "cells": [lines[name].get(each) for each in (*EACH, 0)]}
        for case, lines in curves.items()
        for name in names
        if name in lines
    ]


def _fit_s(table: Mapping[str, Accuracies], name: str) -> str:
    """Time to train a fold in s: the median over all cases."""
    return f"{float(np.median([row[name]['fit_s'] for row in table.values() if name in row])):.2f}"
