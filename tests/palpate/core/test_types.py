"""The format of a sweep with one axis and with several, and files of both."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.types import Frames, Status, Sweep, SweepFormat, load, save
from tests.factories import toy_bundle
from tests.factories.paths import ONE_AXIS

PILLARS = SweepFormat(3, 3, 1000.0, 2000, "float32", 3)


def test_a_format_with_axes():
    """Text, shape and JSON have the axes where there are several; with one all is as it was."""
    plain = SweepFormat(3, 3, 1000.0, 2000, "float32")
    assert (str(PILLARS), PILLARS.shape, PILLARS.channels) == (
        "3x3x3 float32 at 1000 Hz, window 2000",
        (3, 3, 3),
        27,
    )
    assert (str(plain), plain.shape, plain.channels) == (
        "3x3 float32 at 1000 Hz, window 2000",
        (3, 3),
        9,
    )
    assert list(plain.json()) == ["rows", "cols", "rate_hz", "window", "dtype"]
    assert list(PILLARS.json()) == [*plain.json(), "axes"]
    assert PILLARS.skin != plain.skin
    for format in (plain, PILLARS):
        assert typed(SweepFormat, json.loads(json.dumps(format.json()))) == format
        assert Frames.empty(format).taxels.shape == (0, *format.shape)


@pytest.mark.parametrize("axes", [0, 9, -1])
def test_axes_out_of_range(axes: int):
    """The message names the number and the limits."""
    with pytest.raises(
        FormatError, match=f"{axes} axes of each taxel are out of range; use 1 to 8"
    ):
        SweepFormat(3, 3, 1000.0, 2000, "float32", axes)


def test_a_recording_with_axes_comes_back(tmp_path: Path):
    """All counts and the format; records of one axis under a sidecar with three are refused."""
    taxels = np.arange(5 * 27, dtype="<f4").reshape(5, 3, 3, 3)
    sweep = Sweep(1, 0, 9, Status.OK, Frames(np.arange(5), np.arange(5), taxels))
    save(tmp_path / "s.npy", sweep, PILLARS)
    again, format = load(tmp_path / "s.npy")
    assert format == PILLARS
    np.testing.assert_array_equal(again.frames.taxels, taxels)
    sidecar = tmp_path / "s.json"
    sidecar.write_text(sidecar.read_text().replace('"axes": 3', '"axes": 2'))
    with pytest.raises(FormatError, match="do not fit the format 3x3x2 float32"):
        load(tmp_path / "s.npy")


def test_a_recording_from_before_there_were_axes(tmp_path: Path):
    """It is read, and written again byte for byte."""
    sweep, format = load(ONE_AXIS / "sweep.npy")
    assert (format, sweep.frames.taxels.shape) == (toy_bundle.FORMAT, (20, 2, 2))
    about = json.loads((ONE_AXIS / "sweep.json").read_text())
    save(tmp_path / "sweep.npy", sweep, format, {"verdict": about["verdict"]})
    for name in ("sweep.npy", "sweep.json"):
        assert (tmp_path / name).read_bytes() == (ONE_AXIS / name).read_bytes()


def test_a_bundle_of_one_axis_keeps_its_id(default_bundle: bundle.Bundle):
    """The manifest of the packaged bundle has no axes, and is written as it is on disk."""
    assert "axes" not in json.loads((bundle.DEFAULT / bundle.MANIFEST).read_text())["format"]
    assert default_bundle.manifest.json() == (bundle.DEFAULT / bundle.MANIFEST).read_bytes()
