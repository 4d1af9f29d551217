"""The published series that aeon ships: their format, their splits, and the messages if they are
missing."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import published, sets, summary
from palpate_train.data.splitters import Protocol


@pytest.mark.slow
@pytest.mark.parametrize("name", published.SETS)
def test_a_set_has_the_published_split_and_what_the_list_says(name: str):
    """Numbers of sweeps, classes, frames and channels; each sweep is a recording; the training part
    is split 0."""
    pytest.importorskip("aeon")
    s = sets.load(f"aeon:{name}")
    form = r"(\d+) \+ (\d+) sweeps of (\d+) .*?, (\d+) frames"
    first, second, classes, frames = map(int, re.match(form, published.SETS[name]).groups())
    assert s.samples.shape == (first + second, frames, 6 if name == "BasicMotions" else 1, 1)
    assert s.samples.dtype == np.float32
    assert len(s.materials) == classes == len(np.unique(s.labels))
    assert (s.rate_hz, s.source) == (100.0, f"aeon:{name}")
    ((train, test),) = Protocol("split:split=0->1").folds(s, 1)
    assert (len(train), len(test)) == (first, second)
    assert set(s.labels[train]) == set(s.labels[test])
    assert len(np.unique(s.group("recording"))) == len(s)


@pytest.mark.slow
def test_the_series_are_aeons():
    """Equal frame by frame and channel by channel, with the class of each series."""
    datasets = pytest.importorskip("aeon.datasets")
    series, classes = datasets.load_classification("BasicMotions", split="test")
    s = sets.load("aeon:BasicMotions")
    there = s.take(s.group("split") == 1)
    np.testing.assert_array_equal(there.samples[7, :, 3, 0], series[7, 3].astype(np.float32))
    assert [s.materials[label] for label in there.labels] == list(classes)


def test_an_unknown_name_is_told_those_that_exist():
    """The error comes before aeon is imported."""
    with pytest.raises(FormatError, match="set 'aeon:GunPiont' is"):
        sets.load("aeon:GunPiont")


def test_without_aeon_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    """The same extra as for MiniRocket."""
    monkeypatch.setitem(sys.modules, "aeon.datasets", None)
    with pytest.raises(FormatError, match="'aeon:GunPoint' needs"):
        sets.load("aeon:GunPoint")


def test_nothing_is_downloaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """If aeon's version lacks the set, there is a message, and its loader is not called."""
    datasets = pytest.importorskip("aeon.datasets")
    monkeypatch.setattr(datasets, "__file__", str(tmp_path / "__init__.py"))
    monkeypatch.setattr(
        datasets, "load_classification", lambda *a, **k: pytest.fail("it would download")
    )
    with pytest.raises(FormatError, match="version of aeon does not"):
        sets.load("aeon:GunPoint")


def test_the_list_of_sets_names_them():
    """`palpate-train sets` prints a line for each."""
    for name, what in published.SETS.items():
        assert re.search(f"aeon:{name} +{re.escape(what)}", summary.known())
