"""The centre of a contact, the advice that follows from it, and the positions that a bundle holds."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from appliance.bundle.bundle import Bundle, Manifest
from appliance.core.clock import SystemClock
from appliance.core.errors import BundleError, FormatError
from appliance.core.types import Status, Verdict
from appliance.inference.classifier import Classifier
from appliance.io.robot_link import MAX_LINE, result
from appliance.signal.contact import ContactPositions, advice, centre, fill_dead_taxels, moved
from appliance.sim import skin
from train.data import sets
from train.data.sets import Dataset
from train.export import contact_positions
from train.reports import contact_plot

TARE = np.zeros((4, 4))
MIDDLE = ContactPositions(4.0, (6.0, 6.4), (6.0, 5.8), 0.6)
NAN, INF = float("nan"), float("inf")


def counts(load: Any) -> np.ndarray:
    """Frames [2, R, C] with this load."""
    return np.stack([np.asarray(load, float)] * 2)


def patch(row: float, col: float) -> np.ndarray:
    """Loads of a round contact with its centre there, in taxels; 1.2 taxels wide each way."""
    r, c = np.mgrid[0:4, 0:4]
    return np.maximum(0, 100 * (1 - ((r - row) ** 2 + (c - col) ** 2) / 1.3**2))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"pitch_mm": 0.0}, "pitch_mm"),
        ({"pitch_mm": NAN}, "pitch_mm"),
        ({"pitch_mm": "4"}, "pitch_mm"),
        ({"limit_mm": -1.0}, "limit_mm"),
        ({"limit_mm": INF}, "limit_mm"),
        ({"pitch_mm": 1e7}, "pitch_mm"),
        ({"rows_mm": (6.0, -1e7)}, "rows_mm"),
        ({"limit_mm": True}, "limit_mm"),
        ({"rows_mm": ()}, "rows_mm"),
        ({"rows_mm": (6.0, NAN)}, "rows_mm"),
        ({"rows_mm": [6.0, 6.4]}, "rows_mm"),
        ({"cols_mm": (6.0, None)}, "cols_mm"),
        ({"cols_mm": (6.0,)}, "1 cols_mm"),
        ({"rows_mm": (6.0,) * 1001, "cols_mm": (6.0,) * 1001}, "1000"),
    ],
)
def test_a_place_that_makes_no_sense_is_refused(wrong: dict[str, Any], message: str):
    """Values that are no numbers, not finite, too many or not in pairs: a BundleError that names them."""
    with pytest.raises(BundleError, match=re.escape(message)):
        replace(MIDDLE, **wrong)


def test_a_place_goes_through_the_manifest(default_bundle: Bundle):
    """Written as JSON and read again it is the same."""
    manifest = replace(default_bundle.manifest, place=MIDDLE, schema=3)
    assert Manifest.parse(manifest.json()).place == MIDDLE


@pytest.mark.parametrize("at", [(1.5, 1.5), (1.0, 2.0), (1.8, 1.4), (2.0, 1.0)])
def test_the_centre_of_a_contact_that_lies_on_the_skin(at: tuple[float, float]):
    """It is found to 0.15 of a taxel, with any tare and any load below the contact threshold."""
    load = patch(*at)
    for tare in (TARE, np.arange(16.0).reshape(4, 4)):
        noisy = load + tare + 4 * (np.indices((4, 4)).sum(0) == 6)
        assert centre(counts(noisy), tare, 5.0) == pytest.approx(at, abs=0.15)


def test_without_contact_there_is_no_centre():
    """Below the threshold, or where a floating-point skin gives no number: None, and nothing is moved."""
    for load in (np.full((4, 4), 4.9), np.full((4, 4), NAN), np.full((4, 4), -80.0)):
        assert centre(counts(load), TARE, 5.0) is None
        assert moved(counts(load), TARE, 5.0, MIDDLE) == ""
    one = np.where(np.indices((4, 4)).sum(0) == 6, INF, patch(1.5, 1.5))
    assert centre(counts(one), TARE, 5.0) == pytest.approx((1.5, 1.5))


def test_a_threshold_below_zero_takes_no_pulled_taxel_along():
    """A tared skin's threshold may be negative; a taxel with negative load has no weight."""
    load = np.array([[-3.0, 0, 0, 0], [0, 50, 50, 0], [0, 50, 50, 0], [0, 0, 0, -3]])
    assert centre(counts(load), TARE, -10.0) == (1.5, 1.5)


