"""MATLAB: arrays beside and in structures, objects, figures; damage ends a child at most."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files import matlab
from palpate_train.data.files.table import ReadPlan
from tests.factories.later import Later

scipy_io = Later("scipy.io")
sparse = Later("scipy.sparse")

SKIN = np.arange(40 * 4.0).reshape(40, 4)


def saved(path: Path, **values: object) -> Path:
    """A MAT file of version 5, compressed."""
    scipy_io.savemat(path, values, do_compression=True)
    return path


@pytest.mark.parametrize("version", ["4", "5"])
def test_numbers_are_read_in_their_type(tmp_path: Path, version: str):
    """Beside a vector of times, a text, complex and sparse numbers, which are passed over."""
    types = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?")
    others = {"who": "Ada", "z": SKIN * 1j, "t": np.arange(40.0), "s": sparse.eye(9)}
    for kind in types if version == "5" else ("f8", "f4", "i4", "i2", "u2", "u1"):
        skin = (SKIN % 100).astype(kind)
        scipy_io.savemat(tmp_path / "a.mat", {"skin": skin} | others, format=version)
        found = raw_files.read(tmp_path / "a.mat", ReadPlan(time="t"))
        np.testing.assert_array_equal(found.values, skin)
        assert found.values.dtype == kind
        np.testing.assert_array_equal(found.vectors["t"], np.arange(40))


def test_other_byte_orders_and_objects_beside_frames(tmp_path: Path):
    """A matrix of version 4 by hand; strings and tables are opaque, of class 17."""
    head = np.array([1000, 2, 3, 0, 5], ">i4").tobytes() + b"skin\0"
    values = np.array([[1, 2, 3], [4, 5, 6]], ">f8")
    (tmp_path / "a.mat").write_bytes(head + values.tobytes(order="F"))
    found = raw_files.read(tmp_path / "a.mat").values
    np.testing.assert_array_equal(found, values)
    assert found.dtype.isnative
    data = bytearray(saved(tmp_path / "a.mat", skin=SKIN).read_bytes())

    def element(kind: int, content: bytes) -> bytes:
        return np.array([kind, len(content)], "<u4").tobytes() + content

    flags = element(6, bytes([17]) + bytes(7))
    names = [element(1, text.ljust(8, b"\0")) for text in (b"when", b"MCOS", b"datetime")]
    shape, name = element(5, np.array([6, 1], "<i4").tobytes()), element(1, b"")
    ids = element(6, bytes([13]) + bytes(7)) + shape + name + element(6, bytes(24))
    data += element(14, flags + b"".join(names) + element(14, ids))
    (tmp_path / "a.mat").write_bytes(data)
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.mat").values, SKIN)


def test_arrays_are_found_in_structures(tmp_path: Path):
    """data.skin, runs(2).skin, c{2}; a single array of frames needs no name."""
    path = saved(tmp_path / "a.mat", data={"skin": SKIN, "who": "Ada", "t": np.arange(40.0)})
    found = raw_files.read(path, ReadPlan(time="data.t"))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(found.vectors["data.t"], np.arange(40))
    runs = np.zeros((1, 2), [("skin", object)])
    runs["skin"][0, 0], runs["skin"][0, 1] = SKIN, SKIN + 1
    cells = np.empty(2, object)
    cells[:] = [SKIN, SKIN + 2]
    path = saved(tmp_path / "b.mat", runs=runs, c=cells)
    np.testing.assert_array_equal(raw_files.read(path, ReadPlan("runs(2).skin")).values, SKIN + 1)
    np.testing.assert_array_equal(raw_files.read(path, ReadPlan("c{2}")).values, SKIN + 2)
    with pytest.raises(FormatError, match=r"runs\(1\).skin \[40, 4\]"):
        raw_files.read(path)


@pytest.mark.parametrize("name", ["skin", "data/skin"])
def test_version_7_3_is_read_beside_objects(tmp_path: Path, name: str):
    """Strings, tables, cells and empty arrays are not frames; a structure is walked into."""
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def add(name: str, data: object, kind: str) -> None:
            file.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_(kind)

        add(name, SKIN.T, "double")
        add("#refs#/a", np.zeros((9, 9)), "double")
        for kind in ("char", "string", "datetime", "table"):
            add(f"x_{kind}", np.zeros((2, 6), "u4"), kind)
        cell = file.create_dataset("x_cell", (2, 2), h5py.ref_dtype)
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
        add("none", np.zeros((2, 2), "u8"), "double")
        file["none"].attrs["MATLAB_empty"] = np.uint8(1)
    found = raw_files.read(path, ReadPlan(name.replace("/", ".")))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(raw_files.read(path).values, SKIN)
    np.testing.assert_array_equal(raw_files.read(path.rename(tmp_path / "a.h5")).values, SKIN)


@pytest.mark.slow
def test_damage_is_told(tmp_path: Path):
    """Cut anywhere or altered, of both versions: an array, or a FormatError."""
    rng = np.random.default_rng(0)
    for version in ("4", "5"):
        scipy_io.savemat(tmp_path / "a.mat", {"skin": SKIN, "t": np.arange(40.0)}, format=version)
        whole = (tmp_path / "a.mat").read_bytes()
        for _ in range(10):
            data = bytearray(whole[: len(whole) - rng.integers(200)])
            data[rng.integers(300)] = rng.integers(256)
            (tmp_path / "a.mat").write_bytes(data)
            try:
                assert raw_files.read(tmp_path / "a.mat").values.nbytes <= 8 * len(whole)
            except FormatError:
                continue


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0" + bytes(200), b"\xd0\x07\0\0" * 9])
def test_another_file_is_refused(tmp_path: Path, content: bytes):
    """Empty, a head alone, a matrix of a VAX: with what to do."""
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(FormatError, match="-v7"):
        raw_files.read(tmp_path / "a.mat")


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (lambda path: os.kill(os.getpid(), signal.SIGKILL), "SIGKILL"),
        (lambda path: time.sleep(60), "within 0.2 s"),
        (lambda path: bytes(matlab.MOST_BYTES + 1), "MemoryError"),
    ],
)
def test_a_reader_that_dies_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: object, why: str
):
    """It crashes, hangs or takes all memory: the file is refused, and the import goes on."""
    monkeypatch.setattr(matlab, "_arrays", fault)
    monkeypatch.setattr(matlab, "DEADLINE_S", 0.2 if why.startswith("within") else 60.0)
    path = saved(tmp_path / "a.mat", skin=SKIN)
    with pytest.raises(FormatError, match=why):
        raw_files.read(path)
    monkeypatch.undo()
    np.testing.assert_array_equal(raw_files.read(path).values, SKIN)
