"""Sweeps as MCAP: read back with the mcap library, as Foxglove reads them, and by the import."""

import base64
import json
from pathlib import Path

import mcap.reader
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.data import mcap_writer, raw_files
from palpate_train.data.files.table import ReadPlan

SAMPLES = np.arange(3 * 20 * 2 * 3, dtype=np.uint16).reshape(3, 20, 2, 3)


def saved(tmp_path: Path) -> str:
    path = tmp_path / "a.npz"
    labels = np.array([0, 1, 0])
    np.savez(path, samples=SAMPLES, labels=labels, materials=["felt", "wood"], rate_hz=100.0)
    return str(path)


def test_a_set_as_messages(tmp_path: Path):
    """Frames as images and as numbers, triggers and materials, in the order of their times."""
    out = tmp_path / "a.mcap"
    assert main(["sets", "mcap", saved(tmp_path), str(out)]) == 0
    with out.open("rb") as file:
        found = list(mcap.reader.make_reader(file).iter_messages(log_time_order=False))
    topics: dict[str, list[tuple[int, dict[str, object]]]] = {}
    for schema, channel, message in found:
        assert schema is not None
        assert schema.encoding == "jsonschema"
        assert json.loads(schema.data)["type"] == "object"
        topics.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    assert [value["data"] for _, value in topics["/trigger"]] == ["START", "STOP"] * 3
    assert [value["data"] for _, value in topics["/material"]] == ["felt", "wood", "felt"]
    times = [message.log_time for _, _, message in found]
    assert times == sorted(times)
    taxels = [value["taxels"] for _, value in topics["/skin"]]
    np.testing.assert_array_equal(taxels, SAMPLES.reshape(60, 6))
    image = topics["/skin/image"][21][1]
    assert (image["encoding"], image["width"], image["height"]) == ("16UC1", 3, 2)
    pixels = np.frombuffer(base64.b64decode(str(image["data"])), "<u2").reshape(2, 3)
    np.testing.assert_array_equal(pixels, SAMPLES[1, 1])


def test_the_import_reads_it_again(tmp_path: Path):
    """The counts with their materials."""
    mcap_writer.write(saved(tmp_path), tmp_path / "a.mcap")
    found = raw_files.read(tmp_path / "a.mcap", ReadPlan("/skin", fields=("/material",)))
    np.testing.assert_array_equal(found.values, SAMPLES.reshape(60, 6))
    assert found.labels["/material"] == ["felt"] * 20 + ["wood"] * 20 + ["felt"] * 20
    with pytest.raises(FormatError, match="there already"):
        mcap_writer.write(saved(tmp_path), tmp_path / "a.mcap")


@pytest.mark.slow
def test_recordings_with_their_verdicts(tmp_path: Path):
    """A folder of the box: a verdict at the end of each sweep, taxels without a number as null."""
    from palpate.__main__ import main as box

    words = "record --sim skin:wood --virtual --seed 1 --sweeps 2 --material wood --out"
    assert box([*words.split(), str(tmp_path / "kept")]) == 0
    sweeps, frames = mcap_writer.write(str(tmp_path / "kept"), tmp_path / "a.mcap")
    assert sweeps == 2
    assert box(["replay", str(tmp_path / "kept"), "--mcap", str(tmp_path / "b.mcap")]) == 0
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "a.mcap").read_bytes()
    with (tmp_path / "a.mcap").open("rb") as file:
        found = list(mcap.reader.make_reader(file).iter_messages(topics=["/verdict", "/skin"]))
    verdicts = [json.loads(m.data) for _, c, m in found if c.topic == "/verdict"]
    assert len(found) == frames + len(verdicts)
    assert [verdict["status"] for verdict in verdicts] == ["recorded"] * 2
