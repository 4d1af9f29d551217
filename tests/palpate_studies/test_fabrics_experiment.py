"""`python -m palpate_studies fabrics` and `shots`: tests, results that they keep, and errors."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_studies import differences, fabrics_experiment, tables
from palpate_studies.__main__ import main
from palpate_studies.development_experiment import FOUR
from palpate_studies.study import StudyRun
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where

MATERIALS = ("BeigeCotton", "BrownCotton", "Canvas", "Denim", "DenimFlex", "Linen", "WovenFabric")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """FabricSlide's names; each material is louder noise than the previous material."""
    labels, force, speed, rep, direction = (
        x.ravel() for x in np.meshgrid(range(len(MATERIALS)), (100, 180), (1, 2), (1, 2), (0, 1))
    )
    noise = np.random.default_rng(1).normal(size=(len(labels), 40, 2, 1))
    samples = (noise * (labels + 1.0)[:, None, None, None]).astype(np.float32)
    groups = {
        "force": force,
        "speed": speed,
        "rep": rep,
        "direction": direction,
        "recording": np.arange(len(labels)),
    }
    (tmp_path / "fabricslide").mkdir()
    Dataset(samples, labels, MATERIALS, 1000.0, groups, "made").save(
        tmp_path / "fabricslide" / "fabricslide.npz"
    )
    return tmp_path


def run(data: Path, *more: str, method: str = "static-svm") -> int:
    """Run the command on this set, with the folds cached beside it."""
    folder = ["--data", str(data), "--out", str(data / "fabrics.json")]
    cache = ["--jobs", "1", "--cache", str(data / "cache")]
    return main(["fabrics", "--method", method, *folder, *cache, *more])


def results(data: Path) -> list[dict[str, Any]]:
    """The written results."""
    found: list[dict[str, Any]] = json.loads((data / "fabrics.json").read_bytes())
    return found


@pytest.mark.slow
@pytest.mark.thorough  # fits 24 models
def test_methods_are_run_under_all_protocols(data: Path):
    """Twelve tests of each method, those without means first."""
    assert run(data) == 0
    first = results(data)
    assert [(r["means_removed"], r["protocol"]) for r in first] == [
        (removed, protocol)
        for removed in (True, False)
        for _, protocols in fabrics_experiment.PROTOCOLS
        for protocol in protocols
    ]
    assert Counter(len(r["materials"]) for r in first) == {7: 6, 4: 6}
    assert all(r["only"] == list(FOUR) for r in first if r["protocol"] == "leave:direction")
    assert run(data, method="palpate") == 0
    assert "| 7 classes" in tables.fabrics(results(data))


def test_what_is_missing_is_named(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The folder of real sweeps is missing."""
    monkeypatch.delenv("PALPATE_DATA", raising=False)
    assert (
        main(["fabrics", "--method", "static-svm", "--out", str(data / "fabrics.json")])
        == FormatError.exit_code
    )
    assert "PALPATE_DATA" in capsys.readouterr().err


@pytest.mark.slow
def test_a_method_that_cannot_use_these_sweeps_is_named(
    data: Path, capsys: pytest.CaptureFixture[str]
):
    """The others are evaluated."""
    assert run(data, method="H-svm,static-svm") == 0
    assert "H-svm: 40" in capsys.readouterr().out
    assert {r["method"] for r in results(data)} == {"static-svm"}


@pytest.mark.slow
def test_few_sweeps_of_each_material_are_trained_on(data: Path, monkeypatch: pytest.MonkeyPatch):
    """Both seeds count every sweep of a test, and the lead is that of the same answers."""
    monkeypatch.setattr(fabrics_experiment, "SHIPPED", "correlation-svm")
    monkeypatch.setattr(fabrics_experiment, "SHOT_PEERS", ("static-svm",))
    monkeypatch.setattr(fabrics_experiment, "EACH", (2, 3))
    run = StudyRun(Where(1, cache=data / "cache"), lambda line: None, data, seeds=(1, 2))
    made = fabrics_experiment.shots(run)
    assert made["seeds"] == [1, 2]
    tested = [(row["each"], len(row["materials"])) for row in made["rows"]]
    assert tested == [(2, 7), (2, 4), (3, 7), (3, 4)]
    for row in made["rows"]:
        ours, peer = (row["methods"][name] for name in ("correlation-svm", "static-svm"))
        assert ours["total"] == peer["total"] == {7: 56, 4: 64}[len(row["materials"])] * 2
        gap, low, high = row["ahead"]["static-svm"]
        assert gap == pytest.approx((ours["right"] - peer["right"]) / ours["total"], abs=1e-4)
        assert low < gap < high
    head, line, *rows = tables.shots(made, at=3).split("\n")[2:]
    assert head.count("|") == line.count("|") == rows[0].count("|") == 5
    assert [row.partition(" classes")[0] for row in rows] == ["| 7", "| 4"]
    assert differences.shown(made["rows"][2]["ahead"]["static-svm"]) in rows[0]
    monkeypatch.setattr(fabrics_experiment, "SHOT_PEERS", ("H-svm",))
    with pytest.raises(FormatError, match="H-svm, 2 sweeps each: 40"):
        fabrics_experiment.shots(run)
    monkeypatch.setattr(fabrics_experiment, "EACH", (4,))
    run.where = replace(run.where, kept=True)
    with pytest.raises(FormatError, match="with 4 sweeps of a material folds are missing"):
        fabrics_experiment.shots(run)
