"""Formats that a library reads: spreadsheets, Parquet, TDMS, recordings of ROS."""

import sys
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import ReadPlan

SKIN = np.arange(40 * 4, dtype=np.uint16).reshape(40, 4)
TIMES = np.arange(40) / 10


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("a.xlsx", "python_calamine"),
        ("a.parquet", "pyarrow"),
        ("a.tdms", "nptdms"),
        ("a.mcap", "rosbags.highlevel"),
        ("a.zarr", "zarr"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str
):
    """The message says which format it is and what to install."""
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(FormatError, match="pip install"):
        raw_files.read(tmp_path / name)


def book(path: Path, sheets: dict[str, list[list[object]]]) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    made = openpyxl.Workbook()
    made.remove(made.active)
    for name, rows in sheets.items():
        sheet = made.create_sheet(name)
        for row in rows:
            sheet.append(row)
    made.save(path)
    return path


ROWS = [
    ["t", "label", *"abcd"],
    *([t, "wood", *r] for t, r in zip(TIMES, SKIN.tolist(), strict=True)),
]


def test_a_spreadsheet_is_read_as_a_text(tmp_path: Path):
    """Names, text columns and numbers; the sheet of remarks is passed over."""
    path = book(tmp_path / "a.xlsx", {"remarks": [["Recorded by Ada"]], "run": ROWS})
    found = raw_files.read(path)
    assert found.columns == ("t", "label", *"abcd")
    np.testing.assert_array_equal(found.values[:, 2:], SKIN)
    np.testing.assert_allclose(found.values[:, 0], TIMES)
    assert found.texts[1][0] == "wood"
    facts = [["material", "wood"], ["rate", 100], ["taxels", 4]]
    means = [["", "", *"abcd"], ["Mean", "wood", 1, 2, 3, 4]]
    found = raw_files.read(book(tmp_path / "c.xlsx", {"f": facts, "run": ROWS, "m": means}))
    np.testing.assert_array_equal(found.values[:, 2:], SKIN)
    assert found.notes == ("sheet f is left out", "sheet m is left out")
    path = book(tmp_path / "b.xlsx", {"one": ROWS, "two": ROWS})
    with pytest.raises(FormatError, match="2 sheets"):
        raw_files.read(path)
    np.testing.assert_array_equal(raw_files.read(path, ReadPlan("two")).values[:, 2:], SKIN)


def test_a_table_may_stand_anywhere_on_a_sheet(tmp_path: Path):
    """With remarks beside and rows above, which count; empty cells and errors are faults."""
    rows = [[], [], ["", "", "Recorded by Ada"], *[["", "", *row] for row in ROWS]]
    rows[7].append("touched")
    rows[9].append("let go")
    found = raw_files.read(book(tmp_path / "a.xlsx", {"run": rows}))
    assert found.columns == ("t", "label", *"abcd")
    np.testing.assert_array_equal(found.values[:, 2:], SKIN)
    empty, remarks = found.notes
    assert "2 columns" in empty
    assert "9" in remarks
    rows = [["Recorded by Ada"], [], *[list(row) for row in ROWS]]
    rows[9][3] = None
    rows[12][4] = "#DIV/0!"
    found = raw_files.read(book(tmp_path / "a.xlsx", {"run": rows}))
    places = {k: fault.partition(" is ")[0] for k, fault in found.faults.items()}
    assert places == {3: "line 10, column 4", 4: "line 13, column 5"}


