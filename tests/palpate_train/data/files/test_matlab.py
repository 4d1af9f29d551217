"""MATLAB: arrays beside and in structures, objects, figures; of both kinds of MAT files."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import ReadPlan

SKIN = np.arange(40 * 4.0).reshape(40, 4)


def old(path: Path, **values: object) -> Path:
    scipy.io.savemat(path, values, do_compression=True)
    return path


def new(path: Path, name: str = "skin", **attributes: str) -> Path:
    """Version 7.3: MATLAB's arrays are stored by columns, with their class."""
    with h5py.File(path, "w", userblock_size=512) as file:
        at = file.create_dataset(name, data=SKIN.T)
        at.attrs["MATLAB_class"] = np.bytes_("double")
        for kind, data in {
            "char": np.frombuffer("wood".encode("utf-16-le"), "u2"),
            "string": np.zeros((1, 6), "u4"),
            "datetime": np.zeros((1, 6), "u4"),
            "table": np.zeros((1, 6), "u4"),
        }.items():
            file.create_dataset(f"x_{kind}", data=data).attrs["MATLAB_class"] = np.bytes_(kind)
        cell = file.create_dataset("x_cell", (2, 2), h5py.ref_dtype)
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
        file.create_dataset("none", data=np.array([0, 0], "u8")).attrs["MATLAB_class"] = np.bytes_(
            "double"
        )
        file["none"].attrs["MATLAB_empty"] = np.uint8(1)
        file.create_dataset("#refs#/a", data=np.zeros((9, 9))).attrs["MATLAB_class"] = np.bytes_(
            "double"
        )
    return path


def test_arrays_are_found_in_structures(tmp_path: Path):
    """data.skin, runs(2).skin, c{2}: beside text, which is passed over; only one array of frames
    needs no name."""
    path = old(tmp_path / "a.mat", data={"skin": SKIN, "who": "Ada", "t": np.arange(40.0)})
    found = raw_files.read(path, ReadPlan(time="data.t"))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(found.vectors["data.t"], np.arange(40))
    runs = np.zeros((1, 2), [("skin", object)])
    runs["skin"][0, 0], runs["skin"][0, 1] = SKIN, SKIN + 1
    cells = np.empty(2, object)
    cells[:] = [SKIN, SKIN + 2]
    path = old(tmp_path / "b.mat", runs=runs, c=cells)
    np.testing.assert_array_equal(raw_files.read(path, ReadPlan("runs(2).skin")).values, SKIN + 1)
    np.testing.assert_array_equal(raw_files.read(path, ReadPlan("c{2}")).values, SKIN + 2)
    with pytest.raises(FormatError, match=r"holds 4 arrays of frames; .*runs\(1\).skin \[40, 4\]"):
        raw_files.read(path)


@pytest.mark.parametrize("name", ["skin", "data/skin"])
def test_version_7_3_is_read_beside_objects(tmp_path: Path, name: str):
    """Strings, dates, tables and cells are not arrays of frames; axes are MATLAB's; a structure is
    walked into."""
    found = raw_files.read(new(tmp_path / "a.mat", name), ReadPlan(name.replace("/", ".")))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.mat").values, SKIN)
    (tmp_path / "a.mat").rename(tmp_path / "a.h5")
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.h5").values, SKIN)


def test_objects_of_version_7_are_passed_over(tmp_path: Path):
    """MATLAB's strings and tables are opaque objects: an element of class 17 without numbers."""
    data = bytearray(old(tmp_path / "a.mat", skin=SKIN).read_bytes())
    flags = (6).to_bytes(4, "little") + (8).to_bytes(4, "little") + bytes([17]) + bytes(7)
    names = b"".join(
        (1).to_bytes(4, "little") + (8).to_bytes(4, "little") + text.ljust(8, b"\0")
        for text in (b"when", b"MCOS", b"datetime")
    )
    body = flags + names
    data += (14).to_bytes(4, "little") + len(body).to_bytes(4, "little") + body
    (tmp_path / "a.mat").write_bytes(data)
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.mat").values, SKIN)


def figure(path: Path, xs: list[np.ndarray]) -> Path:
    """A figure with a line for each taxel, as savefig stores it."""
    lines = np.zeros((len(xs), 1), [("type", object), ("properties", object), ("children", object)])
    for k, x in enumerate(xs):
        lines[k, 0] = ("graph2d.lineseries", {"XData": x, "YData": SKIN[:, k], "Color": "b"}, [])
    axes = {"type": "axes", "properties": {"Tag": ""}, "children": lines}
    tree = {"type": "figure", "properties": {"Name": "skin"}, "children": axes}
    scipy.io.savemat(path.with_suffix(".mat"), {"hgS_070000": tree})
    return path.with_suffix(".mat").rename(path)


def test_a_figures_lines_are_columns(tmp_path: Path):
    """The x values are the times; lines of different x values are refused with MATLAB's remedy."""
    found = raw_files.read(figure(tmp_path / "a.fig", [np.arange(40) / 100] * 4))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_allclose(found.vectors["x"], np.arange(40) / 100)
    assert found.columns == ("line 1", "line 2", "line 3", "line 4")
    figure(tmp_path / "b.fig", [np.arange(40) + k for k in range(4)])
    with pytest.raises(FormatError, match="differ in their x values; in MATLAB: l = findobj"):
        raw_files.read(tmp_path / "b.fig")
    figure(tmp_path / "c.fig", [])
    with pytest.raises(FormatError, match="is a figure without lines; in MATLAB"):
        raw_files.read(tmp_path / "c.fig")
