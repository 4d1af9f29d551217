"""The default recipe: choice, precisions, independence of PyTorch, refusals."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.cli import fit as fit_command
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import inner_parts
from palpate_train.models.methods import SkinUse
from palpate_train.models.recipe import choice, palpate, recipe
from palpate_train.models.recipe import fitted as fitted_module
from palpate_train.models.recipe.architectures import STAGES
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.recipe import Settings
from palpate_train.onnx_tools.graph_builder import run, with_head
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

checkpoint = Later("palpate_train.models.checkpoint")
stages = Later("palpate_train.models.recipe.stages")

CLOSED = Settings()


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set, without stages."""
    return recipe.fit(easy(), Run(1), CLOSED)


def test_an_easy_set_is_classified_correctly_by_a_fitting_trunk(fitted: Fit):
    """Heads did not see the part; each feature is in a discriminant."""
    assert fitted.about["validation"]["accuracy"] > 0.9
    assert "filters" in fitted.about["chosen"] or "spectrum" in fitted.about["chosen"]
    assert len(fitted.train) + len(fitted.held) == len(easy())
    columns = fitted.plan.columns()
    size = fitted.weights["int8.weight"].shape[1]
    assert columns.tolist() == list(range(size))
    assert run(fitted.trunk(), easy().samples[:2]).shape == (2, size)


def fitted_by_command(folder: Path, *options: str) -> Fit:
    """The fit of the easy set by `palpate-train fit`, without stages."""
    easy().save(folder / "easy.npz")
    out = folder / "fit.npz"
    words = f"fit --set {folder / 'easy.npz'} --seed 1 --out {out}".split()
    assert main([*words, *options]) == 0
    return Fit.load(out)


@pytest.mark.slow
def test_a_skin_that_is_put_back_is_shown_to_every_head(tmp_path: Path, fitted: Fit):
    """With --reattached all discriminants see copies, which nothing else demands."""
    made = fitted_by_command(tmp_path, "--reattached")
    assert made.about["recipe"]["reattached"]
    assert all(part.copies for part in made.plan.parts)
    assert not any(part.copies for part in fitted.plan.parts)


@pytest.mark.slow
@pytest.mark.thorough  # fits twice
def test_a_fit_for_60_hz_is_deaf_to_that(tmp_path: Path, fitted: Fit):
    """--mains is kept; each fit's spectrum is deaf to its own mains alone."""
    sixty = fitted_by_command(tmp_path, "--mains", "60")
    assert sixty.architecture.mains_hz == sixty.about["recipe"]["mains_hz"] == 60
    assert fitted.architecture.mains_hz == fitted.about["recipe"]["mains_hz"] == 50
    sweeps, moved = sets.load("sim:T-LAB:1:2", 1), {}
    # away from the ends of the range, because clipped counts have overtones
    sweeps = replace(sweeps, samples=(sweeps.samples.clip(None, 200) + 40).astype(np.uint8))
    seconds = np.arange(sweeps.format.window)[:, None, None] / sweeps.rate_hz
    for mains_hz in (50, 60):
        trunk = recipe.fixed_trunk(sweeps, 1, mains_hz)
        bands = trunk.layout()["bands"]
        before = trunk.features(sweeps)[:, bands]
        for hz in (50, 60):
            hummed = np.rint(sweeps.samples + 6 * np.sin(2 * np.pi * hz * seconds)).astype(np.uint8)
            moved[hz, mains_hz] = np.abs(
                trunk.features(replace(sweeps, samples=hummed))[:, bands] - before
            ).mean()
    assert max(moved[50, 50], moved[60, 60]) < min(moved[50, 60], moved[60, 50]) / 3, moved


def test_int8_and_float_agree(fitted: Fit):
    """Each precision has a head of its own."""
    forms = [
        with_head(
            fitted.trunk(int8), *(fitted.weights[f"{name}.{part}"] for part in ("weight", "bias"))
        )
        for int8, name in ((True, "int8"), (False, "head"))
    ]
    rounded, precise = (run(form, easy().samples).argmax(axis=1) for form in forms)
    assert np.mean(rounded == precise) > 0.98


