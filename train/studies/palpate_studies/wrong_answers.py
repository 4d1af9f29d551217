"""The tables of README with right and wrong answers of the packaged bundle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

HEAD = "| sweeps | named rightly | named wrongly | not named |\n|---|---|---|---|"
STRESSED = (
    ("noise", 0.0, "{:,} slides over trained materials"),
    ("dead", 1.0, "the same with one dead taxel, which is bridged"),
    ("hum", 0.5, "the same with 50 Hz hum of half of the deviation, which is removed"),
    ("lost", 0.1, "the same with a tenth of the frames lost"),
    ("speed-up", 0.35, "the same, slid 35 % faster than in training"),
    ("bits", 3.0, "the same with counts of five bits instead of eight"),
)
"""Corruption, severity and text of each row; {} is the number of sweeps."""
JUNK = {
    "slides that were altered": "{:,} slides that were altered: gain, speed, lifted, displaced",
    "no material, or no slide": "{:,} windows without a slide, or of two materials",
    "materials that nobody taught": "{:,} slides over three materials that nobody taught",
}
"""Texts of the groups of kinds in the campaign `junk`."""


def of_stress(results: Any) -> str:
    """The table of corruptions, from the results of the study `stress`."""
    curves = results["box"]["curves"]
    rows = []
    for name, severity, text in STRESSED:
        right, wrong = (curves[answer][name] for answer in ("rightly", "wrongly"))
        at = right["severities"].index(severity)
        rows.append((text, right["total"], right["right"][at], wrong["right"][at]))
    return _table(rows)


def of_junk(results: Any) -> str:
    """The table of sweeps that the box should not name, from the results of the campaign `junk`."""
    rows = []
    for group, text in JUNK.items():
        kinds = [kind for kind in results["kinds"].values() if kind["group"] == group]
        total, named, wrong = (
            sum(kind[key] for kind in kinds) for key in ("sweeps", "whole", "whole wrong")
        )
        rows.append((text, total, named - wrong, wrong))
    return _table(rows)


def _table(rows: Iterable[tuple[str, int, int, int]]) -> str:
    lines = [
        f"| {text.format(total)} | {right:,} | {wrong:,} | {total - right - wrong:,} |"
        for text, total, right, wrong in rows
    ]
    return "\n".join(["", HEAD, *lines, ""])
