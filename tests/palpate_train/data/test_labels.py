"""Names of materials that the box cannot send are listed at once, and replaced."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import labels, summary
from tests.factories.recordings import record
from tests.factories.sweep_sets import easy


def test_names_that_cannot_be_sent_are_listed_and_equal_ones_joined():
    """With length and remedy; labels follow, the order of the others stays."""
    s = replace(easy(4), materials=("x" * 25, "good one", ""))
    with pytest.raises(FormatError, match=r"x{25}' \(25 .*, '' \(0 "):
        labels.check(s)
    assert labels.unsendable(["a", "B 1.2_3-4", "x" * 24]) == ""
    assert labels.check(easy(4)).materials == ("low", "middle", "high")
    s = easy(2)
    joined = labels.renamed(s, {"high": "low", "other": "x"})
    assert (joined.materials, joined.labels.tolist()) == (("low", "middle"), [0, 0, 1, 1, 0, 0])
    assert labels.renamed(s, {"other": "x"}) is s
    swapped = labels.renamed(s, {"high": "low", "low": "high"})
    assert (swapped.materials, np.array_equal(swapped.labels, s.labels)) == (
        ("high", "middle", "low"),
        True,
    )


def test_a_description_tells_which_names_must_change(tmp_path: Path):
    """For a file and for a folder of recordings, before any training."""
    replace(easy(4), materials=("a,b", "middle", "c" * 33)).save(tmp_path / "long.npz")
    last = summary.describe(str(tmp_path / "long.npz")).splitlines()[-1]
    assert "cannot be trained on yet" in last
    assert all(name in last for name in ("'a,b' (3 ", f"'{'c' * 33}' (33 "))
    record(tmp_path / "box" / "1.npy", "a")
    record(tmp_path / "box" / "2.npy", "b$")
    assert "'b$' (2 " in summary.describe(str(tmp_path / "box")).splitlines()[-1]
