"""Robustness: each corruption changes only the described property, and right answers are
counted correctly."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.core.types import Status, SweepFormat
from palpate.sim import skin
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import corruption_pairs, corruptions, robustness
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.evaluation_sweeps import EvaluationSweeps
from palpate_train.models import methods
from palpate_train.models.methods import Method, model_inputs

BY_NAME = {s.name: s for s in corruptions.CORRUPTIONS}
DIGITAL = [s.name for s in corruptions.CORRUPTIONS if s.only != "simulated"]


def small(
    kind: str = "int16", shape: tuple[int, ...] = (12, 120, 3, 3), rate_hz: float = 100.0
) -> Dataset:
    """Sweeps of two materials; the second is stronger and rougher."""
    labels = np.arange(shape[0]) % 2
    each = labels.reshape(-1, *(1,) * (len(shape) - 1))
    rough = np.random.default_rng(7).standard_normal(shape) * (3 + 3 * each)
    samples = (rough + 60 + 10 * each).astype(kind)
    return Dataset(samples, labels, ("smooth", "rough"), rate_hz, {}, "small")


@cache
def scene() -> EvaluationSweeps:
    """A small simulated scene: two worlds with one placement each and two sweeps of each
    material."""
    return EvaluationSweeps.simulated("sim:T-LAB:1001-1002:2")


@dataclass
class NearestMean:
    """Answers with the material with the nearest mean of two simple figures."""

    means: np.ndarray

    def logits(self, given: np.ndarray) -> np.ndarray:
        """Minus the squared distance, float32 [n, K]."""
        return -(((_figures(given)[:, None] - self.means) ** 2).sum(axis=2)).astype(np.float32)

    def graph(self) -> onnx.ModelProto:
        """Raises an error: corrupted sweeps go to the model itself, and no graph is needed."""
        raise AssertionError("the corruption asked for a graph")


def _figures(given: np.ndarray) -> np.ndarray:
    x = given.astype(float)
    return np.stack([x.mean(axis=(1, 2, 3)), x.std(axis=1).mean(axis=(1, 2))], axis=1)


def learn(sweeps: Dataset, given: np.ndarray, seed: int) -> NearestMean:
    """Train the fake, which refuses sweeps that are too short, as real methods do."""
    if given.shape[1] < 20:
        raise FormatError(f"a window of {given.shape[1]} frames is too short; use at least 20")
    seen = _figures(given) + seed
    return NearestMean(
        np.stack([seen[sweeps.labels == k].mean(axis=0) for k in range(len(sweeps.materials))])
    )


FAKE = Method("fake", "two figures, nearest mean", "raw", learn)


@pytest.mark.parametrize(
    "sweeps",
    [
        small(),
        small("float32", (4, 128, 16, 1), 35.6),
        small("uint8", (2, 40, 1, 1), 10),
        small(shape=(4, 120, 3, 2, 3)),
    ],
)
@pytest.mark.parametrize("name", DIGITAL)
def test_counts_stay_counts(name: str, sweeps: Dataset):
    """For any grid, rate and type, severity 0 changes no bit, and the severest gives a different
    sweep of the same format, repeatably."""
    entry, trial = BY_NAME[name], EvaluationSweeps(sweeps)
    before = sweeps.samples.copy()
    assert entry.apply(trial, 0, 3) is sweeps.samples
    severe = entry.apply(trial, entry.severities[-1], 3)
    assert (sweeps.samples == before).all()
    assert (severe.shape, severe.dtype) == (before.shape, before.dtype)
    assert np.isfinite(severe).all()
    assert (severe != before).any()
    assert (severe == entry.apply(trial, entry.severities[-1], 3)).all()


@pytest.mark.parametrize("name", [n for n in BY_NAME if BY_NAME[n].only == "simulated"])
def test_the_scene_is_drawn_anew(name: str):
    """Each physical corruption changes simulated sweeps, and is refused by name without a scene."""
    entry = BY_NAME[name]
    assert entry.apply(scene(), 0, 0) is scene().sweeps.samples
    severe = entry.apply(scene(), entry.severities[-1], 0)
    assert (severe.shape, severe.dtype) == (scene().sweeps.samples.shape, np.uint8)
    assert (severe != scene().sweeps.samples).any(axis=(1, 2, 3)).all()
    with pytest.raises(
        FormatError, match=f"stress '{name}' draws sweeps anew and small cannot; use sim:NAME"
    ):
        entry.apply(EvaluationSweeps(small()), entry.severities[-1], 0)


@pytest.mark.parametrize(
    "name",
    [
        "dead",
        "stuck",
        "gain-spread",
        "gain-down",
        "gain-up",
        "drift",
        "bits",
        "lost",
        "saturation",
        "hum",
        "noise",
        "noisy",
        "shift-grid",
        "turn-grid",
    ],
)
def test_a_corruption_only_grows(name: str):
    """A higher severity is further from the sound sweep."""
    trial = EvaluationSweeps(small("float32"))
    away = [
        np.abs(BY_NAME[name].apply(trial, s, 1) - trial.sweeps.samples).mean()
        for s in BY_NAME[name].severities
    ]
    assert (np.diff(away) > 0).all() if name != "bits" else (np.diff(away) > -1e-3).all()


@pytest.mark.parametrize("severity", [-1, 5, np.nan])
def test_no_severity_beyond_the_scale(severity: float):
    """A severity out of range is refused by name."""
    with pytest.raises(FormatError, match="out of range; use 0 to 4"):
        BY_NAME["dead"].apply(EvaluationSweeps(small()), severity, 0)


def test_corruptions_by_name():
    """Corruptions are found by name, and unknown names are refused. Simulated sweeps are drawn
    again; the raw counts of a file are changed."""
    assert [s.name for s in corruptions.find(["hum", "dead"])] == ["hum", "dead"]
    with pytest.raises(FormatError, match="use some of shift-rows,"):
        corruptions.find(["cold"])
    physical = {"shift-rows", "turn", "force-down", "force-up", "speed-down", "speed-up", "window"}
    instead = {"shift-grid", "turn-grid", "window-held", "stretch", "shorten"}
    assert {s.name for s in corruptions.applicable(scene())} == set(BY_NAME) - instead
    assert {s.name for s in corruptions.applicable(EvaluationSweeps(small()))} == set(
        BY_NAME
    ) - physical


def test_the_scene_is_what_the_simulator_draws():
    """The sound sweeps, a shift by one row and a turn by 20 degrees are those of skin.sweep with
    the same random stream."""
    trial, form = scene(), skin.FORMAT
    assert (trial.scene.draw() == trial.sweeps.samples).all()
    assert sorted(np.bincount(trial.sweeps.labels)) == [4] * 6
    place = skin.placements("T-LAB", 1002)[0]
    i = 13  # the second sweep in the second world
    for name, severity, at in (
        ("shift-rows", 1, replace(place, dx_mm=place.dx_mm + 4)),
        ("turn", 20, replace(place, turn_deg=place.turn_deg + 20)),
    ):
        rng = np.random.default_rng([1002, i, *b"stress"])
        whole = skin.sweep("metal", at, rng, rest_s=0.1, slide_s=2.0, after_s=0.1)
        assert (BY_NAME[name].apply(trial, severity, 0)[i] == whole[75 : 75 + form.window]).all(), (
            name
        )


def test_a_window_error_reaches_into_the_rest():
    """75 frames late is the same sweep 75 frames on; the sign is drawn for each sweep."""
    sound = scene().sweeps.samples
    late = scene().scene.draw(late_ms=100)
    assert (late[:, :-75] == sound[:, 75:]).all()
    assert (scene().scene.draw(late_ms=-100)[:, 75:] == sound[:, :-75]).all()
    moved = BY_NAME["window"].apply(scene(), 100, 0)
    is_late = (moved == late).all(axis=(1, 2, 3))
    assert 0 < is_late.sum() < len(sound)
    held = BY_NAME["window-held"].apply(trial := EvaluationSweeps(small()), 100, 0)
    whole = trial.sweeps.samples
    for mine, was in zip(held, whole, strict=True):
        early = np.concatenate([was[:1]] * 10 + [was[:-10]])
        assert (mine == early).all() or (mine == np.concatenate([was[10:]] + [was[-1:]] * 10)).all()


def test_force_is_the_worlds():
    """With half the force, the finger presses about half as much."""
    levels = [BY_NAME[name].apply(scene(), 0.5, 0).mean() for name in ("force-down", "force-up")]
    sound = scene().sweeps.samples.mean()
    assert levels[0] < 0.7 * sound < 1.2 * sound < levels[1]


def test_speed_is_the_fingers():
    """At half the speed, the relief passes at half its frequencies; vibrations of friction keep
    their frequencies."""
    still = replace(skin.WORLD, off=frozenset({"vibration", "drift", "noise", "spot"}))
    shaken = replace(skin.WORLD, off=frozenset({"texture", "drift", "noise", "spot"}))

    def centre_hz(world: skin.World) -> float:
        power = (
            np.abs(
                np.fft.rfft(scene().scene.draw(world=world)[:, :, 1, 1].astype(float) - 60, axis=1)
            )
            ** 2
        )
        return float(
            np.exp(np.average(np.log(np.arange(4, 500)), weights=power[:, 4:500].sum(0))) / 2
        )

    usual, slow, fast = (centre_hz(replace(still, speed=v)) for v in (1.0, 0.5, 1.5))
    assert slow < 0.7 * usual < usual < 0.8 * fast
    assert centre_hz(replace(shaken, speed=0.5)) == centre_hz(shaken)
    drawn = scene().scene.draw(world=replace(skin.WORLD, speed=0.5))
    assert (BY_NAME["speed-down"].apply(scene(), 0.5, 0) == drawn).all()


def test_dead_stuck_and_noisy_taxels():
    """The severity is the number of bad taxels, and the others are unchanged. Taxels that are dead
    at 1 are also dead at 3."""
    trial = EvaluationSweeps(small())
    for name in ("dead", "stuck", "noisy"):
        one, three = (BY_NAME[name].apply(trial, n, 5) != trial.sweeps.samples for n in (1, 3))
        one, three = one.any(axis=1), three.any(axis=1)
        assert (one.sum(axis=(1, 2)) == 1).all(), name
        assert (three.sum(axis=(1, 2)) == 3).all(), name
        assert (three | ~one).all(), name
    dead = BY_NAME["dead"].apply(trial, 3, 5)
    assert ((dead == 0).all(axis=1).sum(axis=(1, 2)) == 3).all()
    stuck = BY_NAME["stuck"].apply(trial, 3, 5)
    assert ((np.ptp(stuck, axis=1) == 0).sum(axis=(1, 2)) == 3).all()


def test_a_taxel_is_dead_on_all_its_axes():
    """The severity is the number of dead taxels, each dead on every axis."""
    trial = EvaluationSweeps(small(shape=(12, 120, 3, 3, 3)))
    changed = (BY_NAME["dead"].apply(trial, 3, 5) != trial.sweeps.samples).any(axis=1)
    assert (changed.any(axis=3).sum(axis=(1, 2)) == 3).all()
    assert (changed.all(axis=3) == changed.any(axis=3)).all()


def test_shear_turns_with_the_skin():
    """After a quarter turn, the grid is as with one axis, shear along the rows becomes shear
    across, and the normal axis stays."""
    flat = np.random.default_rng(0).uniform(10, 90, (2, 5, 3, 3)).astype(np.float32)
    along, normal = np.arange(90, dtype=np.float32).reshape(flat.shape), flat
    x = np.stack([along, 0 * along, normal], axis=-1)
    turned = corruptions._regrid(x, 0.0, 90.0, 0.0, np.random.default_rng(0))
    read = [
        corruptions._regrid(of, 0.0, 90.0, 0.0, np.random.default_rng(0)) for of in (along, normal)
    ]
    np.testing.assert_allclose(turned, np.stack([0 * along, -read[0], read[1]], axis=-1), atol=1e-3)


@pytest.mark.slow
def test_a_scene_with_shear_is_drawn_anew():
    """A scene with shear keeps its skin: the format, the sweeps without a corruption, and those
    with half the force."""
    trial = EvaluationSweeps.simulated("sim:T-LABx3:1001:1")
    assert str(trial.sweeps.format) == "4x4x3 int16 at 750 Hz, window 1500"
    drawn = BY_NAME["force-down"].apply(trial, 0.5, 0)
    assert drawn.shape == trial.sweeps.samples.shape
    np.testing.assert_array_equal(
        drawn, trial.scene.draw(world=skin.World(shear=True, force_n=0.5))
    )


def test_lost_frames_lie_on_the_line():
    """About a fifth of the frames is lost, never more than two in a row, and each is interpolated
    between its neighbours."""
    trial = EvaluationSweeps(small("float32", (6, 400, 1, 2)))
    got, was = BY_NAME["lost"].apply(trial, 0.2, 0), trial.sweeps.samples
    lost = (got != was).all(axis=(2, 3))
    assert 0.15 < lost.mean() < 0.25
    assert not (lost[:, 2:] & lost[:, 1:-1] & lost[:, :-2]).any()
    for i in range(len(was)):
        there = np.flatnonzero(~lost[i])
        want = np.interp(np.arange(400), there, was[i, there, 0, 1])
        assert np.allclose(got[i, :, 0, 1], want, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "share", "hz"), [("stretch", 0.5, 5), ("shorten", 0.5, 15), ("shorten", 0.2, 12)]
)
def test_stretching_moves_frequencies(name: str, share: float, hz: float):
    """A tone of 10 Hz becomes a tone of 5, 15 or 12 Hz of the same amplitude."""
    tone = np.sin(2 * np.pi * 10 * np.arange(400) / 100).astype(np.float32).reshape(1, 400, 1, 1)
    sweeps = Dataset(np.repeat(tone, 2, axis=0), np.arange(2), ("a", "b"), 100.0)
    got = BY_NAME[name].apply(EvaluationSweeps(sweeps), share, 0)[0, :, 0, 0]
    assert np.abs(np.fft.rfft(got)).argmax() / 4 == pytest.approx(hz, abs=0.26)
    assert got.std() == pytest.approx(tone.std(), rel=0.1)


def test_gains_drift_steps_and_clipping():
    """Gains, drift, steps and clipping each follow their formula."""
    trial = EvaluationSweeps(small("float32"))
    was = trial.sweeps.samples

    def apply(name: str, severity: float) -> np.ndarray:
        return BY_NAME[name].apply(trial, severity, 2)

    assert np.allclose(apply("gain-up", 0.5), 1.5 * was)
    assert np.allclose(apply("gain-down", 0.2), 0.8 * was)
    ratio = apply("gain-spread", 0.5) / was
    assert np.ptp(ratio, axis=1).max() < 1e-4
    assert 0.5 <= ratio.min() < 0.6 < 1.4 < ratio.max() <= 1.5
    offset = apply("drift", 0.2) - was
    assert np.abs(np.diff(offset, 2, axis=1)).max() < 1e-4
    assert 0.1 * trial.load < np.abs(offset).max() <= 0.2 * trial.load + 1e-4
    assert len(np.unique(apply("bits", 4).round(4))) <= 16
    assert apply("saturation", 0.3).max() == pytest.approx(0.7 * trial.load)


def test_hum_and_noise_have_their_strength():
    """50 Hz is alike on all taxels; white noise is a share of each taxel's own deviation."""
    sweeps = small("float32", (4, 600, 2, 2), 300.0)
    sweeps.samples[:, :, 0, 0] *= 4
    trial = EvaluationSweeps(sweeps)
    hum = BY_NAME["hum"].apply(trial, 2, 0) - sweeps.samples
    assert np.ptp(hum, axis=(2, 3)).max() < 1e-4
    assert (np.abs(np.fft.rfft(hum[:, :, 0, 0], axis=1)).argmax(axis=1) * 0.5 == 50).all()
    assert hum.max() == pytest.approx(2 * np.sqrt(sweeps.samples.var(axis=1).mean()), rel=0.02)
    noise = BY_NAME["noise"].apply(trial, 0.5, 0) - sweeps.samples
    assert np.allclose(noise.std(axis=(0, 1)), 0.5 * trial.deviation, rtol=0.1)


