"""Captures and saved sweeps: replaying gives the same results bit for bit."""

from __future__ import annotations

import itertools
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle.bundle import Bundle
from palpate.core.config import SweepConfig
from palpate.core.errors import ConfigError, FormatError
from palpate.core.types import (
    EPOCH_BITS,
    Edge,
    EdgeKind,
    Frames,
    Status,
    Sweep,
    Verdict,
    load,
    save,
)
from palpate.io import packets
from palpate.io.robot_link import StdoutPort
from palpate.runtime import assembly
from palpate.runtime.loop import Box, Pipeline
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.capture import MOST_KEPT, CaptureWriter, Playback, RecordKind
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories import toy_bundle
from tests.factories.paths import ONE_AXIS
from tests.factories.settings import load as load_settings
from tests.factories.simulated_box import SECOND, OnSweep, Rigged
from tests.factories.skin_wires import WiredSkin, profile

UNTIL_NEW_OBJECT = (
    "classifier.conflict=fuse",
    "classifier.max_sweeps=0",
    "classifier.object_s=0",
)
"""The settings with which only NEW OBJECT ends an object, as in versions before 0.2."""


def played(
    path: Path, model: Bundle, sets: tuple[str, ...] = ()
) -> tuple[list[Verdict], list[Sweep]]:
    """Verdicts and sweeps of a capture."""
    play = Playback(path)
    sweeps: list[Sweep] = []
    verdicts: list[Verdict] = []
    port = StdoutPort("replay", play.commands)
    classifier = assembly.classifier(load_settings(sets), model, play)
    pipeline = Pipeline(play, play, SweepCutter(play.format, SweepConfig()), classifier)
    box = Box(
        pipeline, play, port=port, observers=[OnSweep(lambda sweep, verdict: sweeps.append(sweep))]
    )
    while not play.finished:
        verdicts += box.step()
    return verdicts, sweeps


def test_frames_before_the_skin_counts_as_streaming_are_not_replayed(tmp_path: Path):
    """A skin that was too fast must send for some seconds before it streams. Replay gives exactly
    the frames that the sensor returned."""
    capture = CaptureWriter(tmp_path / "capture", profile("matrix").format, profile("matrix"))
    wired = WiredSkin("matrix", rate=2.0, tap=capture)
    wired.seconds(4)
    assert wired.sensor.state == "mismatch"
    wired.port.period_ns = wired.format.period_ns
    wired.port.begun_ns = wired.clock.now_ns() - round(wired.port._next * wired.port.period_ns)
    later = wired.seconds(10)
    capture.close()
    assert wired.sensor.state == "streaming"
    play, parts = Playback(tmp_path / "capture"), []
    while not play.finished:
        parts.append(play.read())
    again = Frames.joined(parts)
    assert len(later) > 100
    np.testing.assert_array_equal(again.seq[-len(later) :], later.seq)
    np.testing.assert_array_equal(again.t_ns[-len(later) :], later.t_ns)
    np.testing.assert_array_equal(again.taxels[-len(later) :], later.taxels)
    first = again.seq[-len(later) - 1] >> EPOCH_BITS
    assert first < later.seq[0] >> EPOCH_BITS


