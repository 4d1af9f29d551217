"""The slides of training: the range of speeds, vibrations and patterns."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.slide import CHANCE
from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate_train.answer import fit_slide
from palpate_train.answer.fit_slide import trained_speeds
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from tests.factories import toy_bundle


def test_the_range_covers_nearly_all_sweeps_or_has_a_reason():
    """Two wrong of a hundred do not widen it; without pitch, sweeps or slides none."""

    def swept(speeds: list[float]) -> Dataset:
        """One simulated sweep at each multiple of 30 mm/s."""
        windows = []
        for i, speed in enumerate(speeds):
            rng, world = np.random.default_rng(i), replace(skin.WORLD, speed=speed)
            windows.append(skin.window("plastic rough", skin.Placement(), rng, world))
        labels = np.zeros(len(windows), np.int64)
        groups = {"recording": np.arange(len(windows))}
        return Dataset(np.array(windows), labels, skin.MATERIALS, 750.0, groups, "mine")

    found, why = trained_speeds(swept([1.0, 2.0] * 4 + [1.5]), skin.PITCH_MM)
    assert found
    assert (found.least_mm_s, found.most_mm_s) == pytest.approx((30.0, 60.0), rel=0.03)
    assert why == ""
    found, _ = trained_speeds(swept([1.0] * 98 + [0.6, 3.0]), skin.PITCH_MM)
    assert found
    assert (found.least_mm_s, found.most_mm_s) == pytest.approx((30.0, 30.0), rel=0.05)
    sweeps = swept([1.0] * 6)
    resting = replace(sweeps, samples=np.repeat(sweeps.samples[:, :1], 1500, axis=1))
    for trained, pitch_mm, why in (
        (sweeps, None, "--pitch-mm"),
        (swept([1.0] * 4), skin.PITCH_MM, "4 of 4"),
        (resting, skin.PITCH_MM, "0 of 6"),
    ):
        found, said = trained_speeds(trained, pitch_mm)
        assert found is None
        assert why in said


def test_limits_come_from_training_sweeps(monkeypatch: pytest.MonkeyPatch):
    """No part of a training sweep rests by them; still parts and nine sweeps give none."""
    train = sets.load("sim:T-REAL/level-blind:41:1")
    bare = replace(bundle.load(bundle.DEFAULT).manifest, sliding=None, early=None)
    monkeypatch.setattr(fit_slide, "_pattern", lambda train: None)
    assert fit_slide.limited(bare, train) is bare
    monkeypatch.setattr(fit_slide, "FEWEST_SLIDES", 9)
    found = fit_slide.limited(bare, train)
    assert found.sliding
    assert len(found.sliding.least) == 6
    assert "each tenth" in fit_slide.text(found)
    assert "not noticed" in fit_slide.text(bare)
    still = train.samples.copy()
    still[3, :150] = 80
    assert fit_slide.limited(bare, replace(train, samples=still)) is bare
    assert fit_slide.limited(bare, train.select(("material=metal,wood",))) is bare


def test_early_answers_of_few_sweeps_need_motion_in_each_tenth():
    """Nine sweeps limit unfinished windows alone, and stay where whole ones do not need them."""
    train = sets.load("sim:T-REAL/level-blind:41:1")
    made = bundle.load(bundle.DEFAULT)
    few = fit_slide.limited(replace(made.manifest, sliding=None), train)
    assert few.sliding
    assert (len(few.sliding.least), few.sliding.whole) == (6, False)
    assert "unfinished" in fit_slide.text(few)
    less = fit_slide.without_vibration(made).manifest
    assert less.sliding
    assert (len(less.sliding.least), less.sliding.whole) == (6, False)
    late = fit_slide.without_vibration(replace(made, manifest=replace(made.manifest, early=None)))
    assert late.manifest.sliding
    assert (late.manifest.sliding.least, late.manifest.sliding.whole) == ((), True)


def test_the_packaged_bundle_sees_a_slide_that_ends_early():
    """Every sweep of a trained place is answered; half of them at rest, nearly none is."""
    box = Classifier(bundle.load(bundle.DEFAULT), SystemClock())
    test = sets.load("sim:T-REAL/level-blind:43:1")
    statuses = []
    for counts in test.samples[::3]:
        rest = counts.copy()
        rest[750:] = np.rint(counts[750:].mean(axis=0))
        rest[750::2, 0, 0] += 1  # no taxel is stuck
        rest[750::3] += 1
        n = np.arange(len(rest))
        frames = replace(toy_bundle.sweep(0, 0).frames, t_ns=n, seq=n, taxels=rest)
        statuses.append(box(replace(toy_bundle.sweep(0, 0), frames=frames)).status)
    assert statuses.count(Status.OK) <= 2


def test_slides_need_a_pattern_where_training_always_showed_one():
    """Also with one sweep of each; without a pattern or with two taxels no limit."""
    bare = replace(bundle.load(bundle.DEFAULT).manifest, sliding=None, early=None)
    train = sets.load("sim:T-LAB/level-blind:3:1")
    found = fit_slide.limited(bare, train)
    assert found.sliding
    assert (found.sliding.least, found.sliding.pattern) == ((), CHANCE)
    assert "whole window" in fit_slide.text(found)
    confused = np.random.default_rng(1).permuted(train.samples, axis=1)
    assert fit_slide.limited(bare, replace(train, samples=confused)) is bare
    few = replace(train, samples=train.samples[:, :, :1, :2])
    assert fit_slide.limited(bare, few) is bare
