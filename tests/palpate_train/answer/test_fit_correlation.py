"""The least correlations of slides come from noise that is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.correlation import Correlations
from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate_train.answer.fit_correlation import limits
from palpate_train.data import sets
from palpate_train.data.junk import windows
from palpate_train.metrics import bundle_score
from palpate_train.teach.lesson import Lesson
from palpate_train.teach.taught import teach


@pytest.mark.slow
def test_three_sweeps_of_a_material_teach_what_noise_is(tmp_path: Path):
    """Kinds of junk by which no limit was found are refused as well; slides elsewhere are not."""
    given, others = (
        sets.load(f"sim:T-REAL/level-blind:{seed}:1").select(("position<=2",)) for seed in (1, 2)
    )
    plain = replace(given, groups={"recording": np.arange(len(given))})
    teach(Lesson(plain, tuple(map(str, range(len(given)))), {}), tmp_path / "b", "1", {}, print)
    box = Classifier(bundle.load(tmp_path / "b"), SystemClock(), slides=False)
    assert box.bundle.manifest.correlations
    alone = replace(
        box.bundle.manifest,
        sliding=None,
        known=replace(box.bundle.manifest.known, balanced=1e29, loose=1e30),
    )
    box = Classifier(replace(box.bundle, manifest=alone), SystemClock(), slides=False)
    for kind in ("load and noise", "random phases", "stops halfway"):
        made = windows(kind, others, 12, np.zeros((4, 4)), 5)
        answers = bundle_score.verdicts(box, replace(others.take(np.arange(12)), samples=made))
        assert sum(v.status is Status.NO_SLIDE for _, v in answers) >= 8
    refused = [v.status is Status.NO_SLIDE for _, v in bundle_score.verdicts(box, others)]
    assert not any(refused)


def test_slides_that_are_like_noise_have_no_limit():
    """Nor do few frames; no held-out slide lies below a limit."""
    sweeps = sets.load("sim:T-REAL:1:1")
    noise = np.random.default_rng(0).integers(0, 200, sweeps.samples.shape).astype(np.uint8)
    assert limits(replace(sweeps, samples=noise), sweeps) == Correlations()
    assert limits(sweeps, replace(sweeps, samples=noise)) == Correlations()
