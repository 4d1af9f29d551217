"""The study `development`: its runs, its cache, its omissions, and the figures of its page."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from palpate.core.errors import BundleError, FormatError
from palpate_studies import (
    development_chart,
    development_experiment,
    development_report,
    development_times,
    method_names,
    precisions,
)
from palpate_studies.__main__ import main
from palpate_studies.development_chart import ChartPanel, Spot
from palpate_studies.study import StudyCase, StudyRun, save
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.models import methods
from tests.factories.development_data import SERIES, case, entry, figures, timed, times
from tests.factories.page_reader import PageReader
from tests.factories.paths import ROOT
from tests.factories.study_pages import committed
from tests.factories.sweep_sets import tones


def silent(line: str) -> None:
    """A log that drops every line."""


def shown(made: dict[str, Any]) -> str:
    """The visible text of the page of these results."""
    return PageReader(development_report.render(made)[0]).text.replace("\N{NO-BREAK SPACE}", " ")


def test_the_page_shows_every_figure():
    """Findings, intervals beside the best peer, means, precisions, costs and omissions."""
    facts = [
        "Palpate 90.0 %, 5.0 points ahead of QUANT",
        "+5.0 [−2.1, +12.1] 90.0 % 85.0 – 95.0 % 85.0 % 80.0 – 90.0 % QUANT",
        "two: a force it never felt 70.0 % 65.0 – 75.0 % 2 seeds – 75.5 % 70.5 – 80.5 %",
        "mean of 1: real tactile sets 90.0 % 85.0 – 95.0 % – 85.0 %",
        "Palpate, all views real tactile sets 90.0 % 91.0 % 1.0 1",
        "quick <b>, two: a window of 8 frames",
        "MiniRocket’s = 1 1/14 – 2.2",
        "one.npz, force<=180 leave:force digest of one",
        "seeds 1, 2; commit 0123abcd; x86_64, 2 cores",
        "QUANT float onnx 22 ms 44 ms",
        "Palpate, all views int8 onnx 0.1 ms 0.2 ms 0.7 ms",
        "DS-CNN: one: a force it never felt; two: a force it never felt",
    ]
    text = shown(figures())
    assert [fact for fact in facts if fact not in text] == []


def test_the_page_is_sound_and_marks_the_best_peer():
    """Its tags close and no value is missing. The best peer of each test and mean is bold."""
    page, pictures = development_report.render(figures())
    read = PageReader(page)
    assert set(pictures) == {"front"}
    assert read.faults == []
    bold = re.findall(r'<td class="best">([\d.]+)', page)
    assert bold == ["85.0", "75.5", "93.0", "85.0", "93.0"]


def test_a_part_of_the_results_makes_a_page():
    """A page without peers has no difference, a page without times no chart."""
    alone = [entry("one", "palpate-bands", 0.9), entry("two", "quant", 0.7)]
    made = figures(results=alone, methods=["palpate-bands", "quant"], times=None)
    assert "90.0 % 85.0 – 95.0 % –" in shown(made)
    assert development_report.render(made)[1] == {}
    with pytest.raises(FormatError, match="result of"):
        development_report.render(figures(results=[entry("one", "quant", 0.9)]))


def test_the_chart_has_findings_methods_gaps_and_the_processor():
    """A method with gaps is hollow and listed. So are accuracies below the axis."""

    def texts(svg: str) -> list[str]:
        """All texts of a picture."""
        return [node.text or "" for node in ElementTree.fromstring(svg).findall(".//{*}text")]

    results = [
        entry(c, m, a)
        for c in ("one", "three")
        for m, a in (("palpate", 0.9), ("palpate-bands", 0.6), ("quant", 0.85))
    ]
    costs = [timed(*one) for one in (("palpate", 0.4, "int8"), ("palpate-bands", 0.04, "int8"))]
    costs += [timed("quant", 50.0), timed("lite", 1.4)]
    made = figures(
        cases=[case("one"), case("three"), case(SERIES)],
        results=[*results, entry("one", "lite", 0.8), entry(SERIES, "palpate", 0.9)],
        times=times(*costs),
    )
    words = texts(development_report.front(made))
    assert {"all views 90.0", "LITE 80.0"} <= set(words)
    said = " ".join(words)
    for part in ("Palpate 90.0 %, 5.0 ", "ahead of QUANT", "sets: bands 60.0", "LITE 1 of 2"):
        assert part in said
    assert "a processor, one thread" in said
    assert "5.0 points ahead" in development_report.caption(made)


def test_the_axis_says_what_was_timed():
    """The whole answer of ours, or features and network alone."""
    answered = figures()
    alone = figures(times=times(timed("palpate", 0.1, "int8"), timed("quant", 22.0)))
    for made, what in ((answered, "the whole answer"), (alone, "features and network")):
        assert f"time of {what}" in development_report.front(made)
        assert f"of {what}" in shown(made)


def test_the_picture_of_the_readme_names_at_most_seven_methods():
    """The line of our family, what ships, and the methods that a stranger would take otherwise."""
    named = re.findall(r">([^<>]+) \d+\.\d<", (ROOT / "docs/front.svg").read_text("utf-8"))
    assert {"ships", "Palpate", "MiniRocket", "MultiRocket-Hydra"} <= {*named}
    assert len({*named}) <= 7
    assert max(Counter(named).values()) <= 2  # once in each panel


def test_the_front_is_over_all_forms_and_the_line_over_our_family():
    """A float form may be on it; of equal times the better; the packaged recipe is a size."""

    def panel(*spots: Spot) -> ChartPanel:
        """A panel of one test with these spots."""
        return ChartPanel("a kind", (case("one"),), spots)

    def spot(method: str, ms: float, mean: float, form: str = "", **more: Any) -> Spot:
        """A spot with an interval of five points each way."""
        return Spot(method, form, "int8", ms, (mean, mean - 0.05, mean + 0.05), **more)

    slow, quick = spot("ds-cnn", 0.3, 0.85), spot("ds-cnn", 0.1, 0.8, "int8")
    ours, gap = spot("palpate", 0.4, 0.9), spot("lite", 0.05, 0.99, lacks=("one",))
    worse, later = spot("quant", 0.1, 0.7), spot("minirocket", 10.0, 0.9)
    made = panel(later, gap, ours, slow, worse, quick)
    assert made.front == [quick, slow, ours]
    assert made.peer == later
    assert made.lacking() == {"lite": 1}
    assert panel().front == []
    assert "not run in every test" in development_chart.finding(panel())
    bands, everything = spot("palpate-bands", 0.1, 0.7), spot("palpate", 0.4, 0.9)
    packaged = spot("palpate-reattached", 0.01, 0.85)
    made = panel(everything, bands, packaged, spot("quant", 50.0, 0.95))
    assert made.sizes == [bands, everything]
    assert made.line == [packaged, everything]


@pytest.mark.parametrize(("files", "away"), [(("a", "a"), 0.05), (("a", "b"), 0.05 / 2**0.5)])
def test_the_mean_of_tests_counts_one_set_once(files: tuple[str, str], away: float):
    """Tests of one file err together, tests of two files independently."""
    entries = {name: entry(name, "palpate", 0.8) for name in ("one", "three")}
    middle = development_chart.mean(entries, dict(zip(entries, files, strict=True)))
    assert middle == pytest.approx((0.8, 0.8 - away, 0.8 + away))


def test_cases_and_methods_exist_and_have_words_for_people():
    """No protocol, published set or described method is shown by its name in commands."""
    usual = set(development_experiment.usual_methods())
    assert set(development_experiment.PEERS) < usual <= set(methods.every())
    assert method_names.NAMES.keys() <= methods.every().keys()
    assert method_names.plain_name("recurrent") == "recurrent"
    assert len(development_experiment.CASES) == 12
    for name, one in development_experiment.CASES.items():
        about = case(name, protocol=one.protocol, simulated=one.simulated)
        assert one.protocol not in development_chart.plain_case(about)
        assert one.protocol not in development_chart.about_case(about)
        series = development_chart.kind_of(about) == development_chart.SERIES
        assert series == one.sets[0].startswith("aeon:")


def test_results_are_one_a_test_and_times_those_of_minirocket():
    """Else the page would show the last; without MiniRocket times are not compared."""
    found = [(one["case"], one["method"]) for one in committed("development")["results"]]
    assert len(found) == len(set(found)) > 100
    costs = [timed("minirocket", ms) for ms in (12.0, 10.0)]
    costs += [timed("palpate", 0.1), timed("quant", 22.0)]
    names = ["palpate", "quant", "ds-cnn"]
    assert development_chart.relative_times(costs, names) == {"palpate": "1/100", "quant": "2.2"}
    assert development_chart.relative_times(costs[2:], names) == {}


def experiment(folder: Path, *names: str, **given: Any) -> tuple[StudyRun, dict[str, Any]]:
    """A run, and its results, of two cases on tones."""
    tones().save(folder / "tones.npz")
    replace(tones(), samples=tones().samples[:, :7]).save(folder / "short.npz")
    real: dict[str, Any] = {"real": True, "means_removed": True}
    cases = {
        "tones": StudyCase(("tones.npz",), "leave:session", **real),
        "short": StudyCase(("short.npz",), "split:session=0,1->2", ("material=a,c",), **real),
    }
    where = Where(jobs=1, cache=folder / "cache")
    run = StudyRun(**({"where": where, "log": silent, "data": folder} | given))
    return run, development_experiment.results(run, names, cases)


def test_results_of_named_methods_are_replaced_and_all_others_stay():
    """A run stays named while a result of one of its methods does."""
    held = figures()
    again = {"methods": ["quant", "L"], "seeds": [1], "commit": "4567"}
    better = [entry("one", "quant", 0.95), entry(SERIES, "quant", 0.96), entry("one", "L", 0.5)]
    new = figures(methods=again["methods"], runs=[again], results=better, cases=[case("one")])
    made = development_experiment.joined(held, new)
    found = {(one["case"], one["method"]): one["mean"] for one in made["results"]}
    assert (found["one", "quant"], found["one", "palpate"]) == (0.95, 0.9)
    assert (found["two", "quant"], found["one", "L"]) == (0.755, 0.5)
    assert len(made["results"]) == len(held["results"]) + 1
    assert made["methods"] == [*held["methods"], "L"]
    assert [run["methods"] for run in made["runs"]] == [again["methods"], held["methods"]]
    assert [one["case"] for one in made["cases"]] == ["one", "two", SERIES]
    assert made["times"] == held["times"]
    third = figures(results=[entry(name, "quant", 0.7) for name in ("one", "two", SERIES)])
    left = development_experiment.joined(made, third)["runs"][1:]
    assert [run["methods"] for run in left] == [["L"], ["palpate", "quick <b>"]]


@pytest.mark.slow
@pytest.mark.thorough  # a whole study
def test_all_is_run_kept_and_what_is_refused_is_left_out(tmp_path: Path):
    """A second run needs only the cache."""
    names = ("L-gauss", "spectrogram-svm")
    run, found = experiment(tmp_path, *names, seeds=(1, 2))
    there = {(r["case"], r["method"]) for r in found["results"]}
    assert there == {("short", "L-gauss"), *(("tones", m) for m in names)}
    assert list(run.left_out) == ["spectrogram-svm, short"]
    assert [one["materials"] for one in found["cases"]] == [3, 2]
    assert all(
        r["seeds"] == [1, 2] and r["low"] <= r["mean"] <= r["high"] for r in found["results"]
    )
    kept = replace(run.where, kept=True)
    assert experiment(tmp_path, *names, seeds=(1, 2), where=kept)[1] == found
    assert experiment(tmp_path, "L-knn", where=kept)[1]["results"] == []


def test_what_is_missing_is_listed(tmp_path: Path):
    """Cases without sweeps have a reason; unknown methods are errors."""
    run, found = experiment(tmp_path, "L-gauss", data=None)
    assert found["results"] == []
    assert "PALPATE_DATA" in run.left_out["tones"]
    with pytest.raises(FormatError, match="'nobody'"):
        experiment(tmp_path, "L-gauss", "nobody")


def test_other_precisions_of_a_method_are_counted_with_it():
    """They are counted over all seeds, as the method itself is."""
    one = {"window": {"right": 8, "total": 10}, "interval": (0.5, 0.9), "fit_s": 1.0}
    results = [
        one | {"seed": s, "forms": {"int8": one | {"window": {"right": 5 + s, "total": 10}}}}
        for s in (1, 2)
    ]
    made = development_experiment._entry(results)
    assert (made["mean"], made["seeds"], made["fit_s"]) == (0.8, [1, 2], 1.0)
    assert made["forms"]["int8"]["mean"] == 0.65


def test_panels_are_timed_with_their_own_sweeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With means removed where its tests do so; without real sweeps only published series."""
    asked: list[float] = []

    def measured(names: list[str], sweeps: Dataset, *given: Any) -> dict[str, Any]:
        asked.append(float(np.abs(sweeps.samples.mean(axis=1)).max()))
        return {"entries": []}

    drawn = replace(tones(), samples=tones().samples + 1)
    monkeypatch.setattr(development_times, "measured", measured)
    monkeypatch.setattr(StudyCase, "load", lambda self, data: None if self.real else drawn)
    found = development_times.of_panels(["quant"], None, 1, tmp_path, silent, methods.FULL_EFFORT)
    assert list(found) == [development_chart.SERIES]
    assert len(asked) == 1
    assert asked[0] < 1