def test_counts_are_digitized_again():
    """uint8 ends at 255 and int16 stays whole: a higher gain saturates without overflow."""
    sweeps = small("uint8")
    sweeps.samples[:, :, 1, 1] = 200
    up = BY_NAME["gain-up"].apply(EvaluationSweeps(sweeps), 0.5, 0)
    assert (up[:, :, 1, 1] == 255).all()
    assert (
        BY_NAME["gain-down"].apply(EvaluationSweeps(small()), 0.5, 0)
        == np.rint(small().samples / 2)
    ).all()


def test_the_grid_is_read_elsewhere():
    """With a shift by one row, each row has the values of its neighbour, and the last row mirrors;
    the gains are new ones."""
    trial = EvaluationSweeps(small("float32", (3, 50, 4, 2)))
    was = trial.sweeps.samples
    ratio = BY_NAME["shift-grid"].apply(trial, 1, 0) / was[:, :, [1, 2, 3, 2]]
    assert np.ptp(ratio, axis=1).max() < 1e-4
    assert np.abs(np.log(ratio)).max() <= 0.25 / 1.5 + 1e-4
    was[:] = 50 + np.arange(50)[:, None, None]
    turned = BY_NAME["turn-grid"].apply(EvaluationSweeps(trial.sweeps), 30, 0)
    assert np.ptp(turned / was, axis=1).max() < 1e-4, (
        "a skin that feels the same everywhere may be turned"
    )
    was[:] = np.array([[0, 1], [1, 2], [2, 3], [3, 4]]) * 10.0 + 10
    quarter = corruptions._regrid(was[:, :, 1:3], 0.0, 90.0, 0.0, np.random.default_rng(0))[0, 0]
    assert np.allclose(quarter, [[30, 20], [40, 30]])  # x runs down the rows, y along the columns


