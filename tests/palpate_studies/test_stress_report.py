"""The study `stress`: its page by the cost of each corruption, and the command."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from palpate.core.errors import FormatError
from palpate_studies import stress_plots, stress_report
from palpate_studies.__main__ import main
from palpate_studies.method_names import plain_name
from palpate_train.reports import formatting, html
from tests.factories import stress_data, sweep_sets
from tests.factories.page_reader import PageReader

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


@pytest.mark.parametrize(
    ("method", "falls", "broken"),
    [
        ("palpate", ["50 Hz hum: 0.62 deviations", "dead taxels: 2 taxels"], 2),
        ("L-knn", ["higher gain: 22 %"], 1),
        ("H-svm", [], 0),
    ],
)
def test_what_breaks_first_needs_the_smallest_part_of_its_range(
    method: str, falls: list[str], broken: int
):
    """Hum fails at .625 of 2, dead taxels at 1.19 of 2, more gain never."""
    assert stress_report.first(CURVES[plain_name(method)]) == (falls, broken)


@pytest.mark.parametrize(
    ("unit", "severity", "shown"),
    [
        ("share", 0.35, "35 %"),
        ("of full load", 0.029, "2.9 % of full load"),
        ("taxels", 0.2, "1 taxel"),
        ("taxels", 1.5, "2 taxels"),
        ("fewer than 8", 3.7, "3.7 bits fewer"),
        ("deviations", 1.0, "1 deviation"),
        ("rows", 0.7, "0.7 rows"),
        ("ms", 100.0, "100 ms"),
    ],
)
def test_a_severity_has_its_unit(unit: str, severity: float, shown: str):
    """Shares are in percent. Numbers of taxels are whole."""
    assert formatting.level({"unit": unit}, severity) == shown


def test_five_methods_and_the_box_are_drawn():
    """The sixth is in tables alone; the box where it is silent or wrong."""
    shown = words(stress_plots.methods(CURVES))
    assert set(list(CURVES)[:5]) <= set(shown)
    assert plain_name("L-knn") not in shown
    assert {"50 Hz hum", "dead taxels"} <= set(shown)
    assert stress_report.missing(CURVES, OURS) == ["higher gain"]
    box = stress_data.figures()["box"]["curves"]
    shown = words(stress_plots.box(box))
    assert {"wrong label", "refused", "50 Hz hum", "dead taxels", "higher gain"} <= set(shown)
    quiet = box["wrong"] | {"gain-up": box["wrong"]["gain-up"] | {"accuracy": [0, 0, 0]}}
    assert "higher gain" not in words(stress_plots.box(box | {"wrong": quiet}))
    assert stress_report.most_wrong(box["wrong"])["share"][0] == 0.07


def test_pairs_show_what_is_left_of_each_method():
    """The pair that costs most is on top, the box first; older results have no pairs."""
    columns = stress_report._columns(stress_data.figures(), "pairs")
    assert list(columns)[:2] == [stress_report.BOX, stress_report.NETWORK]
    first, second = stress_report.pair_lines(columns)
    assert first[0].split(" and ") == ["50 Hz hum", "dead taxels"]
    assert first[1:] == ["0", "85", "85", "45", "80", "74", "65", "74"]
    assert second[0].split(" and ") == ["higher gain", "50 Hz hum"]
    assert stress_report.pair_lines({}) == []


def test_the_page_holds_the_figures():
    """Headline, tables, box, refused methods and origin; its tags close."""
    earlier = [{"methods": ["H-svm"], "commit": "0ld"}]
    page, pictures = stress_report.render(stress_data.figures() | {"earlier": earlier})
    reader = PageReader(page)
    assert reader.faults == []
    assert all(html.picture(svg) in page for svg in pictures.values())
    for fact in (
        f"{OURS} classifies 98.0 %",
        "first 50 Hz hum: 0.62 deviations , then dead taxels: 2 taxels",
        "simulated",
        "higher gain, 50 %: 7.0 % [2.0, 8.0]",
        "QUANT: needs aeon",
        "540 sweeps of sim:T-REAL:1 (aa11)",
        "bundle six 3, 8933e0d5",
        "Commit c0ffee, abacus, 2 cores",
        "commit 0ld: H-svm.",
    ):
        assert fact in reader.text.replace("\N{NO-BREAK SPACE}", " "), fact


def test_without_a_box_and_with_nothing_that_breaks():
    """The box's column and picture are missing. Results of no method make no page."""
    figures = stress_data.figures()
    figures["box"]["curves"] = figures["box"]["pairs"] = {}
    figures["methods"] = {"H-svm": figures["methods"]["H-svm"]}
    page, pictures = stress_report.render(figures)
    assert set(pictures) == {"curves"}
    assert "3 things" in PageReader(page).text
    assert "As the box answers" not in page
    figures["methods"] = {}
    with pytest.raises(FormatError):
        stress_report.render(figures)


def test_the_command_makes_the_result_again():
    """Of recorded sweeps the conditions that were kept and the part that is tested."""
    figures = stress_data.figures()
    simulated = stress_report.command(figures, "stress")
    assert "sim:T-REAL:1" in simulated.split()
    recorded = figures | {"train": "f.npz", "only": ["force<=180"], "split": "rep:0.67"}
    words = "--set f.npz --only 'force<=180' --split rep:0.67 --method"
    assert words in stress_report.command(recorded, "stress-fabrics")


@pytest.mark.slow  # fits a model and packs its bundle
def test_a_recorded_set_is_split_and_its_own_bundle_answers(tmp_path: Path):
    """One session of three is corrupted. A share that cannot be read ends it before any work."""
    sweep_sets.tones(12).save(tmp_path / "tones.npz")
    out = tmp_path / "out.json"
    words = ["stress", "--set", str(tmp_path / "tones.npz"), "--method", "H-svm", "--jobs", "1"]
    words += ["--cache", str(tmp_path / "cache"), "--out", str(out), "--split"]
    assert main([*words, "session:0.67"]) == 0
    result = json.loads(out.read_text())
    assert (result["train_sweeps"], result["test_sweeps"]) == (48, 24)
    assert result["box"]["bundle"]["name"] == "stressed"
    assert result["box"]["curves"]["correct"]["noise"]["right"][0] >= 20
    assert result["box"]["pairs"].keys() == result["box"]["curves"].keys()
    assert result["methods"]["H-svm"]["pairs"]["noise+dead"]["total"] == 24
    assert main([*words, "session:most"]) == FormatError.exit_code
