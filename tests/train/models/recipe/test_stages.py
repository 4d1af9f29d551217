"""Compact networks and their training: shapes, invariance, augmentation, a fit on an easy set."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat
from appliance.sim import skin
from tests.factories.sweep_sets import easy
from train.data import sets
from train.metrics.temperature import platt_temperature
from train.models.linear_head import closed_form_head
from train.models.recipe import architectures, spectrum, stages
from train.models.recipe.architectures import ARCHITECTURES, DEFAULT
from train.models.recipe.fitted import Fit
from train.models.recipe.stages import Compact, FitRecipe

QUICK = FitRecipe(steps=40)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set."""
    return stages.fit_network(easy(), 1, QUICK)


@pytest.mark.slow
def test_stages_follow_the_window():
    """The kernels are as expected for the two known windows; every window gets a last stage, or a
    message."""
    assert [(s.kernel, s.stride) for s in DEFAULT.stages(1500)] == [(32, 4), (5, 2), (5, 2)]
    assert [(s.kernel, s.stride) for s in DEFAULT.stages(128)] == [(4, 1), (5, 2), (5, 2)]
    assert DEFAULT.stages(1500)[-1] == architectures.Stage(5, 2, 89, 32 + 4 * 4 + 4 * 8, 16)
    for shape in (shape for shape in ARCHITECTURES.values() if shape.channels):
        for window in range(16, 3000):
            last = shape.stages(window)[-1]
            assert last.steps >= (architectures.MIN_LAST_STEPS if window >= 108 else 1)
            assert (last.steps - 1) * last.hop + last.reach <= window
            assert shape.cut(1).stages(window) == shape.stages(window)[:1]
            assert shape.cut(0, spectrum=True).stages(window) == ()
        with pytest.raises(FormatError, match="a window of 15 frames is too short"):
            shape.stages(15)
    assert ARCHITECTURES["bands"].stages(1500) == ()


@pytest.mark.parametrize(("size", "weights"), [("1k", 1_442), ("20k", 18_558)])
def test_compact_is_as_small_as_it_says(size: str, weights: int):
    """For the skin of the paper with six classes, the stated cost is that of the network."""
    model = Compact(skin.FORMAT, 6, 1.0, norm=False, architecture=ARCHITECTURES[size])
    assert (
        sum(p.numel() for p in model.parameters())
        == weights
        == ARCHITECTURES[size].cost(skin.FORMAT, 6).weights
    )
    assert model(torch.zeros(2, 1500, 4, 4)).shape == (2, 6)
    more = Compact(
        skin.FORMAT, 6, 1.0, norm=False, architecture=replace(ARCHITECTURES[size], spectrum=True)
    )
    assert sum(p.numel() for p in more.parameters()) == weights + 6 * spectrum.count(skin.FORMAT)


@pytest.mark.slow
def test_compact_ignores_offsets():
    """A constant on each taxel changes nothing, because of the kernels and not because of
    `prepare`."""
    model = Compact(skin.FORMAT, 6, 0.1, norm=False)
    rng = np.random.default_rng(0)
    counts = torch.from_numpy(rng.integers(0, 100, (2, 16, 1500)).astype(np.float32))
    offset = torch.from_numpy(rng.integers(0, 100, (2, 16, 1)).astype(np.float32))
    with torch.no_grad():
        torch.testing.assert_close(
            model.training_logits(counts + offset), model.training_logits(counts), rtol=0, atol=1e-4
        )
        assert (
            model.training_logits(counts * 2) - model.training_logits(counts)
        ).abs().max() > 0.01


def test_fused_norms_change_nothing():
    """The folded network answers as the trained one in evaluation."""
    model = Compact(SweepFormat(2, 2, 100.0, 64, "uint8"), 3, 0.1)
    counts = torch.from_numpy(easy(8).samples.astype(np.float32))
    for norm in model.norms:
        torch.nn.init.uniform_(norm.weight, 0.5, 2)
        torch.nn.init.uniform_(norm.bias, -1, 1)
    with torch.no_grad():
        model(counts)  # moves the running means
        torch.testing.assert_close(model.fused()(counts), model.eval()(counts))


def test_temperature_scaling_calibrates():
    """Logits that are five times too large are divided by five; a few right answers do not allow
    any certainty."""
    rng = np.random.default_rng(0)
    calibrated = 2 * rng.standard_normal((4000, 4))
    labels = np.array(
        [rng.choice(4, p=p) for p in np.exp(calibrated) / np.exp(calibrated).sum(1, keepdims=True)]
    )
    assert platt_temperature(5 * calibrated, labels) == pytest.approx(5, rel=0.1)
    sure = 50 * np.eye(3)[np.arange(9) % 3]
    assert 50 / platt_temperature(sure, np.arange(9) % 3) < 6


def test_a_head_of_two_classes_has_two_logits():
    """scikit-learn gives one row then; the labels and their probabilities are the same."""
    rng = np.random.default_rng(0)
    labels = np.arange(200) % 2
    seen = rng.standard_normal((200, 5)) + labels[:, None] * np.array([2, 0, 0, 0, 0])
    weight, bias = closed_form_head(seen, labels, seen, labels)
    assert weight.shape == (2, 5)
    assert np.mean((seen @ weight.T + bias).argmax(1) == labels) > 0.8