def test_fewer_sweeps_as_many_of_each():
    """About `most` sweeps of a file are used, evenly over the materials; a smaller file is used
    whole."""
    sweeps = small("uint8", (40, 20, 1, 1))
    assert len(EvaluationSweeps.of(sweeps).sweeps) == 40
    assert np.bincount(EvaluationSweeps.of(sweeps, 10, 1).sweeps.labels).tolist() == [5, 5]
    assert (
        EvaluationSweeps.of(sweeps, 10, 1).sweeps.samples
        == EvaluationSweeps.of(sweeps, 10, 1).sweeps.samples
    ).all()
    assert (
        EvaluationSweeps.of(sweeps, 10, 1).sweeps.samples
        != EvaluationSweeps.of(sweeps, 10, 2).sweeps.samples
    ).any()


@pytest.mark.parametrize("spec", ["sim:T-NONE", "sim:T-LAB:3-2"])
def test_an_unknown_scene_is_refused(spec: str):
    """An unknown scene is refused as by sets.load."""
    with pytest.raises(FormatError, match="set 'sim:T"):
        EvaluationSweeps.simulated(spec)


def test_the_fall_is_between_two_severities():
    """The fall is interpolated between two severities; exactly five points are enough; without a
    fall it is None."""

    def at(*accuracy: float) -> float | None:
        return robustness.falls({"severities": [0.0, 1.0, 2.0, 4.0], "accuracy": list(accuracy)})

    assert at(0.9, 0.9, 0.8, 0.1) == pytest.approx(1.5)
    assert at(0.95, 0.9, 0.95, 0.95) == pytest.approx(1)  # in floats .95 - .05 is less than .9
    assert at(0.9, 0.88, 0.88, 0.78) == pytest.approx(2.6)
    assert at(0.9, 0.95, 0.93, 0.86) is None


