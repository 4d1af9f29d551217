"""The simulated finger and skin: shapes, the result of each effect alone, and the sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.core.errors import ConfigError
from palpate.sim import skin
from palpate.sim.skin import EFFECTS, FORMAT, MATERIALS, Placement, World

PLACE = Placement(0.5, -0.4, 2.0, seed=7)
STILL = World(off=frozenset(EFFECTS))


def only(*effects: str) -> World:
    """A World with no effects but `effects`."""
    return World(off=frozenset(EFFECTS) - set(effects))


def rng(seed: int = 3) -> np.random.Generator:
    """A random generator that always gives the same numbers."""
    return np.random.default_rng(seed)


SHEAR = World(shear=True)


def test_friction_pulls_against_the_motion_while_the_finger_slides():
    """0.4 of the pressure; else 0."""
    frames = skin.sweep("metal", PLACE, rng(), replace(only("position"), shear=True)).astype(float)
    along, normal = frames[..., 0], frames[..., 2]
    slides = slice(225, 225 + 2250)
    assert np.abs(along[slides] + 0.4 * normal[slides]).max() <= 1
    assert not along[:225].any()
    assert not along[225 + 2250 :].any()
    y = skin.position(PLACE, STILL)[1]
    centred = skin.sweep("metal", PLACE, rng(), replace(STILL, shear=True)).astype(float)
    assert np.abs(centred[..., 1] - centred[..., 2] * y / 25).max() <= 1


def test_shear_only_adds_axes():
    """The normal axis is the same except for noise; sets repeat; 0 without contact."""
    samples, labels, _ = skin.sweep_set("T-HARD", 5, 1, SHEAR)
    assert (samples.shape, samples.dtype) == ((6, 1500, 4, 4, 3), np.int16)
    np.testing.assert_array_equal(labels, np.arange(6))
    idle = skin.idle(3000, rng(), SHEAR)
    assert idle.shape == (3000, 4, 4, 3)
    assert np.abs(idle.mean(0)).max() < 0.1
    assert SHEAR.format == replace(FORMAT, dtype="int16", axes=3)
    off = frozenset({"noise"})
    plain, three = (
        skin.sweep("wood", PLACE, rng(), World(off=off, shear=shear)) for shear in (False, True)
    )
    assert (plain.dtype, three.dtype, three.shape) == (np.uint8, np.int16, (*plain.shape, 3))
    np.testing.assert_array_equal(three[..., 2], plain)


@pytest.mark.parametrize("material", MATERIALS)
def test_a_sweep_rests_slides_and_rests(material):
    """Shape and type are the format's, and only the slide makes the taxels vibrate."""
    taxels = skin.sweep(material, PLACE, rng(), only("texture", "vibration"))
    assert taxels.shape == (2700, 4, 4)
    assert taxels.dtype == FORMAT.numpy_type
    assert (np.diff(taxels[:225].astype(int), axis=0) == 0).all()
    assert (np.diff(taxels[2475:].astype(int), axis=0) == 0).all()
    assert (np.ptp(taxels[225:2475], axis=0) > 0).all()


def test_the_same_seed_gives_the_same_counts():
    """Of sweep, window, idle skin, set; idle counts are 0 with 1 or 2 now and then."""
    idle = skin.idle(3000, rng())
    assert idle.shape == (3000, 4, 4)
    assert idle.mean() < 1
    assert 0 < idle.max() < 8
    assert not skin.idle(10, rng(), STILL).any()
    for make in (
        lambda seed: skin.sweep("foam", PLACE, rng(seed)),
        lambda seed: skin.window("foam", PLACE, rng(seed)),
        lambda seed: skin.idle(300, rng(seed)),
        lambda seed: skin.sweep_set("T-HARD", seed, 1)[0],
    ):
        assert np.array_equal(make(1), make(1))
        assert not np.array_equal(make(1), make(2))


@pytest.mark.parametrize(
    ("effect", "call"),
    [
        ("position", lambda w: skin.position(PLACE, w)[0]),
        ("attachment", lambda w: skin.attachment(PLACE, w)[0]),
        ("drift", lambda w: skin.drift(1500, rng(), w)),
        ("spot", lambda w: skin.spot(w.tube("wood"), rng(), w).vibration_hz),
        (
            "texture",
            lambda w: skin.texture(
                w.tube("wood"), *skin.position(PLACE, STILL)[:1], np.arange(9), rng(), w
            ),
        ),
        (
            "vibration",
            lambda w: skin.vibration(
                w.tube("wood"), np.zeros(1), np.zeros(7), np.ones(99, bool), rng(), w
            ),
        ),
        ("noise", lambda w: skin.noise(99, rng(), w)),
    ],
)
def test_a_switch_reaches_its_own_effect_only(effect, call):
    """An effect is the same whether all others are on or off, and neutral if it is off itself."""
    alone = call(only(effect))
    assert np.array_equal(alone, call(World()))
    assert not np.array_equal(alone, call(STILL))
    assert np.array_equal(call(STILL), call(World(off=frozenset({effect}))))