def test_a_fit_is_read_as_it_was_written(fitted: Fit, tmp_path: Path):
    """Answers and plan are the same; a fit without its bank is refused by name."""
    fitted.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert again.plan == fitted.plan
    for mine, of_file in ((fitted.train, again.train), (fitted.held, again.held)):
        np.testing.assert_array_equal(mine.samples, of_file.samples)
        np.testing.assert_array_equal(mine.group("recording"), of_file.group("recording"))
    x = easy().samples[:4]
    np.testing.assert_array_equal(run(again.trunk(), x), run(fitted.trunk(), x))
    gone = {
        name: values
        for name, values in fitted.weights.items()
        if name not in ("bank.along", "int8.weight")
    }
    replace(fitted, weights=gone).save(tmp_path / "fit.npz")
    with pytest.raises(FormatError, match=r"fit\.npz"):
        Fit.load(tmp_path / "fit.npz")


@pytest.mark.slow
@pytest.mark.thorough  # fits twice; test_stages has a quick form
def test_the_same_seed_gives_the_same_fit(fitted: Fit):
    """Another seed gives other filters; without stages the choice is part two of two."""
    told: list[str] = []
    again, other = (recipe.fit(easy(), Run(seed, told.append), CLOSED) for seed in (1, 2))
    assert told[0].startswith("part 1 of 2, features of")
    assert told[1].startswith("part 2 of 2, choosing: ")
    for name, values in fitted.weights.items():
        np.testing.assert_array_equal(again.weights[name], values)
    assert other.plan != fitted.plan or not np.array_equal(
        other.weights["int8.weight"], fitted.weights["int8.weight"]
    )


@pytest.mark.slow
@pytest.mark.thorough  # fits with every stage
def test_stages_join_in(monkeypatch: pytest.MonkeyPatch):
    """Stages are trained from LEAST_SWEEPS on, if filters are not good enough. Their features come
    first, with a discriminant of their own; a fifth of the sweeps is held out from them, and their
    scale is that of the filters."""
    for name, value in (("LEAST_SWEEPS", 1), ("ENOUGH", 1.01)):
        assert not recipe.fit(easy(), Run(1), Settings(steps=20)).architecture.channels
        monkeypatch.setattr(recipe, name, value)
    told: list[str] = []
    fit = recipe.fit(easy(), Run(1, told.append), Settings(steps=20))
    assert [int(line.split()[1]) for line in told] == sorted(int(line.split()[1]) for line in told)
    assert f"features of {len(easy())} sweeps" in told[0]
    steps = [line for line in told if " step " in line]
    assert "step 10/20 loss" in steps[9]
    assert steps[-1].endswith(", 0 s left")
    assert re.search(r": \d+ filters$", told[-1])  # fewer may do beside stages
    assert fit.architecture.channels == STAGES.channels
    stages = sum(STAGES.channels)
    assert fit.plan.parts[0].columns == tuple(range(stages))
    assert len(fit.plan.parts) > 1
    assert 0 < len(fit.held) < len(fit.train) < len(easy())
    assert fit.about["validation"]["n"] == len(fit.held)
    logits = run(with_head(fit.trunk(), *fit.int8_head()), easy().samples)
    assert np.mean(logits.argmax(axis=1) == easy().labels) > 0.9


@pytest.mark.slow
@pytest.mark.thorough  # fits for seconds
@pytest.mark.parametrize("better", [True, False])
def test_stages_and_the_spectrum_are_enough_unless_more_is_better(
    monkeypatch: pytest.MonkeyPatch, better: bool
):
    """Each stage has a discriminant with the spectrum; filters are absent."""
    for name, value in (("LEAST_SWEEPS", 1), ("ENOUGH", 1.01)):
        monkeypatch.setattr(recipe, name, value)
    monkeypatch.setattr(choice.PairedDifference, "better", property(lambda _: better))
    fit = recipe.fit(easy(), Run(1), Settings(steps=20, use=SkinUse(reattached=True)))
    bands = fit.bands
    assert bands
    assert bool(fit.architecture.pools) == better
    assert bool(fit.architecture.distribution) == better
    assert fit.about["validation"]["n"] == len(fit.held)  # copies were judged, and are not counted
    if not better:
        sizes = [len(part.columns) for part in fit.plan.parts]
        assert sizes == [channels + bands for channels in STAGES.channels]
        assert all(part.copies for part in fit.plan.parts)
        logits = run(with_head(fit.trunk(), *fit.int8_head()), easy().samples)
        assert np.mean(logits.argmax(axis=1) == easy().labels) > 0.9