def task(method: str, seed: int, right: list[int], **more) -> dict:
    """A result of `evaluate_method` written by hand: 20 sweeps under one corruption."""
    ends = {"low": [n / 20 - 0.1 for n in right], "high": [n / 20 + 0.05 for n in right]}
    curve = {
        "title": "dead taxels",
        "unit": "taxels",
        "about": "",
        "severities": [0.0, 1.0, 2.0],
        "right": right,
        "broken": [0, 0, 1],
    } | ends
    return {
        "method": method,
        "seed": seed,
        "set": "x",
        "refused": "",
        "total": 20,
        "ran": "",
        "trouble": {},
        "curves": {"dead": curve},
        "pairs": {},
    } | more


def test_merged_by_hand():
    """Sums, band, fall and loss of two seeds, in any order of completion."""
    tasks = [
        task("a", 0, [18, 16, 10]),
        task("a", 1, [20, 18, 2], ran="less"),
        task("b", 0, [10, 10, 10]),
    ]
    result = robustness.merge(tasks)
    assert json.dumps(result) == json.dumps(robustness.merge(tasks[::-1]))
    curve = result["methods"]["a"]["curves"]["dead"]
    assert (curve["right"], curve["total"], curve["broken"]) == ([38, 34, 12], 40, [0, 0, 2])
    assert curve["accuracy"] == [0.95, 0.85, 0.3]
    assert curve["low"] == [0.85, 0.75, 0.1], "the mean of both intervals, or the worse seed"
    assert curve["high"] == [1.0, 0.9, 0.5], "the mean of both intervals, or the better seed"
    assert curve["falls"] == pytest.approx(0.5)
    assert curve["lost"] == pytest.approx((0.1 + 0.65) / 2)
    assert result["methods"]["b"]["curves"]["dead"]["falls"] is None


