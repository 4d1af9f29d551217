"""The centre of a contact, the advice that follows from it, and the positions in a bundle."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.answer.contact import ContactPositions, advice, centre, displacement, fill_dead_taxels
from palpate.sim import skin
from tests.factories.contacts import MIDDLE, TARE, counts, patch

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("at", [(1.5, 1.5), (1.0, 2.0), (1.8, 1.4), (2.0, 1.0)])
def test_the_centre_of_a_contact_that_lies_on_the_skin(at):
    """It is found to 0.15 of a taxel, with any tare and any load below the contact threshold."""
    load = patch(*at)
    for tare in (TARE, np.arange(16.0).reshape(4, 4)):
        noisy = load + tare + 4 * (np.indices((4, 4)).sum(0) == 6)
        assert centre(counts(noisy), tare, 5.0) == pytest.approx(at, abs=0.15)


def test_the_normal_axis_and_the_nearest_position_count():
    """Shear moves no centre; not the middle of positions, and the limit itself is within."""
    load, tare = patch(2.5, 1.5), np.full((4, 4), 3.0)
    flat = counts(load + tare)
    shear = np.stack([500 * np.indices((4, 4))[0], -counts(load)[0]], axis=-1)
    three = np.concatenate([np.broadcast_to(shear, (*flat.shape, 2)), flat[..., None]], axis=-1)
    tares = np.stack([np.full((4, 4), 77.0), np.zeros((4, 4)), tare], axis=-1)
    assert centre(three, tares, 5.0) == centre(flat, tare, 5.0)
    means = three.mean(axis=0), flat.mean(axis=0)
    moved = [
        displacement(m, t, 5.0, MIDDLE).text for m, t in zip(means, (tares, tare), strict=True)
    ]
    assert moved[0] == moved[1] != ""
    two = ContactPositions(2.0, (0.0, 6.0), (0.0, 0.0), 0.5)
    assert two.offset((3.1, 0.0)) == pytest.approx((0.2, 0.0))
    assert two.within((0.3, -0.4))
    assert not two.within((0.3, -0.41))


def test_loads_below_the_threshold_and_silent_taxels_have_no_weight():
    """Without contact no centre or displacement; silent taxels at the rim are not filled in."""
    for load in (np.full((4, 4), 4.9), np.full((4, 4), NAN), np.full((4, 4), -80.0)):
        assert centre(counts(load), TARE, 5.0) is None
        assert displacement(counts(load).mean(axis=0), TARE, 5.0, MIDDLE).text == ""
    one = np.where(np.indices((4, 4)).sum(0) == 6, INF, patch(1.5, 1.5))
    assert centre(counts(one), TARE, 5.0) == pytest.approx((1.5, 1.5))
    load = np.array([[-3.0, 0, 0, 0], [0, 50, 50, 0], [0, 50, 50, 0], [0, 0, 0, -3]])
    assert centre(counts(load), TARE, -10.0) == (1.5, 1.5)
    load = np.zeros((4, 4))
    load[1:3, 0:3] = 50
    load[1, 2] = 0
    assert (fill_dead_taxels(load) == load).all()


@pytest.mark.parametrize("dead", [(1, 1), (2, 2), (1, 0), (0, 2)])
def test_a_dead_taxel_does_not_push_the_centre_away(dead):
    """Filled in between two loaded ones, the centre stays within 0.15 taxels."""
    load = patch(1.5, 1.5) + 30
    whole = np.array(centre(counts(load), TARE, 5.0))
    load[dead] = 0
    there = np.array(centre(counts(load), TARE, 5.0))
    assert np.hypot(*(there - whole)) < 0.15
    silent = np.array([(load.sum(a) @ np.arange(4)) / load.sum() for a in (1, 0)])
    assert np.hypot(*(silent - whole)) > 2 * np.hypot(*(there - whole))


@pytest.mark.parametrize(
    ("along", "axis", "towards"),
    [("dx_mm", 0, ("row 4", "row 1")), ("dy_mm", 1, ("column 4", "column 1"))],
)
def test_the_advice_follows_the_simulated_skin(along, axis, towards):
    """The further forward the skin, the further back the centre; the end is right."""
    found, rng = [], np.random.default_rng(0)
    for mm in (-4.0, -3.0, 0.0, 3.0, 4.0):
        place = skin.Placement(**{along: mm}, seed=3)
        window = skin.window("wood", place, rng, skin.LEVEL_BLIND)[:200]
        found.append(centre(window, TARE, 5.4)[axis])
        text = displacement(window.mean(axis=0), TARE, 5.4, MIDDLE).text
        assert text == "" if mm == 0 else text.endswith(f"mm too far towards {towards[mm > 0]}")
    assert (np.diff(found) < 0).all()


@pytest.mark.parametrize(
    ("offset", "text"),
    [
        ((2.1, 0.0), "2.1 mm too far towards row 4"),
        ((-2.1, 0.5), "2.1 mm too far towards row 1"),
        ((0.2, -1.26), "1.3 mm too far towards column 1"),
        ((1.0, 3.0), "3.0 mm too far towards column 5 and 1.0 mm towards row 4"),
        ((-3.0, -1.0), "3.0 mm too far towards row 1 and 1.0 mm towards column 1"),
    ],
)
def test_the_advice_names_direction_and_distance(offset, text):
    """The larger direction first; an insignificant one is left out."""
    assert advice(offset, (4, 5)) == text
