"""Methods by protocols, from the list of `evaluate --json`: a picture, and a table for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.storage import put
from palpate_studies import comparison, differences, marked_text, plots
from palpate_studies.development_chart import PROTOCOLS
from palpate_studies.method_names import plain_name
from palpate_train.models.methods import SHIPPED
from palpate_train.reports import provenance
from palpate_train.reports.formatting import estimate

Json = Mapping[str, Any]
HEAD = ("test", "means", "{ours}", "best of the others", "difference, points", "verdict")


def draw(results: Sequence[Json], out: Path, recordings: bool = False) -> None:
    """Write the picture of all methods as SVG. recordings: count recordings instead of windows."""
    picture = plots.matrix(results, count="recording" if recordings else "window")
    put(out, provenance.in_svg(picture, provenance.of(results)).encode(), parents=True)


def insert(results: Sequence[Json], page: Path) -> None:
    """Write the table between the markers of a page. Raises FormatError if it has no markers."""
    text = marked_text.insert(
        page.read_text(encoding="utf-8"), "matrix", headline(results), str(page)
    )
    put(page, provenance.in_markdown(text, provenance.of(results)).encode())


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
    rows = [[cell.format(ours=plain_name(ours)) for cell in HEAD], ["---"] * len(HEAD)]
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
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _cells(line: Json) -> list[str]:
    """Ours, the best of the others with its name, difference, verdict."""
    own = estimate(differences.of(line["ours"]))
    if not line["best"]:
        return [own, "–", "–", line["verdict"]]
    other = f"{plain_name(line['best'])}: {estimate(differences.of(line['leader']))}"
    return [own, other, comparison.shown(line["gap"]), line["verdict"]]