@pytest.mark.parametrize("dead", [(1, 1), (2, 2), (1, 0), (0, 2)])
def test_a_dead_taxel_does_not_push_the_centre_away(dead: tuple[int, int]):
    """Silent between two loaded ones it is filled in: the centre stays within 0.15 taxels; without that it would
    not."""
    load = patch(1.5, 1.5) + 30
    whole = np.array(centre(counts(load), TARE, 5.0))
    load[dead] = 0
    there = np.array(centre(counts(load), TARE, 5.0))
    assert np.hypot(*(there - whole)) < 0.15
    silent = np.array([(load.sum(a) @ np.arange(4)) / load.sum() for a in (1, 0)])
    assert np.hypot(*(silent - whole)) > 2 * np.hypot(*(there - whole))


def test_the_rim_of_a_contact_is_not_filled_in():
    """A silent taxel beside the contact, or at its corner, stays silent."""
    load = np.zeros((4, 4))
    load[1:3, 0:3] = 50
    load[1, 2] = 0
    assert (fill_dead_taxels(load) == load).all()


@pytest.mark.parametrize(
    ("along", "axis", "towards"), [("dx_mm", 0, ("row 4", "row 1")), ("dy_mm", 1, ("column 4", "column 1"))]
)
def test_the_advice_follows_the_simulated_skin(along: str, axis: int, towards: tuple[str, str]):
    """The further forward the skin is, the further back is the centre; the advice names the right end."""
    found = []
    for mm in (-4.0, -3.0, 0.0, 3.0, 4.0):
        window = skin.window("wood", skin.Placement(**{along: mm}, seed=3), np.random.default_rng(0))[:200]
        found.append(centre(window, TARE, 5.4)[axis])
        text = moved(window, TARE, 5.4, MIDDLE)
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
def test_the_advice_names_direction_and_distance(offset: tuple[float, float], text: str):
    """The larger direction first; an insignificant one is left out."""
    assert advice(offset, (4, 5)) == text


def test_the_nearest_position_counts():
    """Distance is to the nearest position, not to their middle; the limit itself is within."""
    two = ContactPositions(2.0, (0.0, 6.0), (0.0, 0.0), 0.5)
    assert two.offset((3.1, 0.0)) == pytest.approx((0.2, 0.0))
    assert two.within((0.3, -0.4))
    assert not two.within((0.3, -0.41))


def test_a_sentence_keeps_what_matters_most_of_the_advice():
    """If a RES sentence is cut at 128 characters, the larger direction is still in it."""
    detail = f"moved {advice((-12.5, 11.5), (4, 4))}"
    scores = np.array([0.98, 0.02])
    v = Verdict(12345, 10**14, Status.OK, "plastic rough", 0.98, 0.96, scores, 1, 0, 400_000, "9f3c2a1b", detail)
    line = result(v, "usb")
    assert len(line) <= MAX_LINE
    assert b"moved 12.5 mm too far towards row 1" in line


@pytest.fixture
def model(default_bundle: Bundle) -> Bundle:
    """The default bundle, with trained positions."""
    return replace(default_bundle, manifest=replace(default_bundle.manifest, place=MIDDLE, schema=3))