def test_parquet_is_read(tmp_path: Path):
    """Lists become columns; empty cells are faults; other types are passed over."""
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns: dict[str, Any] = {
        "t": TIMES,
        "skin": SKIN.tolist(),
        "grid": pa.array(SKIN.reshape(40, 2, 2).tolist()),
        "fixed": pa.FixedSizeListArray.from_arrays(pa.array(SKIN.ravel()), 4),
        "who": ["Ada"] * 40,
        "hole": [None, *range(39)],
        "image": [b"x"] * 40,
        "both": [{"left": k, "right": {"deep": -k}} for k in range(40)],
        "exact": [Decimal(k) / 4 for k in range(40)],
        "since": pa.array([250 * k for k in range(40)], pa.duration("ms")),
    }
    parquet.write_table(pa.table(columns), tmp_path / "a.parquet")
    found = raw_files.read(tmp_path / "a.parquet")
    assert found.columns[:5] == ("t", "skin.0", "skin.1", "skin.2", "skin.3")
    for start in (1, 5, 9):
        np.testing.assert_array_equal(found.values[:, start : start + 4], SKIN)
    assert found.texts[13][0] == "Ada"
    assert found.faults == {14: "row 1 of hole is empty"}
    assert found.columns[15:] == ("both.left", "both.right.deep", "exact", "since")
    assert found.values[8, 15:18].tolist() == [8, -8, 2]
    assert found.texts[18][5] == "0:00:01.250000"
    with pa.ipc.new_stream(tmp_path / "a.arrow", pa.table(columns).schema) as stream:
        stream.write_table(pa.table(columns))
    assert raw_files.read(tmp_path / "a.arrow").columns == found.columns
    assert ["image" in said for said in found.notes] == [True]


def test_a_list_column_that_changes_its_length_is_a_fault(tmp_path: Path):
    """Only if it is used; and an empty row has no numbers."""
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {
        "skin": [None if k == 5 else row for k, row in enumerate(SKIN.tolist())],
        "odd": [[1] * (1 + k % 2) for k in range(40)],
    }
    parquet.write_table(pa.table(columns), tmp_path / "a.parquet")
    found = raw_files.read(tmp_path / "a.parquet")
    assert "column odd" in found.faults[4]
    assert found.faults[0] == "row 6 of skin is empty"
    assert np.isnan(found.values[5, 0])
    assert found.values[6, :4].tolist() == SKIN[6].tolist()


def test_tdms_is_read(tmp_path: Path):
    """Channels of a group are columns; their interval gives the times; groups are named."""
    nptdms = pytest.importorskip("nptdms")
    step = {"wf_increment": 0.1}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        channels = [nptdms.ChannelObject("skin", c, SKIN[:, k], step) for k, c in enumerate("abcd")]
        writer.write_segment(channels)
    found = raw_files.read(tmp_path / "a.tdms")
    assert found.columns == tuple("abcd")
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_allclose(found.vectors["time"], TIMES)
    slow = [nptdms.ChannelObject("skin", name, SKIN[:3, 0], step) for name in ("warm", "wet")]
    for fast, others, name in ((channels, slow[:1], "c.tdms"), (channels[:2], slow, "d.tdms")):
        with nptdms.TdmsWriter(tmp_path / name) as writer:
            writer.write_segment([*fast, *others])
    slower = raw_files.read(tmp_path / "c.tdms")
    np.testing.assert_array_equal(slower.values, SKIN)
    assert slower.notes[0].startswith("warm is left out")
    with pytest.raises(FormatError, match="wet 3"):
        raw_files.read(tmp_path / "d.tdms")
    with nptdms.TdmsWriter(tmp_path / "b.tdms") as writer:
        for group in ("one", "two"):
            writer.write_segment([nptdms.ChannelObject(group, "a", SKIN[:, 0])])
    with pytest.raises(FormatError, match="2 groups"):
        raw_files.read(tmp_path / "b.tdms")