def test_what_breaks_first_comes_first():
    """Corruptions are ordered by the share of the range that they take, then by the loss. Those
    without a fall are left out."""
    found = {
        name: {"lost": lost, "falls": fall, "severities": [0, most]}
        for name, lost, fall, most in (
            ("a", 0.1, 1.0, 4),
            ("b", 0.3, 0.1, 0.2),
            ("c", 0.2, None, 1),
            ("d", 0.2, 0.25, 1),
        )
    }
    assert robustness.breaks_first(found) == ["d", "a", "b"]


def test_intervals_are_by_attachment():
    """Sweeps of one attachment fail together, so the interval is wider than with independent
    sweeps."""
    by_place = replace(small(), groups={"position": np.repeat([0, 1, 2], 4)})
    right = np.repeat([True, True, False], 4)
    widths = []
    for sweeps in (small(), by_place):
        trials = robustness.CorruptionCounts(EvaluationSweeps(sweeps))
        trials.add(BY_NAME["dead"], [(right, 0)])
        widths.append(trials.curves["dead"]["high"][0] - trials.curves["dead"]["low"][0])
    assert widths[1] > widths[0] + 0.2


def test_one_task_travels_and_counts():
    """A task and its result survive a conversion to JSON; the numbers are those counted by hand."""
    sweeps, trial = small(), EvaluationSweeps(small())
    sent = pickle.loads(pickle.dumps((FAKE, sweeps, trial, corruptions.CORRUPTIONS, 0)))
    done = robustness.evaluate_method(*sent[:3], corruptions.find(["gain-up", "hum"]), 0)
    assert json.loads(json.dumps(done)) == done
    assert done["curves"]["gain-up"]["right"][0] == 12
    up = BY_NAME["gain-up"].apply(trial, 0.5, 0)
    right = int((learn(sweeps, sweeps.samples, 0).logits(up).argmax(1) == sweeps.labels).sum())
    assert done["curves"]["gain-up"]["right"][-1] == right < 12


