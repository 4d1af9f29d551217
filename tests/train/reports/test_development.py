"""The development page: what is run and kept, what is left out, and the figures that it shows of any part of the results."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from appliance.core.errors import FormatError
from tests.factories.development_data import entry, figures
from tests.factories.page_reader import PageReader
from tests.factories.sweep_sets import tones
from train.cli.main import main
from train.evaluation.evaluate import Where
from train.metrics.score import Score
from train.models import methods
from train.reports import development_experiment, development_report
from train.reports.chart_report import ChartPart
from train.reports.development_experiment import Development, DevelopmentCase


def test_the_page_shows_every_figure():
    """Accuracies with intervals, differences to the best peer of each line, the mean of what all have, what was left out."""
    page, pictures = development_report.render(figures())
    read = PageReader(page)
    facts = ("one +5.0 90.0 % 85.0 – 95.0 % 80.0 % 75.0 – 85.0 % 85.0 % 80.0 – 90.0 %", "two −5.5 70.0 % 65.0 – 75.0 % –",
             "mean of the 1 that all have +5.0 90.0 % 80.0 % 85.0 %", "in 1 of 2 lines", "quick <b>, two a window of 8 frames",
             "one default 50.0 % 45.0 – 55.0 % – – 90.0 %", "one.npz, force<=180 leave:force 100 4 digest of one",
             "Seeds 1, 2; commit 0123abcd; x86_64, 2 cores", "quant 1.50 0.250")  # fmt: skip
    for fact in facts:
        assert fact in read.text, fact
    assert set(pictures) == {"accuracy", "curves"}
    assert not re.search(r"[{}]|\bNone\b|\bnan\b|Markup|Undefined|mean nothing", read.text)
    assert (read.wrong, read.open) == ([], [])
    assert all(link.startswith("#") for link in read.links)
    assert "mean nothing" in development_report.render(figures(), quick=True)[0]


def test_the_best_peer_of_each_line_is_bold():
    """Never ours, and another one in another line."""
    page, _ = development_report.render(figures())
    rows = re.findall(r'<tr><td class="text">(one|two)</td><td>.*?</tr>', page, re.S)
    bold = re.findall(r'<td class="best">([\d.]+)', page)
    assert (rows[:2], bold) == (["one", "two"], ["85.0", "75.5", "85.0"])


def test_a_part_of_the_results_makes_a_page():
    """No peers: no difference; no curve: no picture of it; a case without a result of ours is left out of the table."""
    alone = [entry("one", "compact", 0.9), entry("two", "quant", 0.7)]
    page, pictures = development_report.render(figures(results=alone, methods=["compact", "quant"]))
    text = PageReader(page).text
    assert "one – 90.0 %" in text
    assert "mean of the 0 that all have – – –" in text
    assert set(pictures) == {"accuracy"}
    assert "lines" not in text


def test_without_a_result_of_ours_there_is_no_page(tmp_path: Path):
    """An error says what to do, and nothing is written."""
    with pytest.raises(
        FormatError, match="no result of default or compact or filter-bank; run the command without --kept"
    ):
        development_report.write(figures(results=[entry("one", "quant", 0.9)]), tmp_path / "page")
    assert not (tmp_path / "page").exists()


def experiment(folder: Path, *names: str, **given: Any) -> Development:
    """Two cases on tones, which lie in `folder` as a file of real sweeps; the first with a learning curve."""
    tones().save(folder / "tones.npz")
    short = replace(tones(), samples=tones().samples[:, :7])
    short.save(folder / "short.npz")
    cases = [DevelopmentCase("tones", ChartPart(("tones.npz",), "leave:session", real=True), curve=True),
             DevelopmentCase("short", ChartPart(("short.npz",), "split:session=0,1->2", ("material=a,c",), real=True))]  # fmt: skip
    where = Where(jobs=1, cache=folder / "cache")
    settings = {"where": where, "log": lambda line: None, "data": folder} | given
    return Development(cases, names, **settings)


@pytest.mark.slow
def test_all_is_run_kept_and_what_is_refused_is_left_out(tmp_path: Path):
    """Each case with all sweeps, one also with fewer; again from the cache alone; a method that cannot take a case is named."""
    lines: list[str] = []
    run = experiment(tmp_path, "L-gauss", "spectrogram-svm", seeds=(1, 2), log=lines.append)
    found = run.results()
    there = {(r["case"], r["method"], r["each"]) for r in found["results"]}
    assert there == {("short", "L-gauss", 0)} | {("tones", m, n) for m in run.names for n in (0, 5, 10, 20)}
    assert list(run.left_out) == ["spectrogram-svm, short"]
    assert [case["case"] for case in found["cases"]] == ["tones", "short"]
    assert [case["materials"] for case in found["cases"]] == [3, 2]
    assert all(r["seeds"] == [1, 2] and r["low"] <= r["mean"] <= r["high"] for r in found["results"])
    assert any(line.startswith("2/2 tones, 10 each: ") for line in lines)
    kept = experiment(tmp_path, *run.names, seeds=(1, 2), where=replace(run.where, kept=True))
    assert kept.results() == found
    assert experiment(tmp_path, "L-knn", where=replace(run.where, kept=True)).results()["results"] == []


def test_without_real_sweeps_their_cases_are_left_out(tmp_path: Path):
    """With what to name."""
    run = experiment(tmp_path, "L-gauss", data=None)
    assert run.results()["results"] == []
    assert run.left_out["tones"] == "real sweeps; name their folder with --data or PALPATE_DATA"


def test_an_unknown_method_ends_it_before_anything_is_trained(tmp_path: Path):
    """With those that exist."""
    with pytest.raises(FormatError, match="method 'nobody' is unknown"):
        experiment(tmp_path, "L-gauss", "nobody").results()


def test_other_precisions_of_a_method_are_counted_with_it():
    """Over all seeds, as the method itself."""
    one = {"window": Score(8, 10).json(), "interval": (0.5, 0.9), "fit_s": 1.0, "ms_p50": 2.0}
    results = [one | {"seed": s, "forms": {"int8": one | {"window": Score(5 + s, 10).json()}}} for s in (1, 2)]
    made = development_experiment._entry(results)
    assert (made["mean"], made["seeds"], made["fit_s"], made["ms_p50"]) == (0.8, [1, 2], 1.0, 2.0)
    assert (made["forms"]["int8"]["mean"], made["forms"]["int8"]["seeds"]) == (0.65, [1, 2])


def test_the_usual_methods_and_cases_exist():
    """Every peer by its name; every set and protocol can be read; the page begins with tactile sweeps."""
    assert set(development_experiment.PEERS) < set(development_experiment.usual_methods())
    assert set(development_experiment.usual_methods()) <= set(methods.every())
    names = [case.name for case in development_experiment.CASES]
    assert len(set(names)) == len(names) == 13
    assert sum(case.curve for case in development_experiment.CASES) == 2


@pytest.mark.slow
def test_the_quick_form_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Results, pictures and a page that says what it is; --kept with fewer methods makes one of these alone."""
    args = ["development", "--quick", "--jobs", "1", "--cache", str(tmp_path / "cache")]
    assert main([*args, "--out", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "a" / "index.html")
    found = json.loads((tmp_path / "a" / "results.json").read_text())
    assert {r["method"] for r in found["results"]} == set(development_experiment.QUICK_METHODS)
    assert {path.name for path in (tmp_path / "a").iterdir()} == {
        "results.json",
        "index.html",
        "accuracy.svg",
        "curves.svg",
    }
    assert {"commit", "machine", "seeds", "effort"} <= found.keys()
    assert "mean nothing" in (tmp_path / "a" / "index.html").read_text()
    assert main([*args, "--kept", "--method", "compact,L-gauss", "--out", str(tmp_path / "b")]) == 0
    again = json.loads((tmp_path / "b" / "results.json").read_text())
    assert again["results"] == [r for r in found["results"] if r["method"] != "edge-spectral"]
    assert main([*args, "--kept", "--method", "quant", "--out", str(tmp_path / "c")]) == FormatError.exit_code
    assert "no result of default" in capsys.readouterr().err
