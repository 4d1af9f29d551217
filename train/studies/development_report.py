"""Renders the pages of the study `development`.

It computes nothing but means and differences of the measured figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from appliance.core.errors import FormatError
from train.reports import html, provenance
from train.reports.formatting import estimate, exact_percent, points
from train.studies import (
    TEMPLATES,
    chart_page,
    comparison,
    development_chart,
    development_plots,
    differences,
    method_names,
    scatter,
)
from train.studies.comparison import ROUNDING
from train.studies.development_chart import (
    UNIT,
    Accuracies,
    Json,
    about_case,
    plain_case,
    quickest,
    ratio,
    relative_times,
)
from train.studies.development_experiment import EACH, OURS

WANTED = {
    "7 fabrics, a force out": 0.90,
    "7 fabrics, a speed out": 0.93,
    "7 fabrics, a repetition out": 0.98,
    "4 fabrics, a direction out": 0.76,
    "simulated tubes, a position out": 0.985,
}
"""Target accuracy of ours, by case."""
AHEAD, QUICKER, MOST_LOST, HALF = 0.01, 100, 0.005, 0.5
"""Targets of ours: lead on the best peer's mean, speed in MiniRocket's, largest loss of int8
against float, largest time of int8 against float."""


REAL = "real and published"
"""Name of the first mean."""


def render(figures: Json) -> tuple[dict[str, str], dict[str, str]]:
    """The pages (HTML) and pictures (SVG) by name; "chart" is there if something was timed.

    Raises FormatError without a result of a method of ours.
    """
    table = by_case(figures["results"])
    ours = subject(table)
    names = [name for name in figures["methods"] if any(name in row for row in table.values())]
    peers = [name for name in names if name not in OURS]
    cases = [case for case in figures["cases"] if ours in table.get(case["case"], {})]
    of = {case["case"]: case for case in cases}
    means = _means(table, cases, ours, names, peers)
    main = means[REAL]
    times = _times(figures)
    pages, pictures = _timed(figures, table, cases, main["shared"])
    pictures["accuracy"] = development_plots.lines(cases, table, ours, peers)
    curves = learning_curves(figures["results"])
    if curves:
        pictures["curves"] = development_plots.curves(of, curves, ours)
    pages["index"] = html.render(
        "development.html.j2",
        TEMPLATES,
        header=provenance.of(figures),
        home=html.HOME,
        figures=figures,
        quick=_quick(figures),
        ours=ours,
        names=names,
        means=means,
        main=main,
        times=times,
        cases=of,
        table=table,
        curves=_curve_rows(curves, names),
        each=EACH,
        relative=relative_times(times["entries"], names),
        precisions=list(precisions(table, main["shared"], names)),
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        costs=[_cost(one) for one in times["entries"]],
        fits=[[method_names.plain_name(name), _fit_s(table, name)] for name in names],
        **_beside_peers(of, table, ours, peers, main, times["entries"]),
        **_words(of, names, _missing(table, of, names, figures["left_out"])),
    )
    return pages, pictures


def _quick(figures: Json) -> bool:
    """Whether the run was too small for figures."""
    return bool(figures.get("quick", False))


def _times(figures: Json) -> Json:
    """The measured times; empty if nothing was timed."""
    return figures.get("times") or {"entries": [], "left_out": {}}


def _cost(one: Json) -> list[Any]:
    """A row of the table of times."""
    columns = ("precision", "runtime", "ms_p50", "ms_p99")
    return [method_names.plain_name(one["method"]), *(one[key] for key in columns)]


def _timed(
    figures: Json, table: Mapping[str, Accuracies], cases: Sequence[Json], shared: Sequence[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """The page of the chart over times, and its picture; both empty if nothing was timed."""
    times = _times(figures)
    dots = development_chart.dots(times["entries"], table, cases, shared)
    if not dots:
        return {}, {}
    axes = development_chart.axes(cases, shared)
    picture = scatter.chart(dots, list(axes)[:1], accuracies=axes)
    page = chart_page.html(
        _with_origin(dots, figures),
        picture,
        _quick(figures),
        times["left_out"],
        accuracies=axes,
        source="development.json",
        header=provenance.of(figures),
    )
    return {"chart": page}, {"front": picture}


def _beside_peers(
    of: Mapping[str, Json],
    table: Mapping[str, Accuracies],
    ours: str,
    peers: Sequence[str],
    main: Json,
    times: Sequence[Json],
) -> dict[str, Any]:
    """Ours beside the best peer of each case, and the targets."""
    lines = [
        comparison.line(
            plain_case(one),
            table[case][ours],
            _plain_names({name: table[case][name] for name in peers if name in table[case]}),
        )
        for case, one in of.items()
    ]
    best = {case: line["best"] for case, line in zip(of, lines, strict=True)}
    return {
        "lines": lines,
        "best_of": best,
        "shown": comparison.shown,
        "targets": list(targets(lines, of, table, ours, main, times)),
    }


def _words(
    of: Mapping[str, Json], names: Sequence[str], missing: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Names of cases and methods in words. missing: by method the cases without a result."""
    plain = {case: plain_case(one) for case, one in of.items()}
    return {
        "plain": plain,
        "name_of": method_names.plain_name,
        "about": {name: method_names.about(name) for name in names},
        "missing": {name: [plain[case] for case in those] for name, those in missing.items()},
        "sets": [[plain[case], about_case(one), one["sweeps"]] for case, one in of.items()],
        "files": [
            [plain[case], ", ".join([one["set"], *one["only"]]), one["protocol"], one["digest"]]
            for case, one in of.items()
        ],
    }


