"""Warnings before an evaluation, and trivial baselines beside it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate_train.cli.main import main
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import Protocol
from palpate_train.evaluate import set_warnings, trivial
from tests.factories.sweep_sets import easy, tones


def test_what_no_fold_can_judge_is_counted():
    """Materials of one session where these are left out; frames shared by windows."""

    def of_protocol(sweeps: Dataset, text: str) -> list[str]:
        """The warnings about a protocol."""
        return list(set_warnings.of_protocol(sweeps, text, Protocol(text).folds(sweeps, 1)))

    sweeps = easy(8)
    sweeps.groups["session"] = sweeps.labels * 2 + np.arange(24) % 2
    half = replace(sweeps, groups=sweeps.groups | {"session": sweeps.labels})
    assert of_protocol(sweeps, "leave:session") == []
    (line,) = of_protocol(half, "leave:session")
    assert "leave:session: 24 of 24" in line
    assert of_protocol(half, "random:4") == []
    (line,) = [line for line in set_warnings.of_set(half) if "session" in line]
    assert "(low, middle, high)" in line
    assert set_warnings.of_set(half, learned=False) == []
    assert not any("session only" in line for line in set_warnings.of_set(sweeps))
    rng = np.random.default_rng(1)
    long = rng.normal(0, 20, (8, 640, 2, 2)).astype(np.int16)
    samples = np.concatenate([[one[s : s + 64] for s in range(0, 577, 16)] for one in long])
    labels, recording = np.repeat(np.arange(8) % 2, 37), np.repeat(np.arange(8), 37)
    sweeps = Dataset(samples, labels, ("a", "b"), 100.0, {}, "noise")
    (line,) = of_protocol(sweeps, "random:5")
    assert "294 of 296" in line
    assert any("296 of 296" in line for line in set_warnings.of_set(sweeps))
    stated = replace(sweeps, groups={"recording": recording})
    assert of_protocol(stated, "random:4") == []


@pytest.mark.parametrize(("count", "told"), [(None, ""), (100, "stuck-taxel"), (255, "saturated")])
def test_sweeps_that_the_box_would_refuse_are_counted(count: int | None, told: str):
    """Before a fit: a loaded taxel that never changes, and counts at the end of the range. A bundle
    refuses a few, and accepts many."""
    rng = np.random.default_rng(2)
    samples = rng.integers(60, 140, (12, 64, 2, 2)).astype(np.uint8)
    if count is not None:
        samples[:3, :, 0, 0] = count
    sweeps = Dataset(samples, np.arange(12) % 2, ("a", "b"), 100.0, {}, "skin")
    lines = [line for line in set_warnings.of_set(sweeps) if "faults of the skin" in line]
    assert len(lines) == bool(told)
    assert all("3 of 12 sweeps" in line and told in line for line in lines)
    assert all("accepts such" in line for line in lines)
    numbers = np.append(np.arange(2, 12), np.resize(np.arange(3, 12), 20))
    few = [line for line in set_warnings.of_set(sweeps.take(numbers)) if told and told in line]
    assert all("1 of 30 sweeps" in line and "would refuse" in line for line in few)
    assert len(few) == bool(told)
    assert set_warnings.of_set(sweeps, learned=False) == []


def test_baselines_find_what_they_look_at():
    """Means offsets, bands pitches; a better one is named, an equal one is not."""
    folds = Protocol("leave:session").folds(tones(), 1)
    found = trivial.figures(tones(), folds)
    assert found[trivial.BANDS]["right"] == 36
    assert found[trivial.MEANS]["accuracy"] < 0.7
    assert trivial.figures(tones(offset=200.0), folds)[trivial.MEANS]["right"] == 36
    assert trivial.beside_a_fit(tones())[trivial.BANDS]["accuracy"] == 1
    constant = replace(tones(), samples=np.ones_like(tones().samples))
    assert trivial.figures(constant, folds)[trivial.MEANS]["n"] == 36
    assert trivial.beside_a_fit(tones(recordings=1)) == {}
    baselines = {trivial.MEANS: {"accuracy": 0.7}, trivial.BANDS: {"accuracy": 0.8}}
    result = {"method": "ours", "protocol": "leave:speed", "baselines": baselines}
    for right, told in ((79, True), (80, False), (95, False)):
        found = trivial.above(result | {"window": {"right": right, "total": 100}})
        assert (trivial.BANDS in found) is told


@pytest.mark.slow
@pytest.mark.thorough  # fits and packs three models
def test_evaluate_shows_the_answers_of_the_box(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """For each sweep of each fold, and counted; none for what export does not pack."""
    file, out = tmp_path / "s.npz", tmp_path / "r.json"
    sweeps = easy(24)
    sweeps.groups["speed"] = np.array(["slow", "fast", "0.5"])[np.arange(72) % 3]
    sweeps.save(file)
    words = ["evaluate", "--set", str(file), "--protocol", "leave:speed", "--jobs", "1"]
    words += ["--method", "palpate-bands,L-gauss", "--cache", str(tmp_path), "--json", str(out)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "as the box answers" in printed.splitlines()[0]
    assert "(means alone)" in printed
    ours, theirs = json.loads(out.read_text())
    assert theirs["box"] is None
    counts = [ours["box"][k] for k in ("right", "wrong", "unsure", "unknown", "refused")]
    assert sum(counts) == ours["box"]["total"] == 72
    assert counts[0] >= 60
    assert [fold["left_out"]["speed"] for fold in ours["each_fold"]] == [
        ["0.5"],
        ["fast"],
        ["slow"],
    ]
    answers = [answer for fold in ours["each_fold"] for answer in fold["answers"]]
    assert sorted(answer["sweep"] for answer in answers) == list(range(72))
    right = sum(a["box"] == "ok" and a["box_label"] == a["material"] for a in answers)
    assert right == counts[0]
    assert main([*words, "--label-alone"]) == 0
    assert json.loads(out.read_text())[0]["box"] is None
