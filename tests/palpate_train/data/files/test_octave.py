"""What Octave 7.3.0 writes: HDF5 with reversed axes, text with one number a line, ranges."""

from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import ReadPlan
from tests.factories.foreign_files import OCTAVE, octave

TIMES = np.arange(1600) * 0.01
HEAD = "# Created by Octave 7.3.0, Sat Nov 28 13:11:25 2026 UTC <user@host>\n"


@pytest.mark.parametrize("name", ["a.h5", "a.mat", "a.dat"])
def test_hdf5_has_octaves_order_of_axes(tmp_path: Path, name: str):
    """Whatever its name; ranges are times; no remark on axes."""
    path = octave(tmp_path / name)
    inside = "run.t" if name == "a.mat" else "run/t"
    for time in ("t", inside):
        found = raw_files.read(path, ReadPlan("skin", time))
        np.testing.assert_array_equal(found.values, OCTAVE)
        np.testing.assert_allclose(found.vectors[time], TIMES)
        assert not found.reversible
    with pytest.raises(FormatError) as refused:
        raw_files.read(path)
    assert "_0 [4, 10]" in str(refused.value)
    assert not any(f" {hidden} [" in str(refused.value) for hidden in ("name", "z", "e", "dims"))


TEXTS = {
    "whole numbers": ("int16 matrix", "# ndims: 2\n 2 3\n 1\n 4\n 2\n 5\n 3\n 6\n", "i2"),
    "logical": ("bool matrix", "# ndims: 2\n 2 3\n 1\n 0\n 1\n 0\n 1\n 1\n", "?"),
    "rows": ("matrix", "# rows: 2\n# columns: 3\n 1 2 NA\n 4 5.5 NaN\n", "f8"),
    "single": ("float matrix", "# rows: 2\n# columns: 3\n 1 2 3\n 4 5.5 6\n", "f4"),
}


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("name", ["a.txt", "a.mat"])
def test_text_has_its_types_and_shapes(tmp_path: Path, kind: str, name: str):
    """Also with a range, a name and a complex number in the file."""
    expected = {
        "whole numbers": [[1, 2, 3], [4, 5, 6]],
        "logical": [[1, 1, 1], [0, 0, 1]],
        "rows": [[1, 2, np.nan], [4, 5.5, np.nan]],
        "single": [[1, 2, 3], [4, 5.5, 6]],
    }
    octave, body, dtype = TEXTS[kind]
    path = tmp_path / name
    path.write_text(
        f"{HEAD}# name: skin\n# type: {octave}\n{body}\n\n"
        "# name: t\n# type: double_range\n# base, limit, increment\n0 0.6 0.2\n\n\n"
        "# name: who\n# type: sq_string\n# elements: 1\n# length: 4\nfelt\n\n\n"
        "# name: z\n# type: complex scalar\n(1,2)\n\n\n"
    )
    found = raw_files.read(path, ReadPlan(time="t"))
    np.testing.assert_array_equal(found.values, np.array(expected[kind], dtype))
    assert found.values.dtype == dtype
    np.testing.assert_allclose(found.vectors["t"], [0, 0.2, 0.4, 0.6])


def test_text_of_several_axes(tmp_path: Path):
    """The first axis runs fastest."""
    path = tmp_path / "a.txt"
    numbers = "\n".join(f" {n}" for n in OCTAVE.ravel(order="F"))
    path.write_text(
        f"{HEAD}# name: skin\n# type: uint8 matrix\n# ndims: 3\n 2 8 1600\n{numbers}\n\n"
    )
    np.testing.assert_array_equal(raw_files.read(path).values, OCTAVE)
    path.write_text(path.read_text()[:-20])
    with pytest.raises(FormatError, match="skin"):
        raw_files.read(path)


@pytest.mark.parametrize("text", ["0 1e12 1e-3", "0 inf 1", "0 1 0", "0 nan 1", "0 -5 1", "0 1"])
def test_a_range_that_no_recording_has_is_refused(tmp_path: Path, text: str):
    """Before it fills the memory."""
    path = tmp_path / "a.txt"
    path.write_text(f"{HEAD}# name: t\n# type: range\n# base, limit, increment\n{text}\n")
    with pytest.raises(FormatError):
        raw_files.read(path)