def _with_origin(dots: Sequence[Json], figures: Json) -> list[dict[str, Any]]:
    """The dots with commit, machine, set and seeds."""
    commits = ", ".join(dict.fromkeys(run["commit"] for run in figures["runs"]))
    seeds = sorted({seed for run in figures["runs"] for seed in run["seeds"]})
    known = {
        "commit": commits,
        "machine": figures["runs"][0]["machine"],
        "set": figures["times"]["set"],
        "seeds": seeds,
    }
    return [{**dot, **known} for dot in dots]


def by_case(results: Iterable[Json]) -> dict[str, dict[str, Json]]:
    """Entries with all training sweeps: {case: {method: entry}}."""
    table: dict[str, dict[str, Json]] = {}
    for entry in results:
        if not entry["each"]:
            table.setdefault(entry["case"], {})[entry["method"]] = entry
    return table


def subject(table: Mapping[str, Accuracies]) -> str:
    """The first of OURS with a result. Raises FormatError if none has one."""
    for name in OURS:
        if any(name in row for row in table.values()):
            return name
    raise FormatError(
        f"no result of {' or '.join(OURS)}; run the command without --kept, or with one of them"
    )


def _plain_names(entries: Mapping[str, Json]) -> dict[str, Json]:
    return {method_names.plain_name(name): one for name, one in entries.items()}


def _means(
    table: Mapping[str, Accuracies],
    cases: Sequence[Json],
    ours: str,
    names: Sequence[str],
    peers: Sequence[str],
) -> dict[str, Json]:
    """Means over cases, by the kind of cases. A mean over the same cases as an earlier one is left
    out."""
    real = [case for case in cases if not case["simulated"]]
    means: dict[str, Json] = {}
    for what, mean in (
        (REAL, mean_row(table, real, ours, names, peers)),
        ("all, the simulated ones too", mean_row(table, cases, ours, names, peers)),
        (
            "real and published that every method has",
            mean_row(table, real, ours, names, peers, peers),
        ),
    ):
        if what == REAL or (
            mean["shared"] and mean["shared"] not in [m["shared"] for m in means.values()]
        ):
            line = mean["line"] and {**mean["line"], "what": f"{len(mean['shared'])} lines: {what}"}
            means[what] = {**mean, "line": line}
    return means


def mean_row(
    table: Mapping[str, Accuracies],
    cases: Sequence[Json],
    ours: str,
    names: Sequence[str],
    peers: Sequence[str],
    of: Sequence[str] = (),
) -> Json:
    """Means over the cases (`shared`) that ours and the peers `of` have, in `entries` by method,
    and ours beside the best peer.

    A method without all of these cases has no mean. Without `of`, peers and cases are those of the
    largest table without gaps.
    """
    sets = {case["case"]: case["set"] for case in cases}
    has = {
        name: {case for case in sets if name in table[case] and ours in table[case]}
        for name in peers
    }
    whole = of or max(
        ([name for name in peers if has[name] >= has[peer]] for peer in peers),
        key=lambda those: (len(those) * (lines := min(len(has[name]) for name in those)), lines),
        default=(),
    )
    shared = [case for case in sets if all(name in table[case] for name in (ours, *whole))]
    entries = {
        name: differences.entry(
            development_chart.mean({case: table[case][name] for case in shared}, sets)
        )
        for name in names
        if shared and all(name in table[case] for case in shared)
    }
    beside = _plain_names({name: entries[name] for name in peers if name in entries})
    line = comparison.line("the mean", entries[ours], beside) if shared else None
    return {"shared": shared, "entries": entries, "line": line}


