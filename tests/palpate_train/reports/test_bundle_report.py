"""The report on a bundle: its figures are the box's answers, and the page holds all of them."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate_train.answer.stranger_limits import COSTS, FIGURES
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.export import measure
from palpate_train.metrics import bundle_score
from palpate_train.reports import bundle_experiment, bundle_report
from tests.factories import rendered
from tests.factories.page_reader import PageReader

NOTHING = lambda line: None  # noqa: E731


@pytest.fixture(scope="module")
def sweeps() -> Dataset:
    """A few sweeps of each material that the packaged bundle was not trained on."""
    return sets.load("sim:T-REAL:1021:1", 1).select(["position<=3"])


@pytest.fixture(scope="module")
def figures(sweeps: Dataset) -> dict:
    """The figures of the packaged bundle. Two sweeps are corrupted, and few are timed."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(measure.measure_all, "__defaults__", (2,))
        patched.setattr(EvaluationSweeps.of.__func__, "__defaults__", (2, 0))
        found = bundle_experiment.run(bundle.DEFAULT, sweeps, NOTHING)
    return found | {"command": "palpate-train report"}


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages with the picture of one sweep."""
    monkeypatch.setattr(bundle_report, "MOST_SHOWN", 1)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without pictures of example sweeps."""
    monkeypatch.setattr(bundle_report, "_examples", lambda sweeps: [])


def test_the_figures_are_those_of_score(figures: dict, sweeps: Dataset, default_bundle: Bundle):
    """Counts add up to the classifier's answers; precision includes other materials."""
    found = bundle_score.score(Classifier(default_bundle, SystemClock()), sweeps)
    assert figures["classified_correctly"]["right"] == found.right.sum()
    assert sum(row["sweeps"] for row in figures["materials"]) == len(sweeps)
    assert (
        round(sum(row["recall"][0] * row["sweeps"] for row in figures["materials"]))
        == found.right.sum()
    )
    assert figures["calibration"]["n"] == found.statuses["ok"] + found.statuses["unsure"]


def test_a_material_that_others_are_taken_for_loses_precision(
    figures: dict, sweeps: Dataset, default_bundle: Bundle
):
    """Three sweeps of wood as metal and one refused: each is counted in the right place."""
    found = bundle_score.score(Classifier(default_bundle, SystemClock()), sweeps)
    answered = {
        "wood": Counter({"wood": 5, "metal": 3, "(unsure)": 1, "(unknown)": 1, "(dead-taxel)": 2}),
        "metal": Counter({"metal": 9}),
    }
    mixed = replace(found, answered=answered, foreign={"felt": Counter({"metal": 6})})
    wood, metal = (bundle_experiment.material(name, mixed) for name in ("wood", "metal"))
    assert [wood[k] for k in ("sweeps", "unsure", "unknown", "refused")] == [12, 1, 1, 2]
    assert wood["taken_for"] == ["metal", 3]
    assert wood["recall"][0] == 5 / 12
    assert wood["precision"][0] == 1
    assert metal["precision"][0] == 9 / 18
    assert (
        bundle_experiment.material(
            "metal", replace(mixed, answered={"metal": Counter({"(gap)": 2})}, foreign={})
        )["precision"]
        == []
    )


@pytest.mark.slow
def test_the_page_holds_the_figures(figures: dict, sweeps: Dataset):
    """A row for each material and corruption; closed tags, nothing from elsewhere."""
    reader = PageReader(bundle_report.page(figures, sweeps))
    assert reader.faults == []
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert f"Of {figures['classified_correctly']['total']} sweeps of 6 materials" in reader.text
    assert "are simulated" in reader.text
    assert not re.search(r"\{\{|\}\}|\{%", reader.text)
    for row in figures["materials"]:
        assert row["name"] in reader.text
    for row in figures["corruptions"]:
        assert f"{row['title']}: {row['about']}" in reader.text


