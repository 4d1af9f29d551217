"""The study `development`: its runs, its cache, its omissions, and the figures of its page."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from appliance.core.errors import FormatError
from tests.factories import rendered
from tests.factories.development_data import entry, figures
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import published
from tests.factories.sweep_sets import tones
from train.evaluation.evaluate import Where
from train.metrics.score import Score
from train.models import methods
from train.studies import (
    development_chart,
    development_experiment,
    development_report,
    development_times,
    scatter,
)
from train.studies.command import main
from train.studies.study import Study, StudyCase, StudyRun, save


def test_the_page_shows_every_figure():
    """Accuracies and differences with intervals beside the best peer of each line, means, targets
    and omissions.
    """
    pages, pictures = development_report.render(figures())
    read = PageReader(pages["index"])
    text = read.text.replace("\N{NO-BREAK SPACE}", " ")
    facts = (
        "names 90.0 % of sweeps rightly, the mean of 1 tests on real data; "
        "QUANT, the best peer there, 85.0 %: a difference of +5.0",
        "It falls short by more than a point in 1 of 2 lines: two: a force it never felt (−5.5 "
        "[−12.6, +1.6] to QUANT)",
        "lines in which it is no more than one point below the best peer wanted: 2 of 2 1 of 2 "
        "missed",
        "ahead of QUANT, the best peer on the mean of 1 real and published lines wanted: ≥ 1.0 "
        "+5.0 [−2.1, +12.1] reached",
        "points that int8 loses of its own float, on the mean wanted: ≤ 0.5 1.0 missed",
        "time of a sweep, MiniRocket’s = 1 wanted: ≤ 1/100 1/100 reached",
        "one: a force it never felt ahead, not certain +5.0 [−2.1, +12.1] 90.0 % 85.0 – 95.0 % "
        "85.0 % 80.0 – 90.0 % QUANT",
        "one: a force it never felt 90.0 % 85.0 – 95.0 % 2 seeds 80.0 % 75.0 – 85.0 % 2 seeds "
        "85.0 % 80.0 – 90.0 % 2 seeds",
        "two: a force it never felt 70.0 % 65.0 – 75.0 % 2 seeds – 75.5 % 70.5 – 80.5 % 2 seeds",
        "1 lines: real and published ahead, not certain +5.0 [−2.1, +12.1] 90.0 % 85.0 – 95.0 %",
        "2 lines: all, the simulated ones too within a point −0.2 [−5.3, +4.8] 80.0 % 76.5 – "
        "83.5 % 80.2 % 76.7 – 83.8 % QUANT",
        "Palpate, all views 90.0 % 91.0 % 1.0 1",
        "quick <b>, two: a window of 8 frames",
        "time of a sweep, MiniRocket’s = 1 1/100 – 2.2",
        "one: a force it never felt Palpate, all views 50.0 % 45.0 – 55.0 % 2 seeds – – 90.0 %",
        "one: a force it never felt one.npz, force<=180 leave:force digest of one",
        "one: a force it never felt : real sweeps, 4 classes: trained on sweeps of all forces "
        "but one",
        "palpate, quick <b>, quant: seeds 1, 2; commit 0123abcd; x86_64, 2 cores",
        "QUANT 1.50",
        "QUANT float onnx 22.0 44.0",
    )
    for fact in facts:
        assert fact in text, fact
    assert set(pictures) == {"front", "accuracy", "curves"}
    assert not re.search(r"[{}]|\bNone\b|\bnan\b|Markup|Undefined|mean nothing", text)
    assert (read.wrong, read.open) == ([], [])
    assert {link for link in read.links if not link.startswith("#")} == {
        "chart.html",
        "development.json",
        "../../README.md",
    }
    assert all(
        "mean nothing" in page or "means anything" in page.replace("\n", " ")
        for page in development_report.render(figures() | {"quick": True})[0].values()
    )


def test_the_chart_has_an_axis_for_each_line_and_their_mean():
    """The mean is the first axis. Dots have measured times, and each line has its chance.

    A method that was measured elsewhere has no dot.
    """
    pages, pictures = development_report.render(figures())
    data = json.loads(
        re.search(
            r'<script type="application/json" id="data">(.*?)</script>', pages["chart"], re.S
        )[1]
    )
    assert [axis["short"] for axis in data["accuracies"].values()] == [
        "mean of 1 tests on real data",
        "one: a force it never felt",
        "two: a force it never felt",
    ]
    assert {axis["chance"] for axis in data["accuracies"].values()} == {0.25}
    assert list(data["costs"]) == ["ms_p50", "ms_p99"]
    assert [(one["method"], one["ms_p50"], one["chosen"]) for one in data["dots"]] == [
        ("palpate", 0.1, True),
        ("quant", 22.0, False),
    ]
    assert data["dots"][1]["accuracy"]["two"] == {
        "mean": 0.755,
        "low": 0.705,
        "high": 0.805,
        "n": 100,
        "seeds": [1, 2],
    }
    assert "older than" not in pages["chart"]
    assert '<a href="development.json" download>' in pages["chart"]
    assert "Palpate, all views: 90.0 % in 0.1 ms" in pictures["front"]
    assert "best peer, QUANT: 85.0 % in 22 ms" in pictures["front"]


def test_the_mean_of_lines_counts_one_set_once():
    """Lines of one file err together, others independently: .05 for one file, .05 / sqrt 2 for
    two.
    """
    table = development_report.by_case([entry(c, "palpate", 0.8) for c in ("one", "two")])
    for files, away in ((("a", "a"), 0.05), (("a", "b"), 0.05 / 2**0.5)):
        cases = [
            {"case": name, "set": file} for name, file in zip(("one", "two"), files, strict=True)
        ]
        ours = development_report.mean_row(table, cases, "palpate", ["palpate"], [])["entries"][
            "palpate"
        ]
        assert (ours["low"], ours["high"]) == pytest.approx((0.8 - away, 0.8 + away))


def test_every_case_has_words_for_people():
    """No protocol or published set is shown by its name in commands."""
    for name, case in development_experiment.CASES.items():
        about = {
            "case": name,
            "protocol": case.protocol,
            "simulated": case.simulated,
            "materials": 2,
        }
        assert case.protocol not in development_chart.plain_case(about)
        assert case.protocol not in development_chart.about_case(about)
        name = name.partition(", ")[0]
        assert (name in development_chart.PUBLISHED) == case.sets[0].startswith("aeon:")


def test_the_best_peer_of_each_line_is_bold():
    """The project's accuracy is never bold. The best peer may differ from line to line."""
    pages, _ = development_report.render(figures())
    bold = re.findall(r'<td class="best">([\d.]+)', pages["index"])
    assert bold == ["85.0", "75.5", "85.0", "80.2"]  # two lines, two means


