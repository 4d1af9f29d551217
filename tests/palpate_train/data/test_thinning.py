"""Fewer sweeps of a large set: of each material and recording alike."""

from dataclasses import replace

import numpy as np
import pytest

from palpate_train.data.sets import Dataset, thinned
from tests.factories.sweep_sets import easy


def uneven() -> Dataset:
    """3, 40 and 200 sweeps of three materials; the first count is the sweep's number."""
    labels = np.repeat([0, 1, 2], [3, 40, 200])
    recording = np.repeat(np.arange(12), [*[1] * 3, *[10] * 4, 100, 50, 30, 16, 4])
    base = easy(1)
    samples = np.zeros((len(labels), *base.samples.shape[1:]), np.int16)
    samples[:, 0, 0, 0] = np.arange(len(labels))
    return replace(base, samples=samples, labels=labels, groups={"recording": recording})


def test_a_set_is_itself_or_thinned_alike():
    """In order; materials with few sweeps keep all, and no recording is lost."""
    s = uneven()
    assert thinned(s, len(s)) is s
    part = thinned(s, 63)
    numbers = part.samples[:, 0, 0, 0]
    assert (np.diff(numbers) > 0).all()
    longest = numbers[part.group("recording") == 7]
    assert set(np.diff(longest)) <= {14, 15, 16, 17}
    assert len(part) == 63
    assert np.bincount(part.labels).tolist() == [3, 30, 30]
    counts = np.unique(part.group("recording"), return_counts=True)[1].tolist()
    assert sorted(counts[:3]) == [1, 1, 1]
    assert sorted(counts[3:7]) == [7, 7, 8, 8]
    assert sorted(counts[7:]) == [4, 6, 6, 7, 7]


@pytest.mark.parametrize("most", [1, 2, 3, 17, 100, 242])
def test_any_number_is_met(most: int):
    """Never more than asked for, but one of each material; never the same sweep twice."""
    part = thinned(uneven(), most)
    assert len(part) == max(most, 3)
    assert len(set(part.samples[:, 0, 0, 0].tolist())) == len(part)