@pytest.mark.slow
@pytest.mark.thorough  # fits three times
def test_an_interrupted_fit_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With the bits of an uninterrupted one; another seed begins anew."""

    def uncalibrated(given: object) -> NoReturn:
        """As if too few sweeps judged; a calibration would take longer than the fit."""
        raise FormatError("not here")

    interrupted = 130
    monkeypatch.setattr(recipe, "LEAST_SWEEPS", 1)
    monkeypatch.setattr(recipe, "ENOUGH", 1.01)
    monkeypatch.setattr("palpate_train.models.checkpoint.wait", lambda took: 0.0)
    monkeypatch.setattr(fit_command, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(fitted_module, "fit_calibration", uncalibrated)
    easy().save(tmp_path / "easy.npz")
    plain, steps = stages.StagesNetwork.backward, []

    def backward(*args):
        if len(steps) == stop:
            raise KeyboardInterrupt
        steps.append("")
        return plain(*args)

    def fitted(name: str, seed: int = 1) -> Fit | None:
        out = tmp_path / f"{name}.npz"
        args = f"--set {tmp_path / 'easy.npz'} --seed {seed} --stages 12 --out {out}".split()
        assert main(["fit", *args]) == (0 if stop < 0 else interrupted)
        return Fit.load(out) if stop < 0 else None

    monkeypatch.setattr(stages.StagesNetwork, "backward", backward)
    stop = 7
    fitted("first")
    assert len(list((tmp_path / "cache").iterdir())) == 1
    stop = -1
    steps.clear()
    other = fitted("other", seed=2)
    assert len(steps) == 12
    steps.clear()
    resumed = fitted("first")
    assert len(steps) == 12 - 7
    assert not list((tmp_path / "cache").iterdir())
    whole = fitted("whole")
    assert other
    assert resumed
    assert whole
    for name, values in whole.weights.items():
        np.testing.assert_array_equal(resumed.weights[name], values)
    assert not np.array_equal(other.weights["convs.0.weight"], whole.weights["convs.0.weight"])


@pytest.mark.slow
@pytest.mark.thorough  # fits in a process of its own
def test_filters_need_no_pytorch(tmp_path: Path):
    """A process that cannot import PyTorch fits and exports; the command prints its choice."""
    easy().save(tmp_path / "easy.npz")
    script = (
        "import sys\n"
        "import builtins, importlib.util as util\n"
        "found, loaded = util.find_spec, builtins.__import__\n"
        "def gone(name, *args, **kwargs):\n"
        "    if name.partition('.')[0] == 'torch': raise ModuleNotFoundError(name)\n"
        "    return loaded(name, *args, **kwargs)\n"
        "util.find_spec = lambda name, *args: None if name == 'torch' else found(name, *args)\n"
        "builtins.__import__ = gone\n"
        "from palpate_train.cli.main import main\n"
        f"sweeps, fit, bundle = {[str(tmp_path / name) for name in ('easy.npz', 'f.npz', 'b')]}\n"
        "code = main(['fit', '--set', sweeps, '--seed', '1', '--out', fit])\n"
        "args = ['--out', bundle, '--name', 'b', '--version', '1']\n"
        "sys.exit(code or main(['export', fit, *args]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "chosen: " in done.stdout
    assert (tmp_path / "b" / "manifest.json").is_file()


@pytest.mark.slow
@pytest.mark.thorough  # fits once more
def test_the_method_is_what_the_command_fits(fitted: Fit):
    """Its fit has the same bits, and its logits are those of the int8 head."""
    s = easy()
    model = palpate.train(s, s.samples, 1, settings=CLOSED)
    for name, values in fitted.weights.items():
        np.testing.assert_array_equal(model.fit.weights[name], values)
    logits = run(with_head(fitted.trunk(), *fitted.int8_head()), s.samples)
    np.testing.assert_allclose(model.logits(s.samples), logits, atol=1e-3)


@pytest.mark.slow
def test_the_method_names_materials_that_it_never_saw_last():
    """A material without a training sweep gets the lowest logit; labels stay."""
    sweeps = easy()
    part = sweeps.take(sweeps.labels != 1)
    model = palpate.train(part, part.samples, 1, settings=CLOSED)
    logits = model.logits(sweeps.samples)
    assert logits.shape == (len(sweeps), len(sweeps.materials))
    assert (logits.argmax(axis=1) != 1).all()
    named = logits.argmax(axis=1)[sweeps.labels != 1]
    assert np.mean(named == part.labels) > 0.9
    assert (
        np.mean(model.precisions["float"].logits(part.samples).argmax(axis=1) == named[: len(part)])
        > 0.95
    )


def test_groups_that_can_be_left_out_judge():
    """The first parts first; else recordings judge."""
    n = 24
    labels, recording = np.arange(n) % 2, np.arange(n) // 2
    groups = {"recording": recording, "speed": recording % 3, "force": recording % 2}
    groups["odd"] = np.arange(n) % 2
    groups["trial"] = recording % 4
    sweeps = Dataset(np.zeros((n, 16, 1, 1), np.uint8), labels, ("a", "b"), 10.0, groups, "x")
    found = " ".join(part.group for part in inner_parts(sweeps))
    assert found == "force speed force speed speed"
    for part in inner_parts(sweeps):
        assert set(sweeps.groups[part.group][part.out]).isdisjoint(
            sweeps.groups[part.group][~part.out]
        )
    pure = replace(sweeps, labels=recording % 2, groups={"recording": recording})
    parts = inner_parts(pure)
    assert [part.group for part in parts] == ["recording"] * 5
    assert np.sum([part.out for part in parts], axis=0).tolist() == [1] * n
    one = replace(pure, labels=(recording == 3).astype(int))
    with pytest.raises(FormatError, match="one recording"):
        inner_parts(one)


def varied() -> Dataset:
    """Easy sweeps under three forces, two tools; a new force hides the materials."""
    sweeps, n = easy(30), 90
    force = np.arange(n) % 3
    faster = np.array([1.0, 2.5, 5.0])[force]
    frames = (np.arange(64) * faster[:, None]).astype(int) % 64
    samples = sweeps.samples[np.arange(n)[:, None], frames]
    groups = {"recording": np.arange(n), "tool": np.arange(n) // 3 % 2, "force": force}
    return replace(sweeps, samples=samples, groups=groups | {"batch": np.arange(n) // 6 % 5})


@pytest.mark.slow
def test_the_hardest_condition_judges():
    """Some force is held out; each condition has figures of its own."""
    made = recipe.fit(varied(), Run(1), CLOSED)
    assert made.about["conditions"] == ["force", "batch", "tool"]
    assert made.about["held_out_by"] == "force"
    assert not set(made.train.group("force")) & set(made.held.group("force"))
    figures = made.held_out_figures()
    shares = {
        name: figures[f"held-out {name}, network alone"]["accuracy"]
        for name in made.about["conditions"]
    }
    assert shares["force"] < shares["batch"] - 0.05
    assert figures["held-out batch"]["n"] == len(varied())


@pytest.mark.slow
def test_sweeps_without_recordings_are_numbered_before_they_are_divided():
    """Each sweep is then a recording of its own on both sides, and counts by itself."""
    made = recipe.fit(replace(easy(), groups={}), Run(1), CLOSED)
    numbers = [side.group("recording") for side in (made.train, made.held)]
    assert len(np.unique(np.concatenate(numbers))) == len(easy())
    assert not [name for name in made.held_out_figures() if name.endswith("by recording")]


@pytest.mark.slow
def test_only_named_conditions_judge():
    """The varying conditions may be named."""
    made = recipe.fit(varied(), Run(1), replace(CLOSED, varies=("batch",)))
    assert made.about["conditions"] == ["batch"]
    assert next(iter(made.held_out_figures())) == "held-out batch"


@pytest.mark.slow
def test_a_condition_whose_value_holds_all_other_materials_judges_no_answers():
    """A second day with one material alone: the limits come of the other conditions, or else of
    recordings."""
    sweeps = varied()
    day = (sweeps.labels == 0) & (np.arange(len(sweeps)) % 2 == 0)
    sweeps = replace(sweeps, groups=sweeps.groups | {"day": day.astype(int)})
    assert "day" in {part.group for part in inner_parts(sweeps)}
    for varies, conditions in (((), ["force", "batch", "tool"]), (("day",), ["recording"])):
        made = recipe.fit(sweeps, Run(1), replace(CLOSED, varies=varies))
        assert made.about["conditions"] == conditions
        assert made.calibration, made.uncalibrated


@pytest.mark.slow
def test_a_condition_that_cannot_be_left_out_is_refused():
    """The error names it."""
    for name in ("recording ", "speed"):
        with pytest.raises(FormatError, match=name):
            recipe.Setup.of(varied(), Run(1), replace(CLOSED, varies=(name,)))


def test_what_cannot_be_fitted_is_named():
    """A constant skin and a window that is too short are refused at once."""
    still = replace(easy(), samples=np.full_like(easy().samples, 7))
    with pytest.raises(FormatError, match="constant"):
        recipe.fit(still, Run(1), CLOSED)
    with pytest.raises(FormatError, match="12 frames"):
        recipe.fit(replace(easy(), samples=easy().samples[:, :12]), Run(1), CLOSED)