def trained(*places: tuple[float, float], group: str = "position", each: int = 2) -> Dataset:
    """A set with `each` sweeps at each of these places, in taxels."""
    samples = np.stack([np.stack([patch(*at)] * 3) for at in places for _ in range(each)]).astype(np.float32)
    n = len(samples)
    numbers = {group: 7 + 2 * (np.arange(n) // each)}
    return Dataset(samples, np.arange(n) % 2, ("a", "b"), 100.0, numbers, "recorded")


def test_the_places_of_a_training_set():
    """One entry per position, in mm; without numbered positions per recording; without both per sweep."""
    at = [(1.5, 1.5), (1.0, 1.5), (2.0, 2.0)]
    for group, each, entries in (("position", 2, 3), ("recording", 2, 3), ("force", 2, 6)):
        found = contact_positions.place_of(trained(*at, group=group, each=each), 5.0, pitch_mm=2.0)
        assert (found.pitch_mm, len(found.rows_mm)) == (2.0, entries)
        every = [at[i * len(at) // entries] for i in range(entries)]
        want = [centre(counts(patch(*one)), TARE, 5.0) for one in every]
        assert np.stack([found.rows_mm, found.cols_mm], 1) == pytest.approx(2.0 * np.array(want), abs=1e-3)


def test_the_limit_leaves_each_position_out():
    """It is the largest distance of a sweep from the other positions; with one position an eighth of the pitch."""
    found = contact_positions.place_of(trained((1.5, 1.5), (1.5, 1.7), (1.5, 2.1)), 5.0, pitch_mm=4.0)
    assert found.limit_mm == pytest.approx(found.cols_mm[2] - found.cols_mm[1], abs=0.01)
    for positions in ([(1.5, 1.5)], [(1.5, 1.5)] * 3):
        assert contact_positions.place_of(trained(*positions), 5.0, pitch_mm=4.0).limit_mm == 0.5


def test_many_positions_are_thinned():
    """A bundle has at most a thousand; of more, evenly spaced ones."""
    found = contact_positions.place_of(trained(*[(1.5, 1 + i / 1100) for i in range(1100)], each=1), 5.0, pitch_mm=4.0)
    assert len(found.rows_mm) == 1000
    assert np.median(np.diff(found.cols_mm)) < 0.02
    assert found.cols_mm[0] == 4.0
    assert found.cols_mm[-1] > 7.9


def test_sets_without_positions():
    """Without a pitch, or without contact, there are none; simulated sets have theirs."""
    assert contact_positions.place_of(trained((1.5, 1.5)), 5.0) is None
    assert contact_positions.place_of(trained((1.5, 1.5)), 500.0, pitch_mm=4.0) is None
    both = sets.join([sets.load("sim:T-LAB:1:1"), sets.load("sim:T-LAB:2:1")])
    found = contact_positions.place_of(both, 5.0)
    assert found.pitch_mm == skin.PITCH_MM
    assert len(found.rows_mm) == 2
    assert np.stack([found.rows_mm, found.cols_mm]) == pytest.approx(np.full((2, 2), 6.0), abs=1.5)


@pytest.mark.slow
def test_moving_is_measured(model: Bundle, monkeypatch: pytest.MonkeyPatch):
    """A skin in place is not flagged, one that is a row forward always is; figures, picture and lines agree."""
    monkeypatch.setattr(contact_positions, "OFF_MM", (5.0,))
    wide = replace(model, manifest=replace(model.manifest, place=ContactPositions(4.0, (5.5,), (6.0,), 1.2)))
    figures = contact_positions.measure(
        Classifier(wide, SystemClock()), "sim:T-LAB:3:2", "sim:T-LAB:1:1", "sim:T-HARD:1:1", lambda line: None
    )
    assert figures["other positions"]["moved"][0] == 0
    assert figures["T-HARD"]["moved"][0] == 1
    back, home, ahead = figures["moved"]["rows"]
    assert (back["mm"], home["mm"], ahead["mm"]) == (-5, 0, 5)
    assert home["accuracy"] == figures["other positions"]["accuracy"]
    assert (home["n"], home["attachments"], home["moved"][0], ahead["moved"][0]) == (12, 1, 0, 1)
    assert back["told_mm"] > ahead["told_mm"] + 0.5  # the trained place is a little ahead
    assert ahead["accuracy"][0] < home["accuracy"][0] > 0.8
    assert figures["rows, forwards"]["lost_at_mm"] == 5
    assert ahead["told_mm"] > 1.2 > home["told_mm"]
    text = "\n".join(contact_positions.lines(figures))
    assert "rows +5.0 mm" in text
    assert "flagged" in contact_plot.draw(figures)
    with pytest.raises(FormatError, match="no positions"):
        contact_positions.measure(
            Classifier(replace(wide, manifest=replace(wide.manifest, place=None)), SystemClock()), "", "", "", print
        )
