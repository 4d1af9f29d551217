"""An interrupted training gives the same bits as an uninterrupted one, for any file that it
finds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from palpate_studies.peers import paper_cnn
from palpate_studies.peers.paper_cnn import ImageLayers, ImageNetwork
from palpate_train.evaluate import evaluate
from palpate_train.evaluate.evaluate import Plan, Where
from palpate_train.models import checkpoint, training
from palpate_train.models.methods import Effort
from palpate_train.models.training import TrainingRecipe
from tests.factories.sweep_sets import tones

LAYERS = ImageLayers((4, 4), ((2, 1), (2, 1)), 2, True, 8)
RECIPE = replace(paper_cnn.PAPER_RECIPE, steps=9, batch=8, peak_rate=1e-3)
EVERYTHING = TrainingRecipe(steps=9, batch=8, noise=0.1, gain=0.1, ema=0.5, dropout=0.3, cycle=True)


class Interrupted(Exception):
    """An exception instead of a power failure."""


def fit(
    recipe: TrainingRecipe, path: Path | None, stop_after: int = 99
) -> tuple[dict[str, torch.Tensor], list]:
    """The trained weights and the cost of each step. stop_after: the step after which it is
    interrupted."""

    def log(line: str) -> None:
        if line.startswith(f"step {stop_after}/"):
            raise Interrupted

    sweeps = tones()
    with training.deterministic_device(5) as device:
        net = ImageNetwork(sweeps.format, 3, 0.1, None, LAYERS)
        net, cost = training.learn(net, sweeps, recipe, 1, log, device, unfinished=path)
    return net.state_dict(), cost


def check_same(
    one: tuple[dict[str, torch.Tensor], list], other: tuple[dict[str, torch.Tensor], list]
) -> None:
    """Bit for bit."""
    assert one[1] == other[1]
    assert all(torch.equal(a, b) for a, b in zip(one[0].values(), other[0].values(), strict=True))


@pytest.mark.parametrize("recipe", [RECIPE, EVERYTHING])
def test_an_interrupted_training_gives_the_same_bits(
    recipe: TrainingRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """After two interruptions dropout, noise, gains, batch norms, the rate and the moving average
    continue unchanged."""
    monkeypatch.setattr(checkpoint, "wait", lambda took: 0.0)
    path = tmp_path / "deeper" / "half.pt"
    for stop in (3, 7):
        with pytest.raises(Interrupted):
            fit(recipe, path, stop)
    done: list[str] = []
    monkeypatch.setattr(training, "backward", counted(done))
    resumed = fit(recipe, path)
    assert len(done) == 2  # steps 8 and 9
    check_same(resumed, fit(recipe, None))


def counted(calls: list[str]):
    """training.backward, which records each call."""
    plain = training.backward

    def backward(*args):
        calls.append("")
        return plain(*args)

    return backward


@pytest.mark.parametrize("broken", [b"", b"PK\x03\x04 half of it", None])
def test_a_file_that_cannot_be_read_counts_as_none(
    broken: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """If the file is empty, truncated or of other bytes, the training begins anew."""
    path = tmp_path / "half.pt"
    if broken is None:
        monkeypatch.setattr(checkpoint, "wait", lambda took: 0.0)
        with pytest.raises(Interrupted):
            fit(RECIPE, path, 3)
        broken = path.read_bytes()[:-2000]
    path.write_bytes(broken)
    check_same(fit(RECIPE, path), fit(RECIPE, None))


def test_it_is_written_from_time_to_time(tmp_path: Path):
    """A training of a second writes no file."""
    fit(RECIPE, tmp_path / "half.pt")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_interrupted_fold_of_the_paper_s_cnn_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its file lies beside the folds, and is removed once the fold is kept."""
    monkeypatch.setattr(checkpoint, "wait", lambda took: 0.0)
    plan = Plan(("paper-cnn",), ("split:session=0->1",), effort=Effort(paper_steps=4))
    where, steps = Where(jobs=1, cache=tmp_path), []
    plain = training.backward

    def third_fails(*args):
        steps.append(1)
        if len(steps) == 3:
            raise Interrupted
        return plain(*args)

    monkeypatch.setattr(training, "backward", third_fails)
    with pytest.raises(Interrupted):
        list(evaluate.evaluate(tones(), plan, where))
    assert [path.suffix for path in tmp_path.iterdir()] == [".pt"]
    (resumed,) = evaluate.evaluate(tones(), plan, where)
    assert len(steps) == 5  # two, the one that failed, and the two that were left
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]
    (whole,) = evaluate.evaluate(tones(), plan, Where(jobs=1, cache=None))
    assert np.array_equal(resumed.logits, whole.logits)