def test_a_part_of_the_results_makes_a_page():
    """Without peers it has no difference, without a curve no picture of it, without times no chart.

    A case without a result of the project has no line.
    """
    alone = [entry("one", "palpate-stages", 0.9), entry("two", "quant", 0.7)]
    pages, pictures = development_report.render(
        figures(results=alone, methods=["palpate-stages", "quant"], times=None)
    )
    text = PageReader(pages["index"]).text.replace("\N{NO-BREAK SPACE}", " ")
    assert "one: a force it never felt no peer was run 90.0 % 85.0 – 95.0 % –" in text
    assert "In none of 1 lines it is more than a point below" in text
    assert (set(pictures), set(pages)) == ({"accuracy"}, {"index"})


def test_without_a_result_of_ours_there_is_no_page(tmp_path: Path):
    """The error says what to do, and no file is written."""
    with pytest.raises(
        FormatError,
        match=r"no result of palpate or palpate-reattached or .*palpate-256; run the command",
    ):
        published("development", figures(results=[entry("one", "quant", 0.9)]), tmp_path)
    assert not (tmp_path / "pages").exists()


@dataclass
class Experiment:
    """One run of a small study."""

    study: Study
    run: StudyRun
    names: Sequence[str]
    skipped: Sequence[str]

    def results(self) -> dict[str, Any]:
        """Run it."""
        return development_experiment.results(self.study, self.run, self.names, self.skipped)


