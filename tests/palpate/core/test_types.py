"""The format of a sweep with one axis and with several, and files of both."""

from __future__ import annotations

import json

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.core.schema import typed
from palpate.core.sweep_file import load, save
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict
from tests.factories import toy_bundle
from tests.factories.paths import ONE_AXIS

PILLARS = SweepFormat(3, 3, 1000.0, 2000, "float32", 3)


def test_a_format_with_axes():
    """Text, shape and JSON have the axes where there are several."""
    plain = SweepFormat(3, 3, 1000.0, 2000, "float32")
    for format, shape, text in ((PILLARS, (3, 3, 3), "3x3x3"), (plain, (3, 3), "3x3")):
        assert (format.shape, format.channels) == (shape, np.prod(shape))
        assert str(format) == f"{text} float32 at 1000 Hz, window 2000"
        assert typed(SweepFormat, json.loads(json.dumps(format.json()))) == format
        assert Frames.empty(format).taxels.shape == (0, *shape)
    assert list(plain.json()) == ["rows", "cols", "rate_hz", "window", "dtype"]
    assert list(PILLARS.json()) == [*plain.json(), "axes"]
    assert PILLARS.skin != plain.skin


@pytest.mark.parametrize("axes", [0, 9, -1])
def test_axes_out_of_range(axes):
    """The message has the number."""
    with pytest.raises(FormatError, match=f"{axes} axes"):
        SweepFormat(3, 3, 1000.0, 2000, "float32", axes)


def test_a_recording_with_axes_comes_back(tmp_path):
    """All counts and the format; records of one axis under a sidecar with three are refused."""
    taxels = np.arange(5 * 27, dtype="<f4").reshape(5, 3, 3, 3)
    sweep = Sweep(1, 0, 9, Status.OK, Frames(np.arange(5), np.arange(5), taxels))
    save(tmp_path / "s.npy", sweep, PILLARS)
    again, format = load(tmp_path / "s.npy")
    assert format == PILLARS
    np.testing.assert_array_equal(again.frames.taxels, taxels)
    sidecar = tmp_path / "s.json"
    sidecar.write_text(sidecar.read_text().replace('"axes": 3', '"axes": 2'))
    with pytest.raises(FormatError, match="3x3x2 float32"):
        load(tmp_path / "s.npy")


def test_a_recording_is_written_byte_for_byte(tmp_path):
    """A recorded file is read, and written again with the same bytes."""
    sweep, format = load(ONE_AXIS / "sweep.npy")
    assert (format, sweep.frames.taxels.shape) == (toy_bundle.FORMAT, (20, 2, 2))
    about = json.loads((ONE_AXIS / "sweep.json").read_text())
    save(tmp_path / "sweep.npy", sweep, format, {"verdict": about["verdict"]})
    for name in ("sweep.npy", "sweep.json"):
        assert (tmp_path / name).read_bytes() == (ONE_AXIS / name).read_bytes()


def test_the_packaged_manifest_is_written_as_it_is(default_bundle):
    """Byte for byte, so that its id stays."""
    assert default_bundle.manifest.json() == (bundle.DEFAULT / bundle.MANIFEST).read_bytes()


def test_an_answer_without_a_label_has_what_is_known_of_its_sweep():
    """Its latency counts from the frame or edge that completed the sweep."""
    about = {"lost": 3, "share": 0.5, "speed_mm_s": 30.0, "force_n": 1.5}
    sweep = Sweep(7, 1, 2, Status.SHORT, Frames.empty(PILLARS), complete_ns=40, **about)
    v = Verdict.of(sweep, Status.GAP, 100, "b", detail="why")
    assert (v.sweep, v.time_ns, v.status, v.detail, v.bundle) == (7, 100, Status.GAP, "why", "b")
    assert {name: getattr(v, name) for name in about} == about
    assert (v.latency_ns, v.label, v.probability, v.margin, v.fused) == (60, "", 0, 0, 0)
    assert (len(v.scores), len(v.own), v.after) == (0, 0, 0)
    bare = Sweep(7, 1, 2, Status.SHORT, Frames.empty(PILLARS))
    assert Verdict.of(bare, Status.SHORT, 100, "").latency_ns == 100
    assert (bare.lost, bare.object, bare.share) == (0, 0, 1)
