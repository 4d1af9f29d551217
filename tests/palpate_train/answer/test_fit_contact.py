"""Contact limits and contact positions of a training set."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.contact import ContactPositions, centre
from palpate.sim import skin
from palpate_train.answer.fit_contact import ContactLimit, Contacts, find_centres, find_limit
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from tests.factories.contacts import TARE, counts, patch

LOADS = ContactLimit(5.0, TARE)
REST = 20_000
"""Raw counts of an unloaded skin."""


def trained(*places: tuple[float, float], group: str = "position", each: int = 2) -> Dataset:
    """A set with `each` sweeps at each of these positions, in taxels."""
    samples = np.stack([np.stack([patch(*at)] * 3) for at in places for _ in range(each)]).astype(
        np.float32
    )
    n = len(samples)
    numbers = {group: 7 + 2 * (np.arange(n) // each)}
    return Dataset(samples, np.arange(n) % 2, ("a", "b"), 100.0, numbers, "recorded")


def positions_of(
    sweeps: Dataset, limit: ContactLimit, pitch_mm: float | None = None
) -> ContactPositions | None:
    """The contact positions of a set in which a load is above `limit`."""
    found = replace(Contacts.of(sweeps), limit=limit, centres=find_centres(sweeps, limit))
    return found.positions(pitch_mm)


def test_the_places_of_a_training_set():
    """One centre a position, in mm, else a recording or a sweep; None without pitch."""
    at = [(1.5, 1.5), (1.0, 1.5), (2.0, 2.0)]
    for group, each, entries in (("position", 2, 3), ("recording", 2, 3), ("force", 2, 6)):
        found = positions_of(trained(*at, group=group, each=each), LOADS, pitch_mm=2.0)
        assert (found.pitch_mm, len(found.rows_mm)) == (2.0, entries)
        every = [at[i * len(at) // entries] for i in range(entries)]
        want = [centre(counts(patch(*one)), TARE, 5.0) for one in every]
        assert np.stack([found.rows_mm, found.cols_mm], 1) == pytest.approx(
            2.0 * np.array(want), abs=1e-3
        )
    assert positions_of(trained((1.5, 1.5)), LOADS) is None
    assert positions_of(trained((1.5, 1.5)), ContactLimit(500.0, TARE), pitch_mm=4.0) is None
    both = sets.join([sets.load("sim:T-LAB:1:1"), sets.load("sim:T-LAB:2:1")])
    found = positions_of(both, LOADS)
    assert found.pitch_mm == skin.PITCH_MM
    assert len(found.rows_mm) == 2
    assert np.stack([found.rows_mm, found.cols_mm]) == pytest.approx(np.full((2, 2), 6.0), abs=1.5)


def test_each_position_is_left_out_and_many_are_thinned():
    """The farthest sweep from the others, or an eighth of the pitch; at most a thousand."""
    found = positions_of(trained((1.5, 1.5), (1.5, 1.7), (1.5, 2.1)), LOADS, pitch_mm=4.0)
    assert found.limit_mm == pytest.approx(found.cols_mm[2] - found.cols_mm[1], abs=0.01)
    for positions in ([(1.5, 1.5)], [(1.5, 1.5)] * 3):
        assert positions_of(trained(*positions), LOADS, pitch_mm=4.0).limit_mm == 0.5
    found = positions_of(
        trained(*[(1.5, 1 + i / 1100) for i in range(1100)], each=1), LOADS, pitch_mm=4.0
    )
    assert len(found.rows_mm) == 1000
    assert np.median(np.diff(found.cols_mm)) < 0.02
    assert found.cols_mm[0] == 4.0
    assert found.cols_mm[-1] > 7.9


def known(drift: float = 0.0, load: float = 1000.0) -> Dataset:
    """Eight sweeps [50, 2, 2], the strongest taxel `load` above a skin that rises by `drift`."""
    rng, n = np.random.default_rng(7), 8
    rest = REST + drift * np.arange(n).reshape(-1, 1, 1, 1)
    samples = rest + rng.normal(0, 3, (n, 50, 2, 2))
    samples[:, :, 0, 0] += load
    level, noise = np.broadcast_to(rest, (n, 1, 2, 2)), np.full((n, 1, 2, 2), 3.0)
    samples = np.rint(samples).astype(np.uint16)
    unloaded = np.concatenate([level, noise], axis=1)
    return Dataset(samples, np.arange(n) % 2, ("a", "b"), 50.0, {}, "known", unloaded)


def test_a_load_is_above_the_unloaded_skin():
    """A tenth of the weakest contact, at least drift plus noise."""
    found = find_limit(known())
    assert found.contact == pytest.approx(100, abs=1)
    assert found.tare.tolist() == np.full((2, 2), REST).tolist()
    assert find_limit(known(load=100)).contact == 5 * 3.0
    assert find_limit(known(drift=40)).contact == pytest.approx(3.5 * 40 + 5 * 3)
    some = known()
    some.samples[0] = REST
    some.unloaded[0] = np.nan
    assert find_limit(some).contact == pytest.approx(100, abs=1)


@pytest.mark.parametrize(
    "how", [{"load": 12.0}, {"drift": 400.0}, {"load": -1000.0}], ids=["weak", "drift", "falling"]
)
def test_what_does_not_separate_is_said(how: dict[str, float]):
    """Contacts as weak as noise, a larger drift, falling counts: no limit, but a reason."""
    found = find_limit(known(**how))
    assert found.contact is None
    assert not found.tare.any()
    assert re.search(r"reads -?[\d.]+ counts", found.why)
    assert "send TARE" in found.why


def test_a_baseline_of_which_nothing_is_known_is_said():
    """Counts that can be loads are taken as loads; else None, and for a single taxel."""
    high = replace(known(), unloaded=None)
    found = find_limit(high)
    assert found.contact is None
    assert "than 199" in found.why
    assert "send TARE" in found.why
    every = np.full_like(known().unloaded, np.nan)
    assert find_limit(replace(high, unloaded=every)).why == found.why
    low = replace(high, samples=high.samples - np.uint16(REST - 100))
    assert find_limit(low).contact == pytest.approx(110, abs=1)
    one = replace(high, samples=high.samples[:, :, :1, :1])
    assert find_limit(one).contact == pytest.approx((REST + 1000) / 10, rel=0.01)


@pytest.mark.parametrize("baseline", [False, True], ids=["contacts", "no-limit"])
def test_contacts_survive_their_file(baseline: bool):
    """Arrays and figures, as JSON, give the same limit and centres; also without a limit."""
    sweeps = known()
    contacts = Contacts.of(replace(sweeps, unloaded=None) if baseline else sweeps)
    assert (contacts.limit.contact is None) == (contacts.centres is None) == baseline
    again = Contacts.read(contacts.arrays(), json.loads(json.dumps(contacts.figures())))
    assert again.positions(4.0) == contacts.positions(4.0)
    assert (again.limit.contact, again.limit.why) == (contacts.limit.contact, contacts.limit.why)
    assert again.limit.tare.tolist() == contacts.limit.tare.tolist()
