"""Renders the page "Speed against accuracy" from the results of the study `development`.

It computes nothing but means and differences of the measured figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_studies import development_plots, differences
from palpate_studies.development_chart import (
    ANSWER,
    Accuracies,
    ChartPanel,
    Json,
    about_case,
    by_case,
    finding,
    panels,
    plain_case,
    relative_times,
)
from palpate_studies.development_experiment import OURS, PEERS
from palpate_studies.method_names import about, plain_name
from palpate_studies.study import Rendered, drawn
from palpate_train.reports import provenance
from palpate_train.reports.formatting import amount, percent, points

SIZES_OF = (("file_kb", "KB"), ("rss_mb", "MB"))
"""Costs of a model in bytes, with their units."""


def render(figures: Json) -> Rendered:
    """The page and its pictures. Raises FormatError without a result of a
    method of ours."""
    table = by_case(figures["results"])
    ours = subject(table)
    names = [name for name in figures["methods"] if any(name in row for row in table.values())]
    cases = {case["case"]: case for case in figures["cases"] if ours in table.get(case["case"], {})}
    lines = []
    for case, one in cases.items():
        row = table[case]
        peers = {plain_name(n): row[n] for n in names if n not in OURS and n in row}
        lines.append(differences.line(plain_case(one), row[ours], peers))
    shown = panels(figures)
    return drawn(
        "development.html.j2",
        figures,
        {"front": front(figures)} if shown else {},
        figures=figures,
        panels=[[panel.kind, finding(panel), len(panel.cases)] for panel in shown],
        ours=ours,
        names=names,
        table=table,
        lines=lines,
        best_of={case: line["best"] for case, line in zip(cases, lines, strict=True)},
        shown=differences.shown,
        means=_mean_rows(shown, names),
        answered=any(panel.answered for panel in shown),
        precisions=list(precisions(table, shown, names)),
        **_costs(figures, table, names),
        **_words(cases, names, _missing(table, cases, names, figures["left_out"])),
    )


def front(figures: Json, plain: bool = False) -> str:
    """The chart of README and of the page. plain: in fixed colours."""
    return development_plots.speed(panels(figures), machine(figures), plain)


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


def subject(table: Mapping[str, Accuracies]) -> str:
    """The first of OURS with a result. Raises FormatError if none has one."""
    for name in OURS:
        if any(name in row for row in table.values()):
            return name
    raise FormatError(
        f"no result of {' or '.join(OURS)}; run the command without --kept, or with one of them"
    )


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
        "machine": machine(figures),
        "relative": relative_times(times["entries"], names),
        "costs": [_cost(one) for one in times["entries"]],
        "fits": [[plain_name(name), _fit_s(table, name)] for name in names],
    }


def _cost(one: Json) -> list[str]:
    """A row of the table of costs."""
    counts = [f"{one[key]:,}" if one.get(key) else "–" for key in ("weights", "macs")]
    sizes = [amount(one[key], unit) if one.get(key) else "–" for key, unit in SIZES_OF]
    times = [amount(one[key], "ms") if key in one else "–" for key in ("ms_p50", "ms_p99", ANSWER)]
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


def _fit_s(table: Mapping[str, Accuracies], name: str) -> str:
    """Time to train a fold in s: the median over all cases."""
    return f"{float(np.median([row[name]['fit_s'] for row in table.values() if name in row])):.2f}"