def experiment(folder: Path, *names: str, skipped: Sequence[str] = (), **given: Any) -> Experiment:
    """Two cases on tones from a file of real sweeps in `folder`. The first case has a learning
    curve.
    """
    tones().save(folder / "tones.npz")
    replace(tones(), samples=tones().samples[:, :7]).save(folder / "short.npz")
    curve = development_experiment.EACH
    cases = {
        "tones": StudyCase(
            ("tones.npz",), "leave:session", real=True, means_removed=True, curve=curve
        ),
        "short": StudyCase(
            ("short.npz",),
            "split:session=0,1->2",
            ("material=a,c",),
            real=True,
            means_removed=True,
        ),
    }
    where = Where(jobs=1, cache=folder / "cache")
    settings = {"where": where, "log": lambda line: None, "data": folder} | given
    return Experiment(Study("tones", cases, names), StudyRun(**settings), names, skipped)


@pytest.mark.slow
@pytest.mark.thorough  # a whole study
def test_all_is_run_kept_and_what_is_refused_is_left_out(tmp_path: Path):
    """Each case runs with all sweeps, the first also with fewer. A second run needs only the cache.

    A method that cannot run a case is reported.
    """
    lines: list[str] = []
    run = experiment(tmp_path, "L-gauss", "spectrogram-svm", seeds=(1, 2), log=lines.append)
    found = run.results()
    there = {(r["case"], r["method"], r["each"]) for r in found["results"]}
    assert there == {("short", "L-gauss", 0)} | {
        ("tones", m, n) for m in run.names for n in (0, 5, 10, 20)
    }
    assert list(run.run.left_out) == ["spectrogram-svm, short"]
    assert [case["case"] for case in found["cases"]] == ["tones", "short"]
    assert [case["materials"] for case in found["cases"]] == [3, 2]
    assert all(
        r["seeds"] == [1, 2] and r["low"] <= r["mean"] <= r["high"] for r in found["results"]
    )
    assert any(line.startswith("1/2 tones, 10 each: ") for line in lines)
    kept = experiment(tmp_path, *run.names, seeds=(1, 2), where=replace(run.run.where, kept=True))
    assert kept.results() == found
    assert (
        experiment(tmp_path, "L-knn", where=replace(run.run.where, kept=True)).results()["results"]
        == []
    )


def test_without_real_sweeps_their_cases_are_left_out(tmp_path: Path):
    """The report names the missing sweeps."""
    run = experiment(tmp_path, "L-gauss", data=None)
    assert run.results()["results"] == []
    assert run.run.left_out["tones"] == "real sweeps; name their folder with --data or PALPATE_DATA"


def test_an_unknown_method_ends_it_before_anything_is_trained(tmp_path: Path):
    """The error lists the existing methods."""
    with pytest.raises(FormatError, match="method 'nobody' is unknown"):
        experiment(tmp_path, "L-gauss", "nobody").results()


def test_what_is_not_wanted_is_not_run_and_named(tmp_path: Path):
    """A case with its curve, or a point of the curve, can be left out. An unknown name is an error
    that lists the existing names.
    """
    run = experiment(tmp_path, "L-gauss", skipped=["short", "tones, 5 each", "tones, 10 each"])
    assert {(r["case"], r["each"]) for r in run.results()["results"]} == {
        ("tones", 0),
        ("tones", 20),
    }
    why = "skipped in the run of L-gauss"
    assert run.run.left_out == dict.fromkeys(["tones, 5 each", "tones, 10 each", "short"], why)
    with pytest.raises(
        FormatError, match="'tone' is not a case; leave out some of tones; tones, 5 each"
    ):
        experiment(tmp_path, "L-gauss", skipped=["tone"]).results()


