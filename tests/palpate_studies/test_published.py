"""The published series of aeon: format, splits, and refusals without them."""

import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_studies import published
from palpate_train.data.splitters import Protocol

SIZES = {
    "ACSF1": (100, 100, 10, 1460, 1),
    "ArrowHead": (36, 175, 3, 251, 1),
    "BasicMotions": (40, 40, 4, 100, 6),
    "GunPoint": (50, 150, 2, 150, 1),
    "OSULeaf": (200, 242, 6, 427, 1),
}
"""Published numbers of training and test sweeps, classes, frames and channels."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_a_set_has_the_published_split(name: str):
    """Each sweep is a recording; the training part is split 0."""
    pytest.importorskip("aeon")
    s = published.load(f"aeon:{name}")
    first, second, classes, frames, channels = SIZES[name]
    assert (s.samples.shape, s.samples.dtype) == ((first + second, frames, channels, 1), np.float32)
    assert len(s.materials) == classes == len(np.unique(s.labels))
    assert (s.rate_hz, s.source) == (100.0, f"aeon:{name}")
    ((train, test),) = Protocol("split:split=0->1").folds(s, 1)
    assert (len(train), len(test)) == (first, second)
    assert len(np.unique(s.group("recording"))) == len(s)


@pytest.mark.slow
def test_the_series_are_aeons():
    """Equal frame by frame and channel by channel, with the class of each series."""
    datasets = pytest.importorskip("aeon.datasets")
    series, classes = datasets.load_classification("BasicMotions", split="test")
    s = published.load("aeon:BasicMotions")
    there = s.take(s.group("split") == 1)
    np.testing.assert_array_equal(there.samples[7, :, 3, 0], series[7, 3].astype(np.float32))
    assert [s.materials[label] for label in there.labels] == list(classes)


def test_without_aeon_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    """The same extra as for MiniRocket."""
    monkeypatch.setitem(sys.modules, "aeon.datasets", None)
    with pytest.raises(FormatError, match="peers"):
        published.load("aeon:GunPoint")


def test_nothing_is_downloaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """If aeon's version lacks the set, its loader is not called."""
    datasets = pytest.importorskip("aeon.datasets")
    monkeypatch.setattr(datasets, "__file__", str(tmp_path / "__init__.py"))
    monkeypatch.setattr(
        datasets, "load_classification", lambda *a, **k: pytest.fail("it would download")
    )
    with pytest.raises(FormatError, match="GunPoint"):
        published.load("aeon:GunPoint")
