"""Renders the page of the study `certainty`: how far the box's probabilities can be trusted.

It computes nothing. Every sentence with a number takes it from the results, so it is true of each
run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate_studies.study import Rendered, drawn
from palpate_train.metrics.tolerances import KEPT
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports import bundle_report, formatting

Json = Mapping[str, Any]
ORIGIN = {
    "set": "trained on",
    "test": "tested on",
    "method": "method",
    "seed": "seed",
    "effort": "share of the usual training",
    "trainings": "trainings",
    "sweeps": "sweeps in all",
    "tested": "sweeps tested",
    "format": "skin",
    "digest": "digest of the sweeps",
    "commit": "commit",
    "machine": "machine",
    "took_s": "seconds that it took",
}
"""The run: names in the results and on the page."""


def render(figures: Json) -> Rendered:
    """The page and its pictures."""
    after = figures["calibration"]["after"] | {"n": figures["calibration"]["n"]}
    (heat,), (rule,) = figures["calibration"]["temperature"], figures["early"]["rules"]
    return drawn(
        "uncertainty.html.j2",
        figures,
        {"reliability": bundle_report.calibration(after)},
        figures=figures,
        shipped=(PACKAGED, SHIPPED),
        tables=_tables(figures),
        worst=_worst(figures),
        temperature=f"{heat:.1f}",
        rule=rule,
        kept=KEPT,
        simulated=str(figures["set"]).startswith("sim:"),
        origin=[[text, figures[name]] for name, text in ORIGIN.items() if figures[name] != ""],
    )


def _worst(figures: Json) -> str:
    """The material that is most often taken for a known one; "" if no material was left out."""
    materials: Mapping[str, Json] = figures.get("unknown", {}).get("materials", {})
    if not materials:
        return ""
    name = max(materials, key=lambda one: materials[one]["false_known"])
    return f"{name}, {formatting.percent(materials[name]['false_known'])}"


def _tables(figures: Json) -> dict[str, list[list[str]]]:
    """The rows of each table; the second is of materials left out of training."""
    always = enumerate(figures["early"]["always"], 1)
    tables = {"always": [[f"{tenth} of 10", _share(p, "accuracy")] for tenth, p in always]}
    if "unknown" not in figures:
        return tables
    of, mean = figures["unknown"], figures["unknown"]["mean"]
    shares = ("false_known", "kept", "auroc", "false_known_at_95")
    rows = [
        [
            name,
            *(_share(m, k) if k == "auroc" else formatting.percent(m[k]) for k in shares),
            f"{m['known']} / {m['unknown']}",
        ]
        for name, m in of["materials"].items()
    ]
    means = ["mean", *(formatting.percent(mean[k]) for k in shares), ""]
    return tables | {"unknown": [*rows, means]}


def _share(of: Json, name: str) -> str:
    """A share with its interval."""
    return formatting.estimate([of[name], of["low"], of["high"]])
