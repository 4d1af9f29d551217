"""The study `development`: its runs, its cache, its omissions, and the figures of its page."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    ranks,
)
from palpate_studies.command import main
from palpate_studies.development_chart import ChartPanel, Spot
from palpate_studies.study import Study, StudyCase, StudyRun, save
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.metrics.score import Score
from palpate_train.models import methods
from palpate_train.reports.plot_style import SVG
from tests.factories import rendered
from tests.factories.development_data import SERIES, case, entry, figures, timed, times
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import published
from tests.factories.sweep_sets import tones


def test_the_page_shows_every_figure():
    """Findings, accuracies and differences with intervals beside the best peer of each test, means,
    targets and omissions.
    """
    pages, pictures = development_report.render(figures())
    read = PageReader(pages["index"])
    text = read.text.replace("\N{NO-BREAK SPACE}", " ")
    facts = (
        "Real tactile sets (1 tests): Palpate 90.0 %, 5.0 points ahead of QUANT.",
        "Published series that are not tactile (1 tests): Palpate 92.0 %, 1.0 points behind QUANT.",
        "0.2 ms Palpate, all views, int8: 90.0 % in 0.1 ms",
        "100 ms Palpate, all views, int8: 90.0 % in 0.1 ms QUANT, float: 93.0 % in 22 ms",
        "points ahead of QUANT, mean of published series that are not tactile wanted: ≥ −1.0 "
        "−1.0 [−8.1, +6.1] reached",
        "no peer is faster and more accurate wanted: all of 6 or more 1 of 1 missed",
        "time of our largest model, MiniRocket’s = 1 wanted: ≤ 1/20 1/100 reached",
        "one: a force it never felt ahead, not certain +5.0 [−2.1, +12.1] 90.0 % 85.0 – 95.0 % "
        "85.0 % 80.0 – 90.0 % QUANT",
        "one: a force it never felt 90.0 % 85.0 – 95.0 % 2 seeds 80.0 % 75.0 – 85.0 % 2 seeds "
        "85.0 % 80.0 – 90.0 % 2 seeds",
        "two: a force it never felt 70.0 % 65.0 – 75.0 % 2 seeds – 75.5 % 70.5 – 80.5 % 2 seeds",
        "mean of 1: real tactile sets 90.0 % 85.0 – 95.0 % – 85.0 %",
        "Palpate, all views real tactile sets 90.0 % 91.0 % 1.0 1",
        "quick <b>, two: a window of 8 frames",
        "time of a sweep, MiniRocket’s = 1 1/100 – 2.2",
        "one: a force it never felt Palpate, all views 50.0 % 45.0 – 55.0 % 2 seeds – – 90.0 %",
        "one: a force it never felt one.npz, force<=180 leave:force digest of one",
        "one: a force it never felt : real sweeps, 4 classes: trained on sweeps of all forces "
        "but one",
        "palpate, quick <b>, quant: seeds 1, 2; commit 0123abcd; x86_64, 2 cores",
        "QUANT 1.50",
        "QUANT float onnx 22 ms 44 ms",
        "a processor, one thread, all methods in turns in one process",
        "with that, the packaged bundle takes 0.7 ms",
        "DS-CNN: one: a force it never felt; two: a force it never felt",
    )
    for fact in facts:
        assert fact in text, fact
    assert set(pictures) == {"front", "accuracy", "ranks", "touch", "curves"}
    assert not re.search(r"[{}]|\bNone\b|\bnan\b|Markup|Undefined|mean nothing", text)
    assert (read.wrong, read.open) == ([], [])
    assert {link for link in read.links if not link.startswith("#")} == {
        "development.json",
        "../../README.md",
    }
    assert "mean nothing" in development_report.render(figures() | {"quick": True})[0]["index"]


def texts(svg: str) -> list[str]:
    """All texts of a picture."""
    return [node.text or "" for node in ElementTree.fromstring(svg).iter(f"{{{SVG}}}text")]


def test_the_picture_names_findings_methods_gaps_and_the_processor():
    """Each kind of tests has a panel. A method with gaps is hollow and listed, a method without
    accuracy is a stroke on the axis.
    """
    results = [
        entry(c, m, a)
        for c in ("one", "three")
        for m, a in (("palpate", 0.9), ("palpate-bands", 0.6), ("quant", 0.85))
    ]
    made = figures(
        cases=[case("one"), case("three"), case(SERIES)],
        results=[*results, entry("one", "lite", 0.8), entry(SERIES, "palpate", 0.9)],
        times=times(
            timed("palpate", 0.4, "int8"),
            timed("palpate-bands", 0.04, "int8"),
            timed("quant", 50.0),
            timed("lite", 1.4),
            timed("paper-cnn-centred", 3.3, "int8"),
        ),
    )
    words = texts(development_report.front(made))
    assert words == texts(development_report.front(made))
    for text in (
        "Palpate 90.0 %, 5.0 points ahead of QUANT",
        "named rightly, mean of 2 tests: real tactile sets",
        "all views 90.0",
        "LITE 80.0",
        "paper’s CNN",
        "Palpate 90.0 %",
    ):
        assert text in words, text
    said = " ".join(words)
    assert "▾ less than the axis shows (real tactile sets: bands 60.0)" in said
    assert "Hollow: not run in all tests (real tactile sets: LITE 1 of 2)" in said
    assert "a processor, one thread" in said
    assert development_report.caption(made).endswith(
        "Real tactile sets: Palpate 90.0 %, 5.0 points ahead of QUANT. "
        "Published series that are not tactile: Palpate 90.0 %."
    )


def test_names_do_not_collide():
    """A name without room is left out, and no two names overlap."""
    crowd = [f"method-{i:02}" for i in range(40)]
    made = figures(
        cases=[case("one")],
        results=[entry("one", name, 0.8 + i / 1000) for i, name in enumerate(crowd)],
        times=times(*(timed(name, 1 + i / 50) for i, name in enumerate(crowd))),
    )
    nodes = ElementTree.fromstring(development_report.front(made)).iter(f"{{{SVG}}}text")
    boxes = [box(node) for node in nodes if (node.text or "").startswith("method-")]
    assert 2 <= len(boxes) < 40
    for i, a in enumerate(boxes):
        assert not any(
            a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for b in boxes[:i]
        )


def box(node: ElementTree.Element) -> tuple[float, float, float, float]:
    """Approximate box of a text."""
    x, y, width = float(node.get("x", 0)), float(node.get("y", 0)), 4.5 * len(node.text or "")
    side = re.search(r"text-anchor: (\w+)", node.get("style", ""))
    left = x - {"start": 0, "middle": width / 2, "end": width}[side[1] if side else "start"]
    return left, y - 8, left + width, y


def panel(*spots: Spot) -> ChartPanel:
    """A panel of one test with these spots."""
    return ChartPanel("a kind", (case("one"),), spots, {})


def spot(method: str, ms: float, mean: float, form: str = "", **more: Any) -> Spot:
    """A spot with an interval of five points each way."""
    return Spot(method, form, "int8", ms, (mean, mean - 0.05, mean + 0.05), **more)


def test_the_front_is_over_all_forms_of_methods_that_were_run_in_every_test():
    """A spot is on the front if none is as quick and as accurate. Of equal times the better counts.

    A float form may be on it where the int8 form is not.
    """
    slow, quick = spot("ds-cnn", 0.3, 0.85), spot("ds-cnn", 0.1, 0.8, "int8")
    ours, gap = spot("palpate", 0.4, 0.9), spot("lite", 0.05, 0.99, lacks=("one",))
    worse, later = spot("quant", 0.1, 0.7), spot("minirocket", 10.0, 0.9)
    made = panel(later, gap, ours, slow, worse, quick)
    assert made.front == [quick, slow, ours]
    assert made.peer == later
    assert made.within(0.35) == slow
    assert made.within(0.01) is None
    assert made.lacking() == {"lite": 1}
    assert panel().front == []


def test_a_size_is_dominated_by_a_peer_that_is_quicker_and_more_accurate():
    """Our other sizes do not count, and neither does the packaged recipe. The line leaves out what
    another of ours beats."""
    bands, everything = spot("palpate-bands", 0.1, 0.7), spot("palpate", 0.4, 0.9)
    peers = spot("ds-cnn", 0.05, 0.8), spot("quant", 50.0, 0.95)
    packaged = spot("palpate-reattached", 0.01, 0.85)
    made = panel(everything, bands, packaged, *peers)
    assert made.sizes == [bands, everything]
    assert made.line == [packaged, everything]
    assert made.dominated == [bands]


def test_ranks_have_cliques_of_what_the_tests_cannot_tell_apart():
    """The example of Demsar (2006): with four methods and 14 data sets the critical difference is
    1.25. The best rank is 1, equal accuracies share a rank.
    """
    table = {name: [float(4 - i)] * 14 for i, name in enumerate("abcd")}
    found = ranks.ranking(table)
    assert found.difference == pytest.approx(1.25, abs=0.005)
    assert found.ranks == {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0}
    assert found.cliques == (("a", "b"), ("b", "c"), ("c", "d"))
    assert set(ranks.ranking({"a": [0.5], "b": [0.5]}).ranks.values()) == {1.5}
    with pytest.raises(ValueError, match="1 methods have no ranks; name two or more"):
        ranks.ranking({"a": [0.5]})


def test_seconds_of_touch_are_windows_and_early_answers():
    """A window is its frames over the rate. In simulation the box answers after a mean time."""
    early = {
        "format": "4x4 uint8 at 750 Hz, window 1500",
        "early": {
            "share": 0.25,
            "rule": {"accuracy": 0.97},
            "always": [{"accuracy": 0.9}, {"accuracy": 0.98}],
        },
    }
    made = development_report.touch_curves(figures(), early)
    assert made == {
        "one: a force it never felt": {"Palpate, all views": [(1.0, 0.75), (2.0, 0.9)]},
        "simulated tubes: other skins than in training": {
            "after a set time": [(1.0, 0.9), (2.0, 0.98)],
            "early answers": [(0.5, 0.97)],
        },
    }
    assert "early answers" in texts(development_report.render(figures(), early)[1]["touch"])


def test_the_mean_of_tests_counts_one_set_once():
    """Tests of one file err together, others independently: .05 for one file, .05 / sqrt 2 for
    two.
    """
    entries = {name: entry(name, "palpate", 0.8) for name in ("one", "three")}
    for files, away in ((("a", "a"), 0.05), (("a", "b"), 0.05 / 2**0.5)):
        sets = dict(zip(entries, files, strict=True))
        middle = development_chart.mean(entries, sets)
        assert middle == pytest.approx((0.8, 0.8 - away, 0.8 + away))


def test_every_case_has_words_for_people():
    """No protocol or published set is shown by its name in commands."""
    for name, one in development_experiment.CASES.items():
        about = case(name, protocol=one.protocol, simulated=one.simulated)
        assert one.protocol not in development_chart.plain_case(about)
        assert one.protocol not in development_chart.about_case(about)
        assert (development_chart.kind_of(about) == development_chart.SERIES) == (
            one.sets[0].startswith("aeon:")
        )


def test_methods_have_names_for_people():
    """Every described method exists. A method without a description keeps its own name."""
    assert method_names.plain_name("palpate-bands") == "Palpate, bands"
    assert method_names.short_name("palpate-bands") == "bands"
    assert method_names.short_name("palpate-reattached") == "packaged recipe"
    assert (method_names.plain_name("recurrent"), method_names.about("recurrent")) == (
        "recurrent",
        "",
    )
    assert method_names.NAMES.keys() <= methods.every().keys()


def test_the_best_peer_of_each_test_is_bold():
    """The project's accuracy is never bold. The best peer may differ from test to test."""
    pages, _ = development_report.render(figures())
    bold = re.findall(r'<td class="best">([\d.]+)', pages["index"])
    assert bold == ["85.0", "75.5", "93.0", "85.0", "93.0"]  # three tests, two means


