"""The report of a choice of model: the same sentences on a page and in a terminal."""

import re
from typing import Any

import pytest

from palpate_train.reports import selection_report
from tests.factories.page_reader import PageReader

Json = dict[str, Any]


def _accuracy(mean: float) -> Json:
    return {"mean": mean, "low": round(mean - 0.05, 3), "high": round(min(mean + 0.04, 1), 3)}


def _difference(mean: float) -> Json:
    return {"mean": mean, "se": 0.012, "low": round(mean - 0.02, 3), "high": round(mean + 0.02, 3)}


def _model(
    method: str, ms: float, accuracy: float | None, behind: float, why_not: str = ""
) -> Json:
    known = accuracy is not None
    cost = {"ms": ms, "kb": 100 * ms, "mb": 57.0, "used": {"ms": ms / 50}}
    judged = {
        "accuracy": _accuracy(accuracy) if known else None,
        "behind": _difference(behind) if known else None,
    }
    return {"method": method, "why_not": why_not} | cost | judged


def _curve(kind: str, kept: str, *points: tuple[str, float, float], **more: Any) -> Json:
    """The points of a reduction: name, accuracy, and loss."""
    each = [
        {"name": name, "share": 1.0, "accuracy": _accuracy(mean), "behind": _difference(behind)}
        | {"fine": behind <= 0.012}
        for name, mean, behind in points
    ]
    made = {"kind": kind, "points": each, "kept": kept, "set": f"set {kind} so", "applied": False}
    return made | more


def chosen(**more: Any) -> Json:
    """Four sizes with all curves. They reach the target."""
    window = ("all", 0.935, 0.0), ("0.5 s", 0.93, 0.005), ("0.2 s", 0.815, 0.12)
    corners = [[0, 0], [0, 3], [3, 0], [3, 3]]
    alike = [["metal", "plastic <smooth>"]]
    curves = [
        _curve("window", "0.5 s", *window, applied=True),
        _curve("rate", "750 Hz", ("750 Hz", 0.935, 0.0), ("375 Hz", 0.875, 0.06)),
        _curve("taxels", "4", ("16", 0.935, 0.0), ("4", 0.928, 0.007), taxels=corners),
        _curve("bits", "6", ("8", 0.935, 0.0), ("6", 0.932, 0.003)),
        _curve("classes", "3", ("3", 0.935, 0.0), ("2", 0.965, 0.0), proposed=alike),
    ]
    bundle = {"content": "relations at 3 scales, spectrum <i>", "kb": 12.0, "ms": 0.118, "mb": 57.0}
    judged = {
        "chosen": "pairs",
        "best": "64",
        "accuracy": _accuracy(0.935),
        "wanted": 0.9,
        "rungs": [
            _model("bands", 0.08, 0.812, 0.131),
            _model("pairs", 0.12, 0.935, 0.008),
            _model("64", 0.31, 0.943, 0.0),
            _model("all", 0.9, None, 0.0, "over the budget"),
        ],
        "honest": _accuracy(0.928) | {"chose": {"pairs": 4, "64": 1}},
        "smaller": {"method": "bands"} | _difference(0.123),
        "larger": {"method": "64"} | _difference(0.008),
        "groups": ["place", "day"],
        "held_out": 960,
        "confused": [{"is": "metal", "named": "plastic <smooth>", "share": 0.115}],
        "less": curves,
        "bundle": bundle | {"used": {"ms": 0.014, "kb": 0.024}},
    }
    run = {
        "command": "palpate-train fit --scene drawer.toml --seed 1 --out drawer.npz",
        **{"set": "sim:T-REAL:1", "digest": "7f7b49c7", "sweeps": 480},
        "materials": ["metal", "plastic <smooth>", "foam"],
        "budget": {"ms": 50, "kb": 500, "slower": 3},
        **{"reattached": True, "seeds": [1], "commit": "c0ffee", "machine": "abacus"},
    }
    return judged | run | more


def test_page_and_terminal_say_the_same_and_a_poor_choice_first():
    """With reason, neighbours and budget; a poor choice has no neighbours or curve."""
    facts = (
        "pairs with 0.5 s of each sweep is enough to distinguish 3 materials",
        "a bundle of 12 kB, 0.118 ms a sweep",
        "relations at 3 scales, spectrum <i>",
        "tested on it (4 × pairs, 1 × 64).",
        "Reached: 90 % is wanted; it is not certain",
        "bands classifies 12.3 [10.3, 14.3] points fewer correctly",
        "64 classifies 0.8 [−1.2, 2.8] points more correctly",
        "0.5 s: 93.0 % of 93.5 %; 0.2 s loses 12.0 [10.0, 14.0] points.",
        "1 % of 50 ms, 2 % of 500 kB",
        "all sweeps are simulated.",
    )

    def missed() -> Json:
        """A single size that misses the target, with no groups that vary and no budget."""
        return chosen(
            **{"chosen": "bands", "best": "bands", "wanted": 0.99, "accuracy": _accuracy(0.51)},
            rungs=[_model("bands", 0.08, 0.512, 0.0)],
            **{"smaller": None, "larger": None, "less": [], "honest": None, "confused": []},
            bundle={"content": "spectrum", "kb": 12.0, "ms": 0.118, "mb": 57.0, "used": {}},
            budget={"slower": 1},
            groups=["recording"],
        )

    terminal = selection_report.text(chosen())
    page = PageReader(selection_report.page(chosen())).text
    for text in (terminal, page):
        assert [fact for fact in facts if fact not in text] == []
    text = selection_report.text(missed())
    page = selection_report.page(missed())
    for fact in (
        "Not reached: 99 % is wanted, 51.0 %",
        "no size is cheaper",
        "No budget was given",
    ):
        assert fact in text
        assert fact in PageReader(page).text
    assert 'class="stop">' in page


@pytest.mark.slow
def test_the_page_is_sound_and_the_terminal_has_a_line_for_each_model():
    """Tags close and foreign names cannot become tags."""
    read = PageReader(selection_report.page(chosen()))
    assert read.faults == []
    assert not re.search(r"[{}]|\bNone\b|\bnan\b", read.text)
    evil = selection_report.page(chosen(set="</title><script>"))
    assert "&lt;/title&gt;" in evil
    assert "<script>" not in evil
    lines = selection_report.text(chosen()).split("\n")
    table = [line.split()[0] for line in lines if line.startswith("  ")]
    assert table == ["size", "bands", "pairs", "64", "all"]
