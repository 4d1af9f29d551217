"""What Octave 7.3.0 writes: HDF5 with reversed axes, text with one number a line, ranges."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import ReadPlan

SKIN = np.random.default_rng(0).integers(0, 250, (2, 8, 1600), np.uint8)
TIMES = np.arange(1600) * 0.01
RANGE = np.dtype([("base", "<f8"), ("limit", "<f8"), ("increment", "<f8")])
HEAD = "# Created by Octave 7.3.0, Sat Nov 28 13:11:25 2026 UTC <user@host>\n"


def variable(file: h5py.Group, name: str, kind: bytes, value: object = None) -> h5py.Group:
    """A variable as `save -hdf5` stores it; a structure without a value."""
    one = file.create_group(name)
    one.attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
    one["type"] = np.bytes_(kind)
    if value is not None:
        one["value"] = value
    return one


def written(path: Path) -> Path:
    """The file of `save -hdf5 FILE skin t run c name z e ok`, as Octave's own."""
    with h5py.File(path, "w") as file:
        variable(file, "skin", b"uint8 matrix", SKIN.T)
        for where in (file, variable(file, "run", b"scalar struct").create_group("value")):
            t = variable(where, "t", b"double_range", np.array((0, 15.99, 0.01), RANGE))
            t["value"].attrs["OCTAVE_RANGE_NELEM"] = np.int64(1600)
        cell = variable(file, "c", b"cell").create_group("value")
        cell["dims"] = np.array([1, 1])
        variable(cell, "_0", b"float matrix", np.arange(40, dtype="f4").reshape(10, 4))
        variable(file, "name", b"sq_string", np.zeros((4, 1), "i1"))
        variable(file, "z", b"complex matrix", np.zeros((3, 3), [("real", "f8"), ("imag", "f8")]))
        variable(file, "e", b"matrix", np.zeros(2, "i8")).attrs["OCTAVE_EMPTY_MATRIX"] = np.uint8(1)
        variable(file, "ok", b"bool", 1.0)
    return path


@pytest.mark.parametrize("name", ["a.h5", "a.mat", "a.dat"])
def test_hdf5_has_octaves_order_of_axes(tmp_path: Path, name: str):
    """Whatever its name; ranges are times; no remark on axes."""
    path = written(tmp_path / name)
    inside = "run.t" if name == "a.mat" else "run/t"
    for time in ("t", inside):
        found = raw_files.read(path, ReadPlan("skin", time))
        np.testing.assert_array_equal(found.values, SKIN)
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
EXPECTED = {
    "whole numbers": [[1, 2, 3], [4, 5, 6]],
    "logical": [[1, 1, 1], [0, 0, 1]],
    "rows": [[1, 2, np.nan], [4, 5.5, np.nan]],
    "single": [[1, 2, 3], [4, 5.5, 6]],
}


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("name", ["a.txt", "a.mat"])
def test_text_has_its_types_and_shapes(tmp_path: Path, kind: str, name: str):
    """Also with a range, a name and a complex number in the file."""
    octave, body, dtype = TEXTS[kind]
    path = tmp_path / name
    path.write_text(
        f"{HEAD}# name: skin\n# type: {octave}\n{body}\n\n"
        "# name: t\n# type: double_range\n# base, limit, increment\n0 0.6 0.2\n\n\n"
        "# name: who\n# type: sq_string\n# elements: 1\n# length: 4\nfelt\n\n\n"
        "# name: z\n# type: complex scalar\n(1,2)\n\n\n"
    )
    found = raw_files.read(path, ReadPlan(time="t"))
    np.testing.assert_array_equal(found.values, np.array(EXPECTED[kind], dtype))
    assert found.values.dtype == dtype
    np.testing.assert_allclose(found.vectors["t"], [0, 0.2, 0.4, 0.6])


def test_text_of_several_axes(tmp_path: Path):
    """The first axis runs fastest."""
    path = tmp_path / "a.txt"
    numbers = "\n".join(f" {n}" for n in SKIN.ravel(order="F"))
    path.write_text(
        f"{HEAD}# name: skin\n# type: uint8 matrix\n# ndims: 3\n 2 8 1600\n{numbers}\n\n"
    )
    np.testing.assert_array_equal(raw_files.read(path).values, SKIN)
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
