"""The table of the rules of the answer, from the results of the study `rules`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate_studies import markdown


def table(results: Mapping[str, Any], pairs: bool = True) -> str:
    """A row for each rule that is left out, with `pairs` also for each pair of rules."""
    first, *others = results["rows"]
    others = [row for row in others if pairs or len(row["without"]) == 1]
    kinds = list(first["total"])
    totals = ", ".join(f"{first['total'][kind]:,} {kind}" for kind in kinds)
    head = ["without", *(f"{kind}: right, wrong" for kind in kinds[:-1]), "junk with a label"]
    rows = []
    for row in (first, *others):
        name = " and ".join(row["without"]) or "(every rule)"
        counts = [f"{row['right'][kind]}, {row['wrong'][kind]}" for kind in kinds[:-1]]
        rows.append([name, *counts, row["wrong"][kinds[-1]], f"{row['ms']:.2f}"])
    about = f"Bundle {results['bundle']}, {totals}."
    return f"\n{markdown.table([*head, 'ms'], rows, about)}\n"
