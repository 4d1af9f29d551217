"""A taught bundle has no rule that its sweeps cannot carry."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate_train.answer.rules import ALL
from palpate_train.data.sets import Dataset
from palpate_train.export import fit_rules
from palpate_train.export.contents import Content
from palpate_train.teach.lesson import Lesson
from palpate_train.teach.taught import teach
from tests.factories.sweep_sets import easy


def lesson(sweeps: Dataset) -> Lesson:
    """The lesson of a set."""
    plain = replace(sweeps, groups={"recording": np.arange(len(sweeps))})
    return Lesson(plain, tuple(map(str, range(len(sweeps)))), {})


@pytest.mark.slow
def test_no_early_rule_where_its_limits_cannot_be_found(tmp_path: Path):
    """Few sweeps are held out: their number is said, and no prefix has been looked at."""
    made = teach(lesson(easy(8)), tmp_path / "few", "1", {}, lambda *news: None)
    assert made.early is None
    assert "sweeps were held out, and its limits need 40" in made.made["early"]


@pytest.mark.slow
def test_early_answers_of_a_taught_bundle_need_motion_in_each_tenth(tmp_path: Path):
    """Its limits of fewer sweeps than a whole window needs are for unfinished sweeps."""
    made = teach(lesson(easy(70)), tmp_path / "many", "1", {}, lambda *news: None)
    assert made.early
    assert made.sliding
    assert len(made.sliding.least) == 3
    assert not made.sliding.whole


def test_no_early_rule_where_slides_are_like_rests():
    """Neither vibration nor pattern tells them apart; the reason is said."""
    packed = bundle.load(bundle.DEFAULT)
    bare = replace(packed, manifest=replace(packed.manifest, sliding=None))
    sweeps = easy(3)
    content = Content(None, "raw", sweeps, sweeps, "recording", {})
    for given, early in ((packed, packed.manifest.early), (bare, None)):
        assert fit_rules.from_answers(content, given, False, ALL).manifest.early == early
    late = fit_rules.from_answers(content, bare, False, ALL).manifest
    assert "rests" in late.made["early"]
