"""The least vibration of each material in training tells a slide from a rest."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.slide import CHANCE
from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate_train.answer import fit_slide
from palpate_train.data import sets
from tests.factories import toy_bundle


def test_limits_come_from_training_sweeps(monkeypatch: pytest.MonkeyPatch):
    """No part of a training sweep rests by them; still parts and nine sweeps give none."""
    train = sets.load("sim:T-REAL/level-blind:41:1")
    bare = replace(bundle.load(bundle.DEFAULT).manifest, sliding=None)
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
    bare = replace(bundle.load(bundle.DEFAULT).manifest, sliding=None)
    train = sets.load("sim:T-LAB/level-blind:3:1")
    found = fit_slide.limited(bare, train)
    assert found.sliding
    assert (found.sliding.least, found.sliding.pattern) == ((), CHANCE)
    assert "whole window" in fit_slide.text(found)
    confused = np.random.default_rng(1).permuted(train.samples, axis=1)
    assert fit_slide.limited(bare, replace(train, samples=confused)) is bare
    few = replace(train, samples=train.samples[:, :, :1, :2])
    assert fit_slide.limited(bare, few) is bare