def test_other_precisions_of_a_method_are_counted_with_it():
    """They are counted over all seeds, as the method itself is."""
    one = {"window": Score(8, 10).json(), "interval": (0.5, 0.9), "fit_s": 1.0, "ms_p50": 2.0}
    results = [
        one | {"seed": s, "forms": {"int8": one | {"window": Score(5 + s, 10).json()}}}
        for s in (1, 2)
    ]
    made = development_experiment._entry(results)
    assert (made["mean"], made["seeds"], made["fit_s"], made["ms_p50"]) == (0.8, [1, 2], 1.0, 2.0)
    assert (made["forms"]["int8"]["mean"], made["forms"]["int8"]["seeds"]) == (0.65, [1, 2])


def test_the_usual_methods_and_cases_exist():
    """Every peer has its name. Every set has a learning curve, and its protocols can be read.

    Simulated sweeps are the last of the page.
    """
    usual = set(development_experiment.usual_methods(development_experiment.STUDY))
    assert set(development_experiment.PEERS) < usual <= set(methods.every())
    cases = development_experiment.CASES
    assert len(cases) == 12
    assert [name for name, case in cases.items() if case.simulated] == [list(cases)[-1]]
    assert [len(case.curve) for case in cases.values()] == [
        3,
        0,
        0,
        0,
        0,
        0,
        1,
        2,
        1,
        2,
        3,
        3,
    ]


def test_a_run_is_joined_by_what_it_lacks_of_another():
    """Methods come in the default order. Each entry comes once, from the run itself if it has it.

    Reasons stay only for results that are still missing. The joined run says which part was run
    when.
    """
    run = figures(methods=["palpate"], results=[entry("one", "palpate", 0.9)], left_out={})
    del run["times"]
    others = [
        entry("one", "palpate", 0.1),
        entry("one", "quant", 0.8),
        entry("two", "minirocket", 0.7),
    ]
    earlier = figures(
        methods=["quant", "minirocket", "palpate"],
        results=others,
        left_out={
            "palpate, one": "was too slow",
            "quant, two": "too short",
            "one": "not wanted",
            "one, 5 each": "no",
        },
    )
    made = development_experiment.join(run, [earlier])
    assert made["methods"] == ["palpate", "minirocket", "quant"]
    assert [(e["case"], e["method"], e["mean"]) for e in made["results"]] == [
        ("one", "palpate", 0.9),
        ("one", "quant", 0.8),
        ("two", "minirocket", 0.7),
    ]
    assert made["left_out"] == {"quant, two": "too short", "one, 5 each": "no"}
    assert made["runs"] == [*run["runs"], *earlier["runs"]]
    assert made["times"] == earlier["times"]
    assert run["methods"] == ["palpate"]  # unchanged


def test_a_run_of_other_sweeps_is_not_joined():
    """The error names the case."""
    earlier = figures()
    earlier["cases"][1]["digest"] = "other"
    with pytest.raises(FormatError, match="'two' was of other sweeps in a run that is joined"):
        development_experiment.join(figures(), [earlier])


def cases_named(*names: str) -> list[dict[str, Any]]:
    """Cases as in the results, each with a set of its own."""
    return [figures()["cases"][0] | {"case": name, "set": name} for name in names]


