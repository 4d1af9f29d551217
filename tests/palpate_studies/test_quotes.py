"""The figures that documents may quote, and the search for sentences that contradict them."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate_studies import quotes
from palpate_studies.quotes import Quote
from tests.factories.development_data import case, entry, figures, timed, times
from tests.factories.paths import ROOT
from tests.factories.study_pages import committed

ALL = [quote for study, of in quotes.QUOTES.items() for quote in of(committed(study))]
DATED = (ROOT / "CHANGELOG.md", ROOT / "docs" / "decisions", ROOT / "docs" / "data" / "trials")
"""Texts about an earlier state, whose figures stay as they were."""
DOCUMENTS = [
    path
    for path in (*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md")))
    if not any(path.is_relative_to(old) for old in DATED)
]
SWEEP = "4x4 uint8 at 750 Hz, window 1500"
UNKNOWN = Quote(
    "unknown", "20.1 %", (20.1, 15.0, 25.5), "%", "", words=("[Uu]nknown", "known name")
)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_document_contradicts_the_figures(path: Path):
    """A sentence about a quantity has its figure, or none."""
    assert quotes.contradictions(path.read_text(encoding="utf-8"), ALL) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("Of unknown materials 20 % get a known name.", []),
        ("Of unknown materials 20.1 % get a known name.", []),
        ("Of unknown materials 25.5 % at most get a known name.", []),
        ("Of unknown materials 19 % get a known name.", ["19 %"]),
        ("Unknown materials\nget a known name in 5 % of sweeps.", ["5 %"]),
        ("| a | b |\n| unknown, known name | 9.0 % |\n| c | 7 % |", ["9.0 %"]),
        ("Unknown materials are rare. 19 % get a known name.", []),
        ("Unknown materials get a known name after 19 ms.", []),
        ("<!-- t -->\nUnknown: a known name in 19 %.\n<!-- /t -->", []),
    ],
)
def test_a_figure_that_differs_is_found(text: str, found: list[str]):
    """A figure may be rounded. A sentence counts if it has all words; other units and tables
    between markers do not count.
    """
    told = [one.partition(":")[0] for one in quotes.contradictions(text, [UNKNOWN])]
    assert told == found


def test_every_row_has_figure_interval_test_sweeps_and_seeds():
    """Of the methods that were run in every test of a kind, the mean and each tactile test."""
    results = figures(
        cases=[case("one")],
        results=[entry("one", "palpate", 0.9), entry("one", "quant", 0.8)],
        times=times(timed("palpate", 0.4, "int8"), timed("quant", 50.0)),
    )
    text = quotes.table("development", results)
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert rows[1:] == [
        "| Palpate, all views | 90.0 % [85.0, 95.0] | mean of 1 tests: real tactile sets | 100 "
        "| 1, 2 |",
        "| Palpate, all views | 90.0 % [85.0, 95.0] | one: a force it never felt | 100 | 1, 2 |",
        f"| time of a sweep: Palpate, all views | 0.4 ms | {SWEEP} | – | – |",
        f"| time of a sweep: QUANT | 50 ms | {SWEEP} | – | – |",
    ]
    assert "by `python -m palpate_studies development`" in text
    assert "**Made without the default" in text


def test_quantities_of_missing_results_are_left_out():
    """Without the packaged recipe the robustness page has no row."""
    assert list(quotes.QUOTES["stress"]({"methods": {}, "test_sweeps": 1, "attachments": 1})) == []
    assert {quote.unit for quote in ALL} == {"%", "ms", "kB", "points", ""}