def bag(
    path: Path, kind: str, messages: str = "sensor_msgs/msg/Image", notes: Sequence[str] = ()
) -> Path:
    """A recording of ROS: the skin, texts (notes, "" for none) and large images."""
    rosbags = pytest.importorskip("rosbags.rosbag2")
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    ros1 = kind == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    if ros1:
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbags.StoragePlugin.MCAP if kind == "mcap" else rosbags.StoragePlugin.SQLITE3
        writer = rosbags.Writer(path, version=9, storage_plugin=plugin)
    write = store.serialize_ros1 if ros1 else store.serialize_cdr
    names = {"/skin": messages, "/note": "std_msgs/msg/String", "/camera": "sensor_msgs/msg/Image"}
    image = types["sensor_msgs/msg/Image"]
    with writer:
        made = {t: writer.add_connection(t, m, typestore=store) for t, m in names.items()}
        for k, row in enumerate(SKIN):
            stamp = time(sec=5 + k // 10, nanosec=k % 10 * 10**8)
            head = header(stamp=stamp, frame_id="skin", **({"seq": k} if ros1 else {}))
            if messages.endswith("Image"):
                padding = np.full((2, 4), 77, np.uint8)
                padded = np.concatenate([row.reshape(2, 2).view(np.uint8), padding], axis=1)
                one = image(head, 2, 2, "mono16", 0, 8, padded.ravel())
            else:
                layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
                one = types[messages](layout=layout, data=row.astype(np.float32))
            sent = {"/skin": one}
            if note := notes[k] if notes else "here":
                sent = {"/note": types["std_msgs/msg/String"](note), **sent}
            if k < 2:
                sent["/camera"] = image(head, 400, 640, "rgb8", 0, 1920, np.zeros(768000, np.uint8))
            for topic, message in sent.items():
                writer.write(made[topic], k * 10**8 + 10**9, write(message, names[topic]))
    return path


@pytest.mark.parametrize("messages", ["sensor_msgs/msg/Image", "std_msgs/msg/Float32MultiArray"])
@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_recordings_of_ros_are_read(tmp_path: Path, kind: str, messages: str):
    """With times of headers or recording; images without their padding."""
    path = bag(tmp_path / ("a.bag" if kind == "bag" else "a"), kind, messages)
    if kind != "bag":
        (path,) = path.glob(f"*.{kind}")
    found = raw_files.read(path)
    np.testing.assert_array_equal(found.values, SKIN)
    assert found.columns == tuple(f"data.{k}" for k in range(4))
    np.testing.assert_allclose(found.vectors["received"], TIMES)
    if messages.endswith("Image"):
        np.testing.assert_allclose(found.vectors["time"], TIMES, atol=1e-6)
    with pytest.raises(FormatError, match="'skin'"):
        raw_files.read(path, ReadPlan("skin"))
    moved = path.rename(tmp_path / f"moved{path.suffix}")
    if kind == "db3":
        with pytest.raises(FormatError, match=r"metadata.yaml"):
            raw_files.read(moved)
    else:
        np.testing.assert_array_equal(raw_files.read(moved).values, SKIN)


def test_a_recording_that_was_cut_off_says_how_to_mend_it(tmp_path: Path):
    """A file without its end, in each format of ROS."""
    for kind, mends in {"mcap": "mcap recover", "bag": "reindex", "db3": "recover"}.items():
        path = bag(tmp_path / f"a.{kind}", kind, "std_msgs/msg/Float32MultiArray")
        path = next(path.glob(f"*.{kind}"), path)
        content = path.read_bytes()
        for kept in (len(content) // 2, len(content) - 20):
            path.write_bytes(content[:kept])
            with pytest.raises(FormatError, match="cut off") as e:
                raw_files.read(path)
            assert mends in str(e.value)


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("late", [0, 5])
def test_a_topic_of_texts_gives_labels(tmp_path: Path, kind: str, late: int):
    """The last text before a frame is its label; frames before the first text are left out."""
    labels = ["wood"] * 15 + ["felt"] * 25
    name = tmp_path / ("a.bag" if kind == "bag" else "a")
    texts = [""] * late + labels[late:]
    path = bag(name, kind, "std_msgs/msg/Float32MultiArray", texts)
    if kind != "bag":
        (path,) = path.glob(f"*.{kind}")
    found = raw_files.read(path, ReadPlan(fields=("/note", "note")))
    assert found.labels["/note"] == found.labels["note"] == labels[late:]
    np.testing.assert_array_equal(found.values, SKIN[late:])
    np.testing.assert_allclose(found.vectors["received"], TIMES[late:])
    assert len(found.notes) == (late > 0)
    with pytest.raises(FormatError, match="/skin"):
        raw_files.read(path, ReadPlan("/skin", fields=("/skin",)))
