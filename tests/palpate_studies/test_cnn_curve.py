"""`palpate_studies.cnn_curve`: its test sets, the points of a curve, and a restart after an
interruption.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.sim import skin
from palpate_studies import cnn_curve
from palpate_studies.command import main
from palpate_train.models import checkpoint
from palpate_train.models.peers import paper_cnn

FEW = {"train": 1, "new": 1, "hard": 1}


class CurveInterrupted(Exception):
    """Represents a loss of power."""


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training of a moment that is measured and saved after steps 2, 4 and the last."""
    layers = paper_cnn.ImageLayers((2, 2), ((5, 2), (5, 2)), 2, False, 4)
    recipe = replace(paper_cnn.PAPER_RECIPE, steps=7, batch=8)
    monkeypatch.setattr(cnn_curve, "SIZES", {"small": cnn_curve.Size(layers, 60, recipe)})
    monkeypatch.setattr(cnn_curve, "ATTACHMENTS", 2)
    monkeypatch.setattr(cnn_curve, "EACH", FEW)
    monkeypatch.setattr(cnn_curve, "FIRST_MARK", 2)
    monkeypatch.setattr(checkpoint, "wait", lambda took: 0.0)


def follow(out: Path, seed: int = 1, stop_at: int = 0, **options: Any) -> dict[str, Any]:
    """The curve of a training, which is interrupted after step `stop_at`."""

    def log(line: str) -> None:
        if line.startswith(f"step {stop_at}/"):
            raise CurveInterrupted

    return cnn_curve.follow(out, "small", seed, log=log, **options)


def test_it_is_tested_on_positions_and_attachments_that_it_never_saw() -> None:
    """Each set has its own attachments, also in another world.

    T-HARD has the numbers of the paper's experiment.
    """
    drawn = cnn_curve.draw(2, skin.WORLD, 60, FEW)
    assert {name: len(sweeps) for name, sweeps in drawn.items()} == {
        "train": 54,
        "new": 54,
        "hard": 12,
    }
    assert all(sweeps.samples.shape[1:] == (60, 4, 4) for sweeps in drawn.values())
    assert len(np.unique(drawn["hard"].group("position"))) == 2
    third = skin.sweep_set("T-HARD", 3, 1)[0][:, :60]
    assert np.array_equal(drawn["hard"].samples[:6], third)
    assert not np.array_equal(drawn["train"].samples, drawn["new"].samples)


def test_a_position_is_left_out_of_the_training_alone() -> None:
    """Its sweeps are tested; the others, and the other test sets, stay as they are. A position that
    T-REAL does not have is refused with those that it has."""
    whole = cnn_curve.draw(2, skin.LEVEL_BLIND, 60, FEW)
    drawn = cnn_curve.draw(2, skin.LEVEL_BLIND, 60, FEW, left=4)
    of = whole["train"].group("position")
    assert np.array_equal(drawn["left"].samples, whole["train"].samples[of == 4])
    assert np.array_equal(drawn["train"].samples, whole["train"].samples[of != 4])
    assert np.array_equal(drawn["hard"].samples, whole["hard"].samples)
    with pytest.raises(FormatError, match="position 9 of T-REAL is unknown; use 0 to 8"):
        cnn_curve.draw(2, skin.WORLD, 60, FEW, left=9)


def test_points_are_doubled_and_the_last_iteration_is_one() -> None:
    """This holds for every number of iterations."""
    assert cnn_curve.marks(600)[-3:] == [256, 512, 600]
    assert cnn_curve.marks(2) == [2]
    assert cnn_curve.marks(1) == [1]


@pytest.mark.slow
def test_a_curve_has_all_its_points(tmp_path: Path) -> None:
    """The points are shares with intervals, and confusions that add up.

    Nothing else stays on the disk, and the curve is not trained again.
    """
    out = tmp_path / "deeper" / "curve.json"
    result = follow(out)
    assert json.loads(out.read_text()) == json.loads(json.dumps(result))
    assert [point["step"] for point in result["points"]] == [2, 4, 7]
    for point in result["points"]:
        assert point["cost"] > 0
        for name, total in (("new", 54), ("hard", 12)):
            confusion = np.array(point[f"{name} confusion"])
            share, low, high = point[name]
            assert confusion.sum() == total
            assert share == pytest.approx(np.trace(confusion) / total, abs=1e-4)
            assert 0 <= low <= share <= high <= 1
    for name in ("new", "hard"):
        newest = {k: np.array(v) for k, v in result["newest"][name].items()}
        right = newest["logits"].argmax(1) == newest["labels"]
        assert right.mean() == pytest.approx(result["points"][-1][name][0], abs=1e-4)
        assert newest["position"].shape == newest["labels"].shape
    assert result["steps"] == 7
    assert [path.name for path in out.parent.iterdir()] == ["curve.json"]
    assert follow(out, stop_at=1) == json.loads(out.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("centred", [False, True])
def test_an_interrupted_curve_goes_on(centred: bool, tmp_path: Path) -> None:
    """It becomes the curve of an uninterrupted training."""
    with pytest.raises(CurveInterrupted):
        follow(tmp_path / "a.json", stop_at=5, centred=centred)
    assert [p["step"] for p in json.loads((tmp_path / "a.json").read_text())["points"]] == [2, 4]
    resumed, whole = (
        follow(tmp_path / name, centred=centred)["points"] for name in ("a.json", "b.json")
    )
    assert resumed == whole


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["", "half of {", None])
def test_another_training_in_the_file_is_replaced(kept: str | None, tmp_path: Path) -> None:
    """Its checkpoint, which has other weights, is replaced, too. So is a file that cannot be
    read.
    """
    out = tmp_path / "a.json"
    with pytest.raises(CurveInterrupted):
        follow(out, seed=2, stop_at=5)
    if kept is not None:
        out.write_text(kept)
    assert follow(out)["points"] == follow(tmp_path / "b.json")["points"]


@pytest.mark.slow
def test_the_command_prints_the_curve(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The paper's printed numbers stand above it. Zero iterations are refused."""
    out = tmp_path / "a.json"
    assert main(["cnn-curve", "--seed", "3", "--steps", "2", "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "small, seed 3; printed 0.923 and 0.917"
    assert lines[2].split()[0] == "2"
    assert len(lines) == 3
    chosen = ["--world", "level-blind", "--left", "0"]
    assert main(["cnn-curve", "--seed", "3", "--steps", "2", *chosen, "--out", str(out)]) == 0
    assert "position left out" in capsys.readouterr().out
    result = json.loads(out.read_text())
    assert (result["world"], result["left"]) == ("level-blind", 0)
    assert set(result["newest"]) == {"left", "new", "hard"}
    assert main(["cnn-curve", "--steps", "0", "--out", str(out)]) != 0
    assert "--steps 0 is out of range; use a whole number from 1 on" in capsys.readouterr().err
