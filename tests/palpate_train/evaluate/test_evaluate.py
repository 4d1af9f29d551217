"""The grid of methods, protocols, folds and seeds: counts, cache, results for scripts."""

import json
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from palpate.answer.objects import softmax
from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import evaluate, fold
from palpate_train.evaluate.evaluate import Plan, Where
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from tests.factories.sweep_sets import tones


def every(sweeps: Dataset, where: Where, *names: str, **plan) -> list[evaluate.Result]:
    given = {"protocols": ("leave:session",), **plan}
    return list(evaluate.evaluate(sweeps, Plan(names, **given), where))


HERE = Where(jobs=1, cache=None)


@pytest.mark.slow
def test_it_finds_nothing_where_there_is_nothing():
    """Random labels are guessed at one in three: nothing leaks from test sweeps."""
    sweeps = tones(recordings=20, windows=1)
    labels = np.random.default_rng(2).permutation(sweeps.labels)
    shuffled = Dataset(sweeps.samples, labels, sweeps.materials, 100.0, sweeps.groups, "shuffled")
    (result,) = every(shuffled, HERE, "L-svm")
    assert 8 <= result.json()["window"]["right"] <= 32


@pytest.mark.slow
def test_the_counts_are_those_of_the_logits():
    """Windows by the largest logit, recordings by the product; matrices agree."""
    sweeps = tones(noise=150.0)
    (result,) = every(sweeps, HERE, "L-knn")
    figures, labels = result.json(), sweeps.labels[result.test]
    assert sorted(result.test) == list(range(len(sweeps)))
    assert figures["window"] == {
        "right": int((result.logits.argmax(1) == labels).sum()),
        "total": 36,
    }
    right = 0
    for number in range(18):
        mine = sweeps.groups["recording"][result.test] == number
        right += np.log(softmax(result.logits[mine])).sum(0).argmax() == labels[mine][0]
    assert figures["recording"] == {"right": right, "total": 18}
    confusion = np.array(figures["confusion"])
    assert confusion.sum(1).tolist() == [12, 12, 12]
    assert np.trace(confusion) == figures["window"]["right"]
    low, high = figures["interval"]
    assert low <= figures["window"]["right"] / 36 <= high


@pytest.mark.slow
@pytest.mark.thorough  # starts processes for each run
def test_the_same_seed_gives_the_same_bits_in_one_process_or_two():
    """The number of processes does not change the result."""
    one, two = (
        every(tones(), Where(jobs, cache=None), "L-svm", protocols=("random:3",)) for jobs in (1, 2)
    )
    assert np.array_equal(one[0].logits, two[0].logits)


def test_an_interrupted_evaluation_continues_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Finished folds are not trained again, and the result is the same."""
    where = Where(jobs=1, cache=tmp_path)
    calls: list[int] = []
    train = fold.run

    def counted(*args):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return train(*args)

    monkeypatch.setattr(evaluate, "run", counted)
    with pytest.raises(KeyboardInterrupt):
        every(tones(), where, "L-gauss")
    assert len(list(tmp_path.glob("*.npz"))) == 2
    assert not every(
        tones(), replace(where, kept=True), "L-gauss"
    )  # and nothing is trained, no incomplete result reported
    (result,) = every(tones(), where, "L-gauss")
    assert len(calls) == 4
    (again,) = every(tones(), where, "L-gauss")
    assert len(calls) == 4
    assert np.array_equal(result.logits, again.logits)
    assert np.array_equal(
        result.logits, every(tones(), replace(where, kept=True), "L-gauss")[0].logits
    )
    assert again.json()["window"] == every(tones(), HERE, "L-gauss")[0].json()["window"]


def test_a_broken_cache_file_is_done_again(tmp_path: Path):
    """A file that is cut in half is ignored."""
    where = Where(jobs=1, cache=tmp_path)
    (first,) = every(tones(), where, "L-gauss")
    path = min(tmp_path.glob("*.npz"))
    path.write_bytes(path.read_bytes()[:100])
    (again,) = every(tones(), where, "L-gauss")
    assert np.array_equal(first.logits, again.logits)


def test_a_fold_is_kept_under_all_that_it_depends_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Data, method, effort, seed, split and code each give the fold another name."""
    task = fold.FoldTask("L-svm", methods.FULL_EFFORT, 1, np.arange(5), np.arange(5, 9))
    others = [
        fold.FoldTask("L-knn", methods.FULL_EFFORT, 1, task.train, task.test),
        fold.FoldTask("recurrent", methods.FULL_EFFORT, 1, task.train, task.test),
        fold.FoldTask("recurrent", methods.Effort(0.5), 1, task.train, task.test),
        fold.FoldTask("L-svm", methods.FULL_EFFORT, 2, task.train, task.test),
        fold.FoldTask("L-svm", methods.FULL_EFFORT, 1, task.train[:4], task.test),
        fold.FoldTask("L-svm", methods.FULL_EFFORT, 1, task.train, task.test[:3]),
    ]
    names = {fold.key(t, "data") for t in [task, *others]} | {fold.key(task, "other data")}
    assert len(names) == 8
    assert (
        fold.key(fold.FoldTask("L-svm", methods.Effort(0.5), 1, task.train, task.test), "data")
        in names
    )  # nothing to it
    monkeypatch.setattr(fold, "version", lambda name: "0")
    assert fold.key(task, "data") not in names


