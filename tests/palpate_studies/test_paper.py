"""The paper's experiment: fused sweeps, counts of results, joined runs, and its page."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.sim.skin import MATERIALS
from palpate_studies import paper_experiment, paper_report, study
from palpate_studies.paper_experiment import Outcome, Step
from palpate_studies.study import StudyCase, StudyRun
from palpate_train.evaluate.evaluate import Where
from palpate_train.models import methods
from palpate_train.reports.html import picture
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import published

SURE = 9.0


def outcome(part: str, method: str, seed: int = 1, right: float = 0.8, places: int = 3) -> Outcome:
    """An invented outcome: 4 sweeps of each material at each position, `right` of them correct.

    All others are taken for the next material.
    """
    labels = np.tile(np.repeat(np.arange(6), 4), places)
    place = np.repeat(np.arange(places), 24) + 10_000 * seed
    correct = np.random.default_rng(seed).random(len(labels)) < right
    given = np.where(correct, labels, (labels + 1) % 6)
    confusion = np.zeros((6, 6), int)
    np.add.at(confusion, (labels, given), 1)
    about = {
        **{"part": part, "method": method, "seed": seed, "materials": list(MATERIALS)},
        **{"machine": "abacus, 2 cores", "confusion": confusion.tolist(), "fit_s": 1.5},
        **{"ms_p50": 0.25, "ran": "7 beads" if "cnn" in method else "", "commit": "c0ffee<"},
    }
    logits = SURE * np.eye(6, dtype=np.float32)[given]
    return Outcome(part, method, seed, labels, logits, place, about)


def summary(cnn: bool = True) -> dict[str, Any]:
    """The results of invented outcomes, read back from their file."""
    outcomes = [
        outcome(p, m, w)
        for p in paper_experiment.FULL
        for m in (*paper_experiment.BASELINES, "static-svm", "palpate-reattached")
        for w in (1, 2)
    ]
    outcomes += [outcome(p, "paper-cnn", right=0.9) for p in ("lopo", "hard") if cnn]
    return json.loads(study.text(paper_experiment.summary(outcomes, paper_experiment.FULL)))


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    """A summary for many tests."""
    return summary()


def test_printed_numbers_are_the_papers():
    """One number of each figure by hand; rows of the confusion matrix sum to one."""
    at = (("lab", "H-svm"), ("lopo", "H-knn"), ("random", "L-svm"), ("hard", "L-knn"))
    assert [paper_experiment.PRINTED[p][m] for p, m in at] == [0.96, 0.75, 0.83, 0.58]
    assert round(55 / 60, 3) == paper_experiment.PRINTED["hard"]["paper-cnn"]
    assert np.allclose(paper_experiment.CONFUSION.sum(1), 1, atol=0.011)


def test_objects_are_fused_of_their_own_sweeps():
    """Each begins one, of one place; two votes are the first's, a product can be better."""
    o = outcome("lopo", "H-svm")
    keep = np.arange(len(o.labels)) != 5
    labels, place = o.labels[keep], o.place[keep]
    drawn = paper_experiment.objects(labels, place, seed=1)
    assert drawn.shape == (71, 3)
    assert drawn[:, 0].tolist() == list(range(71))
    assert (labels[drawn] == labels[:, None]).all()
    assert (place[drawn] == place[:, None]).all()
    assert all(len(set(row)) == 3 for row in drawn.tolist())
    assert np.array_equal(drawn, paper_experiment.objects(labels, place, seed=1))
    assert not np.array_equal(drawn, paper_experiment.objects(labels, place, seed=2))
    o = outcome("lopo", "H-svm", right=1)
    weak = np.arange(len(o.labels)) % 2 == 0
    o.logits[weak] = np.eye(6)[(o.labels[weak] + 1) % 6]
    by = paper_experiment.several([o])
    assert [by["vote"][n][0] for n in (0, 1)] == [0.5, 0.5]
    assert by["product"][0][0] == 0.5
    assert by["product"][1][0] > 0.7
    assert all(low <= mean <= high for lines in by.values() for mean, low, high in lines)


def test_intervals_are_over_places_and_exploration_stops_when_sure():
    """192 sweeps at eight positions; sure sweeps need one, uniform ones all four."""
    place = np.repeat(np.arange(8), 24)
    _, low, high = paper_experiment.estimate(place % 2 == 0, place)
    assert high - low > 0.5
    sure = outcome("lopo", "H-svm", right=1)
    assert [(e["sweeps"], e["share"][0]) for e in paper_experiment.explored([sure])] == [(1, 1)] * 3
    sure.logits[:] = 0
    unsure = [(e["sweeps"], e["share"][0]) for e in paper_experiment.explored([sure])]
    assert unsure == [(4, round(1 / 6, 4))] * 3


