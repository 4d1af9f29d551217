"""Scoring a bundle: a set through the box's classifier, with interval and confusions."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate_train.cli.main import main
from palpate_train.data import repeats, sets
from palpate_train.data.sets import Dataset
from palpate_train.metrics import bundle_score
from palpate_train.metrics.score import interval
from tests.factories import toy_bundle

HERE = [(0, 0), (6, 0), (0, 6)]
"""Embeddings of the toy's three materials."""


def sweeps(
    *embeddings: tuple[float, float], labels: list[int], materials: str = "abc", **groups: list[int]
) -> Dataset:
    """A set for the toy bundle."""
    samples = np.stack([toy_bundle.window(*z) for z in embeddings])
    values = {k: np.array(v) for k, v in groups.items()}
    return Dataset(samples, np.array(labels), tuple(materials), 100.0, values, "s.npz")


@pytest.fixture
def classifier(tmp_path: Path) -> Classifier:
    """The classifier of the toy bundle."""
    return Classifier(toy_bundle.load(tmp_path / "toy"), SystemClock())


def test_what_is_named_is_counted(classifier: Classifier):
    """By material; the interval resamples positions."""
    places = (0, 0), (0, 0), (6, 0), (0, 6), (3, 0), (40, 40)
    s = sweeps(*places, labels=[0, 0, 0, 2, 1, 2], position=[1, 1, 2, 2, 3, 3])
    found = bundle_score.score(classifier, s)
    assert found.right.tolist() == [True, True, False, True, False, False]
    assert found.answered["a"] == Counter(a=2, b=1)
    assert found.answered["c"] == Counter({"c": 1, "(unknown)": 1})
    assert found.statuses == Counter(ok=4, unsure=1, unknown=1)
    assert found.json()["classified_correctly"] == {
        "right": 3,
        "total": 6,
        "interval": interval(found.right, s.groups["position"]),
    }
    assert found.by == "position"
    lines = found.text().splitlines()
    assert "3 of 6: 50.0 % [" in lines[1]
    assert lines[1].endswith("by position (3)")
    assert "  a     2 of 3     b 1" in lines
    labels, named = bundle_score.labels_of(classifier, s)[:2]
    assert (found.right == ((labels == s.labels) & named)).all()


def test_materials_go_by_name_and_forms_must_agree(classifier: Classifier):
    """In another order; foreign ones are listed; both formats are named."""
    s = sweeps(*HERE, (0, 6), labels=[1, 0, 2, 2], materials="bax")
    found = bundle_score.score(classifier, s)
    assert found.right.tolist() == [True, True]
    assert found.foreign == {"x": Counter(c=2)}
    assert "not counted: c 2" in found.text()
    s = sweeps(*HERE, labels=[0, 1, 2])
    with pytest.raises(FormatError, match="2x2 int16"):
        bundle_score.score(classifier, replace(s, rate_hz=50.0))
    with pytest.raises(FormatError, match="x, y, z"):
        bundle_score.score(classifier, replace(s, materials=tuple("xyz")))


def test_windows_of_a_recording_are_fused_too(classifier: Classifier):
    """The last answer to each counts; without several windows no such figure."""
    s = sweeps((0, 0), (3, 0), (6, 0), (6, 0), labels=[0, 0, 1, 1], recording=[0, 0, 1, 1])
    found = bundle_score.score(classifier, s)
    assert found.recordings is not None
    assert found.recordings.tolist() == [True, True]
    assert found.by == "recording"
    assert "fused: 2 of 2" in found.text()
    assert bundle_score.score(classifier, sweeps(*HERE, labels=[0, 1, 2])).recordings is None


def test_the_command_prints_and_writes_what_it_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """With --json and --rename; known sweeps by their digests; a broken bundle is a line."""
    toy_bundle.load(tmp_path / "toy")
    sweeps(*HERE, labels=[0, 1, 2], materials="Abc").save(tmp_path / "s.npz")
    args = ["score", str(tmp_path / "toy"), "--set", str(tmp_path / "s.npz")]
    assert main([*args, "--rename", "A=a", "--json", str(tmp_path / "out.json")]) == 0
    assert "[43.9, 100.0]" in capsys.readouterr().out
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["classified_correctly"]["right"] == 3
    assert told["answers"] == {"a": {"a": 1}, "b": {"b": 1}, "c": {"c": 1}}
    content = toy_bundle.files()
    manifest = content["manifest.json"].replace(b'"seed": 1', b'"set": "s.npz"')
    toy_bundle.put(tmp_path / "toy", content | {"manifest.json": manifest})
    assert main(args) == 0
    assert "s.npz" in capsys.readouterr().out
    three = sets.load(str(tmp_path / "s.npz"))
    for kept, said in (
        (repeats.sketch(three.take(np.arange(2))), "warning: 2 of 3 sweeps are the very ones that"),
        (repeats.sketch(replace(three, samples=three.samples + np.int16(1))), ""),
    ):
        manifest = content["manifest.json"].replace(b'"seed": 1', f'"sweeps": "{kept}"'.encode())
        toy_bundle.put(tmp_path / "toy", content | {"manifest.json": manifest})
        assert main(args) == 0
        printed = capsys.readouterr().out
        assert said in printed
        assert ("very ones" in printed) == bool(said)
    manifest = content["manifest.json"].replace(b'"seed": 1', b'"sweeps": "broken"')
    toy_bundle.put(tmp_path / "toy", content | {"manifest.json": manifest})
    assert main(args) == FormatError.exit_code
    assert "digests" in capsys.readouterr().err
    assert main([*args, "--rename", "Q=a"]) == FormatError.exit_code
    assert "'Q'" in capsys.readouterr().err
    assert main(["score", str(tmp_path / "none"), *args[2:]]) != 0
    assert capsys.readouterr().err.count("\n") == 1


def test_sweeps_outside_the_trained_positions_are_told(
    classifier: Classifier, monkeypatch: pytest.MonkeyPatch
):
    """Their number, their most frequent description, the remedy; nothing for none."""
    s = sweeps(*HERE, (0, 0), labels=[0, 1, 2, 0])
    assert "trained positions" not in bundle_score.score(classifier, s).text()
    given = bundle_score.verdicts
    words = {
        0: "moved 2.1 mm too far towards row 6",
        2: "moved 2.1 mm too far towards row 6",
        3: "moved 1.9 mm",
    }
    monkeypatch.setattr(
        bundle_score,
        "verdicts",
        lambda *args, **more: (
            (i, replace(verdict, displacement=words.get(i))) for i, verdict in given(*args, **more)
        ),
    )
    found = bundle_score.score(classifier, s)
    assert found.json()["moved"] == 3
    told = (
        "outside the trained positions: 3 sweeps, most often moved 2.1 mm too far towards row 6; "
        "record there, too, or align the skin"
    )
    assert told in found.text().splitlines()