def test_a_part_of_the_results_makes_a_page():
    """Without peers there is no difference, without a curve no picture of it, without times no
    panel.

    A case without a result of the project is left out.
    """
    alone = [entry("one", "palpate-bands", 0.9), entry("two", "quant", 0.7)]
    alone += [entry("one", "quant", 0.7, each=5), entry("two", "palpate-bands", 0.7, each=5)]
    pages, pictures = development_report.render(
        figures(results=alone, methods=["palpate-bands", "quant"], times=None)
    )
    text = PageReader(pages["index"]).text.replace("\N{NO-BREAK SPACE}", " ")
    assert "one: a force it never felt no peer was run 90.0 % 85.0 – 95.0 % –" in text
    assert (set(pictures), set(pages)) == (set(), {"index"})


def test_without_a_result_of_ours_there_is_no_page(tmp_path: Path):
    """The error says what to do, and no file is written. A panel without our largest size says
    so."""
    with pytest.raises(
        FormatError, match=r"no result of palpate or palpate-reattached or .*; run the command"
    ):
        published("development", figures(results=[entry("one", "quant", 0.9)]), tmp_path)
    assert not (tmp_path / "pages").exists()
    assert development_chart.finding(panel()) == "our largest size was not run in every test"


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
    (before,) = earlier["runs"]
    assert made["runs"] == [*run["runs"], before | {"methods": ["quant"]}]
    assert made["times"] == earlier["times"]
    assert run["methods"] == ["palpate"]  # unchanged