def test_a_fold_depends_on_the_code_that_its_method_runs():
    """The imports of a method count, also indirectly; code around it does not."""

    def reached(method: str) -> set[str]:
        """Names of modules without the packages."""
        return {
            name.split(".")[-1]
            for name in fold.reached((methods.module_of(method), "palpate_train.evaluate.fold"))
        }

    assert {"paper_cnn", "networks", "training", "graph_builder", "linear_head", "fold"} <= reached(
        "paper-cnn"
    )
    classical = reached("L-svm")
    assert {"baselines", "temperature", "graph_builder", "features"} <= classical
    assert (
        not {"paper_cnn", "recurrent", "networks", "network", "evaluate", "score", "main"}
        & classical
    )
    assert all(methods.module_of(name) in methods.modules() for name in methods.every())


@pytest.mark.parametrize("library", ["aeon", "numpy", "scikit-learn", "onnxruntime", "torch"])
def test_a_fold_depends_on_the_versions_of_numerical_libraries(
    library: str, monkeypatch: pytest.MonkeyPatch
):
    """An upgrade of one gives the fold another name; a library that is gone does so, too."""
    task = fold.FoldTask("L-svm", methods.FULL_EFFORT, 1, np.arange(5), np.arange(5, 9))
    names, real = [fold.key(task, "data")], fold.version

    def gone(name: str) -> str:
        if name == library:
            raise PackageNotFoundError(name)
        return real(name)

    for other in (lambda name: "0" if name == library else real(name), gone):
        monkeypatch.setattr(fold, "version", other)
        names.append(fold.key(task, "data"))
    assert len(set(names)) == 3


@pytest.mark.parametrize(
    ("names", "protocol", "why"),
    [
        (["L-gaus"], "leave:session", "palpate-bands"),
        (["L-gauss"], "leave:speed", "'speed'"),
        (["L-gauss"], "random:7", "'a'"),
    ],
)
def test_what_cannot_be_evaluated_is_named(names: list[str], protocol: str, why: str):
    """An unknown method or protocol is refused before any training."""
    with pytest.raises(FormatError, match=why):
        every(tones(), HERE, *names, protocols=(protocol,))


def command(words: str, folder: Path, *more: str, code: int = 0) -> list[dict[str, Any]]:
    """The results that `palpate-train evaluate` writes; its cache lies in `folder`."""
    out = folder / "deep" / "results.json"
    args = [*words.split(), *more, "--jobs", "1", "--cache", str(folder / "cache")]
    assert main(["evaluate", *args, "--json", str(out)]) == code
    found: list[dict[str, Any]] = json.loads(out.read_text())
    return found


