"""Corruptions change one property, grow with their severity, and give the same for a seed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.sim import skin
from palpate_train.data import corruptions
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset

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
    """Two worlds with one placement each and two sweeps of each material."""
    return EvaluationSweeps.simulated("sim:T-LAB:1001-1002:2")


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
    """Severity 0 changes no bit; the severest gives another sweep of the same format."""
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
    with pytest.raises(FormatError, match=name):
        entry.apply(EvaluationSweeps(small()), entry.severities[-1], 0)


@pytest.mark.parametrize("name", sorted({*DIGITAL} - {"window-held", "stretch", "shorten"}))
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
    with pytest.raises(FormatError, match="0 to 4"):
        BY_NAME["dead"].apply(EvaluationSweeps(small()), severity, 0)


def test_corruptions_by_name():
    """Unknown names are refused, files changed; simulated sweeps drawn again, as by force."""
    assert [s.name for s in corruptions.find(["hum", "dead"])] == ["hum", "dead"]
    with pytest.raises(FormatError, match="cold"):
        corruptions.find(["cold"])
    physical = {"shift-rows", "turn", "force-down", "force-up", "speed-down", "speed-up", "window"}
    instead = {"shift-grid", "turn-grid", "window-held", "stretch", "shorten"}
    assert {s.name for s in corruptions.applicable(scene())} == set(BY_NAME) - instead
    assert {s.name for s in corruptions.applicable(EvaluationSweeps(small()))} == set(
        BY_NAME
    ) - physical
    levels = [BY_NAME[name].apply(scene(), 0.5, 0).mean() for name in ("force-down", "force-up")]
    sound = scene().sweeps.samples.mean()
    assert levels[0] < 0.7 * sound < 1.2 * sound < levels[1]


def test_the_scene_is_what_the_simulator_draws():
    """Sound, shifted and turned sweeps are those of skin.sweep with the same stream."""
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


def test_speed_is_the_fingers():
    """At half the speed the relief has half its frequencies; those of friction stay."""
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
    """The severity is their number, each dead on every axis; those dead at 1 are dead at 3."""
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
    trial = EvaluationSweeps(small(shape=(12, 120, 3, 3, 3)))
    changed = (BY_NAME["dead"].apply(trial, 3, 5) != trial.sweeps.samples).any(axis=1)
    assert (changed.any(axis=3).sum(axis=(1, 2)) == 3).all()
    assert (changed.all(axis=3) == changed.any(axis=3)).all()


def test_shear_turns_with_the_skin():
    """After a quarter turn shear along the rows is shear across; the normal axis stays."""
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
    """It keeps its format, the sweeps without a corruption, and those with half the force."""
    trial = EvaluationSweeps.simulated("sim:T-LABx3:1001:1")
    assert trial.sweeps.format == skin.SHEAR_FORMAT
    drawn = BY_NAME["force-down"].apply(trial, 0.5, 0)
    assert drawn.shape == trial.sweeps.samples.shape
    np.testing.assert_array_equal(
        drawn, trial.scene.draw(world=skin.World(shear=True, force_n=0.5))
    )


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


def test_hum_noise_and_lost_frames():
    """Alike on all taxels, or a share of each; a fifth lost, two in a row at most, on a line."""
    sweeps = small("float32", (4, 600, 2, 2), 300.0)
    sweeps.samples[:, :, 0, 0] *= 4
    trial = EvaluationSweeps(sweeps)
    hum = BY_NAME["hum"].apply(trial, 2, 0) - sweeps.samples
    assert np.ptp(hum, axis=(2, 3)).max() < 1e-4
    assert (np.abs(np.fft.rfft(hum[:, :, 0, 0], axis=1)).argmax(axis=1) * 0.5 == 50).all()
    assert hum.max() == pytest.approx(2 * np.sqrt(sweeps.samples.var(axis=1).mean()), rel=0.02)
    noise = BY_NAME["noise"].apply(trial, 0.5, 0) - sweeps.samples
    assert np.allclose(noise.std(axis=(0, 1)), 0.5 * trial.deviation, rtol=0.1)
    trial = EvaluationSweeps(small("float32", (6, 400, 1, 2)))
    got, was = BY_NAME["lost"].apply(trial, 0.2, 0), trial.sweeps.samples
    lost = (got != was).all(axis=(2, 3))
    assert 0.15 < lost.mean() < 0.25
    assert not (lost[:, 2:] & lost[:, 1:-1] & lost[:, :-2]).any()
    for i in range(len(was)):
        there = np.flatnonzero(~lost[i])
        want = np.interp(np.arange(400), there, was[i, there, 0, 1])
        assert np.allclose(got[i, :, 0, 1], want, atol=1e-4)


def test_counts_are_digitized_again_and_large_sets_thinned():
    """255 and whole numbers without overflow; about `most` sweeps, evenly."""
    sweeps = small("uint8")
    sweeps.samples[:, :, 1, 1] = 200
    up = BY_NAME["gain-up"].apply(EvaluationSweeps(sweeps), 0.5, 0)
    assert (up[:, :, 1, 1] == 255).all()
    assert (
        BY_NAME["gain-down"].apply(EvaluationSweeps(small()), 0.5, 0)
        == np.rint(small().samples / 2)
    ).all()
    sweeps = small("uint8", (40, 20, 1, 1))
    assert len(EvaluationSweeps.of(sweeps).sweeps) == 40
    assert np.bincount(EvaluationSweeps.of(sweeps, 10, 1).sweeps.labels).tolist() == [5, 5]
    one, same, other = (EvaluationSweeps.of(sweeps, 10, seed).sweeps.samples for seed in (1, 1, 2))
    assert (one == same).all()
    assert (one != other).any()


def test_the_grid_is_read_elsewhere():
    """Shifted by one row, each row has its neighbour's values; the last is mirrored."""
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


@pytest.mark.parametrize("spec", ["sim:T-NONE", "sim:T-LAB:3-2"])
def test_an_unknown_scene_is_refused(spec: str):
    """An unknown scene is refused as by sets.load."""
    with pytest.raises(FormatError, match="sim:T"):
        EvaluationSweeps.simulated(spec)