def test_methods_run_side_by_side_and_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Each method and seed is one task; kept tasks do not run again; unknown names are refused."""
    sweeps, trial = small(), EvaluationSweeps(small())
    monkeypatch.setattr(
        methods, "find", lambda names, effort: [replace(FAKE, name=name) for name in names]
    )
    monkeypatch.setattr(methods, "module_of", lambda name: "palpate_studies.peers.baselines")
    lines: list[str] = []
    where = Where(jobs=1, cache=tmp_path)
    first = robustness.run(["a", "b"], sweeps, trial, where, seeds=(1, 2), log=lines.append)
    assert [line.split(" done")[0] for line in lines] == ["1/4", "2/4", "3/4", "4/4"]
    assert [
        line.partition("a under" if i in (0, 2) else "b under")[1] != ""
        for i, line in enumerate(lines)
    ] == [True] * 4
    assert first["methods"]["b"]["seeds"] == [1, 2]
    monkeypatch.setattr(robustness, "evaluate_method", None)
    assert robustness.run(["a", "b"], sweeps, trial, where, seeds=(1, 2)) == first
    monkeypatch.undo()
    with pytest.raises(FormatError, match="method 'a' is unknown"):
        robustness.run(["a"], sweeps, trial, where)


def test_all_applicable_corruptions_by_default():
    """None stands for all that apply; features are computed from the corrupted counts."""
    seen = []

    @dataclass
    class InputSpy:
        def logits(self, x: np.ndarray) -> np.ndarray:
            seen.append(x.copy())
            return np.zeros((len(x), 2), np.float32)

    method = Method("spy", "", "L", lambda *_: InputSpy())
    trial = EvaluationSweeps(small())
    done = robustness.evaluate_method(method, small(), trial, None, 6)
    assert list(done["curves"]) == [s.name for s in corruptions.applicable(trial)]
    assert list(done["pairs"]) == [s.name for s in corruption_pairs.pairs()]
    assert seen[0].shape == (12, 3)
    first = corruptions.applicable(trial)[0]
    mild = replace(small(), samples=first.apply(trial, first.severities[1], 6))
    assert (seen[1] == model_inputs("L", mild)).all()
    assert (seen[1] != seen[0]).any()


def test_a_pair_is_both_corruptions_at_once():
    """One dead taxel of each sweep reads 0, the others have noise; severity 0 changes nothing."""
    trial = EvaluationSweeps(small())
    both = {pair.name: pair for pair in corruption_pairs.pairs()}
    assert len(both) == 10
    changed = both["noise+dead"].apply(trial, 1, 0)
    dead = (changed == 0).all(axis=1)
    assert (dead.sum(axis=(1, 2)) == 1).all()
    moved = (changed != trial.sweeps.samples).any(axis=1)
    assert moved[~dead].all()
    assert (both["noise+dead"].apply(trial, 0, 0) == trial.sweeps.samples).all()


def test_what_cannot_be_done_is_said():
    """A set of another kind is an error of the caller; a method that refuses its set is a
    result."""
    with pytest.raises(FormatError, match=r".*3x3 uint8.* is not of"):
        robustness.evaluate_method(FAKE, small(), EvaluationSweeps(small("uint8")), None, 0)
    short = small(shape=(4, 10, 3, 3))
    entry = robustness.merge(
        [robustness.evaluate_method(FAKE, short, EvaluationSweeps(short), None, 0)]
    )["methods"]["fake"]
    assert entry["refused"] == "a window of 10 frames is too short; use at least 20"
    assert (entry["curves"], entry["clean"]) == ({}, None)


def test_an_answer_that_is_not_finite_is_wrong():
    """Such an answer counts as wrong and as broken, also if the label would have been right."""

    class NanModel(NearestMean):
        def logits(self, given: np.ndarray) -> np.ndarray:
            logits = super().logits(given)
            logits[:3] = [np.nan, 1]
            return logits

    model = NanModel(learn(small(), small().samples, 0).means)
    done = robustness.evaluate_model(
        FAKE, model, EvaluationSweeps(small()), corruptions.find(["dead"]), 0
    )
    assert done["curves"]["dead"]["right"][0] == 9
    assert done["curves"]["dead"]["broken"] == [3] * 5
    assert (
        robustness.uninformative_answers(FAKE, model, EvaluationSweeps(small()))["silent"]
        == "not finite"
    )


def test_each_answer_to_an_uninformative_sweep_has_a_name():
    """Sound methods stay finite or refuse; values that are not finite never reach them; a crash is
    reported, and the worst answer counts."""
    model = learn(small(), small().samples, 0)
    found = robustness.uninformative_answers(FAKE, model, EvaluationSweeps(small("float32")))
    assert [found[k] for k in ("silent", "constant", "saturated")] == ["finite"] * 3
    assert found["one-frame"].startswith("refused: 3x3 float32 at 100 Hz, window 1 instead of")
    for name in ("nan", "inf"):
        assert (
            found[name]
            == f"refused: {name}: samples[0, 60, 0, 0] is {name}; drop sweep 0 or fill it in"
        )

    class Crash:
        def logits(self, given: np.ndarray) -> np.ndarray:
            raise ZeroDivisionError("no contact")

    for name, window in robustness._uninformative(
        SweepFormat(2, 2, 100.0, 40, "float32", 3), 90.0
    ).items():
        assert window.shape[1:] == (2, 2, 3), name
    crashed = robustness.uninformative_answers(FAKE, Crash(), EvaluationSweeps(small()))
    assert crashed["silent"] == "crashed: ZeroDivisionError: no contact"
    assert set(crashed) == {"silent", "constant", "one-frame", "saturated"}
    both = [
        task("a", seed, [1, 1, 1], trouble={"silent": s})
        for seed, s in enumerate(["not finite", "refused: a long reason"])
    ]
    assert robustness.merge(both)["methods"]["a"]["trouble"] == {"silent": "not finite"}


def test_the_box_answers_with_a_status(default_bundle: bundle.Bundle):
    """The sweep cutter and the classifier refuse a sweep without information by name, and accept a
    sound one."""
    assert robustness.box_answers(default_bundle) == {
        "silent": "no-contact",
        "constant": "stuck-taxel",
        "one-frame": "short",
        "saturated": "saturated",
    }
    assert robustness.answer(default_bundle, default_bundle.golden[0]).status is Status.OK
    assert robustness.answer(default_bundle, default_bundle.golden[0][:-1]).status is Status.SHORT


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_nan_from_a_float_skin_is_never_an_answer():
    """If a board sends one NaN, its taxel is dead, although a bundle with float32 input would
    accept it."""
    form = SweepFormat(3, 3, 100.0, 40, "float32")
    nodes = [
        helper.make_node("ReduceMean", ["sweep"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "one"], ["column"]),
        helper.make_node("Concat", ["column", "column"], ["logits"], axis=1),
    ]
    takes = helper.make_tensor_value_info("sweep", TensorProto.FLOAT, [1, 40, 3, 3])
    gives = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 2])
    one = helper.make_tensor("one", TensorProto.INT64, [1], [1])
    graph = helper.make_graph(nodes, "mean", [takes], [gives], [one])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    limits = bundle.Thresholds(contact=1, full_scale=100)
    manifest = bundle.Manifest("mean", "1", form, "raw", ("a", "b"), limits, {})
    nothing = np.zeros((1, 40, 3, 3), np.float32)
    float_bundle = bundle.Bundle(
        manifest, "mean", model.SerializeToString(), nothing, np.zeros((1, 2), np.float32)
    )
    found = robustness.box_answers(float_bundle)
    assert found["silent"] == "no-contact"
    assert found["nan"] == "dead-taxel"
    assert found["inf"] == "dead-taxel"
