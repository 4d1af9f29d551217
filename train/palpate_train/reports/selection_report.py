"""The reasons for a choice of model, as the same sentences for a terminal and for a page.

It computes only shares and points; every number is in choice.json.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from palpate_train.reports import formatting, html, provenance, selection_plots

Json = Mapping[str, Any]


def text(choice: Json) -> str:
    """The reasons for the terminal."""
    return html.render_text("selection.txt.j2", choice=choice, **_facts(choice)).rstrip()


def page(choice: Json) -> str:
    """The page (HTML)."""
    sizes = selection_plots.sizes(
        choice["rungs"], choice["chosen"], choice["wanted"], "accuracy of each size"
    )
    pictures = {"sizes": html.picture(sizes)}
    if choice["less"]:
        reductions = selection_plots.reductions(choice["less"], "accuracy with less of each thing")
        pictures["reductions"] = html.picture(reductions)
    header = provenance.of({key: choice.get(key) for key in ("commit", "set", "seeds", "date")})
    return html.render(
        "selection.html.j2", header=header, choice=choice, pictures=pictures, **_facts(choice)
    )


def _facts(choice: Json) -> dict[str, Any]:
    """Values for the sentences that choice.json does not state directly."""
    models, smaller = choice["rungs"], choice["smaller"]
    curves = list(_curves(choice))
    expected = choice["honest"] or choice["accuracy"]
    return {
        "to_expect": expected,
        "missed": expected["mean"] < choice["wanted"],
        "cut": [
            c["kept"] + " of each sweep" * (c["kind"] == "window")
            for c in choice["less"]
            if c["applied"]
        ],
        "applied": any(c["applied"] for c in choice["less"]),
        "smaller_behind": next(m["behind"] for m in models if m["method"] == smaller["method"])
        if smaller
        else None,
        "curves": curves,
        "merged": _merged(choice),
        "caveats": list(_caveats(choice)),
        "models": [_row(model, choice["best"]) for model in models],
    }


def _row(model: Json, best: str) -> list[str]:
    """One row of the table of models."""
    costs = (
        ["–"] * 3
        if model["ms"] is None
        else [f"{model['ms']:.3f}", f"{model['kb']:.1f}", f"{model['mb']:.0f}"]
    )
    used = formatting.percent(max(model["used"].values()), 0) if model["used"] else "–"
    accuracy = model["accuracy"]
    right = formatting.estimate([accuracy[k] for k in ("mean", "low", "high")]) if accuracy else "–"
    behind = model["why_not"]
    if model["method"] == best:
        behind = "best"
    elif model["behind"]:
        mean, low, high = (formatting.points(model["behind"][k]) for k in ("mean", "low", "high"))
        behind = f"{mean} [{low}, {high}]"
    return [model["method"], *costs, used, right, behind]


def _curves(choice: Json) -> Iterator[dict[str, Any]]:
    """The smallest sufficient window, rate and so on; whole: nothing may be left out."""
    for curve in choice["less"]:
        tried = [point for point in curve["points"] if "accuracy" in point]
        kept = next(point for point in tried if point["name"] == curve["kept"])
        yield {
            "kind": curve["kind"],
            "name": "materials" if curve["kind"] == "classes" else curve["kind"],
            "kept": curve["kept"],
            "whole": kept is tried[0],
            "fails": next((point for point in tried if not point.get("fine", True)), None),
            "set": curve["set"],
            "accuracy": kept["accuracy"]["mean"],
            "of": tried[0]["accuracy"]["mean"],
            "applied": curve["applied"],
            "taxels": curve.get("taxels"),
        }


def _merged(choice: Json) -> dict[str, Any] | None:
    """The materials that could be merged, and the gain; None if there are none."""
    curve = next((curve for curve in choice["less"] if curve["kind"] == "classes"), None)
    if curve is None or not curve["proposed"]:
        return None
    names = len(choice["materials"]) - sum(len(those) - 1 for those in curve["proposed"])
    accuracy = next(
        point["accuracy"]["mean"] for point in curve["points"] if point["name"] == str(names)
    )
    return {"proposed": curve["proposed"], "names": names, "accuracy": accuracy}


def _caveats(choice: Json) -> Iterator[str]:
    """Limits of the figures."""
    if choice["groups"] == ["recording"]:
        yield "the set has no groups that vary, so recordings were left out: that flatters"
    if choice["reattached"]:
        yield "two thirds of the held-out sweeps are augmented copies, as of a skin put back"
    if choice["set"].startswith("sim:"):
        yield "all sweeps are simulated"
    if refused := choice["bundle"].get("refused_with_less"):
        yield f"not shortened: {refused}"
