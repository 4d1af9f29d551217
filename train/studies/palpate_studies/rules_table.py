"""The table of the rules of the answer, from the results of the study `rules`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def table(results: Mapping[str, Any], pairs: bool = True) -> str:
    """A row for each rule that is left out, with `pairs` also for each pair of rules."""
    first, *others = results["rows"]
    others = [row for row in others if pairs or len(row["without"]) == 1]
    kinds = list(first["total"])
    totals = ", ".join(f"{first['total'][kind]:,} {kind}" for kind in kinds)
    head = ["without", *(f"{kind}: right, wrong" for kind in kinds[:-1]), "junk with a label"]
    lines = [f"Bundle {results['bundle']}, {totals}.", "", *_head([*head, "ms", "lines"])]
    for row in (first, *others):
        name = " and ".join(row["without"]) or "(every rule)"
        cells = [f"{row['right'][kind]}, {row['wrong'][kind]}" for kind in kinds[:-1]]
        cells += [str(row["wrong"][kinds[-1]]), f"{row['ms']:.2f}", str(row["lines"] or "")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(["", *lines, ""])


def _head(names: list[str]) -> list[str]:
    return [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
