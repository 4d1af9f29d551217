"""Ours and the best of the others by protocol: a table of the list of `evaluate --json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate_studies import comparison, differences, markdown
from palpate_studies.development_chart import PROTOCOLS
from palpate_studies.method_names import plain_name
from palpate_train.models.methods import SHIPPED
from palpate_train.reports.formatting import estimate, points

Json = Mapping[str, Any]
HEAD = ("test", "means", "{ours}", "best of the others", "difference, points", "verdict")


def headline(results: Sequence[Json], ours: str = SHIPPED) -> str:
    """A line for each test: `ours`, the best of the others (chosen in hindsight), their difference,
    a verdict.

    Sweeps without means come first. Each figure is the mean over seeds, with its 95 % interval.
    """
    tests: dict[tuple[bool, int, str], dict[str, list[list[float]]]] = {}
    for result in results:
        test = (bool(result["means_removed"]), len(result["materials"]), result["protocol"])
        share = result["window"]["right"] / result["window"]["total"]
        tests.setdefault(test, {}).setdefault(result["method"], []).append(
            [share, *result["interval"]]
        )
    rows = []
    for removed, classes, protocol in sorted(tests, key=lambda test: (not test[0], -test[1])):
        found = {
            name: dict(zip(("mean", "low", "high"), np.mean(seeds, axis=0).tolist(), strict=True))
            for name, seeds in tests[removed, classes, protocol].items()
        }
        if ours in found:
            line = comparison.line(
                "", found[ours], {name: one for name, one in found.items() if name != ours}
            )
            what = f"{classes} classes: {PROTOCOLS.get(protocol, (protocol,))[0]}"
            rows.append([what, "removed" if removed else "kept", *_cells(line)])
    return markdown.table([cell.format(ours=plain_name(ours)) for cell in HEAD], rows)


def shots(results: Json, at: int = 5) -> str:
    """A line for each test of the study `shots`: accuracy in per cent of all methods by sweeps of a
    material, and by how much ours is ahead of each peer with `at`."""
    names, tests = list(map(plain_name, results["rows"][0]["methods"])), dict[str, list[str]]()
    ahead: dict[str, list[str]] = {}
    for row in results["rows"]:
        test = f"{len(row['materials'])} classes"
        shares = (one["right"] / one["total"] for one in row["methods"].values())
        tests.setdefault(test, []).append("/".join(map(points, shares)))
        if row["each"] == at:
            ahead[test] = [comparison.shown(gap) for gap in row["ahead"].values()]
    numbers = dict.fromkeys(row["each"] for row in results["rows"])
    head = (
        "sweeps of a material",
        *map(str, numbers),
        *(f"{at}: ahead of {name}" for name in names[1:]),
    )
    rows = [[test, *cells, *ahead[test]] for test, cells in tests.items()]
    return markdown.table(head, rows, f"{'/'.join(names)}, per cent:")


def _cells(line: Json) -> list[str]:
    """Ours, the best of the others with its name, difference, verdict."""
    own = estimate(differences.of(line["ours"]))
    if not line["best"]:
        return [own, "–", "–", line["verdict"]]
    other = f"{plain_name(line['best'])}: {estimate(differences.of(line['leader']))}"
    return [own, other, comparison.shown(line["gap"]), line["verdict"]]
