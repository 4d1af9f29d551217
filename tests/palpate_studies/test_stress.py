"""The study of corruptions: tasks of methods that count right answers under each of them."""

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from palpate.core.errors import FormatError
from palpate_studies import stress
from palpate_train.data import corruptions
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.models import methods
from palpate_train.models.methods import Method, model_inputs


def small(kind: str = "int16", shape: tuple[int, ...] = (12, 120, 3, 3)) -> Dataset:
    """Sweeps of two materials; the second is stronger and rougher."""
    labels = np.arange(shape[0]) % 2
    each = labels.reshape(-1, *(1,) * (len(shape) - 1))
    rough = np.random.default_rng(7).standard_normal(shape) * (3 + 3 * each)
    samples = (rough + 60 + 10 * each).astype(kind)
    return Dataset(samples, labels, ("smooth", "rough"), 100.0, {}, "small")


@dataclass
class NearestMean:
    """Answers with the material with the nearest mean of two simple figures."""

    means: np.ndarray
    broken: int = 0

    def logits(self, given: np.ndarray) -> np.ndarray:
        """Minus the squared distance, float32 [n, K]; NaN for the first `broken` sweeps."""
        logits = -(((figures(given)[:, None] - self.means) ** 2).sum(axis=2)).astype(np.float32)
        logits[: self.broken, 0] = np.nan
        return logits

    def graph(self) -> onnx.ModelProto:
        """Raises an error: corrupted sweeps go to the model itself, and no graph is needed."""
        raise AssertionError("the corruption asked for a graph")


def figures(given: np.ndarray) -> np.ndarray:
    """Level and roughness."""
    x = given.astype(float)
    return np.stack([x.mean(axis=(1, 2, 3)), x.std(axis=1).mean(axis=(1, 2))], axis=1)


def learn(sweeps: Dataset, given: np.ndarray, seed: int, broken: int = 0) -> NearestMean:
    """Train the fake, which refuses sweeps that are too short, as real methods do."""
    if given.shape[1] < 20:
        raise FormatError(f"a window of {given.shape[1]} frames is too short; use at least 20")
    seen = figures(given) + seed
    return NearestMean(np.stack([seen[sweeps.labels == k].mean(axis=0) for k in (0, 1)]), broken)


FAKE = Method("fake", "two figures, nearest mean", "raw", learn)


def test_one_task_travels_and_counts():
    """A task and its result survive a conversion; the numbers are those counted by hand."""
    by_name = {one.name: one for one in corruptions.CORRUPTIONS}
    sweeps, trial = small(), EvaluationSweeps(small())
    sent = pickle.loads(pickle.dumps((FAKE, sweeps, trial, 0)))
    done = stress.evaluate_method(*sent)
    assert json.loads(json.dumps(done)) == done
    assert list(done["curves"]) == [one.name for one in corruptions.applicable(trial)]
    assert list(done["pairs"]) == [one.name for one in stress.pairs()]
    assert done["curves"]["gain-up"]["right"][0] == 12
    up = by_name["gain-up"].apply(trial, 0.5, 0)
    right = int((learn(sweeps, sweeps.samples, 0).logits(up).argmax(1) == sweeps.labels).sum())
    assert done["curves"]["gain-up"]["right"][-1] == right < 12


def test_what_is_not_finite_is_wrong_and_refusals_are_said():
    """A set of another kind is the caller's error; a refused set is a result."""

    def learn_broken(sweeps: Dataset, given: np.ndarray, seed: int) -> NearestMean:
        """Train a fake with three answers that are not finite."""
        return learn(sweeps, given, seed, 3)

    done = stress.evaluate_method(
        replace(FAKE, train=learn_broken), small(), EvaluationSweeps(small()), 0
    )
    assert done["curves"]["dead"]["right"][0] == 9
    with pytest.raises(FormatError, match="uint8"):
        stress.evaluate_method(FAKE, small(), EvaluationSweeps(small("uint8")), 0)
    short = small(shape=(4, 10, 3, 3))
    task = stress.evaluate_method(FAKE, short, EvaluationSweeps(short), 0)
    assert "10 frames" in task["refused"]


def test_features_are_of_the_corrupted_counts():
    """A method on features gets these of the corrupted sweeps."""
    seen = []

    class InputSpy:
        def logits(self, x: np.ndarray) -> np.ndarray:
            seen.append(x.copy())
            return np.zeros((len(x), 2), np.float32)

    trial = EvaluationSweeps(small())
    stress.evaluate_method(Method("spy", "", "L", lambda *_: InputSpy()), small(), trial, 6)
    first = corruptions.applicable(trial)[0]
    mild = replace(small(), samples=first.apply(trial, first.severities[1], 6))
    assert (seen[1] == model_inputs("L", mild)).all()
    assert (seen[1] != seen[0]).any()


def test_a_pair_is_both_corruptions_at_once():
    """One dead taxel of each sweep reads 0, the others have noise; severity 0 changes nothing."""
    trial = EvaluationSweeps(small())
    both = {pair.name: pair for pair in stress.pairs()}
    assert len(both) == 10
    changed = both["noise+dead"].apply(trial, 1, 0)
    dead = (changed == 0).all(axis=1)
    assert (dead.sum(axis=(1, 2)) == 1).all()
    moved = (changed != trial.sweeps.samples).any(axis=1)
    assert moved[~dead].all()
    assert (both["noise+dead"].apply(trial, 0, 0) == trial.sweeps.samples).all()


def test_methods_run_side_by_side_and_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A task for each method and seed; kept tasks do not run again."""
    sweeps, trial = small(), EvaluationSweeps(small())
    monkeypatch.setattr(
        methods, "find", lambda names, effort: [replace(FAKE, name=name) for name in names]
    )
    monkeypatch.setattr(methods, "module_of", lambda name: "palpate_studies.peers.baselines")
    lines: list[str] = []
    where = Where(jobs=1, cache=tmp_path)
    first = stress.run(["a", "b"], sweeps, trial, where, seeds=(1, 2), log=lines.append)
    for line, begin, method in zip(lines, "1234", "abab", strict=True):
        assert line.startswith(f"{begin}/4")
        assert f"{method} under" in line
    assert first["methods"]["b"]["seeds"] == [1, 2]
    monkeypatch.setattr(stress, "evaluate_method", None)
    assert stress.run(["a", "b"], sweeps, trial, where, seeds=(1, 2)) == first
    monkeypatch.undo()
    with pytest.raises(FormatError, match="'a'"):
        stress.run(["a"], sweeps, trial, where)