def targets(
    lines: Sequence[Json],
    cases: Mapping[str, Json],
    table: Mapping[str, Accuracies],
    ours: str,
    mean: Json,
    times: Sequence[Json],
) -> Iterator[Json]:
    """A line for each target: wanted, reached, and whether it is met."""
    judged = [line for line in lines if line["best"]]
    if judged:
        near = sum(not line["short"] for line in judged)
        yield {
            "what": "lines in which it is no more than one point below the best peer",
            "target": f"{len(judged)} of {len(judged)}",
            "here": f"{near} of {len(judged)}",
            "met": near == len(judged),
        }
    if mean["line"] and mean["line"]["best"]:
        yield {
            "what": f"points ahead of {mean['line']['best']}, the best peer on the mean of "
            f"{len(mean['shared'])} real and published lines",
            "target": f"≥ {points(AHEAD)}",
            "here": comparison.shown(mean["line"]["gap"]),
            "met": mean["line"]["gap"][0] >= AHEAD - ROUNDING,
        }
    for case, wanted in WANTED.items():
        if case in cases:
            one = table[case][ours]
            yield {
                "what": plain_case(cases[case]),
                "target": f"≥ {exact_percent(wanted)}",
                "met": one["mean"] >= wanted - ROUNDING,
                "here": estimate([one["mean"], one["low"], one["high"]]),
            }
    for one in precisions(table, mean["shared"], [ours]):
        yield {
            "what": "points that int8 loses of its own float, on the mean",
            "target": f"≤ {points(MOST_LOST)}",
            "here": points(one["float"] - one["int8"]),
            "met": one["float"] - one["int8"] <= MOST_LOST + ROUNDING,
        }
    yield from _time_targets(times, ours)


def _time_targets(times: Sequence[Json], ours: str) -> Iterator[Json]:
    """Lines for the targets of time, if times were measured."""
    if (quick := quickest(times)).keys() >= {ours, UNIT}:
        share = quick[ours] / quick[UNIT]
        yield {
            "what": "time of a sweep, MiniRocket’s = 1",
            "target": f"≤ 1/{QUICKER}",
            "here": ratio(share),
            "met": share * QUICKER <= 1,
        }
    own = {one["precision"]: one["ms_p50"] for one in times if one["method"] == ours}
    if own.keys() >= {"int8", "float"}:
        share = own["int8"] / own["float"]
        yield {
            "what": "time of a sweep in int8, that of its own float = 1",
            "target": f"≤ {HALF:g}",
            "here": f"{share:.2f}",
            "met": share <= HALF,
        }


def precisions(
    table: Mapping[str, Accuracies], cases: Sequence[str], names: Iterable[str]
) -> Iterator[Json]:
    """For each method with results in int8 and in float, the means of both over its `cases`."""
    for name in names:
        entries = [
            table[case][name]
            for case in cases
            if name in table[case] and table[case][name]["forms"]
        ]
        if not entries:
            continue
        (form,) = entries[0]["forms"]
        own, other = (
            float(np.mean([e["mean"] for e in those]))
            for those in (entries, [e["forms"][form] for e in entries])
        )
        yield {
            "method": name,
            "lines": len(entries),
            form: other,
            "int8" if form == "float" else "float": own,
        }


def _missing(
    table: Mapping[str, Accuracies],
    cases: Iterable[str],
    names: Sequence[str],
    left_out: Mapping[str, str],
) -> dict[str, list[str]]:
    """By method the cases without a result and without another reason."""
    lacks = {
        name: [
            case for case in cases if name not in table[case] and f"{name}, {case}" not in left_out
        ]
        for name in names
    }
    return {name: those for name, those in lacks.items() if those}


def learning_curves(results: Iterable[Json]) -> dict[str, dict[str, dict[int, Json]]]:
    """{case: {method: {training sweeps of each material, 0 for all: entry}}} of cases with more
    than one point."""
    curves: dict[str, dict[str, dict[int, Json]]] = {}
    for entry in results:
        curves.setdefault(entry["case"], {}).setdefault(entry["method"], {})[entry["each"]] = entry
    return {
        case: lines
        for case, lines in curves.items()
        if any(set(line) & set(EACH) for line in lines.values())
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
