"""The rooms of networks and training: shapes, what is ignored, what augmentation does, a fit on an easy set."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_sets import easy

from appliance.errors import FormatError
from appliance.sim import skin
from appliance.sweep import SweepFormat
from train import compact, fit, heads, loop, score, sets
from train.__main__ import main
from train.compact import Compact, stages
from train.fit import Fit, Recipe

QUICK = Recipe(steps=40)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set."""
    return fit.fit(easy(), 1, QUICK)


def test_stages_follow_the_window():
    """The kernels of the two windows that are known; every window gets a last stage, or a message."""
    assert stages(1500) == ((16, 4), (5, 2), (5, 2))
    assert stages(128) == ((4, 1), (5, 2), (5, 2))
    for window in range(16, 3000):
        steps = window
        for kernel, stride in stages(window):
            steps = (steps - kernel) // stride + 1
        assert steps >= (compact.LEAST_STEPS if window >= 108 else 1)
    with pytest.raises(FormatError, match="a window of 15 frames is too short"):
        stages(15)


def test_compact_is_as_small_as_it_says():
    """19,110 weights for the skin of the paper with six classes."""
    model = Compact(skin.FORMAT, 6, 1.0, norm=False)
    assert sum(p.numel() for p in model.parameters()) == 19_110
    assert model(torch.zeros(2, 1500, 4, 4)).shape == (2, 6)


def test_compact_ignores_offsets():
    """A constant on each taxel changes nothing: it is the offset, not the texture."""
    model = Compact(skin.FORMAT, 6, 0.1, norm=False)
    rng = np.random.default_rng(0)
    digits = torch.from_numpy(rng.integers(0, 100, (2, 1500, 4, 4)).astype(np.float32))
    offset = torch.from_numpy(rng.integers(0, 100, (2, 1, 4, 4)).astype(np.float32))
    with torch.no_grad():
        torch.testing.assert_close(model(digits + offset), model(digits), rtol=0, atol=1e-4)
        assert (model(digits * 2) - model(digits)).abs().max() > 0.01


def test_fused_norms_change_nothing():
    """The folded network answers as the trained one in evaluation."""
    model = Compact(SweepFormat(2, 2, 100.0, 64, "uint8"), 3, 0.1)
    digits = torch.from_numpy(easy(8).samples.astype(np.float32))
    for norm in model.norms:
        torch.nn.init.uniform_(norm.weight, 0.5, 2)
        torch.nn.init.uniform_(norm.bias, -1, 1)
    with torch.no_grad():
        model(digits)  # moves the running means
        torch.testing.assert_close(model.fused()(digits), model.eval()(digits))


def test_row_shift_is_drawn_per_sweep():
    """Some sweeps stay, some go up, some down by one row; the row that comes in is its neighbour's, no stronger."""
    x = torch.arange(1, 9, dtype=torch.float32).reshape(1, 8, 1).expand(300, 8, 5)  # rows (1,2) (3,4) (5,6) (7,8)
    still = Recipe(row_shift=0.5, noise=0, gain=0)
    y = fit.vary(x, torch.Generator().manual_seed(0), 4, still)[:, :, 0]
    stays = (y[:, 2:6] == torch.tensor([3, 4, 5, 6])).all(1)
    up = (y[:, :6] == torch.tensor([3, 4, 5, 6, 7, 8])).all(1)
    down = (y[:, 2:] == torch.tensor([1, 2, 3, 4, 5, 6])).all(1)
    assert (stays.int() + up.int() + down.int() == 1).all()
    assert 120 < stays.sum() < 180
    assert 45 < up.sum() < 105
    level = y[up, 6:] / torch.tensor([7, 8])
    torch.testing.assert_close(level[:, 0], level[:, 1])
    assert level.min() >= 0
    assert level.max() <= 1
    assert level.std() > 0.2


def test_stretch_changes_speed_and_nothing_else():
    """A tone comes back at 0.7 to 1.3 times its rate, with its strength."""
    t = torch.arange(400) / 400
    x = torch.sin(2 * np.pi * 40 * t).expand(64, 1, 400)
    y = fit.vary(x, torch.Generator().manual_seed(0), 1, Recipe(stretch=0.3, noise=0, gain=0))
    crossings = (y[:, 0, 1:] * y[:, 0, :-1] < 0).sum(1) / 2
    assert crossings.min() >= 26
    assert crossings.max() <= 54
    assert crossings.max() - crossings.min() > 15
    torch.testing.assert_close(y.std(2), x.std(2), rtol=0.1, atol=0)


