"""Stores of robot learning: Zarr with episodes, and MCAP with JSON, written by their libraries."""

import json
import zipfile
from pathlib import Path

import mcap.writer
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.data import raw_files, readers
from palpate_train.data.files.table import ReadPlan
from tests.factories.later import Later

zarr = Later("zarr")

SKIN = np.arange(40 * 4, dtype=np.uint16).reshape(40, 4)
TIMES = np.arange(40) / 10


def buffer(path: Path, version: int = 2) -> Path:
    """A replay buffer with two episodes, actions and materials."""
    group = zarr.open_group(path, mode="w", zarr_format=version)
    group.create_array("data/tactile", data=SKIN, chunks=(7, 3))
    group.create_array("data/action", data=np.zeros((40, 2), np.float32))
    group.create_array("data/timestamp", data=TIMES)
    group.create_array("meta/episode_ends", data=np.array([24, 40]))
    group.create_array("meta/material", data=np.array([b"wood", b"felt"]))
    group.attrs["skin"] = "mine"
    return path


@pytest.mark.parametrize("version", [2, 3])
def test_a_store_of_both_versions(tmp_path: Path, version: int):
    """The array, its times, where episodes end, the texts of episodes and attributes."""
    plan = ReadPlan("tactile", "data/timestamp", fields=("material",))
    found = raw_files.read(buffer(tmp_path / "a.zarr", version), plan)
    np.testing.assert_array_equal(found.values, SKIN)
    np.testing.assert_array_equal(found.vectors["data/timestamp"], TIMES)
    assert found.ends == (24, 40)
    assert found.labels["material"] == ["wood"] * 24 + ["felt"] * 16
    assert found.facts["skin"] == "mine"


def test_a_packed_store_and_other_archives(tmp_path: Path):
    """A .zip is read; others are to be unpacked or are cut off."""
    with zarr.storage.ZipStore(tmp_path / "a.zip", mode="w") as store:
        zarr.create_array(store, data=SKIN)
    np.testing.assert_array_equal(raw_files.read(tmp_path / "a.zip").values, SKIN)
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("a.csv", "1,2")
    (tmp_path / "c.zarr").mkdir()
    for name, said in (("b.zip", "unpack"), ("c.zarr", "zarr.json")):
        with pytest.raises(FormatError, match=said):
            raw_files.read(tmp_path / name)


def test_a_store_of_several_arrays_counts_as_a_file(tmp_path: Path):
    """They are listed, its chunks are not; ends of another number of frames are refused."""
    path = buffer(tmp_path / "a.zarr")
    with pytest.raises(FormatError, match="data/action"):
        raw_files.read(path)
    zarr.open_group(path, mode="a").create_array("data/short", data=SKIN[:9])
    with pytest.raises(FormatError, match="episode_ends"):
        raw_files.read(path, ReadPlan("data/short"))
    (tmp_path / "a.csv").write_text("1")
    buffer(tmp_path / "in" / "b.zarr")
    names = [path.relative_to(tmp_path).as_posix() for path in readers.files_below(tmp_path)]
    assert names == ["a.csv", "a.zarr", "in/b.zarr"]


def messages(path: Path, end: bool = True) -> Path:
    """An MCAP with a topic of frames and a topic of labels as JSON."""
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, chunk_size=600)
        writer.start()
        schema = writer.register_schema("Any", "jsonschema", b'{"type": "object"}')
        skin, label = (writer.register_channel(n, "json", schema) for n in ("/skin", "/label"))
        for i, row in enumerate(SKIN.tolist()):
            said = [(skin, {"taxels": row})]
            said += [(label, {"data": "felt" if i else "wood"})] if i in (2, 20) else []
            for channel, value in said:
                data = json.dumps(value).encode()
                writer.add_message(channel, i * 100_000_000, data, i * 100_000_000)
        if end:
            writer.finish()
    return path


def test_messages_of_json(tmp_path: Path):
    """Frames with the times of their recording, from the first label on; topics are listed."""
    path = messages(tmp_path / "a.mcap")
    found = raw_files.read(path, ReadPlan(fields=("/label", "label")))
    np.testing.assert_array_equal(found.values, SKIN[2:])
    np.testing.assert_allclose(found.vectors["received"], TIMES[2:], atol=1e-9)
    assert found.labels["/label"] == found.labels["label"] == ["felt"] * 38
    with pytest.raises(FormatError, match="/skin"):
        raw_files.read(path, ReadPlan("/other"))
    with pytest.raises(FormatError, match="recover"):
        raw_files.read(messages(tmp_path / "b.mcap", end=False))
    for profile, said in (("", r"/skin \(protobuf\)"), ("ros2", "in 'protobuf'")):
        with (tmp_path / "c.mcap").open("wb") as file:
            writer = mcap.writer.Writer(file)
            writer.start(profile)
            schema = writer.register_schema("skin.Frame", "protobuf", b"")
            writer.add_message(writer.register_channel("/skin", "protobuf", schema), 0, b"\0", 0)
            writer.finish()
        with pytest.raises(FormatError, match=said):
            raw_files.read(tmp_path / "c.mcap")


@pytest.mark.slow
def test_the_command_cuts_at_episodes_and_labels(tmp_path: Path):
    """No window lies in two episodes; a store can be the folder itself."""
    out = ["--grid", "2x2", "--window", "10", "--every", "10"]
    store = str(buffer(tmp_path / "all" / "a.zarr"))
    rate = ["--variable", "data/tactile", "--rate", "10", "--field", "material=material"]
    assert main(["import", store, *rate, *out, "--out", str(tmp_path / "z.npz")]) == 0
    made = np.load(tmp_path / "z.npz")
    assert sorted(made["samples"][:, 0, 0, 0].tolist()) == [0, 40, 96]
    (tmp_path / "m").mkdir()
    messages(tmp_path / "m" / "a.mcap")
    said = ["--field", "material=/label", "--time", "received:s"]
    assert main(["import", str(tmp_path / "m"), *said, *out, "--out", str(tmp_path / "m.npz")]) == 0
    assert len(np.load(tmp_path / "m.npz")["samples"]) == 3