@pytest.mark.parametrize("effect", ["drift", "spot", "texture", "vibration"])
def test_removing_an_effect_keeps_the_random_numbers_of_the_others(effect):
    """The readout noise is the same."""
    loud = World(noise_counts=2.0)
    noisy, clean = (replace(loud, off=frozenset(off)) for off in ({effect}, {effect, "noise"}))
    added = [skin.window("metal", PLACE, rng(), w).astype(float) for w in (noisy, clean)]
    drawn = [
        skin.window("metal", PLACE, rng(), w).astype(float)
        for w in (loud, replace(loud, off=frozenset({"noise"})))
    ]
    alike = np.corrcoef((added[0] - added[1]).ravel(), (drawn[0] - drawn[1]).ravel())[0, 1]
    assert alike > 0.9  # not 1: each of the four is rounded to whole digits


def test_noise_is_white_and_vibration_common():
    """Noise by taxel, plus rounding; vibration is one signal in proportion to pressure."""
    taxels = skin.window("metal", PLACE, rng(), only("noise")).reshape(-1, 16).astype(float)
    assert taxels.std(0).mean() == pytest.approx(np.hypot(World().noise_counts, 12**-0.5), rel=0.05)
    assert abs(np.corrcoef(taxels.T) - np.eye(16)).max() < 0.15
    loud = replace(only("vibration"), counts_per_kpa=25.0)
    taxels = skin.window("plastic rough", PLACE, rng(), loud).reshape(-1, 16).astype(float)
    assert np.corrcoef(taxels.T).min() > 0.95
    share = taxels.std(0) / taxels.mean(0)
    assert share.max() / share.min() < 1.1


def test_further_forward_there_is_less_vibration_and_higher_relief():
    """One row forward: damped high vibrations; the same relief, higher as the World says."""
    power = []
    for dx_mm in (0.0, skin.PITCH_MM):
        frames = skin.window("metal", Placement(dx_mm), rng(), only("position", "vibration"))[
            :, 1, 1:3
        ].astype(float)
        power.append(frames.std(0).mean() / frames.mean())
    assert power[1] < 0.75 * power[0]
    tube, felt = World().tube("plastic rough"), []
    for dx_mm in (0.0, skin.PITCH_MM):
        x = skin.position(Placement(dx_mm), World())[0]
        felt.append(skin.texture(tube, x, np.arange(1500), rng(), World()))
    assert felt[1] == pytest.approx(felt[0] * np.exp(World().relief_per_mm * skin.PITCH_MM))
    assert felt[1].std() > 1.2 * felt[0].std()


def test_rows_see_the_texture_in_turn_under_a_steady_force():
    """Row 3 100 frames earlier; for any error within a fifth."""
    frames = skin.window("plastic rough", Placement(), rng(), only("texture")).astype(float)
    frames -= frames.mean(0)
    lags = np.arange(-200, 201)
    for row in range(3):
        lead, follow = frames[300:-300, row + 1, 1], frames[:, row, 1]
        match = [np.corrcoef(lead, follow[300 + k : len(follow) - 300 + k])[0, 1] for k in lags]
        assert lags[np.argmax(match)] == 100
        assert max(match) > 0.9
    assert abs(np.corrcoef(frames[:, 1, 1], frames[:, 1, 2])[0, 1]) < 0.6
    for world in (World(), World(force_spread=0.5)):
        force = np.array([skin.drift(1500, rng(seed), world) for seed in range(40)])
        assert force.min() >= 0.8
        assert force.max() <= 1.2
        assert 0.02 < force.mean(axis=1).std() < 0.2
        assert abs(np.diff(force, axis=1)).max() < 0.01


@pytest.mark.parametrize("kpa_per_mm", [2.0, 4.0])
def test_the_springs_carry_the_force(kpa_per_mm):
    """The patch carries all; a softer bed sinks in deeper."""
    force = np.array([0.8, 1.0, 1.2])
    depth = skin.indentation(force, kpa_per_mm, World())
    x, y = np.meshgrid(np.linspace(-15, 15, 301), np.linspace(-15, 15, 301))
    pressed = np.maximum(depth[:, None, None] - skin.gap(x, y, World()), 0)
    assert (kpa_per_mm * pressed).sum((1, 2)) * 0.1**2 / 1000 == pytest.approx(force, rel=0.02)
    assert (depth > skin.indentation(force, 2 * kpa_per_mm, World())).all()