def test_the_shipped_method_is_named_even_behind_the_front():
    """It has the accent colour. All peers are named, too.

    A method without a line of the mean is not in the mean's picture.
    """
    table = development_report.by_case(
        [
            entry(c, m, a)
            for c in ("one", "two")
            for m, a in (("palpate", 0.8), ("minirocket", 0.9), ("ds-cnn", 0.7))
        ]
    )
    table["one"]["quant"] = entry("one", "quant", 0.99)
    times = [
        {"method": name, "precision": "float", "runtime": "onnx", "runs_on_box": True, "ms_p50": ms}
        for name, ms in (("palpate", 0.5), ("minirocket", 0.05), ("ds-cnn", 0.01), ("quant", 9.0))
    ]
    cases = cases_named("one", "two")
    dots = development_chart.dots(times, table, cases, ["one", "two"])
    means = {dot["method"]: dot["accuracy"].get("development", {}).get("mean") for dot in dots}
    assert means == {"palpate": 0.8, "minirocket": 0.9, "ds-cnn": pytest.approx(0.7), "quant": None}
    assert dots[0]["accuracy"]["development"]["low"] == pytest.approx(0.8 - 0.05 / 2**0.5)
    svg = scatter.chart(
        dots, ["development"], accuracies=development_chart.axes(cases, ["one", "two"])
    )
    assert all(name in svg for name in ("Palpate, all views", "MiniRocket", "DS-CNN"))
    assert "QUANT" not in svg
    shipped = [part for part in svg.split("<text") if "Palpate, all views</text>" in part]
    assert len(shipped) == 1
    assert "--accent" in shipped[0]


def test_the_int8_form_of_a_peer_has_a_dot_of_its_own():
    """The dot has its own time and accuracy. Without an accuracy it has none."""
    table = development_report.by_case([entry("one", "palpate", 0.8)])
    table["one"]["ds-cnn"] = entry("one", "ds-cnn", 0.7) | {
        "forms": {"int8": entry("one", "ds-cnn", 0.6)}
    }
    table["one"]["lite"] = entry("one", "lite", 0.7)
    times = [
        {"method": name, "form": form, "ms_p50": 1.0}
        for name in ("ds-cnn", "lite")
        for form in ("", "int8")
    ]
    found = [
        (dot["method"], dot["form"], dot["accuracy"]["development"]["mean"])
        for dot in development_chart.dots(times, table, cases_named("one"), ["one"])
    ]
    assert found == [("ds-cnn", "", 0.7), ("ds-cnn", "int8", 0.6), ("lite", "", 0.7)]


def test_int8_is_held_against_its_own_float():
    """If both were timed, the target of int8 is half of float's time.

    Otherwise int8 has no target.
    """
    times = [
        {"method": "palpate", "precision": name, "ms_p50": ms}
        for name, ms in (("int8", 0.6), ("float", 1.0))
    ]
    (row,) = development_report._time_targets(times, "palpate")
    assert (row["here"], row["met"]) == ("0.60", False)
    times[0]["ms_p50"] = 0.5
    assert next(development_report._time_targets(times, "palpate"))["met"]
    assert not list(development_report._time_targets(times[:1], "palpate"))


def test_the_means_that_all_peers_share_stand_beside_the_larger_table():
    """Three lines of two peers are a larger table than one line of three peers. Both means are
    shown.
    """
    lines = ("one", "two", "three")
    results = [
        entry(c, m, a)
        for c in lines
        for m, a in (("palpate", 0.8), ("quant", 0.9), ("minirocket", 0.7))
    ]
    cases = [
        case | {"case": name, "simulated": False}
        for case in figures()["cases"][:1]
        for name in lines
    ]
    names = ["palpate", "minirocket", "quant", "ds-cnn"]
    pages, _ = development_report.render(
        figures(
            cases=cases, results=[*results, entry("one", "ds-cnn", 0.95)], methods=names, times=None
        )
    )
    text = PageReader(pages["index"]).text.replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "3 lines: real and published falls short −10.0 [−17.1, −2.9] 80.0 % 75.0 – 85.0 % 90.0 % "
        "85.0 – 95.0 % QUANT" in text
    )
    assert (
        "1 lines: real and published that every method has falls short −15.0 [−22.1, −7.9]" in text
    )
    assert (
        "On the mean of 1 lines: real and published that every method has it falls short: −15.0 "
        "[−22.1, −7.9] to DS-CNN." in text
    )
    assert "DS-CNN: two: a force it never felt; three: a force it never felt" in text