def test_gain_is_a_taxel_s_and_noise_a_frame_s():
    """The stated deviations, gain constant in time, the same draw for the same seed."""
    x = torch.ones(200, 4, 300)
    y, again = (loop.unsettled(x, Recipe(), torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(y, again)
    assert y.mean(2).std().item() == pytest.approx(0.15, rel=0.1)
    assert y.std(2).mean().item() == pytest.approx(0.05, rel=0.05)


def test_temperature_finds_how_sure_to_be():
    """Logits made five times too large are divided by five; a few right answers do not allow any certainty."""
    rng = np.random.default_rng(0)
    honest = 2 * rng.standard_normal((4000, 4))
    labels = np.array([rng.choice(4, p=p) for p in np.exp(honest) / np.exp(honest).sum(1, keepdims=True)])
    assert heads.temperature(5 * honest, labels) == pytest.approx(5, rel=0.1)
    sure = 50 * np.eye(3)[np.arange(9) % 3]
    assert 50 / heads.temperature(sure, np.arange(9) % 3) < 6


def test_a_head_of_two_classes_has_two_logits():
    """scikit-learn gives one row there; the labels and their probabilities are the same."""
    rng = np.random.default_rng(0)
    labels = np.arange(200) % 2
    seen = rng.standard_normal((200, 5)) + labels[:, None] * np.array([2, 0, 0, 0, 0])
    weight, bias = heads.closed_form_head(seen, labels, seen, labels)
    assert weight.shape == (2, 5)
    assert np.mean((seen @ weight.T + bias).argmax(1) == labels) > 0.8


def test_figure_is_wilson_s():
    """55 of 60, the paper's T-HARD: .917 in [.819, .964]."""
    assert score.figure(55, 60) == {"accuracy": 0.9167, "n": 60, "low": 0.8193, "high": 0.9639}


def test_a_fit_learns_what_is_easy(fitted: Fit):
    """Far above the third of chance on sweeps of another seed, with honest probabilities."""
    other = easy(seed=9)
    with torch.no_grad():
        p = torch.softmax(fitted.network()(torch.from_numpy(other.samples.astype(np.float32))), 1).numpy()
    assert np.mean(p.argmax(1) == other.labels) > 0.9
    assert p.max(1).mean() == pytest.approx(np.mean(p.argmax(1) == other.labels), abs=0.1)
    assert not set(fitted.train.groups["recording"]) & set(fitted.held.groups["recording"])
    assert fitted.about["validation"]["accuracy"] > 0.9


def test_a_fit_is_its_seed_s_alone(fitted: Fit):
    """The same bits again, whatever the state outside, which stays as it was; another seed gives others."""
    torch.manual_seed(99)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    again = fit.fit(easy(), 1, QUICK)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    for name, value in fitted.weights.items():
        np.testing.assert_array_equal(again.weights[name], value)
    assert not np.array_equal(fit.fit(easy(), 2, QUICK).weights["convs.0.weight"], fitted.weights["convs.0.weight"])


def test_positions_are_held_out_where_there_are_several():
    """The figures of validation are of positions that training never saw."""
    s = easy()
    s.groups["position"] = np.arange(len(s)) % 5
    made = fit.fit(s, 1, replace(QUICK, steps=2))
    assert made.about["held_out_by"] == "position"
    assert len(np.unique(made.held.groups["position"])) == 1
    assert not set(made.train.groups["position"]) & set(made.held.groups["position"])


def test_a_fit_survives_its_file(tmp_path: Path, fitted: Fit):
    """Weights, sweeps and story come back; another file is refused by name."""
    fitted.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert (again.scale, again.about, again.train.materials) == (fitted.scale, fitted.about, fitted.train.materials)
    for mine, theirs in ((again.train, fitted.train), (again.held, fitted.held)):
        np.testing.assert_array_equal(mine.samples, theirs.samples)
        np.testing.assert_array_equal(mine.group("recording"), theirs.group("recording"))
    for name, value in fitted.weights.items():
        np.testing.assert_array_equal(again.weights[name], value)
    easy(4).save(tmp_path / "set.npz")
    with pytest.raises(FormatError, match=r"^set.npz: not a fit"):
        Fit.load(tmp_path / "set.npz")


def test_the_command_splits_and_keeps_the_rest(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """What was not trained on is written as a set, recordings kept; together it is everything."""
    easy(20, pieces=2).save(tmp_path / "easy.npz")
    args = ["fit", "--set", str(tmp_path / "easy.npz"), "--seed", "1", "--steps", "4", "--only", "speed<=2"]
    args += [
        "--split",
        "recording:0.7",
        "--rest",
        str(tmp_path / "rest.npz"),
        "--out",
        str(tmp_path / "new" / "fit.npz"),
    ]
    assert main(args) == 0
    made, rest = Fit.load(tmp_path / "new" / "fit.npz"), sets.load(str(tmp_path / "rest.npz"))
    parts = [set(s.groups["recording"]) for s in (made.train, made.held, rest)]
    whole = easy(20, pieces=2).select(["speed<=2"])
    assert sum(map(len, parts)) == len(set.union(*parts)) == len(np.unique(whole.groups["recording"]))
    assert len(made.train) + len(made.held) + len(rest) == len(whole)
    assert "held-out recording" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--set", "none.npz"], "none.npz: not a sweep set"),
        (["--set", "sim:T-LAB:1:1", "--only", "force=1"], "no group 'force'"),
        (["--set", "sim:T-LAB:1:1", "--split", "recording"], "split 'recording' cannot be read"),
        (["--set", "sim:T-LAB:1:1", "--rest", "rest.npz"], "--rest needs --split"),
    ],
)
def test_a_named_trouble_is_one_line(args: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The exit code of a FormatError and its message on the error stream."""
    assert main(["fit", "--seed", "1", "--out", str(tmp_path / "fit.npz"), *args]) == FormatError.exit_code
    err = capsys.readouterr().err
    assert err.startswith("palpate-train: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.skipif("PALPATE_DATA" not in os.environ, reason="PALPATE_DATA does not name the folder of real sweeps")
def test_fabrics_are_told_apart(tmp_path: Path):
    """Real sweeps, seven fabrics, another skin: a short fit reaches nine of ten windows of recordings it never saw."""
    path = Path(os.environ["PALPATE_DATA"]) / "fabricslide" / "fabricslide.npz"
    whole = sets.load(str(path)).select(["direction=0", "force<=180"])
    assert len(whole.materials) == 7
    seen, unseen = whole.split("recording", 0.7, 1)
    made = fit.fit(seen, 1, Recipe(steps=300))
    with torch.no_grad():
        given = made.network()(torch.from_numpy(unseen.samples.astype(np.float32))).argmax(1).numpy()
    assert np.mean(given == unseen.labels) > 0.9