@pytest.mark.slow
def test_a_fit_learns_what_is_easy(fitted: Fit):
    """Its accuracy is far above chance on sweeps of another seed, with calibrated probabilities."""
    other = easy(seed=9)
    with torch.no_grad():
        p = torch.softmax(
            stages.network_of(fitted)(torch.from_numpy(other.samples.astype(np.float32))), 1
        ).numpy()
    assert np.mean(p.argmax(1) == other.labels) > 0.9
    assert p.max(1).mean() == pytest.approx(np.mean(p.argmax(1) == other.labels), abs=0.1)
    assert not set(fitted.train.groups["recording"]) & set(fitted.held.groups["recording"])
    assert fitted.about["validation"]["accuracy"] > 0.9


@pytest.mark.slow
def test_a_fit_is_its_seed_s_alone(fitted: Fit):
    """It has the same bits for any random state outside, which does not change; another seed gives
    other bits."""
    torch.manual_seed(99)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    again = stages.fit_network(easy(), 1, QUICK)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    for name, value in fitted.weights.items():
        np.testing.assert_array_equal(again.weights[name], value)
    assert not np.array_equal(
        stages.fit_network(easy(), 2, QUICK).weights["convs.0.weight"],
        fitted.weights["convs.0.weight"],
    )


@pytest.mark.slow
def test_positions_are_held_out_where_there_are_several():
    """The figures of validation are those of positions that training never saw."""
    s = easy()
    s.groups["position"] = np.arange(len(s)) % 5
    made = stages.fit_network(s, 1, replace(QUICK, steps=2))
    assert made.about["held_out_by"] == "position"
    assert len(np.unique(made.held.groups["position"])) == 1
    assert not set(made.train.groups["position"]) & set(made.held.groups["position"])


@pytest.mark.slow
def test_a_fit_survives_its_file(tmp_path: Path, fitted: Fit):
    """Weights, sweeps and description are read again; another file is refused by name."""
    fitted.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert (again.scale, again.about, again.train.materials) == (
        fitted.scale,
        fitted.about,
        fitted.train.materials,
    )
    for mine, theirs in ((again.train, fitted.train), (again.held, fitted.held)):
        np.testing.assert_array_equal(mine.samples, theirs.samples)
        np.testing.assert_array_equal(mine.group("recording"), theirs.group("recording"))
    for name, value in fitted.weights.items():
        np.testing.assert_array_equal(again.weights[name], value)
    assert (again.architecture, again.ranges) == (fitted.architecture, fitted.ranges)
    easy(4).save(tmp_path / "set.npz")
    with pytest.raises(FormatError, match=r"^set.npz: not a fit"):
        Fit.load(tmp_path / "set.npz")


def test_the_size_without_convolutions_learns_its_head_alone(tmp_path: Path):
    """It has neither iterations nor a cost, learns an easy set, and can be read from its file."""
    made = stages.fit_network(easy(), 1, QUICK, architecture=ARCHITECTURES["bands"])
    assert (made.architecture, made.bands, made.cost) == (ARCHITECTURES["bands"], 5, [])
    assert sorted(made.weights) == ["head.bias", "head.weight", "int8.bias", "int8.weight"]
    assert made.about["validation"]["accuracy"] > 0.9
    made.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert (again.architecture, again.ranges) == (made.architecture, made.ranges)
    np.testing.assert_array_equal(
        stages.features(stages.network_of(again), made.held),
        stages.features(stages.network_of(made), made.held),
    )
    assert again.trunk() == made.trunk()


def test_a_fit_of_another_form_is_refused(tmp_path: Path, fitted: Fit):
    """Weights that do not fit the architecture in the file are refused, and so is a file of an
    older version."""
    replace(fitted, architecture=ARCHITECTURES["1k"]).save(tmp_path / "fit.npz")
    with pytest.raises(
        FormatError,
        match=r"^fit.npz: its weights are not those of its Architecture"
        r"\(channels=\(2, 6, 8\).*; fit again$",
    ):
        Fit.load(tmp_path / "fit.npz")
    with np.load(tmp_path / "fit.npz") as z:
        old = dict(z)
    meta = json.loads(str(old["meta"]))
    del meta["architecture"]
    np.savez(tmp_path / "old.npz", **old | {"meta": np.array(json.dumps(meta))})
    with pytest.raises(FormatError, match=r"^old.npz: not a fit .*; fit again: 'architecture'$"):
        Fit.load(tmp_path / "old.npz")


@pytest.mark.skipif(
    "PALPATE_DATA" not in os.environ, reason="PALPATE_DATA does not name the folder of real sweeps"
)
def test_fabrics_are_distinguished(tmp_path: Path):
    """On real sweeps of seven fabrics from another skin, a short fit names nine of ten windows of
    unseen recordings rightly."""
    path = Path(os.environ["PALPATE_DATA"]) / "fabricslide" / "fabricslide.npz"
    whole = sets.load(str(path)).select(["direction=0", "force<=180"])
    assert len(whole.materials) == 7
    seen, unseen = whole.split("recording", 0.7, 1)
    made = stages.fit_network(seen, 1, FitRecipe(steps=300))
    with torch.no_grad():
        given = (
            stages.network_of(made)(torch.from_numpy(unseen.samples.astype(np.float32)))
            .argmax(1)
            .numpy()
        )
    assert np.mean(given == unseen.labels) > 0.9