def test_a_run_of_other_sweeps_is_not_joined():
    """The error names the case."""
    earlier = figures()
    earlier["cases"][1]["digest"] = "other"
    with pytest.raises(FormatError, match="'two' was of other sweeps in a run that is joined"):
        development_experiment.join(figures(), [earlier])


def test_a_form_of_a_method_has_a_spot_of_its_own():
    """The spot has its own time and accuracy, in the quicker of two libraries. Without an accuracy
    there is no spot.
    """
    results = [
        entry("one", "palpate", 0.8),
        entry("one", "ds-cnn", 0.7) | {"forms": {"int8": entry("one", "ds-cnn", 0.6)}},
        entry("one", "lite", 0.7),
    ]
    costs = [
        timed(name, ms, form or "float", form)
        for name in ("ds-cnn", "lite")
        for form, ms in (("", 1.0), ("int8", 0.5), ("", 0.9))
    ]
    (made,) = development_chart.panels(figures(results=results, times=times(*costs)))
    assert [(one.method, one.form, one.ms, one.mean) for one in made.whole] == [
        ("ds-cnn", "int8", 0.5, 0.6),
        ("ds-cnn", "", 0.9, 0.7),
        ("lite", "", 0.9, 0.7),
    ]


def test_a_panel_has_the_times_of_its_own_sweeps():
    """A model that sees more on fabrics takes longer there than on the simulated skin. The picture
    names the sweeps; a panel without times of its own has those of the simulated skin."""
    results = [entry(c, "palpate", 0.9) for c in ("one", SERIES)]
    cases = [case("one"), case(SERIES)]
    own = times(timed("palpate", 0.4)) | {"format": "16x1 int16 at 36 Hz, window 128"}
    made = figures(cases=cases, results=results, times=times(timed("palpate", 0.1)))
    made |= {"panel_times": {development_chart.TACTILE: own}}
    shown = {panel.kind: panel for panel in development_chart.panels(made)}
    assert {kind: panel.whole[0].ms for kind, panel in shown.items()} == {
        development_chart.TACTILE: 0.4,
        development_chart.SERIES: 0.1,
    }
    words = texts(development_report.front(made))
    assert any(text.endswith("of 16x1 taxels, 128 frames") for text in words)