@pytest.mark.slow
def test_the_command_writes_what_scripts_rely_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The documented keys, one result for each method and seed, in order."""
    keys = {
        "method",
        "protocol",
        "means_removed",
        "seed",
        "window",
        "recording",
        "interval",
        "fit_s",
        "ms_p50",
    }
    tones(offset=9.0).save(tmp_path / "tones.npz")
    words = f"--set {tmp_path / 'tones.npz'} --protocol leave:session --method H-knn,L-gauss"
    words += " --seeds 2 --remove-means --only material=a,c session<=2"
    results = command(words, tmp_path)
    made = [(r["method"], r["seed"]) for r in results]
    assert made == [("H-knn", 1), ("H-knn", 2), ("L-gauss", 1), ("L-gauss", 2)]
    for result in results:
        assert set(result) >= keys
        assert result["protocol"] == "leave:session"
        assert result["means_removed"] is True
        assert result["materials"] == ["a", "c"]
        assert result["window"]["total"] == 24
        assert result["recording"]["total"] == 12
        assert 0 <= result["interval"][0] <= result["interval"][1] <= 1
        assert result["fit_s"] > 0
        assert result["ms_p50"] > 0
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 7  # the header, two baselines, four results
    assert "leave:session" in printed[1]
    assert " out " in printed[1]


def test_a_set_without_recordings_has_no_count_of_them(tmp_path: Path):
    """Every sweep counts alone."""
    whole = tones(windows=1)
    Dataset(
        whole.samples, whole.labels, whole.materials, 100.0, {"day": whole.groups["session"]}
    ).save(tmp_path / "a.npz")
    words = f"--set {tmp_path / 'a.npz'} --protocol leave:day --method L-svm"
    (result,) = command(words, tmp_path)
    assert "recording" not in result


@pytest.mark.slow
def test_a_method_whose_features_cannot_be_computed_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Named once, above the final line, and kept, so that --kept names it too."""
    whole = tones()
    fast = Dataset(whole.samples[:, :80], whole.labels, whole.materials, 1000.0, whole.groups, "f")
    fast.save(tmp_path / "fast.npz")
    words = f"--set {tmp_path / 'fast.npz'} --protocol leave:session --seeds 2 --method "
    results = command(words + "H-svm,L-gauss,H-knn", tmp_path, code=FormatError.exit_code)
    assert [(r["method"], r["seed"]) for r in results] == [("L-gauss", 1), ("L-gauss", 2)]
    *above, last = capsys.readouterr().err.splitlines()
    assert [line.split()[0] for line in above] == ["H-svm", "H-knn"]
    assert all("80 frames" in line for line in above)
    assert "H-svm, H-knn left" in last
    kept = every(fast, Where(jobs=1, cache=tmp_path / "cache", kept=True), "H-svm")
    assert "80 frames" in kept[0].refused


@pytest.mark.parametrize("broken", ["train", "logits", "not finite"])
def test_a_method_refused_in_one_fold_loses_no_other_result(
    broken: str, monkeypatch: pytest.MonkeyPatch
):
    """A refusal is named once for a protocol and seed; the others are complete."""

    @dataclass(frozen=True)
    class Spoilt:
        """A model that fails after training, or gives logits that are not numbers."""

        model: methods.Model
        how: str

        def logits(self, inputs: np.ndarray) -> np.ndarray:
            """Fail, or give logits that cannot be used."""
            if self.how == "logits":
                raise FormatError("too few of something")
            return self.model.logits(inputs) * np.nan

        def graph(self) -> onnx.ModelProto:
            """The graph of the sound model."""
            return self.model.graph()

    calls: list[int] = []
    (sound,) = methods.find(["L-gauss"])

    def second_fold_fails(sweeps: Dataset, inputs: np.ndarray, seed: int) -> methods.Model:
        calls.append(1)
        if broken == "train" and len(calls) == 2:
            raise FormatError("too few of something")
        model = sound.train(sweeps, inputs, seed)
        return Spoilt(model, broken) if len(calls) == 2 else model

    fragile = replace(sound, name="fragile", train=second_fold_fails)
    monkeypatch.setattr(
        methods, "every", lambda effort=methods.FULL_EFFORT: {"fragile": fragile, "L-gauss": sound}
    )
    results = every(
        tones(), HERE, "fragile", "L-gauss", protocols=("leave:session", "split:session=0,1->2")
    )
    found = [(r.method, r.protocol, bool(r.refused)) for r in results]
    assert found == [
        ("fragile", "leave:session", True),
        ("fragile", "split:session=0,1->2", False),
        ("L-gauss", "leave:session", False),
        ("L-gauss", "split:session=0,1->2", False),
    ]
    why = "gave a logit that is not finite" if broken == "not finite" else "too few of something"
    assert why in results[0].refused
    assert results[2].json()["window"]["total"] == 36


