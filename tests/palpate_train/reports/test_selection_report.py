"""The report of a choice of model: the same sentences on a page and in a terminal."""

import re

import pytest

from palpate_train.reports import selection_report
from tests.factories import choice_data
from tests.factories.page_reader import PageReader

FACTS = (
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


def test_page_and_terminal_say_the_same_and_a_poor_choice_first():
    """With reason, neighbours and budget; a poor choice has no neighbours or curve."""
    terminal = selection_report.text(choice_data.choice())
    page = PageReader(selection_report.page(choice_data.choice())).text
    for text in (terminal, page):
        assert [fact for fact in FACTS if fact not in text] == []
    text = selection_report.text(choice_data.missed())
    page = selection_report.page(choice_data.missed())
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
    read = PageReader(selection_report.page(choice_data.choice()))
    assert read.faults == []
    assert not re.search(r"[{}]|\bNone\b|\bnan\b", read.text)
    evil = selection_report.page(choice_data.choice(set="</title><script>"))
    assert "&lt;/title&gt;" in evil
    assert "<script>" not in evil
    lines = selection_report.text(choice_data.choice()).split("\n")
    table = [line.split()[0] for line in lines if line.startswith("  ")]
    assert table == ["size", "bands", "pairs", "64", "all"]