def test_the_pressure_centre_moves_against_the_skin():
    """If the end of the pad is near, in either direction."""

    def centre(frames: np.ndarray) -> np.ndarray:
        """Pressure centre (row, column) of frames [n, 4, 4]."""
        load = frames.mean(0, dtype=float)
        return (
            np.array([(load.sum(1) * np.arange(4)).sum(), (load.sum(0) * np.arange(4)).sum()])
            / load.sum()
        )

    still = replace(skin.LEVEL_BLIND, off=only("position").off)
    middle = centre(skin.window("metal", Placement(), rng(), still))
    ahead = centre(skin.window("metal", Placement(dx_mm=1.0), rng(), still))
    across = centre(skin.window("metal", Placement(dy_mm=1.0), rng(), still))
    assert middle == pytest.approx([1.5, 1.5])
    assert ahead[0] < middle[0] - 0.02
    assert ahead[1] == pytest.approx(middle[1], abs=0.02)
    assert across[1] < middle[1] - 0.1
    assert across[0] == pytest.approx(middle[0], abs=0.02)
    flat = centre(skin.window("metal", Placement(dx_mm=1.0), rng(), only("position")))
    assert flat[0] == pytest.approx(1.5, abs=0.02)


def test_reattaching_changes_the_load_but_not_the_position():
    """Other gains; the same seed the same."""
    off = only("attachment").off
    for world, least in ((skin.WORLD, 0.5), (skin.LEVEL_BLIND, 3)):
        still = replace(world, off=off)
        first, again, other = (
            skin.window("wood", Placement(seed=s), rng(), still)[0].astype(float) for s in (1, 1, 2)
        )
        assert np.array_equal(first, again)
        assert abs(first - other).mean() > least


@pytest.mark.parametrize("name", ["T-LAB", "T-REAL"])
def test_loads_are_in_the_range_of_the_converter(name):
    """Middle taxels are loaded, none saturates for long, and no loaded one is constant. In the
    level-blind world the outer columns are loaded too; else only soft tubes reach them."""
    for world in skin.WORLDS.values():
        samples, labels, _ = skin.sweep_set(name, 0, 1, world)
        load = samples.mean(1)
        assert 30 < load[:, 1:3, 1:3].mean() < 160
        assert (samples == 255).mean() < 0.005
        assert (np.ptp(samples, axis=1) > 0).all()
        outer = load[labels == skin.MATERIALS.index("foam")][:, :, [0, 3]]
        assert (load if world is skin.LEVEL_BLIND else outer).min() > 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "places", "each"), [("T-LAB", 1, 40), ("T-REAL", 9, 10), ("T-HARD", 1, 10)]
)
def test_sets_have_the_papers_counts(name, places, each):
    """Every tube is swept equally often at every position."""
    samples, labels, positions = skin.sweep_set(name, 5)
    assert samples.shape == (places * 6 * each, 1500, 4, 4)
    assert samples.dtype == np.uint8
    assert labels.dtype == positions.dtype == np.int64
    counts = np.zeros((places, 6), int)
    np.add.at(counts, (positions, labels), 1)
    assert (counts == each).all()


def test_positions_are_those_of_the_paper():
    """Nine within 1 mm; in T-HARD a row further the first leaves the pad, the others not."""
    lab, real, hard = (skin.placements(name, 5) for name in ("T-LAB", "T-REAL", "T-HARD"))
    assert [len(lab), len(real), len(hard)] == [1, 9, 1]
    assert max(np.hypot(p.dx_mm, p.dy_mm) for p in lab + real) <= 1
    assert hard[0].dx_mm == 4
    assert abs(hard[0].dy_mm) <= 1
    assert len({p.seed for p in lab + real + hard}) == 11
    assert skin.placements("T-REAL", 5) == real
    assert skin.placements("T-REAL", 6) != real
    samples, _, _ = skin.sweep_set("T-HARD", 0, 1, skin.LEVEL_BLIND)
    load = samples.mean((1, 3))
    assert (load[:, 3] < 1).all()
    assert (load[:, :3] > 10).all()
    samples, _, _ = skin.sweep_set("T-HARD", 0, 1)
    load = samples.mean((1, 3))
    share = load[:, 3] / load[:, :3].mean(axis=1)
    assert (share > 0.8).all()
    assert (share < 1).all()


def test_a_set_is_made_of_windows_at_its_positions():
    """By material and position alone; unknown names are refused."""
    world = only("position", "attachment")
    samples, labels, positions = skin.sweep_set("T-REAL", 5, 1, world)
    places = skin.placements("T-REAL", 5)
    for i in (0, 17, 53):
        expected = skin.window(MATERIALS[labels[i]], places[positions[i]], rng(), world)
        assert np.array_equal(samples[i], expected)
    with pytest.raises(ConfigError, match="'glass'"):
        skin.window("glass", PLACE, rng())
    with pytest.raises(ConfigError, match="'gravity'"):
        World(off=frozenset({"gravity"}))
    with pytest.raises(ConfigError, match="'T-EASY'"):
        skin.placements("T-EASY", 0)
