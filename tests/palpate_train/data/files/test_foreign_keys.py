"""Keys that a foreign file lacks, or whose value cannot be: the message names key and value."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import lerobot, raw_files
from palpate_train.data.files.table import ReadPlan
from palpate_train.data.import_plan import ImportPlan
from tests.factories.foreign_files import HEAD, lerobot_set, movie, octave

SKIN = np.arange(40 * 4).reshape(40, 4)
SENSORS = [{"name": name, "units": "N"} for name in "abcd"]
MISSING = object()


def acquired(path: Path, key: str, value: Any) -> None:
    """Edge Impulse's format with one key changed."""
    payload: dict[str, Any] = {"interval_ms": 10, "sensors": SENSORS, "values": SKIN.tolist()}
    payload[key] = value
    kept = {k: v for k, v in payload.items() if v is not MISSING}
    (path / "a.json").write_text(json.dumps({"payload": kept}))


def channels(path: Path, key: str, value: Any) -> None:
    """A TDMS file with one property of its channels."""
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(path / "a.tdms") as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("g", name, SKIN[:, k], {key: value})
                for k, name in enumerate("ab")
            ]
        )


def tekscan(path: Path, key: str, value: Any) -> None:
    """A movie with another line in its head."""
    (path / "a.asf").write_text(movie(head=HEAD.replace(f"{key} 0.01", f"{key} {value}")))


@pytest.mark.parametrize("value", [0, -1, "abc", float("inf"), float("nan")], ids=str)
@pytest.mark.parametrize(
    ("make", "key"),
    [(acquired, "interval_ms"), (channels, "wf_increment"), (tekscan, "SECONDS_PER_FRAME")],
)
def test_no_interval(tmp_path: Path, make: Callable[..., None], key: str, value: Any):
    """The frames are read, but without times; a remark names key and value. LabVIEW writes 0 for
    channels without an interval."""
    make(tmp_path, key, value)
    found = raw_files.read(next(tmp_path.iterdir()))
    assert len(found.values) > 10
    assert not found.vectors
    silent = key == "wf_increment" and value == 0
    assert [key in said and str(value) in said for said in found.notes] == [True] * (not silent)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        *(("sensors", v, "sensors is") for v in (MISSING, 0, None, [None], [{}], [1], "abc")),
        *(("values", v, "values is") for v in (0, None, 1.5, "abc", {})),
        ("values", [*SKIN.tolist(), [1, 2]], "entry 41"),
        ("sensors", [], "payload.sensors"),
        ("sensors", [{"name": "skin"}] * 4, "'skin' twice"),
    ],
)
def test_acquired_data_without_a_key(tmp_path: Path, key: str, value: Any, said: str):
    """Edge Impulse's format; without `values` it is another format."""
    acquired(tmp_path, key, value)
    with pytest.raises(FormatError, match=said):
        raw_files.read(tmp_path / "a.json")


def test_acquired_data_without_an_interval(tmp_path: Path):
    """A missing key is as good as one of no use."""
    acquired(tmp_path, "interval_ms", MISSING)
    found = raw_files.read(tmp_path / "a.json")
    np.testing.assert_array_equal(found.values, SKIN)
    assert ["interval_ms is None" in said for said in found.notes] == [True]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"data": 0}, "data is '0'"),
        ({"data": [[1, 2], [3]]}, "entry 2 of data"),
        ({"data": [None]}, "entry 1 of data"),
        ({"columns": ["a"]}, "entry 1 of data"),
    ],
)
def test_a_data_frame_whose_parts_do_not_fit(tmp_path: Path, changed: dict[str, Any], said: str):
    """pandas' orient="split"; names of columns may be numbers."""
    whole = {"columns": [0, 1], "data": [[1, 2], [3, 4]]}
    (tmp_path / "a.json").write_text(json.dumps(whole))
    assert raw_files.read(tmp_path / "a.json").columns == ("0", "1")
    (tmp_path / "a.json").write_text(json.dumps(whole | changed))
    with pytest.raises(FormatError, match=said):
        raw_files.read(tmp_path / "a.json")


def episodes(folder: Path) -> list[str]:
    plan = ImportPlan(None, rate_hz=30.0, fields={"material": "task"})
    return [name for name, _ in lerobot.episodes(folder, plan)]


@pytest.mark.parametrize("value", ["abc", [0, 3], [None], [2.5, 3], [[2], 3]], ids=str)
def test_a_feature_of_lerobot_without_a_shape(tmp_path: Path, value: Any):
    """The feature of the skin has to state it; an entry that is no feature is passed over."""
    info = lerobot_set(tmp_path / "set", "v2.1") / lerobot.INFO
    content = json.loads(info.read_text())
    content["features"] |= {"odd": None, "odder": 3}
    info.write_text(json.dumps(content))
    assert len(episodes(tmp_path / "set")) == 4
    content["features"]["observation.tactile"]["shape"] = value
    info.write_text(json.dumps(content))
    with pytest.raises(FormatError, match="shape of observation"):
        episodes(tmp_path / "set")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(
    "columns",
    [{"task": ["a", "b"]}, {"task_index": [0, 1]}, {"n": [0, 1], "task": ["a", "b"]}],
    ids=str,
)
def test_tasks_of_lerobot_without_a_column(tmp_path: Path, version: str, columns: dict[str, Any]):
    """The message lists the columns that are there."""
    pa = pytest.importorskip("pyarrow")
    folder = lerobot_set(tmp_path / "set", version)
    if version == "v3.0":
        pytest.importorskip("pyarrow.parquet").write_table(
            pa.table(columns), folder / lerobot.TASKS[1]
        )
    else:
        rows = [json.dumps({k: values[i] for k, values in columns.items()}) for i in range(2)]
        (folder / lerobot.TASKS[0]).write_text("\n".join(rows))
    with pytest.raises(FormatError):
        episodes(folder)


@pytest.mark.parametrize("column", ["frame_index", "episode_index"])
@pytest.mark.parametrize("value", [None, "x", 0.5])
def test_a_number_of_lerobot_that_is_none(tmp_path: Path, column: str, value: Any):
    """The columns that cut a file into episodes."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = next(lerobot_set(tmp_path / "set", "v3.0").glob("data/**/*.parquet"))
    whole = parquet.read_table(path)
    parquet.write_table(
        whole.drop_columns([column]).append_column(column, pa.array([value] * len(whole))), path
    )
    with pytest.raises(FormatError, match=column):
        episodes(tmp_path / "set")


@pytest.mark.parametrize("value", ["abc", np.inf, np.array([1, 2]), h5py.Empty("f8")], ids=repr)
def test_a_range_of_octave_without_a_length(tmp_path: Path, value: Any):
    """OCTAVE_RANGE_NELEM says how many numbers a range has."""
    path = octave(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["t/value"].attrs["OCTAVE_RANGE_NELEM"] = value
    with pytest.raises(FormatError, match="OCTAVE_RANGE_NELEM"):
        raw_files.read(path, ReadPlan("skin", "t"))


def test_a_range_of_octave_without_a_base(tmp_path: Path):
    """A range that is plain numbers."""
    path = octave(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["t/value"]
        file["t/value"] = np.zeros(3)
        file["t/value"].attrs["OCTAVE_RANGE_NELEM"] = np.int64(3)
    with pytest.raises(FormatError, match="t/value is a range"):
        raw_files.read(path, ReadPlan("skin", "t"))
