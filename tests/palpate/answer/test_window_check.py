"""Checks of a window without a model: each fault is named, and any window gets a status."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.answer.unloaded import UnloadedSkin
from palpate.answer.window import STAYS, Window, ceiling, inspect, inspect_bare, inspect_readings
from palpate.bundle.manifest import Thresholds
from palpate.core.types import Status, shape

LIMITS = Thresholds(contact=10, full_scale=255, saturated=0.01)
BARE = np.zeros((4, 4))


def moving(level: float = 80, shape: tuple[int, ...] = (300, 4, 4)) -> np.ndarray:
    """A window of a skin that is loaded everywhere and vibrates."""
    return np.random.default_rng(0).integers(level - 5, level + 5, shape).astype(np.uint8)


@pytest.mark.parametrize(
    ("place", "value", "status", "detail"),
    [
        (np.s_[:, 3], 0, Status.OK, ""),  # the last row is off the tube
        (np.s_[:, :, :], 0, Status.NO_CONTACT, "0.0 raw counts"),
        (np.s_[:, 1, 2], 90, Status.STUCK_TAXEL, "taxel 2.3"),
        (np.s_[:, 1, 2], 0, Status.DEAD_TAXEL, "taxel 2.3"),
        (np.s_[:, 0, 0], 0, Status.DEAD_TAXEL, "taxel 1.1"),
        (np.s_[:, 0, 1], 255, Status.SATURATED, "taxel 1.2"),
        (np.s_[:60, 2:, 2:], 255, Status.SATURATED, "taxel 3.3 3.4 4.3 4.4"),
    ],
)
def test_a_spoiled_window_is_named(place, value, status, detail):
    """Each kind of fault with its taxel, from 1; a loaded skin and allowed dead taxels pass."""
    taxels = moving()
    assert inspect(taxels, BARE, LIMITS).status is Status.OK
    taxels[place] = value
    found = inspect(taxels, BARE, LIMITS)
    assert found.status is status
    assert detail in found.detail
    if status is Status.DEAD_TAXEL:
        assert inspect(taxels, BARE, replace(LIMITS, dead_taxels=1)).status is Status.OK


def test_full_counts_and_windows_without_a_threshold():
    """The share of full counts of an accepted window; without a threshold all are loaded."""
    taxels = moving()
    taxels[:150, 0, 1] = 255
    found = inspect(taxels, BARE, replace(LIMITS, saturated=0.1))
    assert (found.status, found.full) == (Status.OK, 1 / 32)
    unknown = replace(LIMITS, contact=None)
    assert inspect(moving(6), BARE, unknown).status is Status.OK
    taxels = moving()
    taxels[:, 1, 2] = 0
    assert inspect(taxels, BARE, unknown).status is Status.STUCK_TAXEL


def test_an_amplifier_that_clips_below_full_scale():
    """Its ceiling is the highest count if two taxels stay there and one of them always does. One
    alone is stuck. A count that is reached now and then is a peak."""

    def clips(taxels: np.ndarray) -> float:
        return ceiling(Window(taxels), 255.0)

    taxels = moving()
    assert clips(taxels) == clips(np.minimum(taxels, 82)) == 255  # none is constant
    taxels[:, 2, 2] = 90
    assert clips(taxels) == 255
    assert clips(np.minimum(taxels, 82)) == 82
    brief = taxels.copy()
    brief[: int(STAYS * len(brief)) - 1, 1, 1] = 90
    assert clips(brief) == 255
    brief[: int(STAYS * len(brief)), 1, 1] = 90
    assert clips(brief) == 90
    taxels[:, 2, 3] = 90
    assert clips(taxels) == 90
    taxels[:, 2, 3] = 255
    assert clips(taxels) == 255
    numbers = moving().astype(np.float32)
    numbers[0, 0, 0] = np.nan
    assert clips(numbers) == 255


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_taxel_that_gives_no_number_is_dead(value):
    """One frame is enough, also at the edge, for any number of allowed dead taxels."""
    taxels = moving().astype(np.float32)
    taxels[150, 0, 3] = value
    found = inspect(taxels, BARE, replace(LIMITS, dead_taxels=3))
    assert (found.status, found.detail) == (Status.DEAD_TAXEL, "taxel 1.4")


SHEARED = np.zeros((4, 4, 3))
THREE = Thresholds(contact=10, full_scale=2000, saturated=0.01)


def sheared() -> np.ndarray:
    """A window with three axes: shear of both signs, and the normal axis loaded everywhere."""
    shear = np.random.default_rng(1).integers(-30, 30, (300, 4, 4, 2))
    return np.concatenate([shear, moving()[..., None]], axis=-1).astype(np.int16)


@pytest.mark.parametrize(
    ("place", "value", "status", "detail"),
    [
        (np.s_[:, :, :, 2], 3, Status.NO_CONTACT, "strongest taxel 3.0 raw counts"),
        (np.s_[:, 1, 2, 0], 7, Status.STUCK_TAXEL, "taxel 2.3 axis 1"),
        (np.s_[:, 1, 2, :2], 7, Status.STUCK_TAXEL, "taxel 2.3 axis 1 2"),
        (np.s_[:, 1, 2], 90, Status.STUCK_TAXEL, "taxel 2.3"),
        (np.s_[:, 1, 2:, 1], 0, Status.STUCK_TAXEL, "taxel 2.3 axis 2 and 2.4 axis 2"),
        (np.s_[:, 1, 2], 0, Status.DEAD_TAXEL, "taxel 2.3"),
        (np.s_[:, 1, 2, 2], 0, Status.DEAD_TAXEL, "taxel 2.3 axis 3"),
        (np.s_[:, 0, 1, 2], 2000, Status.SATURATED, "taxel 1.2 axis 3"),
        (np.s_[:, 0, 1, 0], 2000, Status.SATURATED, "taxel 1.2 axis 1"),
        (np.s_[:200, 0, 1, 0], -2000, Status.SATURATED, "taxel 1.2 axis 1"),
    ],
)
def test_a_spoiled_axis_is_named(place, value, status, detail):
    """Each kind of fault on one axis or all; a taxel whose every axis is meant stands alone."""
    taxels = sheared()
    assert inspect(taxels, SHEARED, THREE).status is Status.OK
    taxels[place] = value
    found = inspect(taxels, SHEARED, THREE)
    assert (found.status, found.detail) == (status, detail)


def test_axes_have_their_own_rules():
    """Contact is counted from the normal axis' tare; one of shear does not matter. A shear axis
    that gives no number is dead. A tared skin may be pulled: the normal axis is saturated only at
    its upper end."""
    taxels, tare = sheared(), SHEARED.copy()
    tare[..., :2] = 500
    assert inspect(taxels, tare, THREE).status is Status.OK
    tare[..., 2] = 75
    assert inspect(taxels, tare, THREE).status is Status.NO_CONTACT
    broken = taxels.astype(np.float32)
    broken[9, 3, 0, 1] = np.nan
    assert inspect(broken, SHEARED, THREE).detail == "taxel 4.1 axis 2"
    taxels[:, 3, 3, 2] = np.where(np.arange(300) % 2, -2000, -1999)
    assert inspect(taxels, SHEARED, THREE).status is Status.OK


@given(
    st.tuples(st.integers(1, 40), st.integers(1, 5), st.integers(1, 5), st.integers(1, 4)),
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
)
def test_any_window_gets_a_status(sizes, spread, seed):
    """Any counts of any shape, one frame long or constant: a status, never an error."""
    n, *rest = sizes
    form = shape(*rest)
    taxels = np.random.default_rng(seed).integers(0, spread + 1, (n, *form)).astype(np.uint8)
    assert inspect(taxels, np.zeros(form), LIMITS).status in Status


UNLOADED = UnloadedSkin.measured(
    np.random.default_rng(1).integers(9, 12, (100, 4, 4)).astype(np.uint8)
)


@pytest.mark.parametrize(
    ("place", "value", "status", "detail"),
    [
        (np.s_[:, :, :], 10, Status.NO_CONTACT, "raw counts"),
        (np.s_[:, 1, 2], 90, Status.STUCK_TAXEL, "taxel 2.3"),
        (np.s_[:, 1, 2], 10, Status.DEAD_TAXEL, "taxel 2.3"),
        (np.s_[:, 0, 1], 255, Status.SATURATED, "taxel 1.2"),
    ],
)
def test_faults_are_found_without_a_bundle(place, value, status, detail):
    """By comparison with the unloaded skin; saturation by the highest count."""
    taxels = moving()
    assert inspect_bare(taxels, UNLOADED).status is Status.OK
    taxels[place] = value
    found = inspect_bare(taxels, UNLOADED)
    assert found.status is status
    assert detail in found.detail


def test_a_touch_is_a_difference_from_the_unloaded_skin():
    """In either direction, or a vibration, also if its mean equals that of a stretch taken for the
    unloaded skin, such as a finger at rest. Constant taxels next to the contact are no fault."""
    falling = UnloadedSkin(np.full((4, 4), 200.0), np.ones((4, 4)), 5.0)
    assert inspect_bare(moving(80), falling).status is Status.OK
    assert inspect_bare(np.full((300, 4, 4), 201, np.uint8), falling).status is Status.NO_CONTACT
    at_rest = UnloadedSkin(np.full((4, 4), 80.0), np.full((4, 4), 0.3), 2.0)
    assert inspect_bare(moving(80), at_rest).status is Status.OK
    edge = moving(120)
    edge[:, 3] = 13
    assert inspect_bare(edge, UNLOADED).status is Status.OK


@pytest.mark.parametrize(
    ("bits", "status"), [(10, Status.SATURATED), (12, Status.SATURATED), (11, Status.OK)]
)
def test_the_full_scale_of_usual_converters(bits, status):
    """Ten bits in sixteen are saturated at 1023; an unusual limit is not guessed."""
    taxels = moving().astype(np.uint16)
    taxels[::10, 1:3, 1:3] = 2**bits - 1
    assert inspect_bare(taxels, UNLOADED).status is status


@pytest.mark.parametrize("value", [1e20, -3e15, np.inf, np.nan])
def test_one_impossible_reading_kills_its_taxel(value):
    """With a bundle, without, and before the unloaded skin is known."""
    taxels = moving().astype(np.float32)
    taxels[17, 1, 2] = value
    bare = UnloadedSkin(np.zeros((4, 4)), np.ones((4, 4)), 10.0)
    checks = (inspect(taxels, BARE, LIMITS), inspect_bare(taxels, bare), inspect_readings(taxels))
    assert {(one.status, one.detail) for one in checks} == {(Status.DEAD_TAXEL, "taxel 2.3")}
    for dtype in (np.uint8, np.float32):
        assert inspect_readings(moving().astype(dtype)).status is Status.OK