@pytest.mark.slow
def test_a_capture_gives_the_same_verdicts_bit_for_bit(
    rigged: Callable[..., Rigged], default_bundle: Bundle, tmp_path: Path
):
    """With drift, spikes, lost transfers, an unplugged skin and NEW OBJECT, replay gives the same
    windows, times and scores."""
    rng = np.random.default_rng(5)
    acts = list(script.tubes(1010, 8, only="wood"))
    acts[3] = rig.Act(acts[3].frames, acts[3].start, acts[3].stop, acts[3].label, new_object=True)
    simulated = devices.build(skin.FORMAT, acts, rig.VirtualClock(), "sim")
    simulated.backend.board = rig.ReadoutBoard(
        skin.FORMAT,
        simulated.robot,
        simulated.clock,
        ppm=80,
        latency=lambda: int(
            rng.exponential(100_000) + (rng.random() < 0.01) * rng.uniform(5e6, 4e7)
        ),
    )
    simulated.backend.mangle = lambda data: b"" if rng.random() < 0.001 else data
    begin = simulated.clock.now_ns()
    simulated.backend.at(begin + 9 * SECOND, simulated.backend.unplug)
    simulated.backend.at(begin + 10 * SECOND, simulated.backend.plug)
    capture = CaptureWriter(tmp_path / "capture", skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    verdicts, sweeps = played(tmp_path / "capture", default_bundle)
    assert [(v.sweep, v.status, v.label, v.fused, v.lost) for v in verdicts] == [
        (v.sweep, v.status, v.label, v.fused, v.lost) for v in first
    ]
    assert {str(v.status) for v in first} >= {"sensor-lost"}
    assert max(v.fused for v in first) > 1
    for a, b in zip(first, verdicts, strict=True):
        assert a.scores.tobytes() == b.scores.tobytes()
    for a, b in zip(box.kept, sweeps, strict=True):
        assert a.frames.taxels.tobytes() == b.frames.taxels.tobytes()
        assert (a.frames.t_ns == b.frames.t_ns).all()


def test_a_capture_from_before_there_were_axes(tmp_path: Path):
    """Its sweeps get their original verdicts with the settings of then."""
    model = toy_bundle.load(tmp_path / "bundle")
    verdicts, sweeps = played(ONE_AXIS / "capture", model, UNTIL_NEW_OBJECT)
    then = json.loads((ONE_AXIS / "verdicts.json").read_text())
    assert [(v.sweep, v.status, v.label, v.fused) for v in verdicts] == [
        (v["sweep"], v["status"], v["label"], v["fused"]) for v in then
    ]
    np.testing.assert_allclose([v.scores for v in verdicts], [v["scores"] for v in then], rtol=1e-5)
    np.testing.assert_array_equal(
        sweeps[1].frames.taxels, load(ONE_AXIS / "sweep.npy")[0].frames.taxels
    )


@pytest.mark.slow
def test_commands_are_part_of_a_capture(
    rigged: Callable[..., Rigged], default_bundle: Bundle, tmp_path: Path
):
    """NEW and ABORT affect later sweeps, so they are captured: replayed sweeps are fused and end as
    before."""
    simulated = devices.build(
        skin.FORMAT, script.tubes(1014, 5, only="wood"), rig.VirtualClock(), "sim"
    )
    capture = CaptureWriter(tmp_path / "capture", skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: box.box.answered == 1)
    assert ",NEW,ok" in box.ask("$PPLP,NEW")
    first += box.until(lambda: box.box.answered == 3)
    first += box.seconds(2)
    os.write(box.far_end, b"$PPLP,ABORT\r\n")
    first += box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    verdicts, _ = played(tmp_path / "capture", default_bundle)
    assert [v.fused for v in first] == [1, 1, 2, 0, 3]
    assert [(v.status, v.label, v.fused) for v in verdicts] == [
        (v.status, v.label, v.fused) for v in first
    ]
    for a, b in zip(first, verdicts, strict=True):
        assert a.scores.tobytes() == b.scores.tobytes()


def test_a_capture_of_a_skin_that_sent_another_format(
    rigged: Callable[..., Rigged], default_bundle: Bundle, tmp_path: Path
):
    """After packets of another grid in the stream the sweep is `sensor-lost`, live and in the
    replay."""
    simulated = devices.build(skin.FORMAT, script.tubes(1015, 2), rig.VirtualClock(), "sim")
    count = itertools.count()
    other = packets.pack(0, 0, np.zeros((1, 2, 2), np.uint8))
    simulated.backend.mangle = lambda data: other if next(count) == 200 else data
    capture = CaptureWriter(tmp_path / "capture", skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    verdicts, _ = played(tmp_path / "capture", default_bundle)
    assert first[0].status == "sensor-lost"
    assert [v.status for v in verdicts] == [v.status for v in first]


def test_a_capture_that_was_cut_off_plays_up_to_there(
    rigged: Callable[..., Rigged], default_bundle: Bundle, tmp_path: Path
):
    """After a power cut within a record, all earlier records are played."""
    simulated = devices.build(skin.FORMAT, script.tubes(1011, 2), rig.VirtualClock(), "sim")
    capture = CaptureWriter(tmp_path / "capture", skin.FORMAT)
    box = rigged(simulated, capture=capture)
    box.until(lambda: box.box.answered == 2)
    capture.close()
    data = (tmp_path / "capture").read_bytes()
    (tmp_path / "cut").write_bytes(data[: len(data) - 7])
    assert len(played(tmp_path / "cut", default_bundle)[0]) == 1
    (tmp_path / "half").write_bytes(data[: len(data) * 2 // 3])
    assert len(played(tmp_path / "half", default_bundle)[0]) == 1


def test_a_restart_keeps_the_capture_before(tmp_path: Path, logged: list[str]):
    """Earlier captures get the next number. If there are too many, the start is refused and nothing
    is overwritten."""
    path = tmp_path / "capture"
    for edges in range(3):
        capture = CaptureWriter(path, skin.FORMAT)
        capture.edges(7, [Edge(EdgeKind.START, 7)] * edges)
        capture.close()
    sizes = [(tmp_path / name).stat().st_size for name in ("capture.1", "capture.2", "capture")]
    assert sizes == sorted({*sizes})
    assert logged[-1] == f"capture: {path} of an earlier start was renamed to capture.2"
    for i in range(3, MOST_KEPT + 1):
        (tmp_path / f"capture.{i}").touch()
    with pytest.raises(
        ConfigError, match="99 captures of earlier starts are beside it; move them away"
    ):
        CaptureWriter(path, skin.FORMAT)
    assert path.stat().st_size == sizes[-1]


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        (b"GIF89a", "not a capture"),
        (b"PPLPCAP1\x02\x00\x00\x00{}", "head cannot be read"),
        (b"PPLPCAP1\x05\x00\x00\x00{nope", "head cannot be read"),
    ],
)
def test_other_files_are_named(tmp_path: Path, content: bytes, hint: str):
    """The error says that the file is not a capture."""
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(FormatError, match=hint):
        Playback(tmp_path / "x")


def test_a_missing_capture(tmp_path: Path):
    """No file."""
    with pytest.raises(FormatError, match="cannot be read"):
        Playback(tmp_path / "x")


def test_speed_and_force_are_part_of_a_capture(tmp_path: Path):
    """Edges come back with them, and edges without them are written as before."""
    plain, with_speed = Edge(EdgeKind.STOP, 5), Edge(EdgeKind.START, 6, 30.0)
    capture = CaptureWriter(tmp_path / "x", skin.FORMAT)
    capture.edges(7, [plain])
    capture.edges(8, [plain, with_speed, Edge(EdgeKind.START, 7, 0.1, 1.5)])
    capture.command(9, "START,30")
    capture.close()
    play = Playback(tmp_path / "x")
    assert play.edges(7) == [plain]
    assert play.edges(8) == [plain, with_speed, Edge(EdgeKind.START, 7, 0.1, 1.5)]
    play.read()
    assert [command.line for command in play.commands()] == ["START,30"]
    as_before = struct.pack("<BQIQB", RecordKind.EDGES, 7, 9, 5, [*EdgeKind].index(plain.kind))
    assert as_before in (tmp_path / "x").read_bytes()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0])
