"""Tekscan's exports: movies as blocks of lines, with or without places that have no sensel."""

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data.files import tekscan
from palpate_train.data.files.table import ReadPlan, Table
from palpate_train.data.files.text import lines_of
from tests.factories.foreign_files import FRAMES, HEAD, movie


def read(text: str) -> Table:
    lines = lines_of(text)
    assert tekscan.is_movie(lines)
    return tekscan.read(lines, ReadPlan(), ())


@pytest.mark.parametrize(
    "text",
    [
        movie(),
        movie().replace("\n", "\r\n"),
        movie(tail=","),
        movie(head=HEAD.replace("\n", ",,,\n")),
        "".join(
            f'"{line}"\n' if line[:1].isupper() else f"{line}\n" for line in movie().split("\n")
        ),
    ],
)
def test_each_block_is_a_frame(text: str):
    """Rows and columns as stored, times from the interval in the header."""
    found = read(text)
    np.testing.assert_array_equal(found.values, FRAMES)
    np.testing.assert_allclose(found.vectors["time"], np.arange(12) / 100)
    assert ["100 Hz" in said for said in found.notes] == [True]


def test_places_without_a_sensel_are_left_out_or_read_zero():
    """A row and a column of B vanish; a B at another place reads 0, and both are said."""
    text = movie().replace("\n0,1,2,3\n", "\nB,1,2,B\n")
    cells = FRAMES.astype(object)
    cells[:, 0, :] = "B"
    cells[:, :, 3] = "B"
    cells[:, 1, 0] = "B"
    found = read(movie(cells))
    expected = FRAMES[:, 1:, :3].copy()
    expected[:, 0, 0] = 0
    np.testing.assert_array_equal(found.values, expected)
    said, _ = found.notes
    assert "2 rows and 3 columns; 1 " in said
    with pytest.raises(FormatError, match="is B"):
        read(text)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("\n40,41,42,43\n", "\n40,41,42\n", "30 has 3"),
        ("\n40,41,42,43\n", "\n40,x,42,43\n", "30, column 2 is 'x',"),
        ("\n40,41,42,43\n", "\n", "4 has 2"),
        ("Frame 4\n", "Frame 5\n", "5 follows frame 3"),
    ],
)
def test_damage_is_named(old: str, new: str, why: str):
    """The line and the cell, or the frame."""
    with pytest.raises(FormatError) as e:
        read(movie().replace(old, new))
    assert why in str(e.value)


def test_a_cut_movie_is_read_up_to_its_last_whole_frame():
    """The end mark is missing, and so is a part of the last frame: both are said."""
    text = movie()[: -len("140,141,142,143\n@@\n")]
    found = read(text)
    np.testing.assert_array_equal(found.values, FRAMES[:11])
    assert ["@@" in found.notes[0], "frame 12" in found.notes[1]] == [True, True]
