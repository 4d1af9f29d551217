"""Renders the page of the study `paper`, in the order of the paper.

It computes nothing but differences. Every sentence with a number takes it from the results, so it
is true of each run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_studies import TEMPLATES, differences, plots
from palpate_studies.paper_experiment import ATTACHMENTS, BLIND, HARD, HARD_BLIND, OWN
from palpate_studies.paper_stamps import (
    BEST,
    COST_FACTOR,
    FIVE,
    LEAST_CORRELATION,
    NEAR,
    NEAR_SEVERAL,
    VERDICTS,
    by_subject,
    stamps,
)
from palpate_studies.paper_values import CNN, CONFUSION, COST, FIGURES, SEVERAL, short_name
from palpate_train.metrics.score import row_shares
from palpate_train.reports import confusion_plot, html, provenance
from palpate_train.reports.formatting import estimate, exact_percent, points, seconds

TITLES = {
    "lopo": "T-REAL, leave one position out",
    "hard": "trained on T-REAL, tested on T-HARD",
    "lopo" + BLIND: "level-blind T-REAL, leave one position out",
    "hard" + BLIND: "trained on level-blind T-REAL, tested on T-HARD",
    "lab": "T-LAB, random folds",
    "random": "T-REAL, random folds",
}
"""Hard protocols first."""
COLUMNS = {
    "lopo": "leave\nposition",
    "hard": "T-HARD",
    "lopo" + BLIND: "level-blind\nleave position",
    "hard" + BLIND: "level-blind\nT-HARD",
}
"""Columns of the picture of all methods."""
LOADS = "static-svm"
"""The method that sees mean loads alone."""
NEAR_ON_AVERAGE = 0.02
"""Target of the calibration for the mean."""
Row = Mapping[str, Any]
Key = tuple[str, str]
"""Part and method."""


def render(
    summary: Mapping[str, Any], box_on_hard: Mapping[str, Any] | None = None
) -> tuple[str, dict[str, str]]:
    """The page (HTML) of the results, and its pictures (SVG) by name.

    box_on_hard: the box's answers to T-HARD's sweeps, see pages.box_on_hard.
    """
    report = PaperReport(summary)
    pictures = report.pictures()
    drawn = {name: html.picture(svg) for name, svg in pictures.items()}
    return html.render(
        "paper.html.j2",
        TEMPLATES,
        header=provenance.of(summary),
        home=html.HOME,
        pictures=drawn,
        box_on_hard=box_on_hard,
        **report.run(),
        **report.figures(),
        **report.network(),
    ), pictures


class PaperReport:
    """Content of page and pictures."""

    def __init__(self, summary: Mapping[str, Any]) -> None:
        self.summary = summary
        self.rows: dict[Key, Row] = {(row["part"], row["method"]): row for row in summary["table"]}
        self.stamps = stamps(summary)
        self.cnn = ("lopo", CNN) in self.rows
        self.own = [method for method in OWN if ("hard", method) in self.rows]

    def pictures(self) -> dict[str, str]:
        """All pictures by name."""
        drawn = {f"figure-{number}": self._bars(number, part) for part, number in FIGURES.items()}
        names, confusion = self.summary["results"][0]["materials"], self.summary["confusion"]
        if self.cnn:
            groups = {TITLES[part]: [self._bar(at) for at in self._compared(part)] for part in HARD}
            drawn |= {
                "figure-9": plots.curve(self._costs(), COST, "Fig. 9: cost in training"),
                "figure-10": plots.bars(groups, "Fig. 10: H-svm, the CNN and ours"),
                "figure-11": confusion_plot.draw(
                    np.array(confusion[CNN]), names, "Fig. 11: confusion of the CNN", CONFUSION
                ),
            }
        drawn["figure-12"] = confusion_plot.draw(
            np.array(confusion[BEST]), names, "Fig. 12: confusion of H-svm"
        )
        several = self.summary["several"]
        shown = {short_name(m): several[m] for m in (BEST, CNN, *self.own[:1]) if m in several}
        printed = {short_name(m): values for m, values in SEVERAL.items()}
        cells: dict[Key, plots.Estimate] = {
            (method, COLUMNS[part]): tuple(row["share"])
            for part in COLUMNS
            for (its_part, method), row in self.rows.items()
            if its_part == part
        }
        return drawn | {
            "figure-13": plots.sweeps(shown, printed, "Fig. 13: one, two and three sweeps"),
            "methods": plots.grid({"": cells}, "all methods, new positions, in both worlds"),
        }

    def run(self) -> dict[str, Any]:
        """Methods, sets and commits of the run, and the results in short."""
        summary, table = self.summary, self.summary["table"]
        trained = {row["method"]: row for row in table if row["ran"] and row["method"] not in OWN}
        return {
            "quick": summary["quick"],
            "commits": self._commits(),
            "machine": summary["results"][0]["machine"],
            "evaluations": len(summary["results"]),
            "method_count": len({method for _, method in self.rows}),
            "sets": self._sets(),
            "own_seeds": any(
                "{a}" in name for part in summary["parts"].values() for name in part["sets"]
            ),
            "attachments_each": ATTACHMENTS,
            "reference": BEST,
            "stamps": self.stamps,
            "verdicts": [
                (word, by_subject(self.stamps, result)) for result, word in VERDICTS.items()
            ],
            "rules": {
                "cost": f"{COST_FACTOR:g}",
                "correlation": LEAST_CORRELATION,
                "several": NEAR_SEVERAL,
            },
            "short": [TITLES[part] for part in (*HARD, *HARD_BLIND)],
            "trainings": [
                [m, row["ran"], "–" if row["fit_s"] is None else seconds(row["fit_s"])]
                for m, row in trained.items()
            ],
            "methods": summary["methods"],
            "overview": [self._overview(method) for method in (BEST, CNN, *self.own)],
            "ahead": self._ahead(),
            "loads_method": LOADS,
            "loads": [
                row for part in ("hard", HARD_BLIND[1]) if (row := self.rows.get((part, LOADS)))
            ],
            "match": self._match(),
        }

    def figures(self) -> dict[str, Any]:
        """Figs. 4 to 7 and 13, and all methods."""
        pairs = [
            (self.rows["random", m], self.rows["lopo", m])
            for m in FIVE
            if {("random", m), ("lopo", m)} <= self.rows.keys()
        ]
        count, low, high = self.rows["hard", BEST]["attachments"]
        several, explored = self.summary["several"], self.summary["explored"]
        return {
            "spectral": {number: self._figure(part) for part, number in FIGURES.items()},
            "flattery": {
                "ours": np.mean([easy["share"][0] - hard["share"][0] for easy, hard in pairs]),
                "printed": np.mean([easy["printed"] - hard["printed"] for easy, hard in pairs]),
            },
            "attachments": {"count": count, "low": low, "high": high},
            "several": [
                [
                    m,
                    *(estimate(rules["product"][n], 0) for n in range(3)),
                    estimate(rules["vote"][2], 0),
                ]
                for m, rules in sorted(several.items(), key=lambda item: -item[1]["product"][2][0])
            ],
            "probabilities": [exact_percent(e["sure"]) for e in next(iter(explored.values()))],
            "explored": [
                [
                    m,
                    *(f"{estimate(e['share'], 0)} in {e['sweeps']:.1f}" for e in those),
                ]
                for m, those in sorted(explored.items(), key=lambda item: -item[1][-1]["share"][0])
            ],
            "all_numbers": {
                title: self._numbers([at for at in self.rows if at[0] == part])
                for part, title in TITLES.items()
            },
        }

    def network(self) -> dict[str, Any]:
        """Figs. 9 to 12; `curves` is None if the paper's CNN was not run."""
        names, confusion = self.summary["results"][0]["materials"], self.summary["confusion"]
        common = {
            "own": [short_name(m) for m in self.own],
            "reference_confused": _worst(np.array(confusion[BEST]), names),
        }
        if not self.cnn:
            return common | {"curves": None}
        return common | {
            "curves": self.summary.get("curves", []),
            "trained": [
                [
                    f"{c['seed']}{', level-blind' if c['world'] else ''}",
                    c.get("left", "none"),
                    f"{c['right']} / {c['total']}" if "left" in c else "–",
                    f"{c['step']} of {c['steps']}",
                    c["commit"],
                ]
                for c in self.summary.get("curves", [])
            ],
            "final_cost": float(np.median([cost[-1, 1] for cost in self._costs()])),
            "compared": self._numbers([at for part in HARD for at in self._compared(part)]),
            "cnn_confused": _worst(np.array(confusion[CNN]), names),
        }

    def _ahead(self) -> list[list[str]]:
        """Our first method less H-svm and less the CNN, in points, for each of the hard parts."""
        lines = []
        for part in (*HARD, *HARD_BLIND):
            ours = self.rows.get((part, self.own[0])) if self.own else None
            if ours:
                others = [self.rows.get((part, m)) for m in (BEST, CNN)]
                lines.append([TITLES[part], *(_gap(ours, other) for other in others)])
        return lines

    def _commits(self) -> list[list[str]]:
        """Each commit with the methods of its results. The commit with most results comes last."""
        by_commit: dict[str, dict[str, None]] = {}
        for result in self.summary["results"]:
            by_commit.setdefault(result["commit"], {})[result["method"]] = None
        return [
            [commit, ", ".join(those)]
            for commit, those in sorted(by_commit.items(), key=lambda item: len(item[1]))
        ]

    def _overview(self, method: str) -> dict[str, Any]:
        """One line of the summary at the top: its result in each of HARD, None if there is none."""
        rows = [self.rows.get((part, method)) for part in (*HARD, *HARD_BLIND)]
        ran = next((row["ran"] for row in rows if row and method == CNN), "")
        return {"name": method, "rows": rows, "ran": ran}

    def _match(self) -> dict[str, Any]:
        """Differences between the simulator and the printed accuracies of the five classical
        methods."""
        rows = [self.rows[part, m] for part in FIGURES for m in FIVE if (part, m) in self.rows]
        away = np.array([row["share"][0] - row["printed"] for row in rows])
        off = [
            {"method": row["method"], "title": TITLES[row["part"]], "difference": difference}
            for row, difference in zip(rows, away, strict=True)
            if abs(difference) > NEAR
        ]
        return {
            "count": len(rows),
            "mean": np.abs(away).mean(),
            "most": np.abs(away).max(),
            "limit": NEAR,
            "near": int(np.sum(np.abs(away) <= NEAR)),
            "mean_limit": NEAR_ON_AVERAGE,
            "off": off,
        }

    def _figure(self, part: str) -> dict[str, Any]:
        """One of Figs. 4 to 7: title, numbers, the best of ours and of those printed."""
        rows = [self.rows[part, m] for m in FIVE if (part, m) in self.rows]
        return {
            "title": TITLES[part],
            "rows": self._numbers([(part, m) for m in FIVE]),
            "best_ours": max(rows, key=lambda row: row["share"][0]),
            "best_printed": max(rows, key=lambda row: row["printed"]),
        }

    def _bars(self, number: int, part: str) -> str:
        bars = [self._bar((part, m)) for m in FIVE if (part, m) in self.rows]
        return plots.bars({"": bars}, f"Fig. {number}: {TITLES[part]}", chance=1 / 6)

    def _bar(self, at: Key) -> plots.Bar:
        row = self.rows[at]
        return plots.Bar(short_name(row["method"]), tuple(row["share"]), row["printed"])

    def _compared(self, part: str) -> list[Key]:
        """The bars of Fig. 10 of a part."""
        return [(part, m) for m in (BEST, CNN, *self.own) if (part, m) in self.rows]

    def _costs(self) -> list[NDArray[Any]]:
        return [np.array(cost) for cost in self.summary["costs"][CNN]]

    def _numbers(self, those: Sequence[Key]) -> list[Row]:
        """Lines of a table of numbers, each with a name. If there are several parts, the name has
        the part."""
        several_parts = len({part for part, _ in those}) > 1
        return [
            {
                **self.rows[part, m],
                "name": f"{m}, {TITLES[part]}" if several_parts else m,
            }
            for part, m in those
            if (part, m) in self.rows
        ]

    def _sets(self) -> list[list[str]]:
        """Title, sets and protocol of each part."""
        parts = self.summary["parts"]
        return [
            [
                title,
                ", ".join(map(_readable, parts[part]["sets"]))
                + (f" ({', '.join(parts[part]['only'])})" if parts[part]["only"] else ""),
                parts[part]["protocol"],
            ]
            for part, title in TITLES.items()
            if part in parts
        ]


def _readable(name: str) -> str:
    """A set's name with letters for numbers that differ between worlds."""
    return name.format(w="W", a="A", b="B")


def _gap(ours: Row, other: Row | None) -> str:
    """The difference of two accuracies in points with its 95 % interval; "–" without the other."""
    if other is None:
        return "–"
    one, two = (tuple(row["share"]) for row in (ours, other))
    gap, low, high = (points(value, sign=True) for value in differences.difference(one, two))
    return f"{gap} [{low}, {high}]"


def _worst(matrix: NDArray[Any], names: Sequence[str]) -> list[dict[str, Any]]:
    """The two greatest confusions."""
    rows = row_shares(matrix)
    off = np.where(np.eye(len(names), dtype=bool), -1, rows)
    order = np.argsort(off, axis=None)[::-1][:2]
    return [
        {"truth": names[i], "named": names[j], "share": rows[i, j]}
        for i, j in zip(*np.unravel_index(order, off.shape), strict=True)
    ]