def test_a_speed_that_was_never_written(tmp_path: Path, value: float):
    """A record with a speed that the box cannot have received is refused by its place."""
    capture = CaptureWriter(tmp_path / "x", skin.FORMAT)
    capture.edges(7, [Edge(EdgeKind.START, 6, value)])
    capture.close()
    with pytest.raises(FormatError, match=r"record of kind 4 with 25 bytes at byte \d+ is unknown"):
        Playback(tmp_path / "x")


def test_an_unknown_record(tmp_path: Path):
    """A record of a kind that this version does not know."""
    capture = CaptureWriter(tmp_path / "x", skin.FORMAT)
    capture.transfer(1, b"data")
    capture.close()
    data = bytearray((tmp_path / "x").read_bytes())
    data[-17] = 9
    (tmp_path / "x").write_bytes(data)
    with pytest.raises(FormatError, match="kind 9"):
        Playback(tmp_path / "x")


def test_saved_sweeps_are_read_as_they_were(rigged: Callable[..., Rigged], tmp_path: Path):
    """Frames, times, numbers and status are read again, and there are only the two files."""
    simulated = devices.build(skin.FORMAT, script.tubes(1012, 1), rig.VirtualClock(), "sim")
    box = rigged(simulated)
    box.until(lambda: simulated.finished(box.box.answered))
    (sweep,) = box.kept
    save(tmp_path / "s.npy", sweep, skin.FORMAT)
    again, format = load(tmp_path / "s.npy")
    assert format == skin.FORMAT
    assert (again.id, again.status, again.start_ns, again.stop_ns) == (
        sweep.id,
        sweep.status,
        sweep.start_ns,
        sweep.stop_ns,
    )
    for k in ("t_ns", "seq", "taxels"):
        assert (getattr(again.frames, k) == getattr(sweep.frames, k)).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.json", "s.npy"]


