"""The table of the recipe's views, from the results of the study `recipe`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from palpate_studies import markdown
from palpate_train.reports.formatting import amount

Json = Mapping[str, Any]
VIEWS = {
    "filters": (
        "log mean magnitude of random integer filters",
        "texture: which patterns in time and across taxels occur how strongly",
        "usually; as few filters as suffice",
    ),
    "shares": (
        "share of each filter's responses above a threshold",
        "stick and slip: rare strong responses, which a mean hides",
        "with the filters, in every second discriminant",
    ),
    "distribution": (
        "shares of counts and of their differences above thresholds, of each taxel",
        "roughness and friction of fast and slow skins",
        "unless accuracy is better without it",
    ),
    "spectrum": (
        "log power in bands, averaged over taxels",
        "vibration; it carries over to a skin that was put back",
        "unless accuracy is better without it",
    ),
    "relations": (
        "deviations of taxels and correlations of their pairs, at up to seven time scales",
        "how taxels move together: a new force, speed or direction",
        "only if held-out groups show a gain, and several taxels exist",
    ),
    "loads": (
        "mean count of each taxel; the change of all in the first and the last tenth",
        "hardness, which the level shows",
        "only if held-out groups show a gain",
    ),
    "stages": (
        "log mean responses of three trained convolutions",
        "patterns that no fixed filter has",
        "with `--stages`, from 25 sweeps of each material on, unless accuracy is worse",
    ),
}
"""Features, purpose and condition of each view."""


def table(results: Json) -> str:
    """A row for each view: features, purpose, cost, condition, sets."""
    costs = {view["view"]: view for view in results["views"]}
    rows = []
    for name, (features, purpose, when) in VIEWS.items():
        cost = costs[name]
        spent = (
            f"{cost['features']}, {amount(cost['us'], 'µs')}, {amount(cost['bytes'] / 1e3, 'KB')}"
        )
        rows.append([name, features, purpose, spent, when, _on(name, results["sets"])])
    head = "view", "features", "what it is for", "alone: features, time, bytes", "when chosen", "on"
    return markdown.table(head, rows)


def _on(view: str, sets: Sequence[Json]) -> str:
    """The sets whose fit has this view, or those without it where these are fewer."""
    chosen = [one["set"] for one in sets if view in one["views"]]
    without = [one["set"] for one in sets if view not in one["views"]]
    if not without:
        return f"all {len(sets)}"
    if len(without) < len(chosen):
        return f"all but {', '.join(without)}"
    return ", ".join(chosen) or "no set"