@pytest.mark.parametrize(("mean", "word"), [(0.9, "reached"), (0.8999, "not reached")])
def test_what_was_wanted_of_a_case_is_reached_or_not(mean: float, word: str):
    """The verdict stands with the interval."""
    (case,) = list(development_report.WANTED)[:1]
    table = development_report.by_case([entry(case, "palpate", mean)])
    cases = cases_named(case)
    shared = development_report.mean_row(table, cases, "palpate", ["palpate"], [])
    made = development_report.targets([], {case: cases[0]}, table, "palpate", shared, [])
    rows = {row["what"]: row for row in made}
    assert rows["7 fabrics: a force it never felt"]["met"] == (word == "reached")
    assert rows["7 fabrics: a force it never felt"]["target"] == "≥ 90 %"
    assert rows["7 fabrics: a force it never felt"]["here"].startswith("90.0 % [85.0, 95.0]")
    assert set(development_report.WANTED) <= development_experiment.CASES.keys()


def test_a_peer_that_lacks_a_line_has_no_mean_and_costs_none_a_line():
    """The mean is over the lines of the peers with the fewest missing lines."""
    table = development_report.by_case(
        [entry(c, m, a) for c in ("one", "two") for m, a in (("palpate", 0.8), ("quant", 0.9))]
    )
    table["one"]["ds-cnn"] = entry("one", "ds-cnn", 0.99)
    found = development_report.mean_row(
        table,
        cases_named("one", "two"),
        "palpate",
        ["palpate", "quant", "ds-cnn"],
        ["quant", "ds-cnn"],
    )
    assert (found["shared"], found["line"]["best"]) == (["one", "two"], "QUANT")
    assert found["line"]["gap"][0] == pytest.approx(-0.1)
    assert {name: one["mean"] for name, one in found["entries"].items()} == pytest.approx(
        {"palpate": 0.8, "quant": 0.9}
    )


def test_times_are_told_in_those_of_minirocket():
    """The unit is MiniRocket's quickest time. Without it times are not compared."""
    times = [
        {"method": "minirocket", "ms_p50": 12.0},
        {"method": "minirocket", "ms_p50": 10.0},
        {"method": "palpate", "ms_p50": 0.1},
        {"method": "quant", "ms_p50": 22.0},
    ]
    names = ["palpate", "quant", "ds-cnn"]
    assert development_chart.relative_times(times, names) == {"palpate": "1/100", "quant": "2.2"}
    assert development_chart.relative_times(times[2:], names) == {}


def test_networks_of_peers_are_trained_briefly_for_their_time():
    """The project's networks are trained in full, because their choices decide their speed."""
    brief, whole = (
        development_times._briefly(name, methods.FULL_EFFORT).effort
        for name in ("ds-cnn", "palpate-stages")
    )
    assert (brief, whole) == ("200 iterations", methods.every()["palpate-stages"].effort)


@pytest.mark.slow
@pytest.mark.thorough  # trains and times every method
def test_all_methods_are_timed_in_one_run(tmp_path: Path):
    """The box's classifier times bundles, also in int8; aeon times its methods.

    A method that cannot take the sweeps is left out with a reason.
    """
    found = development_times.measured(
        ["L-gauss", "ds-cnn", "quant", "spectrogram-svm"],
        tones(),
        1,
        tmp_path,
        lambda line: None,
        methods.Effort(0.4),
        2,
    )
    assert [
        (one["method"], one["form"], one["precision"], one["runtime"], one["runs_on_box"])
        for one in found["entries"]
    ] == [
        ("L-gauss", "", "float", "onnx", True),
        ("ds-cnn", "", "float", "onnx", True),
        ("ds-cnn", "int8", "int8", "onnx", True),
        ("quant", "", "float", "aeon", False),
    ]
    assert all(
        one["weights"] > 0 and one["macs"] > 0 and one["file_kb"] > 0
        for one in found["entries"][:3]
    )
    assert found["entries"][2]["file_kb"] < found["entries"][1]["file_kb"]
    assert all(0 < one["ms_p50"] <= one["ms_p99"] for one in found["entries"])
    assert list(found["left_out"]) == ["spectrogram-svm"]
    assert found["format"] == str(tones().format)


