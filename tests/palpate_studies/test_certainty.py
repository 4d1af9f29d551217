"""The study `certainty`: figures on Gaussians with known values, and its command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_studies import certainty, uncertainty_report
from palpate_train.answer.calibrate import fit_calibration
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import uncertainty
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.fold import keep, kept
from palpate_train.evaluate.uncertainty import FIELDS, NONE_LEFT_OUT, Case
from palpate_train.models.methods import Effort
from tests.factories.calibration_inputs import plain_inputs

pytestmark = pytest.mark.slow

NAMES = ("a", "b", "c", "d")


def world(places: int, n: int, seed: int, apart: float = 6.0, first: int = 0):
    """Features [N, 10, 4] of four materials, which differ from the middle of the sweep on."""
    rng = np.random.default_rng(seed)
    labels = np.tile(np.repeat(np.arange(4), n), places)
    at = np.repeat(np.arange(places), 4 * n) + first
    grown = np.minimum(np.arange(1, 11) / 5, 1)
    means = apart / np.sqrt(2) * np.eye(4)  # any two are `apart`
    x = means[labels][:, None] * grown[:, None] + rng.standard_normal((len(labels), 1, 4))
    return x, labels, at


def case(left_out: int = NONE_LEFT_OUT, apart: float = 6.0, places: int = 3) -> Case:
    """A training on eight positions and a test on others."""
    x, y, at = world(8, 20, 1, apart)
    keep = y != left_out
    y = y - (y > left_out) * (left_out != NONE_LEFT_OUT)
    new, labels, there = world(places, 24, 2, apart, first=100)
    x, y, at = x[keep], y[keep], at[keep]
    seen = at % 2 == 1
    copied = x[:, -1] + np.random.default_rng(9).normal(0, 0.1, (len(x), 4))
    known = x, y, at[None], ~seen, True, copied, y, np.arange(len(y)), ~seen
    return Case(left_out, 2, *known, new, labels, there, np.zeros(len(y), bool))


@pytest.fixture(scope="module")
def figures():
    """All figures, with each material left out once."""
    held = [case(k) for k in (NONE_LEFT_OUT, 0, 1, 2, 3)]
    return json.loads(json.dumps(certainty.figures(held, NAMES)))


def test_error_is_the_gap_between_probability_and_accuracy():
    """0.9 with an accuracy of 0.7 is an error of 0.2; bins are weighted by their sweeps."""
    right = np.arange(100) < 70
    assert uncertainty.error(np.full(100, 0.9), right) == pytest.approx(0.2)
    assert uncertainty.error(np.full(100, 0.7), right) == pytest.approx(0)
    confidence = np.concatenate([np.full(50, 0.95), np.full(50, 0.55)])
    right = np.concatenate([np.ones(50, bool), np.arange(50) < 5])
    assert uncertainty.error(confidence, right) == pytest.approx(0.25)
    *_, last = uncertainty.reliability(np.array([1.0, 0.0]), np.array([True, False]))
    assert last == {"said": 1.0, "right": 1.0, "n": 1}


def test_temperature_scaling_corrects_an_overconfident_head():
    """Positions that shift the materials make LDA overconfident, which it corrects."""
    one = case(apart=2.5, places=12)
    # sweeps of one position close together: their scatter says little of other positions
    shift = 1.5 * np.random.default_rng(3).standard_normal((200, 1, 4))
    one = replace(one, seen=one.seen + shift[one.seen_groups[0]], new=one.new + shift[one.places])
    done = fit_calibration(plain_inputs(one.seen, one.seen_labels, one.seen_groups[0], one.held))
    figures = certainty.calibration(one, done)
    right = figures["accuracy"]["accuracy"]
    mean = {}
    for when in ("before", "after"):
        said, n = zip(*((b["said"], b["n"]) for b in figures[when]["bins"]), strict=True)
        mean[when] = np.average(said, weights=n)
    assert figures["n"] == sum(b["n"] for b in figures["after"]["bins"]) == 12 * 4 * 24
    assert done.temperature > 1.3
    assert mean["before"] > right + 0.1
    assert right < mean["after"] < mean["before"] - 0.1
    assert figures["after"]["error"] < 0.5 * figures["before"]["error"]
    assert figures["accuracy"]["low"] < right < figures["accuracy"]["high"]


def test_unknown_materials_are_detected_as_far_as_they_differ(figures):
    """Six deviations away AUROC is above 0.95; of equal materials 0.5."""
    for row in figures["unknown"]["materials"].values():
        assert row["low"] <= row["auroc"] <= row["high"]
        assert (row["known"], row["unknown"]) == (216, 72)
    assert 0.99 < figures["unknown"]["mean"]["auroc"] <= 1
    assert figures["unknown"]["mean"]["kept"] > 0.95
    held = [case(k, apart=0.0) for k in (0, 1)]
    assert abs(uncertainty.unknown(held, NAMES)["mean"]["auroc"] - 0.5) < 0.06


def test_early_needs_half_the_sweep_where_that_suffices(figures):
    """All is known at the fifth tenth: a share below 0.6, the accuracy of the whole."""
    early = figures["early"]
    assert early["share"] < 0.6
    assert abs(early["lost"]) <= 0.02
    assert len(early["always"]) == 10
    assert early["always"][0]["accuracy"] < early["always"][5]["accuracy"]


def test_of_two_materials_none_is_left_out():
    """The page has calibration and early answers, and nothing of left-out materials."""
    # What the page says of a run
    about = dict.fromkeys(uncertainty_report.ORIGIN, "x")
    one = case()
    two, test, also = one.seen_labels < 2, one.labels < 2, one.copied_labels < 2
    of_parts = {
        name: getattr(one, name)[part]
        for names, part in (
            ("seen seen_labels held faulty", two),
            ("copied copied_labels copied_held", also),
            ("new labels places", test),
        )
        for name in names.split()
    }
    source = np.cumsum(two)[one.copied_source[also]] - 1
    fewer = replace(one, seen_groups=one.seen_groups[:, two], copied_source=source, **of_parts)
    figures = certainty.figures([fewer], NAMES[:2])
    assert set(figures) == {"calibration", "early"}
    html, pictures = uncertainty_report.render(figures | about)
    assert set(pictures) == {"reliability"}
    assert "never trained<" not in html


def sweeps(materials: int = 3) -> Dataset:
    """Hums of different pitch at four positions, [128, 16, 1] float32 at 36 Hz."""
    rng = np.random.default_rng(0)
    labels = np.tile(np.repeat(np.arange(materials), 6), 4)
    t = np.arange(128)[:, None] / 36
    pitch = 2 * np.pi * (3 + 3 * labels)
    hum = np.stack([np.sin(w * t + rng.uniform(0, 6)) * rng.uniform(0.8, 1.2) for w in pitch])
    x = (hum[:, :, None] + rng.normal(0, 0.5, (len(labels), 128, 16, 1))).astype(np.float32)
    position = np.repeat(np.arange(4), 6 * materials)
    return Dataset(x, labels, tuple("abcd"[:materials]), 36.0, {"position": position}, "hums")


def split(hums: Dataset, first: int = 3) -> tuple[Dataset, Dataset]:
    """The sweeps of the `first` positions, and the others."""
    seen = hums.groups["position"] < first
    return hums.take(seen), hums.take(~seen)


@pytest.mark.thorough  # a whole study
def test_from_set_to_page_and_again_from_the_cache(tmp_path):
    """A study with a few iterations makes results and a page. A second run trains nothing."""
    halves, lines = split(sweeps()), []
    where = Where(jobs=1, cache=tmp_path / "cache")
    given = "palpate-pairs", where, lines.append, Effort(0.02)
    first = certainty.run(*halves, *given)
    assert first["trainings"] == 4
    assert "4/4 done" in lines[-2]
    assert sorted(uncertainty_report.render(first)[1]) == ["reliability"]
    kept = "palpate-pairs", replace(where, kept=True), lines.append, Effort(0.02)
    again = certainty.run(*halves, *kept)
    assert again | {"took_s": 0} == first | {"took_s": 0}
    with pytest.raises(FormatError, match="4 of 4"):
        certainty.run(*split(sweeps(), 2), *kept)


def test_methods_without_tenths_are_refused():
    """L-gauss has no trunk. The error says so."""
    where = Where(jobs=1, cache=None)
    with pytest.raises(FormatError, match="L-gauss"):
        certainty.run(*split(sweeps()), "L-gauss", where, print, Effort(0.02))


def test_a_case_lost_on_the_way_is_trained_again(tmp_path):
    """A broken cache file is not taken for a Case."""
    path = tmp_path / "x.case.npz"
    keep(path, vars(case(2)))
    found = Case(**(kept(path, FIELDS) or {}))
    assert found.left_out == 2
    assert np.array_equal(found.seen, case(2).seen)
    path.write_bytes(path.read_bytes()[:100])
    assert kept(path, FIELDS) is None