@pytest.mark.usefixtures("undrawn")
def test_a_set_with_a_foreign_material_and_many_labels(figures: dict, sweeps: Dataset):
    """A material that the bundle lacks has its table; beyond twelve labels no matrix."""
    many = figures | {
        "labels": [f"m{i}" for i in range(13)],
        "not_in_the_bundle": {"felt": {"(unknown)": 7, "wood": 1}},
        "set": "mine.npz",
        "recordings": {"right": 3, "total": 4},
    }
    plain = PageReader(bundle_report.page(many, sweeps)).text
    assert "felt 8 7 1" in plain
    assert "by the labels that" not in plain
    assert "fused: 3 of 4" in plain
    assert "simulated" not in plain.split("How it was made")[0]


@pytest.mark.usefixtures("undrawn")
def test_the_headline_says_what_was_missed(figures: dict, sweeps: Dataset):
    """All sweeps are right, wrong or unnamed; the worst material, the first corruption."""
    named = figures["named"]
    assert named["right"] + named["wrong"] + named["not_named"] == named["n"] == len(sweeps)
    missed = figures | {
        "named": {"n": 20, "right": 15, "wrong": 3, "not_named": 2, "unknown": [0.1, 0.0, 0.3]},
        "materials": [
            row | {"recall": [0.25, 0.1, 0.5] if row["name"] == "wood" else [1.0, 0.9, 1.0]}
            for row in figures["materials"]
        ],
        "foreign_named": [0.75, 0.5, 0.9],
    }
    text = PageReader(bundle_report.page(missed, sweeps)).text
    for line in (
        "classified correctly 75.0 %, 15 of 20",
        "wrong label 15.0 %, 3 of 20",
        "refused) 10.0 %, 2 of 20",
        "least often: wood 25.0 % [10.0, 50.0]",
        "does not have, with a label 75.0 % [50.0, 90.0]",
        "10.0 % [0.0, 30.0] of the sweeps of its own materials are called unknown",
    ):
        assert line in text, line


def test_what_the_bundle_calls_a_foreign_material_is_counted(
    sweeps: Dataset, default_bundle: Bundle
):
    """Four of six sweeps of felt get a label: two thirds; own materials apart."""
    found = bundle_score.score(Classifier(default_bundle, SystemClock()), sweeps)
    answered = {"wood": Counter({"wood": 5, "metal": 3, "(unsure)": 1, "(unknown)": 2})}
    foreign = {"felt": Counter({"metal": 3, "wood": 1, "(unknown)": 2})}
    mixed = replace(found, answered=answered, right=np.arange(11) < 5, foreign=foreign)
    assert bundle_experiment.foreign_named(mixed)[0] == pytest.approx(4 / 6)
    assert bundle_experiment.foreign_named(found) == []
    named = bundle_experiment.named(sweeps.take(np.arange(11)), mixed)
    assert [named[k] for k in ("n", "right", "wrong", "not_named")] == [11, 5, 3, 3]
    assert named["unknown"][0] == pytest.approx(2 / 11)


@pytest.mark.usefixtures("undrawn")
def test_a_bundle_without_novelty_says_so(figures: dict, sweeps: Dataset):
    """Such a bundle never answers `unknown`, and the page states no figure for it."""
    text = PageReader(bundle_report.page(figures | {"tells_unknown": False}, sweeps)).text
    assert "never answers unknown" in text
    assert "of its own materials" not in text


@pytest.mark.slow
@pytest.mark.thorough  # a command that trains and draws
def test_the_command_writes_page_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """Both files are written; the target is checked before any measurement."""
    monkeypatch.setattr(EvaluationSweeps.of.__func__, "__defaults__", (12, 0))
    named = ["report", str(bundle.DEFAULT), "--set", "sim:T-REAL:1021:1", "--only", "position<=2"]
    assert main([*named, "--out", "/proc/none/report.html"]) != 0
    assert "cannot be written" in capsys.readouterr().err
    assert (
        main([*named, "--out", str(tmp_path / "report.html"), "--json", str(tmp_path / "f.json")])
        == 0
    )
    text = (tmp_path / "report.html").read_text()
    assert "bad at</h2>" in text
    assert "<code>--train</code>" in text
    assert json.loads((tmp_path / "f.json").read_text())["bundle"]["name"] == "default"