@pytest.mark.parametrize(
    ("text", "why"),
    [(None, "No such file"), ("{", "not JSON"), ("[]", "has no"), ("{}", "has no")],
)
def test_other_results_are_not_joined_or_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, why: str
):
    """The error names a missing file, half a file or a file of another kind. Nothing is written."""
    if text is not None:
        (tmp_path / "development.json").write_text(text)
    file, out = str(tmp_path / "development.json"), str(tmp_path / "pages")
    for command in (
        ["pages", "development", "--results", str(tmp_path), "--out", out],
        ["development", "--times", "--out", file],
        ["paper", "--method", "L-gauss", "--out", file],
    ):
        assert main(command) == FormatError.exit_code
        shown = capsys.readouterr().err
        assert why in shown
        assert "development.json" in shown
    assert not (tmp_path / "pages").exists()


def test_times_alone_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """All methods of the results are timed. Their accuracies stay."""
    file = save(tmp_path / "development.json", figures())
    asked: list[Any] = []

    def measured(names: list[str], *given: Any) -> dict[str, Any]:
        asked.append((names, given[1]))
        return figures()["times"] | {"format": "measured again"}

    monkeypatch.setattr(development_times, "measured", measured)
    monkeypatch.setattr(
        development_experiment, "results", lambda *run: pytest.fail("accuracy was run")
    )
    assert main(["development", "--quick", "--out", str(file), "--times"]) == 0
    assert asked == [(figures()["methods"], 1)]
    found = json.loads(file.read_text())
    assert found["times"]["format"] == "measured again"
    assert found["results"] == figures()["results"]


@pytest.mark.slow
@pytest.mark.thorough  # a whole study
def test_the_quick_form_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Its results say that they are of a quick run. --kept with fewer methods reports only these.

    The page has all pictures and a warning.
    """
    args = ["development", "--quick", "--jobs", "1", "--cache", str(tmp_path / "cache")]
    file, quick = tmp_path / "a.json", set(development_experiment.QUICK.methods)
    assert main([*args, "--out", str(file)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(file)
    found = json.loads(file.read_text())
    assert {r["method"] for r in found["results"]} == quick
    page = published("development", found, tmp_path)
    assert {path.name for path in page.parent.iterdir()} == {
        "development.json",
        "index.html",
        "chart.html",
        "accuracy.svg",
        "curves.svg",
        "front.svg",
    }
    assert {"commit", "machine", "seeds", "effort"} <= found["runs"][0].keys()
    assert {one["method"] for one in found["times"]["entries"]} == quick
    assert "mean nothing" in page.read_text()
    assert (
        main(
            [
                *args,
                "--kept",
                "--method",
                "palpate-bands,L-gauss",
                "--out",
                str(tmp_path / "b.json"),
            ]
        )
        == 0
    )
    again = json.loads((tmp_path / "b.json").read_text())
    assert again["results"] == [r for r in found["results"] if r["method"] != "edge-spectral"]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("width", rendered.WIDTHS)
def test_both_pages_can_be_read(browser: Any, tmp_path: Path, width: int, scheme: str):
    """Nothing is cut off, every axis has a title, no raw brace is left, and the contrast is high
    enough.
    """
    page = published("development", figures(), tmp_path)
    for name in ("index", "chart"):
        address = rendered.address(page.with_name(f"{name}.html"))
        assert rendered.faults(browser, address, width, scheme) == {}, name