def test_panels_are_timed_with_their_own_sweeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Each with means removed where its tests remove them. Without the folder of real sweeps only
    published series are timed."""
    asked: list[tuple[str, float]] = []

    def measured(names: list[str], sweeps: Dataset, *given: Any) -> dict[str, Any]:
        asked.append((sweeps.source, float(np.abs(sweeps.samples.mean(axis=1)).max())))
        return {"entries": []}

    drawn = replace(tones(), samples=tones().samples + 1, source="published")
    monkeypatch.setattr(development_times, "measured", measured)
    monkeypatch.setattr(StudyCase, "load", lambda self, data: None if self.real else drawn)
    found = development_times.of_panels(
        ["quant"], None, 1, tmp_path, lambda line: None, methods.FULL_EFFORT
    )
    assert list(found) == [development_chart.SERIES]
    ((source, level),) = asked
    assert (source, level < 1) == ("published", True)


@pytest.mark.parametrize(("mean", "met"), [(0.91, True), (0.9099, False)])
def test_what_was_wanted_of_a_case_is_reached_or_not(mean: float, met: bool):
    """The verdict stands with the interval and the number of seeds."""
    (name,) = list(development_report.WANTED)[:1]
    table = development_chart.by_case([entry(name, "palpate", mean)])
    (row,) = development_report.targets(table, {name: case(name)}, [], [])
    assert (row["target"], row["met"]) == ("≥ 91 %", met)
    assert row["what"] == "7 fabrics: a force it never felt, 2 seeds"
    assert row["here"].startswith("91.0 % [86.0, 96.0]")
    assert set(development_report.WANTED) <= development_experiment.CASES.keys()


def test_times_are_held_against_the_papers_network_in_int8_and_minirocket():
    """The smallest, the packaged and the largest size have targets if they were timed."""
    costs = [
        timed("palpate-bands", 0.05, "int8"),
        timed("palpate-reattached", 0.11, "int8"),
        timed("palpate", 0.6, "int8"),
        timed("paper-cnn-centred", 2.0),
        timed("paper-cnn-centred", 4.0, "int8", "int8"),
        timed("minirocket", 10.0),
    ]
    rows = [(row["here"], row["met"]) for row in development_report.time_targets(costs)]
    assert rows == [("1/80", True), ("1/36", False), ("1/91", False), ("1/17", False)]
    assert not list(development_report.time_targets(costs[-1:]))


def test_times_are_told_in_those_of_minirocket():
    """The unit is MiniRocket's quickest time. Without it times are not compared."""
    costs = [
        timed("minirocket", 12.0),
        timed("minirocket", 10.0),
        timed("palpate", 0.1),
        timed("quant", 22.0),
    ]
    names = ["palpate", "quant", "ds-cnn"]
    assert development_chart.relative_times(costs, names) == {"palpate": "1/100", "quant": "2.2"}
    assert development_chart.relative_times(costs[2:], names) == {}