@pytest.mark.slow
def test_people_read_display_names(figures: dict, sweeps: Dataset):
    """In tables and pictures; figures for programs keep the labels."""
    shown = figures | {"displays": {"wood": "Holz, geölt"}}
    page = bundle_report.page(shown, replace(sweeps, displays=shown["displays"]))
    text = PageReader(page).text
    assert "Holz, geölt" in text
    assert not re.search(r"\bwood\b", text.partition("How it was made")[0])
    assert shown["labels"] == figures["labels"]


def test_a_row_of_few_sweeps_says_how_many(figures: dict):
    """The share is that of all sweeps, those without a label too: one of thirty is 3 %."""
    answers = {
        "wood": {"wood": 1, "(unknown)": 29},
        "metal": {"metal": 2, "paper": 1},
        "x" * 40: {"x" * 40: 1},
    }
    some = figures | {"labels": [*answers, "paper"], "answers": answers}
    drawn = PageReader(bundle_report.confusion(some)).text
    assert "wood · " not in drawn
    assert re.search(r"\b3\b", drawn)
    assert "n = 3" in drawn
    assert "n = 30" not in drawn
    assert "n = 0" in drawn
    assert "n = 1" in drawn
    assert f"{'x' * 23}…" in drawn


@pytest.mark.usefixtures("undrawn")
def test_the_page_shows_the_curve_and_materials_left_out(figures: dict, sweeps: Dataset):
    """Each point in words, the picture with titles, the material in its table."""
    row = {"auroc": 0.9, "low": 0.8, "high": 1.0, "kept": 0.95, "false_known": 0.25}
    more = {
        "curve": [
            {"each": 5, "share": 0.5, "low": 0.4, "high": 0.6, "n": 90},
            {"each": 16.0, "share": 0.75, "low": 0.7, "high": 0.8, "n": 90},
        ],
        "trained": {"method": "palpate", "set": "t.npz", "sweeps": 60, "effort": 1.0},
        "left_out": {"materials": {"wood": row | {"known": 9, "unknown": 4}}, "mean": row},
    }
    page = bundle_report.page(figures | more, sweeps)
    text = PageReader(page).text
    for point in ("5: 50.0 % [40.0, 60.0]", "16: 75.0 % [70.0, 80.0]"):
        assert point in text
    assert "sweeps of each" in page
    assert re.search(r"wood 25.0 % 95.0 % .*9 / 4", text)
    assert "known sweeps answered" in page
    assert all(f'classifier.strangers = "{limit}"' in text for limit in COSTS)


def test_each_condition_has_its_curve(figures: dict):
    """Of several conditions each is drawn, with a point for each limit; else their sum. The limits
    have their names at one of the curves."""
    found = dict(figures["figures"][FIGURES])
    one = bundle_report.strangers(found)
    shares = {limit: [[0.9, 0.2]] for limit in COSTS} | {"curve": [[0.6, 0.1], [0.95, 0.4]]}
    two = bundle_report.strangers(found | {"by condition": {"force": shares, "speed": shares}})
    assert "new force" in two
    assert "new speed" in two
    assert all(of.count(f">{limit}<") == 1 for of in (one, two) for limit in COSTS)
    assert two.count("<use") - one.count("<use") == len(COSTS)
    hard = shares | {"balanced": [[0.37, 0.2]]}
    assert ">40<" not in two
    assert ">40<" in bundle_report.strangers(found | {"by condition": {"a": shares, "b": hard}})


@pytest.mark.slow
@rendered.LOOKS
def test_the_page_can_be_read_everywhere(
    browser: Any, tmp_path: Path, figures: dict, sweeps: Dataset, width: int, scheme: str
):
    """At three widths, by day and by night."""
    (tmp_path / "r.html").write_text(bundle_report.page(figures, sweeps))
    assert rendered.faults(browser, rendered.address(tmp_path / "r.html"), width, scheme) == {}