def test_a_model_without_a_graph_is_timed_in_its_library(monkeypatch: pytest.MonkeyPatch):
    """One sweep at a time, with the label of all at once; pack names the library."""
    (sound,) = methods.find(["L-gauss"])
    asked: list[int] = []

    class Alone:
        """A model without a graph."""

        def __init__(self, model: methods.Model) -> None:
            self.model = model

        def logits(self, inputs: np.ndarray) -> np.ndarray:
            """The logits of the sound model."""
            asked.append(len(inputs))
            return self.model.logits(inputs)

    alone = replace(
        sound, name="alone", library="its library", train=lambda *args: Alone(sound.train(*args))
    )
    monkeypatch.setattr(methods, "every", lambda effort=methods.FULL_EFFORT: {"alone": alone})
    monkeypatch.setattr(fold, "TIMED_SWEEPS", 5)
    (result,) = every(tones(), HERE, "alone", protocols=("split:session=0,1->2",))
    figures = result.json()
    assert asked == [12, 1, 1, 1, 1, 1]
    assert figures["agreement"] == 1
    assert figures["ms_p50"] > 0
    with pytest.raises(FormatError, match="'alone'"):
        MethodFit.of(alone, tones(), 1)


def test_a_point_of_a_learning_curve_is_trained_on_so_many(monkeypatch: pytest.MonkeyPatch):
    """Each fold trains on the given number of sweeps of each material; its test sweeps stay."""
    seen: list[np.ndarray] = []
    (sound,) = methods.find(["L-gauss"])

    def watched(sweeps: Dataset, inputs: np.ndarray, seed: int) -> methods.Model:
        seen.append(np.bincount(sweeps.labels))
        return sound.train(sweeps, inputs, seed)

    monkeypatch.setattr(
        methods,
        "every",
        lambda effort=methods.FULL_EFFORT: {"L-gauss": replace(sound, train=watched)},
    )
    (result,) = every(tones(), HERE, "L-gauss", each=5)
    assert np.array(seen).tolist() == [[5, 5, 5]] * 3
    assert result.json()["window"]["total"] == 36


def test_trained_on_one_set_and_tested_on_another(tmp_path: Path):
    """Two sets make one with a group `set`: T-REAL for training, T-HARD for the test."""
    words = "--set sim:T-REAL:1001:1 --set sim:T-HARD:1002:1 --method L-gauss --protocol"
    (result,) = command(words, tmp_path, "split:set=0->1")
    assert result["window"]["total"] == 6


@pytest.mark.parametrize(
    "args",
    [
        ("--seeds", "0"),
        ("--each", "-2"),
        ("--method", "nobody"),
        ("--protocol", "loo"),
        ("--only", "x=1"),
    ],
)
def test_bad_arguments_are_one_line(
    args: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The message has the value and a remedy."""
    tones().save(tmp_path / "t.npz")
    good = {"--set": str(tmp_path / "t.npz"), "--protocol": "leave:session", "--method": "L-svm"}
    words = sum((good | dict([args])).items(), ())
    assert main(["evaluate", *words, "--cache", str(tmp_path)]) == FormatError.exit_code
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1
    assert args[1].split("=")[0] in error[0]


def test_the_methods_are_listed_with_a_line_each(capsys: pytest.CaptureFixture[str]):
    """The documented methods are listed, and a method that needs an extra states it."""
    with pytest.raises(SystemExit, match="0"):
        main(["evaluate", "--list"])
    lines = capsys.readouterr().out.splitlines()
    promised = (
        "L-gauss L-knn L-svm H-knn H-svm fishel-bayes static-svm spectrogram-svm correlation-svm "
        "st-hmp paper-cnn "
        "tactnet2 recurrent minirocket palpate"
    )
    assert {line.split()[0] for line in lines} >= set(promised.split())
    assert all(len(line.split()) > 4 for line in lines)
    assert any("palpate-train[peers]" in line for line in lines)
