"""Renders the page of the study `paper`. Every sentence with a number takes it from the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate_studies import differences
from palpate_studies.paper_experiment import (
    ATTACHMENTS,
    BASELINES,
    BLIND,
    CNN,
    CONFUSION,
    FIGURES,
    HARD,
    HARD_BLIND,
    OWN,
)
from palpate_studies.study import Rendered, drawn
from palpate_train.reports import confusion_plot
from palpate_train.reports.formatting import estimate, exact_percent, seconds

TITLES = {
    "lopo": "T-REAL, leave one position out",
    "hard": "trained on T-REAL, tested on T-HARD",
    "lopo" + BLIND: "level-blind T-REAL, leave one position out",
    "hard" + BLIND: "trained on level-blind T-REAL, tested on T-HARD",
    "lab": "T-LAB, random folds",
    "random": "T-REAL, random folds",
}
"""Hard protocols first."""
BEST = "H-svm"
"""The most accurate of the paper's classical methods."""
LOADS = "static-svm"
"""The method that sees mean loads alone."""
NEAR = 0.06
"""Differences from the printed accuracies that are larger than this are listed."""
Row = Mapping[str, Any]
Key = tuple[str, str]
"""Part and method."""


def render(summary: Mapping[str, Any], box_on_hard: Mapping[str, Any] | None = None) -> Rendered:
    """The page and its pictures. box_on_hard: the box's answers to T-HARD's sweeps, see
    pages.box_on_hard."""
    rows = {(row["part"], row["method"]): row for row in summary["table"]}
    own = [method for method in OWN if ("hard", method) in rows]
    return drawn(
        "paper.html.j2",
        summary,
        pictures(summary),
        box_on_hard=box_on_hard,
        own=own,
        reference=BEST,
        short=[TITLES[part] for part in (*HARD, *HARD_BLIND)],
        overview=[_overview(rows, method) for method in (BEST, CNN, *own)],
        ahead=_ahead(rows, own),
        loads_method=LOADS,
        loads=[row for part in ("hard", HARD_BLIND[1]) if (row := rows.get((part, LOADS)))],
        match=_match(rows),
        figures={
            number: {"title": TITLES[part], "rows": _numbers(rows, part, (*BASELINES, CNN))}
            for part, number in FIGURES.items()
        },
        all_numbers={
            title: _numbers(rows, part, [m for its_part, m in rows if its_part == part])
            for part, title in TITLES.items()
        },
        **_several(summary),
        **_run(summary),
    )


def pictures(summary: Mapping[str, Any]) -> dict[str, str]:
    """The confusions of the CNN, if it was run, and of the best classical method: Figs. 11, 12."""
    names, confusion = summary["results"][0]["materials"], summary["confusion"]
    made = {}
    if CNN in confusion:
        about = "Fig. 11: confusion of the CNN"
        made["figure-11"] = confusion_plot.draw(np.array(confusion[CNN]), names, about, CONFUSION)
    about = f"Fig. 12: confusion of {BEST}"
    return made | {"figure-12": confusion_plot.draw(np.array(confusion[BEST]), names, about)}


def _overview(rows: Mapping[Key, Row], method: str) -> dict[str, Any]:
    """One line of the summary at the top: its result in each hard part, None if there is none."""
    those = [rows.get((part, method)) for part in (*HARD, *HARD_BLIND)]
    ran = next((row["ran"] for row in those if row and method == CNN), "")
    return {"name": method, "rows": those, "ran": ran}


def _ahead(rows: Mapping[Key, Row], own: Sequence[str]) -> list[list[str]]:
    """Our first method less H-svm and less the CNN, in points, for each of the hard parts."""
    lines = []
    for part in (*HARD, *HARD_BLIND):
        if own and (ours := rows.get((part, own[0]))):
            others = [rows.get((part, method)) for method in (BEST, CNN)]
            lines.append([TITLES[part], *(_gap(ours, other) for other in others)])
    return lines


def _gap(ours: Row, other: Row | None) -> str:
    """The difference of two accuracies in points with its 95 % interval; "–" without the other."""
    if other is None:
        return "–"
    one, two = (tuple(row["share"]) for row in (ours, other))
    return differences.shown(differences.difference(one, two))


def _match(rows: Mapping[Key, Row]) -> dict[str, Any]:
    """Differences between simulated and printed accuracies of the five classical methods."""
    those = [rows[part, m] for part in FIGURES for m in BASELINES if (part, m) in rows]
    away = np.array([row["share"][0] - row["printed"] for row in those])
    off = [
        {"method": row["method"], "title": TITLES[row["part"]], "difference": difference}
        for row, difference in zip(those, away, strict=True)
        if abs(difference) > NEAR
    ]
    return {
        "count": len(those),
        "mean": np.abs(away).mean(),
        "most": np.abs(away).max(),
        "limit": NEAR,
        "off": off,
    }


def _numbers(rows: Mapping[Key, Row], part: str, methods: Sequence[str]) -> list[Row]:
    """Lines of a table of numbers, each with a name."""
    return [
        {**rows[part, method], "name": method.removeprefix("palpate-")}
        for method in methods
        if (part, method) in rows
    ]


def _several(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Accuracies after several sweeps of one object, and after as many as a posterior takes."""
    several, explored = summary["several"], summary["explored"]
    fused = sorted(several.items(), key=lambda item: -item[1]["product"][2][0])
    added = sorted(explored.items(), key=lambda item: -item[1][-1]["share"][0])
    return {
        "several": [
            [m, *(estimate(one, 0) for one in (*rules["product"][:3], rules["vote"][2]))]
            for m, rules in fused
        ],
        "probabilities": [exact_percent(e["sure"]) for e in next(iter(explored.values()))],
        "explored": [
            [m, *(f"{estimate(e['share'], 0)} in {e['sweeps']:.1f}" for e in those)]
            for m, those in added
        ],
    }


def _run(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Methods, sets and commits of the run."""
    table, parts = summary["table"], summary["parts"]
    trained = {row["method"]: row for row in table if row["ran"] and row["method"] not in OWN}
    by_commit: dict[str, dict[str, None]] = {}
    for result in summary["results"]:
        by_commit.setdefault(result["commit"], {})[result["method"]] = None
    return {
        # the commit with most results comes last
        "commits": [
            [commit, ", ".join(those)]
            for commit, those in sorted(by_commit.items(), key=lambda item: len(item[1]))
        ],
        "machine": summary["results"][0]["machine"],
        "evaluations": len(summary["results"]),
        "sets": [
            [title, _sets(parts[part]), parts[part]["protocol"]]
            for part, title in TITLES.items()
            if part in parts
        ],
        "attachments_each": ATTACHMENTS,
        "trainings": [
            [m, row["ran"], "–" if row["fit_s"] is None else seconds(row["fit_s"])]
            for m, row in trained.items()
        ],
        "methods": summary["methods"],
    }


def _sets(part: Mapping[str, Any]) -> str:
    """The sets of a part with letters for numbers that differ between worlds."""
    names = ", ".join(name.format(w="W", a="A", b="B") for name in part["sets"])
    return names + (f" ({', '.join(part['only'])})" if part["only"] else "")