def test_summary_pools_seeds_and_keeps_each_result(results: dict[str, Any]):
    """144 sweeps of two seeds at six positions, and the printed value."""
    row = next(r for r in results["table"] if (r["part"], r["method"]) == ("lopo", "H-svm"))
    shown = (row["total"], row["seeds"], row["printed"], row["attachments"][0])
    assert shown == (144, [1, 2], 0.86, 6)
    assert row["share"][0] == round(row["right"] / 144, 4)
    assert len(results["results"]) == 6 * 7 * 2 + 2
    assert np.sum(results["confusion"]["H-svm"], 1).tolist() == [24] * 6


@pytest.mark.slow
def test_the_page_is_one_file_with_ours_and_the_printed_values(results: dict[str, Any]):
    """Its tags close, it needs no other file, and it has each row with its interval."""
    page, pictures = paper_report.render(results)
    read = PageReader(page)
    assert read.faults == []
    assert "<script>" not in page
    assert set(pictures) == {"figure-11", "figure-12"}
    assert all(picture(svg) in page for svg in pictures.values())
    text = read.text.replace("\N{NO-BREAK SPACE}", " ")
    for row in results["table"]:
        low, high = (f"{100 * v:.1f}" for v in row["share"][1:])
        printed = "–" if row["printed"] is None else f"{round(100 * row['printed'], 1):g} %"
        assert f"{low} – {high} % {printed}" in text
    for fact in ("simulated sweeps", "c0ffee<", "abacus, 2 cores", "7 beads"):
        assert fact in text
    titles = (">T-REAL, leave one", ">trained on T-REAL", ">level-blind", "<summary>T-LAB")
    places = [page.index(title) for title in titles]
    assert places == sorted(places)  # hard protocols first


def test_both_worlds_stand_side_by_side(results: dict[str, Any]):
    """The level-blind cases have their own sets; the difference is that of the table."""
    assert all("/level-blind:" in name for name in paper_experiment.FULL["hard/level-blind"].sets)
    rows = {(row["part"], row["method"]): row for row in results["table"]}
    lines = paper_report._ahead(rows, ["palpate-reattached"])
    parts = ("lopo", "hard", "lopo/level-blind", "hard/level-blind")
    for (_, gap, cnn), part in zip(lines, parts, strict=True):
        ours, other = (rows[part, m]["share"][0] for m in ("palpate-reattached", "H-svm"))
        assert gap.startswith(f"{100 * (ours - other):+.1f} [".replace("-", "−"))
        assert (cnn == "–") == part.endswith("level-blind")


def test_the_plan_holds_methods_and_parts_that_exist():
    """Every part is run and shown, and every classical accuracy that the paper prints."""
    steps = paper_experiment.FULL_STEPS
    ran = {(part, m) for step in steps for part in step.parts for m in step.methods}
    assert {m for _, m in ran} <= methods.every().keys()
    assert {part for part, _ in ran} == set(paper_experiment.FULL) == set(paper_report.TITLES)
    assert {(p, m) for p in paper_experiment.FIGURES for m in paper_experiment.BASELINES} <= ran
    assert ("hard", "paper-cnn") in ran


@pytest.mark.slow
def test_run_writes_everything_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A second run uses the cached folds and gives the same figures."""
    real, one = "sim:T-REAL:100{w}:2", ("position<=1",)
    parts = {
        "lopo": StudyCase((real,), "leave:position", one),
        "hard": StudyCase((real, "sim:T-HARD:100{w}:2"), "split:set=0->1", one),
        "lab": StudyCase(("sim:T-LAB:100{w}:2",), "random:2"),
        "random": StudyCase((real,), "random:2", one),
    }
    step = Step(("L-gauss", "H-svm"), tuple(parts), (1,))
    monkeypatch.setattr(paper_experiment, "FULL", parts)
    monkeypatch.setattr(paper_experiment, "FULL_STEPS", (step,))
    lines: list[str] = []
    run = StudyRun(Where(jobs=1, cache=tmp_path / "cache"), lines.append)
    results = paper_experiment.results(run)
    assert "L-gauss" in published("paper", results, tmp_path).read_text()
    assert len(results["results"]) == 8
    assert len(lines) == 14
    assert lines[-1].startswith("4/4 random, seed 1")
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "cache").iterdir()}
    assert paper_experiment.results(run) == results
    assert kept == {p: p.stat().st_mtime_ns for p in (tmp_path / "cache").iterdir()}