@pytest.mark.slow
@pytest.mark.thorough  # trains and times every method
def test_all_methods_are_timed_in_one_run(tmp_path: Path):
    """Graphs are timed in int8, too; a method without a graph is timed in its library."""
    names = ["L-gauss", "ds-cnn", "quant", "spectrogram-svm"]
    found = development_times.measured(names, tones(), 1, tmp_path, silent, methods.Effort(0.4), 2)
    keys = ("method", "form", "precision", "runtime", "runs_on_box")
    assert [tuple(one[key] for key in keys) for one in found["entries"]] == [
        ("L-gauss", "", "float", "onnx", True),
        ("ds-cnn", "", "float", "onnx", True),
        ("ds-cnn", "int8", "int8", "onnx", True),
        ("quant", "", "float", "aeon", False),
        ("spectrogram-svm", "", "float", "palpate_studies", False),
    ]
    counted = ("weights", "macs", "file_kb")
    assert all(one[key] > 0 for one in found["entries"][:3] for key in counted)
    assert found["entries"][2]["file_kb"] < found["entries"][1]["file_kb"]
    assert all(0 < one["ms_p50"] <= one["ms_p99"] for one in found["entries"])
    assert found["left_out"] == {}


@pytest.mark.slow
def test_a_model_that_the_box_refuses_is_timed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It has times, counts and the reason; the bundle is timed with sweeps of its own format."""

    def refuse(*given: Any) -> None:
        raise BundleError("it needs too much memory")

    monkeypatch.setattr(precisions, "packed", refuse)
    found = development_times.measured(["L-gauss"], tones(), 1, tmp_path, silent)
    (one,) = found["entries"]
    assert (one["runs_on_box"], one["refused"]) == (False, "it needs too much memory")
    assert 0 < one["ms_p50"] <= one["ms_p99"]
    assert one["weights"] > 0 < one["file_kb"]
    assert "rss_mb" not in one


@pytest.mark.slow
def test_the_axis_has_the_whole_answer_of_a_bundle_of_ours(tmp_path: Path):
    """With checks and rules it takes longer than its network; a peer has neither."""
    skin_sweeps = sets.load("sim:T-REAL/level-blind:1001:2")
    ours, peer = development_times.measured(
        ["palpate-bands", "L-gauss"], skin_sweeps, 1, tmp_path, silent, rounds=2
    )["entries"]
    assert ours["answer_ms"] > ours["ms_p50"]
    assert development_chart.answer_ms(ours) == ours["answer_ms"]
    assert development_chart.answer_ms(peer) == peer["ms_p50"]


@pytest.mark.parametrize("text", [None, "{", "[]", "{}"])
def test_other_results_are_not_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None
):
    """The error has the name of a missing or wrong file. Nothing is written."""
    if text is not None:
        (tmp_path / "development.json").write_text(text)
    file, out = str(tmp_path / "development.json"), str(tmp_path / "pages")
    for command in (
        ["pages", "development", "--results", str(tmp_path), "--out", out],
        ["development", "--times", "--out", file],
    ):
        assert main(command) == FormatError.exit_code
        assert "development.json" in capsys.readouterr().err
    assert not (tmp_path / "pages").exists()


def test_times_alone_are_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Accuracies stay, and so do the times of a panel that cannot be timed here."""
    before = {development_chart.TACTILE: {"format": "fabrics"}, SERIES: {"format": "before"}}
    file = save(tmp_path / "development.json", figures(panel_times=before))
    again = figures()["times"] | {"format": "again"}
    monkeypatch.setattr(development_times, "measured", lambda *given: again)
    monkeypatch.setattr(StudyCase, "load", lambda self, data=None: tones())
    monkeypatch.setattr(
        development_times, "of_panels", lambda *given: {SERIES: {"format": "again"}}
    )
    monkeypatch.setattr(
        development_experiment, "results", lambda *run: pytest.fail("accuracy was run")
    )
    assert main(["development", "--out", str(file), "--times"]) == 0
    found = json.loads(file.read_text())
    assert found["times"]["format"] == "again"
    assert found["panel_times"] == before | {SERIES: {"format": "again"}}
    assert found["results"] == figures()["results"]
