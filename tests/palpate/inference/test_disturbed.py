"""Disturbed sweeps of known materials are known as far as the bundle allows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep, SweepFormat, Verdict
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from palpate.signal.disturbances import Allowance, Disturbances
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

CHANGES = np.float16([[[0, -20], [0, -20], [0, -40]], [[0, 0], [0, 0], [0, 0]]])
"""Lost frames move the second direction, "c" twice as far; hum moves nothing."""
ALLOWED = Disturbances((Allowance("lost", 0.0, 0.25, 2.0), Allowance("hum", 0.0, 3.0, 1.0)), 4.0)


def toy(tmp_path: Path, allowed: Disturbances = ALLOWED, **more) -> bundle.Bundle:
    arrays = toy_bundle.means(changes=CHANGES[: len(allowed.allowances)])
    return toy_bundle.load(tmp_path / "toy", arrays=arrays, disturbances=allowed, **more)


def answer(of: bundle.Bundle, sweep: Sweep) -> Verdict:
    return Classifier(of, VirtualClock())(sweep)


def lost(sweep: Sweep, frames: int) -> Sweep:
    return replace(sweep, lost=frames)


def test_the_means_move_with_the_disturbance(tmp_path: Path):
    """A fifth of the frames lost moves "a" by 4. A sweep there is at a distance of 16 from it, and
    with that loss on it. Without the loss it is unknown."""
    given, z = toy(tmp_path), toy_bundle.sweep(0, -4)
    assert answer(given, z).status is Status.UNKNOWN
    assert answer(given, lost(z, 4)).label == "a"
    away = answer(given, lost(toy_bundle.sweep(0, 4), 4))
    assert away.status is Status.UNKNOWN
    assert "limit 12.6" in away.detail


def test_the_limit_grows_with_the_disturbance(tmp_path: Path):
    """From 9 to 12.6 at a fifth."""
    given, z = toy(tmp_path), toy_bundle.sweep(3.4, -4)
    assert answer(given, lost(z, 4)).label
    assert "limit 12.6" in answer(given, lost(toy_bundle.sweep(0, -8), 4)).detail


def test_more_than_was_tried_is_unknown(tmp_path: Path):
    """The reason is said, although the sweep is on a mean."""
    verdict = answer(toy(tmp_path), lost(toy_bundle.sweep(0, 0), 6))
    assert (verdict.status, verdict.label) == (Status.UNKNOWN, "")
    assert verdict.detail == "more lost frames than was tried with this bundle"


def test_displaced_sweeps_are_allowed_the_same(tmp_path: Path):
    """In the turned embedding of displaced contacts."""
    arrays = toy_bundle.means(changes=CHANGES) | toy_bundle.displaced_arrays()
    place = replace(toy_bundle.IN_PLACE, limit_mm=0.001)
    more = {"displacement": toy_bundle.DISPLACEMENT, "contact": place}
    given = toy_bundle.load(tmp_path / "toy", arrays=arrays, disturbances=ALLOWED, **more)
    z = toy_bundle.sweep(1, -4)
    verdict = answer(given, z)
    assert verdict.displacement
    assert verdict.status is Status.UNKNOWN
    assert answer(given, lost(z, 4)).status is not Status.UNKNOWN


def test_an_enrolled_label_moves_as_the_others_do_on_average(tmp_path: Path):
    """By 5.3 with a fifth of the frames lost."""
    given = toy(tmp_path)
    sweeps = np.stack([toy_bundle.window(20, 20)] * 5)
    now = enrolment.enrol(given, "new", sweeps).bundle
    assert answer(now, toy_bundle.sweep(20, 20)).label == "new"
    moved = toy_bundle.sweep(20, 14.7)
    assert answer(now, moved).status is Status.UNKNOWN
    assert answer(now, lost(moved, 4)).label == "new"


def test_a_manifest_holds_what_was_tried_only_where_it_differs(tmp_path: Path):
    """Programs that do not know it read the others."""
    for tried in (None, 0.5):
        lost = replace(ALLOWED.allowances[0], tried=tried)
        allowed = replace(ALLOWED, allowances=(lost, *ALLOWED.allowances[1:]))
        text = replace(toy(tmp_path).manifest, disturbances=allowed).json()
        assert bundle.Manifest.parse(text).disturbances == allowed
        assert (b'"tried"' in text) == (tried is not None)


def test_hum_is_removed_and_said(tmp_path: Path):
    """A sweep with hum gets the answer of a sweep without it."""
    format = SweepFormat(2, 2, 750.0, 1500, "int16")
    given, clean = toy(tmp_path, format=format), toy_bundle.sweep(6, 0, format=format)
    times = np.arange(1500)[:, None, None] / 750
    noisy = clean.frames.taxels + 5 * np.sin(2 * np.pi * 50 * times)
    frames = replace(clean.frames, taxels=np.rint(noisy).astype(np.int16))
    verdict = answer(given, replace(clean, frames=frames))
    assert (verdict.label, verdict.detail) == ("b", "hum of 5.1 counts removed")
    assert answer(given, clean).detail == ""
    quiet = replace(ALLOWED, hum=None)
    kept = answer(toy(tmp_path, quiet, format=format), replace(clean, frames=frames))
    assert (kept.label, kept.detail) == ("b", "")


def test_a_material_is_enrolled_without_hum(tmp_path: Path):
    """Sweeps with hum and without it give the same mean, as they give the same answer."""
    format = SweepFormat(2, 2, 750.0, 1500, "int16")
    given = toy(tmp_path, format=format)
    clean = np.stack([toy_bundle.window(20, 20, format)] * 3)
    times = np.arange(1500)[:, None, None] / 750
    humming = np.rint(clean + 5 * np.sin(2 * np.pi * 50 * times)).astype(np.int16)
    plain, cleaned = (enrolment.enrol(given, "new", of).bundle for of in (clean, humming))
    assert plain.classes
    assert cleaned.classes
    assert cleaned.classes.means[-1] == pytest.approx(plain.classes.means[-1], abs=0.01)
    assert cleaned.golden[-1] == pytest.approx(plain.golden[-1], abs=1)


@pytest.mark.parametrize("changes", [CHANGES[:1], CHANGES[:, :2], CHANGES[:, :, :1]])
def test_changes_of_another_shape_are_refused(tmp_path: Path, changes: np.ndarray):
    """A row for each allowance, a column for each trained label."""
    arrays = toy_bundle.means(changes=changes)
    with pytest.raises(BundleError, match="holds changes float16"):
        toy_bundle.load(tmp_path / "toy", arrays=arrays, disturbances=ALLOWED)


def test_a_bundle_without_means_uses_no_allowances(tmp_path: Path):
    """They belong to the distances from class means."""
    files = toy_bundle.files(known=None, disturbances=ALLOWED)
    given = bundle.load(toy_bundle.put(tmp_path / "toy", files))
    assert answer(given, lost(toy_bundle.sweep(0, 0), 6)).label == "a"
