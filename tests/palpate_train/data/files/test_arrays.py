"""HDF5 and NumPy: only the wanted array is read; named fields are columns."""

import json
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import ReadPlan

SKIN = np.arange(40 * 4, dtype=np.uint16).reshape(40, 4)
FIELDS = np.zeros(40, [("t", "f8"), ("who", "S5"), ("taxels", "u2", (4,)), ("note", "U3")])
FIELDS["t"], FIELDS["taxels"], FIELDS["who"] = np.arange(40) / 10, SKIN, b"wood"


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5"])
def test_named_fields_are_columns(tmp_path: Path, suffix: str):
    """A field of several numbers is several columns; a field of text is a text column."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, FIELDS)
    elif suffix == ".npz":
        np.savez(path, run=FIELDS)
    else:
        with h5py.File(path, "w") as file:
            file["run/data"] = FIELDS.astype(
                [("t", "f8"), ("who", "S5"), ("taxels", "u2", (4,)), ("note", "S3")]
            )
    found = raw_files.read(path)
    assert found.columns == ("t", "who", *(f"taxels.{k}" for k in range(4)), "note")
    assert found.texts[1][3] == "wood"
    np.testing.assert_array_equal(found.values[:, 2:6], SKIN)
    np.testing.assert_allclose(found.values[:, 0], FIELDS["t"])


def test_a_camera_beside_the_skin_is_not_read(tmp_path: Path):
    """Unfinished, virtual or larger than memory: no matter if the skin is named."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["skin"] = SKIN
        file.create_dataset("camera .*not written", (4000, 480, 640), "u1", chunks=(1, 480, 640))
        file["link"] = h5py.ExternalLink("other.h5", "/camera")
    tracemalloc.start()
    found = raw_files.read(tmp_path / "a.h5", ReadPlan("skin"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(found.values, SKIN)
    assert peak < 2e6
    with pytest.raises(FormatError, match="2 arrays"):
        raw_files.read(tmp_path / "a.h5")
    with pytest.raises(FormatError, match="camera"):
        raw_files.read(tmp_path / "a.h5", ReadPlan("camera"))


def test_arrays_are_found_beside_others_and_beside_objects(tmp_path: Path):
    """By the end of the path if it is one; dictionaries and None are never unpickled."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/skin"], file["run/camera"] = SKIN, np.zeros((3, 3))
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.h5", ReadPlan("skin")).values, SKIN)
    np.savez(
        tmp_path / "a.npz", skin=SKIN, info={"who": "Ada"}, none=None, name="wood", t=SKIN[:, 0]
    )
    found = raw_files.read(tmp_path / "a.npz", ReadPlan(time="t"))
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(found.vectors["t"], SKIN[:, 0])
    np.savez(tmp_path / "b.npz", info={"skin": SKIN})
    with pytest.raises(FormatError, match="no array"):
        raw_files.read(tmp_path / "b.npz")


def test_vectors_are_columns(tmp_path: Path):
    """Of one length, in one group; the times are not among them, and others are left out."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for k in range(4):
            file[f"taxels/s{k}"] = SKIN[:, k]
        file["rate"], file["t"], file["events"] = 100.0, np.arange(40) / 10, np.arange(7)
    found = raw_files.read(tmp_path / "a.h5", ReadPlan(time="t"))
    np.testing.assert_array_equal(found.values, SKIN)
    assert found.columns == tuple(f"taxels/s{k}" for k in range(4))
    assert found.vectors["t"][3] == 0.3
    assert "4 arrays" in found.notes[0]
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["camera"] = np.zeros((5, 6, 6))
    found = raw_files.read(tmp_path / "a.h5", ReadPlan("taxels", time="t"))
    np.testing.assert_array_equal(found.values, SKIN)
    assert found.vectors["t"][3] == 0.3


def test_numbered_arrays_are_frames(tmp_path: Path):
    """In the order of their numbers, not of their names; without one of them they are refused."""
    frames = {f"frame {k}": row.reshape(2, 2) for k, row in enumerate(SKIN)}
    np.savez(tmp_path / "a.npz", **frames)
    found = raw_files.read(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.values.reshape(40, 4), SKIN)
    assert "frame 0 to frame 39" in found.notes[0]
    for change in ({"frame 12": np.zeros((3, 3))}, {"frame 77": SKIN[:2, :2]}, {"x": SKIN}):
        np.savez(tmp_path / "a.npz", **frames | change)
        with pytest.raises(FormatError, match=r"4\d arrays"):
            raw_files.read(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", **{k: v for k, v in frames.items() if k != "frame 12"})
    with pytest.raises(FormatError, match="39 arrays"):
        raw_files.read(tmp_path / "a.npz")


def lines(*rows: object) -> bytes:
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


@pytest.mark.parametrize(
    "content",
    [
        lines(*({"t": k / 10, "skin": r} for k, r in enumerate(SKIN.tolist()))),
        lines(
            *(
                {"t": k / 10, "skin": {"a": r[:2], "b": [r[2:]]}}
                for k, r in enumerate(SKIN.tolist())
            )
        ),
        json.dumps([{"t": k / 10, "skin": r} for k, r in enumerate(SKIN.tolist())]).encode(),
        json.dumps({"t": [k / 10 for k in range(40)], "skin": SKIN.tolist()}).encode(),
        lines(*([k / 10, *r] for k, r in enumerate(SKIN.tolist()))),
        lines(*({"t": k / 10, "skin": r} for k, r in enumerate(SKIN.tolist()))) + b'{"t": 4.0, "sk',
    ],
)
def test_json_is_read(tmp_path: Path, content: bytes):
    """Objects or lists on lines, a list of objects, lists by name; a cut last line is dropped."""
    (tmp_path / "a.jsonl").write_bytes(content)
    found = raw_files.read(tmp_path / "a.jsonl")
    np.testing.assert_array_equal(found.values[:, 1:], SKIN)
    np.testing.assert_allclose(found.values[:, 0], np.arange(40) / 10)
    cut = content.endswith(b"sk")
    assert ["line 41" in said for said in found.notes] == [True] * cut


def test_acquired_data_is_read(tmp_path: Path):
    """Edge Impulse's format: sensors by name, times by its interval; a short frame is named."""
    sensors = [{"name": name, "units": "N"} for name in "abcd"]
    payload = {"interval_ms": 10, "sensors": sensors, "values": SKIN.tolist(), "device_name": "a"}
    (tmp_path / "a.json").write_text(json.dumps({"signature": "0", "payload": payload}))
    found = raw_files.read(tmp_path / "a.json")
    np.testing.assert_array_equal(found.values, SKIN)
    assert found.columns == tuple("abcd")
    assert "100 Hz" in found.notes[0]
    assert found.facts["device_name"] == "a"
    np.testing.assert_allclose(found.vectors["time"], np.arange(len(SKIN)) / 100)
    payload["values"][4] = [1, 2]
    (tmp_path / "a.json").write_text(json.dumps({"payload": payload}))
    with pytest.raises(FormatError, match="entry 5"):
        raw_files.read(tmp_path / "a.json")


FRAMES = [{"t": k / 10, "skin": r} for k, r in enumerate(SKIN.tolist())]


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (json.dumps({"who": "Ada", "frames": FRAMES}).encode(), "'frames'"),
        (lines({"type": "head", "rate": 10}, *FRAMES), "1 is passed"),
        (b",\n".join(json.dumps(x).encode() for x in FRAMES), ""),
        (lines(*({"t": str(x["t"]), "skin": list(map(str, x["skin"]))} for x in FRAMES)), ""),
        (b"[\n" + b",\n".join(json.dumps(x).encode() for x in FRAMES) + b",\n]", ""),
        (
            json.dumps(
                {"columns": ["t", *"abcd"], "data": [[x["t"], *x["skin"]] for x in FRAMES]}
            ).encode(),
            "",
        ),
        (
            json.dumps(
                {k: {str(i): x[k] for i, x in enumerate(FRAMES)} for k in ("t", "skin")}
            ).encode(),
            "",
        ),
        (json.dumps({str(i): x for i, x in enumerate(FRAMES)}).encode(), ""),
    ],
)
def test_frames_inside_of_json_are_read(tmp_path: Path, content: bytes, note: str):
    """In a list, behind a line of facts, with commas between lines, in pandas' forms."""
    (tmp_path / "a.json").write_bytes(content)
    found = raw_files.read(tmp_path / "a.json")
    np.testing.assert_array_equal(found.values[:, 1:], SKIN)
    np.testing.assert_allclose(found.values[:, 0], np.arange(40) / 10)
    assert [note in said for said in found.notes] == [True] * bool(note)


def test_lists_of_json_are_named_and_null_is_a_fault(tmp_path: Path):
    """Without --variable they are columns of one table; null counts in a taxel alone."""
    both = {"left": SKIN.tolist(), "right": SKIN[:9].tolist()}
    (tmp_path / "a.json").write_text(json.dumps(both))
    found = raw_files.read(tmp_path / "a.json", ReadPlan("left"))
    np.testing.assert_array_equal(found.values, SKIN)
    with pytest.raises(FormatError, match="'left': 40, 'right': 9"):
        raw_files.read(tmp_path / "a.json")
    rows = [{"a": 1, "b": 2}, {"a": None, "b": 3}, {"a": 1, "b": 3}]
    (tmp_path / "a.jsonl").write_bytes(lines(*rows))
    found = raw_files.read(tmp_path / "a.jsonl")
    assert found.faults.keys() == {0}
    assert "line 2, a is None" in found.faults[0]
    assert found.values[:, 1].tolist() == [2, 3, 3]
    (tmp_path / "a.jsonl").write_bytes(lines({"b": 1, "a": 2}, {"a": True, "b": 3}))
    found = raw_files.read(tmp_path / "a.jsonl")
    assert "line 2, a is True" in found.faults[0]
    assert (found.columns, found.values[:, 1].tolist()) == (("a", "b"), [1, 3])


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (lines({"a": 1, "b": 2}, {"a": 1}), "line 2 lacks 'b'"),
        (b'{"a": 1, "a": 2}\n', "'a'"),
        (b'{"a": 1}\n{"a": \n{"a": 2}\n', "'{\"a\":'"),
        (lines({"a": 1, "b": [1, 2]}, {"a": 1, "b": [1]}), "line 2 lacks 'b.1'"),
    ],
)
def test_bad_json_is_named(tmp_path: Path, content: bytes, why: str):
    """The line and the key."""
    (tmp_path / "a.jsonl").write_bytes(content)
    with pytest.raises(FormatError) as e:
        raw_files.read(tmp_path / "a.jsonl")
    assert why in str(e.value)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.pkl", b"", "a pickle"),
        ("a.rds", b"", "of R"),
        ("a.ts", b"@data\n1,2,3:a\n", "of series"),
        ("a.csv", b"PK\3\4...", "zip"),
        ("a.csv", b"\x1f\x8b...", "gzip"),
        ("a.csv", b"BZh9...", "bzip2"),
        ("a.txt", b"\xfd7zXZ...", "xz"),
        ("a.dat", b"RIFF...WAVE", "sound"),
        ("a.csv", b"<!DOCTYPE html><p>1 2 3", "web page"),
        ("a.csv", b"version https://git-lfs.github.com/spec/v1\nsize 9\n", "git lfs pull"),
        ("a.npy", b"version https://git-lfs.github.com/spec/v1\nsize 9\n", "git lfs pull"),
        ("a.fsx", b"", "Tekscan"),
        ("a.txt", b"PAR1", "Parquet"),
        ("a.mp4", b"", "picture"),
    ],
)
def test_a_format_that_is_not_read_is_named(tmp_path: Path, name: str, content: bytes, why: str):
    """With what to do."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError) as e:
        raw_files.read(tmp_path / name)
    assert why in str(e.value)