def test_networks_of_peers_are_trained_briefly_for_their_time():
    """The project's networks are trained in full, because their choices decide their speed."""
    brief, whole = (
        development_times._briefly(name, methods.FULL_EFFORT).effort
        for name in ("ds-cnn", "palpate-bands")
    )
    assert (brief, whole) == ("200 iterations", methods.every()["palpate-bands"].effort)


@pytest.mark.slow
@pytest.mark.thorough  # trains and times every method
def test_all_methods_are_timed_in_one_run(tmp_path: Path):
    """Graphs are timed also in int8; aeon times its methods.

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


def test_a_model_that_the_box_refuses_is_timed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It has times and counts, no memory, and the reason. The packaged bundle is timed only with
    sweeps of its own format.
    """

    def refuse(*given: Any) -> None:
        raise BundleError("it needs too much memory")

    monkeypatch.setattr(precisions, "packed", refuse)
    found = development_times.measured(["L-gauss"], tones(), 1, tmp_path, lambda line: None)
    (one,) = found["entries"]
    assert (one["runs_on_box"], one["refused"]) == (False, "it needs too much memory")
    assert 0 < one["ms_p50"] <= one["ms_p99"]
    assert one["weights"] > 0 < one["file_kb"]
    assert "rss_mb" not in one
    assert found["box"] == {}
    skin_sweeps = sets.load("sim:T-REAL/level-blind:1001:1").select(["position<=1"])
    found = development_times.measured([], skin_sweeps, 1, tmp_path, lambda line: None, rounds=1)
    assert 0 < found["box"]["ms_p50"] <= found["box"]["ms_p99"]


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


def test_a_panel_that_cannot_be_timed_keeps_its_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without the folder of real sweeps only published series are timed again. Else the accuracy of
    fabrics would stand at the time of the simulated skin."""
    before = {development_chart.TACTILE: {"format": "fabrics"}, SERIES: {"format": "before"}}
    file = save(tmp_path / "development.json", figures() | {"panel_times": before})
    monkeypatch.setattr(development_times, "measured", lambda *given: figures()["times"])
    monkeypatch.setattr(StudyCase, "load", lambda self, data=None: tones())
    monkeypatch.setattr(
        development_times, "of_panels", lambda *given: {SERIES: {"format": "again"}}
    )
    assert main(["development", "--out", str(file), "--times"]) == 0
    found = json.loads(file.read_text())["panel_times"]
    assert found == before | {SERIES: {"format": "again"}}


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
        "accuracy.svg",
        "curves.svg",
        "front.svg",
        "ranks.svg",
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
def test_the_page_can_be_read(browser: Any, tmp_path: Path, width: int, scheme: str):
    """Nothing is cut off, every axis has a title, no raw brace is left, and the contrast is high
    enough.
    """
    page = published("development", figures(), tmp_path)
    assert rendered.faults(browser, rendered.address(page), width, scheme) == {}
