"""Renders the page of the study `certainty`: how far the box's probabilities can be trusted.

It computes nothing. Every sentence with a number takes it from the results, so it is true of each
run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate_studies import TEMPLATES
from palpate_train.metrics.tolerances import KEPT
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports import bundle_report, formatting, html, provenance

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


def render(figures: Json) -> tuple[str, dict[str, str]]:
    """The page (HTML) and its pictures (SVG) by name."""
    after = figures["calibration"]["after"] | {"n": figures["calibration"]["n"]}
    pictures = {"reliability": bundle_report.calibration(after)}
    (heat,), (rule,) = figures["calibration"]["temperature"], figures["early"]["rules"]
    page = html.render(
        "uncertainty.html.j2",
        TEMPLATES,
        header=provenance.of(figures),
        home=html.HOME,
        figures=figures,
        shipped=(PACKAGED, SHIPPED),
        pictures={name: html.picture(svg) for name, svg in pictures.items()},
        tables=_tables(figures),
        worst=_worst(figures),
        temperature=f"{heat:.1f}",
        rule=rule,
        kept=KEPT,
        simulated=str(figures["set"]).startswith("sim:"),
        origin=[[text, figures[name]] for name, text in ORIGIN.items() if figures[name] != ""],
    )
    return page, pictures


def _worst(figures: Json) -> str:
    """The material that is most often taken for a known one; "" if no material was left out."""
    materials: Mapping[str, Json] = figures.get("unknown", {}).get("materials", {})
    if not materials:
        return ""
    name = max(materials, key=lambda one: materials[one]["false_known"])
    return f"{name}, {formatting.percent(materials[name]['false_known'])}"


def _tables(figures: Json) -> dict[str, list[list[str]]]:
    """The rows of each table."""
    tables = {
        "always": [
            [f"{tenth} of 10", _share(p, "accuracy")]
            for tenth, p in enumerate(figures["early"]["always"], 1)
        ],
    }
    return tables | _unknown_tables(figures) if "unknown" in figures else tables


def _unknown_tables(figures: Json) -> dict[str, list[list[str]]]:
    """The rows of the tables about materials left out of training."""
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
    return {
        "unknown": [*rows, ["mean", *(formatting.percent(mean[k]) for k in shares), ""]],
    }


def _share(of: Json, name: str) -> str:
    """A share with its interval."""
    return formatting.estimate([of[name], of["low"], of["high"]])