@pytest.mark.parametrize(
    ("spoil", "hint"),
    [
        (lambda d: (d / "s.json").unlink(), "not a recorded sweep"),
        (lambda d: (d / "s.json").write_text("{}"), "not a recorded sweep"),
        (
            lambda d: (d / "s.json").write_text(
                (d / "s.json").read_text().replace('"schema": 1', '"schema": 7')
            ),
            "schema 7",
        ),
        (
            lambda d: (d / "s.json").write_text(
                (d / "s.json").read_text().replace('"rows": 4', '"rows": 3')
            ),
            "do not fit",
        ),
        (lambda d: (d / "s.json").write_text("3"), "not a recorded sweep"),
        (lambda d: (d / "s.npy").write_bytes(b"nonsense"), "not a recorded sweep"),
        (lambda d: (d / "s.npy").write_bytes(b""), "not a recorded sweep"),
        (lambda d: np.save(d / "s.npy", np.array([{}]), allow_pickle=True), "not a recorded sweep"),
    ],
)
def test_broken_recordings_are_named(
    rigged: Callable[..., Rigged], tmp_path: Path, spoil, hint: str
):
    """A missing or broken sidecar, an unknown schema, another grid, a broken array, a pickle."""
    simulated = devices.build(skin.FORMAT, script.tubes(1013, 1), rig.VirtualClock(), "sim")
    box = rigged(simulated)
    box.until(lambda: simulated.finished(box.box.answered))
    save(tmp_path / "s.npy", box.kept[0], skin.FORMAT)
    spoil(tmp_path)
    with pytest.raises(FormatError, match=hint):
        load(tmp_path / "s.npy")


def kept(n: int) -> Sweep:
    """Sweep number `n` of 40 frames."""
    frames = Frames(np.arange(40), np.arange(40), np.full((40, 4, 4), n, np.uint8))
    return Sweep(n, 0, 40, Status.OK, frames)


def test_a_name_that_cannot_be_taken_leaves_nothing(tmp_path: Path):
    """If the second of the two files cannot be renamed, the first file is removed, too."""
    (tmp_path / "sweep-000001.npy").mkdir()
    with pytest.raises(OSError, match="directory"):
        save(tmp_path / "sweep-000001.npy", kept(1), skin.FORMAT)
    assert [p.name for p in tmp_path.iterdir()] == ["sweep-000001.npy"]
