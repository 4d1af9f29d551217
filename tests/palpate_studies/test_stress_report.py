"""The page of the study `stress`: the corruptions by their effect, and the box's answers."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from palpate.core.errors import FormatError
from palpate_studies import stress_plots, stress_report
from palpate_studies.command import main
from palpate_studies.commands import measure
from palpate_studies.method_names import plain_name
from palpate_train.reports import formatting, html, provenance
from tests.factories import rendered, stress_data, sweep_sets
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import published

OURS = plain_name("palpate")
CURVES = {
    plain_name(name): entry["curves"]
    for name, entry in stress_data.figures()["methods"].items()
    if entry["curves"]
}


def words(svg: str) -> list[str]:
    """All texts of a picture."""
    return [
        node.text or ""
        for node in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
    ]


def test_what_breaks_first_needs_the_smallest_part_of_its_range():
    """Hum fails at .625 of 2, dead taxels at 1.19 of 2, more gain never. A part of a taxel is a
    taxel.
    """
    assert stress_report.first(CURVES[OURS]) == (
        ["50 Hz hum: 0.62 deviations", "dead taxels: 2 taxels"],
        2,
    )
    assert stress_report.first(CURVES[plain_name("L-knn")]) == (["higher gain: 22 %"], 1)
    assert stress_report.first(CURVES[plain_name("H-svm")]) == ([], 0)


@pytest.mark.parametrize(
    ("unit", "severity", "shown"),
    [
        ("share", 0.35, "35 %"),
        ("of full load", 0.029, "2.9 % of full load"),
        ("taxels", 0.2, "1 taxel"),
        ("taxels", 1.5, "2 taxels"),
        ("fewer than 8", 3.7, "3.7 bits fewer"),
        ("rows", 1.0, "1 row"),
        ("deviations", 1.0, "1 deviation"),
        ("rows", 0.7, "0.7 rows"),
        ("ms", 100.0, "100 ms"),
    ],
)
def test_a_severity_has_its_unit(unit: str, severity: float, shown: str):
    """Shares are in percent. Numbers of taxels are whole."""
    assert formatting.level({"unit": unit}, severity) == shown


def test_five_methods_are_drawn():
    """The sixth method is only in the tables. A corruption that affects only that method has no
    picture.
    """
    shown = words(stress_plots.methods(CURVES))
    drawn = ("palpate", "minirocket", "minirocket-augmented", "H-svm", "L-svm")
    assert set(map(plain_name, drawn)) <= set(shown)
    assert plain_name("L-knn") not in shown
    assert [text for text in shown if text in ("50 Hz hum", "dead taxels", "higher gain")] == [
        "50 Hz hum",
        "dead taxels",
    ]
    assert stress_report.missing(CURVES, OURS) == ["higher gain"]


def test_the_matrix_shows_where_each_method_fails_and_the_box_first():
    """Columns: the box, its network, then every method. A cell has the severity of the loss; a dot
    stands for none. The corruption that is endured least is on top.
    """
    shown = words(stress_plots.matrix(stress_report._columns(stress_data.figures(), "curves")))
    own = ["the box, as it answers", "its network alone"]
    columns = shown[shown.index(own[0]) :]
    assert columns[:4] == [*own, "all views", "MiniRocket"]
    rows = [shown[i : i + 1 + len(columns)] for i in (0, 9)]
    assert rows == [
        ["50 Hz hum, to 2 deviations", ".09", ".62", ".62", "1.1", ".42", "·", ".5", "·"],
        ["dead taxels, to 2 taxels", "1", "2", "2", "1", "2", "·", "·", "·"],
    ]


def test_pairs_show_what_is_left_of_each_method():
    """The pair that costs most is on top; a tile has per cent; older results have none."""
    columns = stress_report._columns(stress_data.figures(), "pairs")
    shown = words(stress_plots.pairs(columns))
    assert shown[:9] == [
        "50 Hz hum and dead taxels",
        "0",
        "85",
        "85",
        "45",
        "80",
        "74",
        "65",
        "74",
    ]
    assert shown[9] == "higher gain and 50 Hz hum"
    page, pictures = stress_report.render(stress_data.figures())
    assert "The hardest for the first column is 50 Hz hum and dead taxels" in PageReader(page).text
    assert "pairs" in pictures
    old = stress_data.figures()
    old["box"].pop("pairs")
    for entry in old["methods"].values():
        entry.pop("pairs")
    assert "pairs" not in stress_report.render(old)[1]


def test_the_command_makes_the_result_again():
    """Of recorded sweeps the conditions that were kept and the part that is tested."""
    figures = stress_data.figures()
    simulated = stress_report.command(figures, "stress")
    assert "--set sim:T-REAL:1 --test sim:T-REAL:101:2 --method palpate," in simulated
    assert "--split" not in simulated
    recorded = figures | {"train": "f.npz", "only": ["force<=180"], "split": "rep:0.67"}
    assert "--set f.npz --only 'force<=180' --split rep:0.67 --method" in stress_report.command(
        recorded, "stress-fabrics"
    )


@pytest.mark.slow  # fits a model and packs its bundle
def test_a_recorded_set_is_split_and_its_own_bundle_answers(tmp_path: Path):
    """One session of three is corrupted; methods and bundle learnt the others. A share that cannot
    be read ends it before any work."""
    sweep_sets.tones(12).save(tmp_path / "tones.npz")
    out = tmp_path / "out.json"
    words = ["stress", "--set", str(tmp_path / "tones.npz"), "--method", "H-svm", "--jobs", "1"]
    words += ["--cache", str(tmp_path / "cache"), "--out", str(out), "--split"]
    assert main([*words, "session:0.67"]) == 0
    result = json.loads(out.read_text())
    assert (result["train_sweeps"], result["test_sweeps"]) == (48, 24)
    assert result["split"] == "session:0.67"
    assert result["box"]["bundle"]["name"] == "stressed"
    assert result["box"]["curves"]["rightly"]["noise"]["right"][0] >= 20
    assert result["box"]["pairs"].keys() == result["box"]["curves"].keys()
    assert result["methods"]["H-svm"]["pairs"]["noise+dead"]["total"] == 24
    assert main([*words, "session:most"]) == 65


def test_methods_of_an_earlier_run_join_if_it_was_of_the_same_sweeps():
    """The run's own results count. The origin of the others stays: they may be of an older default.
    Results of other sweeps are refused.
    """
    run = {"methods": {"ds-cnn": 2}, "train_digest": "a", "test_digest": "b", "shipped": "new"}
    earlier = run | {"methods": {"palpate": 1, "ds-cnn": 1}, "shipped": "old"}
    made = measure._joined(run, earlier)
    assert made == run | {
        "methods": {"palpate": 1, "ds-cnn": 2},
        "earlier": [{"methods": ["palpate"], "shipped": "old"}],
    }
    assert "old" in provenance.of(made).bundle
    with pytest.raises(FormatError, match="have test_digest other, not b; name those of the same"):
        measure._joined(run, earlier | {"test_digest": "other"})


def test_the_box_is_shown_where_it_falls_silent_or_names_wrongly():
    """Dead taxels and hum cost the box answers. Higher gain gives seven wrong labels in a
    hundred.
    """
    box = stress_data.figures()["box"]["curves"]
    shown = words(stress_plots.box(box))
    assert {
        "named rightly",
        "named wrongly",
        "refused",
        "50 Hz hum",
        "dead taxels",
        "higher gain",
    } <= set(shown)
    quiet = box | {
        "wrongly": box["wrongly"] | {"gain-up": box["wrongly"]["gain-up"] | {"accuracy": [0, 0, 0]}}
    }
    assert "higher gain" not in words(stress_plots.box(quiet))
    assert stress_report.most_wrong(box["wrongly"])["share"][0] == 0.07


def test_the_page_holds_the_figures():
    """Headline, table, box and origin. Tags close, no brace is left, and it links to no other
    place.

    A refused method has its reason.
    """
    earlier = [{"methods": ["H-svm"], "commit": "0ld"}]
    page, pictures = stress_report.render(stress_data.figures() | {"earlier": earlier})
    reader = PageReader(page)
    assert (reader.wrong, reader.open) == ([], [])
    assert not re.search(r"[{}]|\bNone\b|\bnan\b|Undefined", reader.text)
    assert all(html.picture(svg) in page for svg in pictures.values())
    for fact in (
        f"{OURS} names 98.0 % of undisturbed sweeps rightly",
        "Of 3 things that can go wrong, 2 cost it 5 percentage points",
        "first 50 Hz hum: 0.62 deviations",
        "then dead taxels: 2 taxels",
        "All sweeps are simulated",
        "It gives most wrong names with higher gain, 50 %: 7.0 % [2.0, 8.0]",
        "for a skin that is taken off and put back",
        "QUANT: needs aeon",
        "540 sweeps of sim:T-REAL:1 (aa11)",
        "bundle six 3, 8933e0d5",
        "silent 6 answer no-contact",
        "Commit c0ffee, abacus, 2 cores",
        "Of an earlier run, commit 0ld: H-svm.",
    ):
        assert fact in reader.text, fact


def test_without_a_box_and_with_nothing_that_breaks():
    """Without answers of the packaged bundle its columns and its picture are missing.

    A method that withstands all corruptions says so.
    """
    figures = stress_data.figures()
    figures["box"]["curves"] = figures["box"]["pairs"] = {}
    figures["methods"] = {"H-svm": figures["methods"]["H-svm"]}
    page, pictures = stress_report.render(figures)
    text = PageReader(page).text
    assert set(pictures) == {"matrix", "pairs", "curves"}
    assert "None of 3 things that can go wrong costs it 5 percentage points" in text
    assert "As the box answers" not in text
    assert "box, rightly" not in text
    figures["methods"] = {}
    with pytest.raises(FormatError, match="no method has a result; run the study without --kept"):
        stress_report.render(figures)


def test_the_page_is_drawn_from_its_results(tmp_path: Path):
    """Page, pictures, and the results that the page links to."""
    page = published("stress", stress_data.figures(), tmp_path)
    assert {path.name for path in page.parent.iterdir()} == {
        "stress.json",
        "index.html",
        "curves.svg",
        "box.svg",
        "matrix.svg",
        "pairs.svg",
    }
    assert json.loads((page.parent / "stress.json").read_text())["test_sweeps"] == 100
    assert "stress.json" in PageReader(page.read_text()).links


@pytest.mark.slow
@pytest.mark.parametrize("width", rendered.WIDTHS)
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
def test_a_reader_sees_all_of_it(browser: Any, tmp_path: Path, width: int, scheme: str):
    """On a phone and a wide screen, light and dark: nothing is cut off, every axis has a title, and
    all texts can be read.
    """
    page = published("stress", stress_data.figures(), tmp_path)
    assert rendered.faults(browser, rendered.address(page), width, scheme) == {}
