"""An interrupted training gives the same bits, whatever file it finds."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.factories.later import Later
from tests.factories.sweep_sets import tones

torch = Later("torch")
checkpoint = Later("palpate_train.models.checkpoint")
training = Later("palpate_train.models.training")
stages = Later("palpate_train.models.recipe.stages")

PLAIN = {"steps": 9, "batch": 8, "ema": 0.0, "dropout": 0.0, "cycle": False}
EVERYTHING = {"steps": 9, "batch": 8, "ema": 0.5, "dropout": 0.3}


class Interrupted(Exception):
    """An exception instead of a power failure."""


def noisy(x: torch.Tensor, rng: torch.Generator) -> torch.Tensor:
    """Sweeps with added noise."""
    return x + 0.1 * torch.randn(x.shape, generator=rng)


def fit(
    recipe: dict[str, Any], path: Path | None, stop_after: int = 99
) -> tuple[dict[str, torch.Tensor], list, list[str]]:
    """Weights, the cost of each step, and progress. stop_after: the step of the interruption."""
    lines: list[str] = []

    def log(line: str) -> None:
        lines.append(line)
        if line.startswith(f"step {stop_after}/"):
            raise Interrupted

    sweeps = tones()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        net = stages.StagesNetwork(sweeps.format, 3, 0.1)
        net, cost = training.learn(
            net, sweeps, training.TrainingRecipe(**recipe), 1, log, augment=noisy, unfinished=path
        )
    return net.state_dict(), cost, lines


def check_same(one: tuple, other: tuple) -> None:
    """Bit for bit."""
    assert one[1] == other[1]
    assert all(torch.equal(a, b) for a, b in zip(one[0].values(), other[0].values(), strict=True))


@pytest.mark.parametrize("recipe", [PLAIN, EVERYTHING], ids=["plain", "everything"])
def test_an_interrupted_training_gives_the_same_bits(
    recipe: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Dropout, noise, norms, rate and moving average go on after two interruptions."""
    monkeypatch.setattr("palpate_train.models.checkpoint.wait", lambda took: 0.0)
    path = tmp_path / "deeper" / "half.pt"
    for stop in (3, 7):
        with pytest.raises(Interrupted):
            fit(recipe, path, stop)
    resumed = fit(recipe, path)
    assert len(resumed[2]) == 2, "steps 8 and 9"
    check_same(resumed, fit(recipe, None))


@pytest.mark.parametrize("broken", [b"", b"PK\x03\x04 half of it", None])
def test_a_file_that_cannot_be_read_counts_as_none(
    broken: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """If the file is empty, truncated or of other bytes, the training begins anew."""
    path = tmp_path / "half.pt"
    if broken is None:
        monkeypatch.setattr("palpate_train.models.checkpoint.wait", lambda took: 0.0)
        with pytest.raises(Interrupted):
            fit(PLAIN, path, 3)
        broken = path.read_bytes()[:-2000]
    path.write_bytes(broken)
    check_same(fit(PLAIN, path), fit(PLAIN, None))


@pytest.mark.parametrize(("step_s", "written"), [(1, False), (2, True)])
def test_it_is_written_from_time_to_time(
    step_s: int, written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Nine steps within ten seconds write no file."""
    seconds = count(0, step_s)
    monkeypatch.setattr(
        "palpate_train.models.checkpoint.time", SimpleNamespace(monotonic=lambda: next(seconds))
    )
    fit(PLAIN, tmp_path / "half.pt")
    assert bool(list(tmp_path.iterdir())) == written
