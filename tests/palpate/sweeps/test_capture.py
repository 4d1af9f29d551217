"""Captures and saved sweeps: replaying gives the same results bit for bit."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle.bundle import Bundle
from palpate.core.config import SweepConfig
from palpate.core.errors import ConfigError, FormatError
from palpate.core.sweep_file import load, save
from palpate.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier
from palpate.io import packets
from palpate.io.robot_link import StdoutPort
from palpate.runtime.loop import Box
from palpate.sim import devices, rig, script, skin
from palpate.sweeps.capture import MOST_KEPT, CaptureWriter, Playback
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories import toy_bundle
from tests.factories.settings import load as load_settings
from tests.factories.simulated_box import SECOND, OnSweep, tubes
from tests.factories.skin_wires import WiredSkin, profile


def played(path: Path, model: Bundle) -> tuple[list[Verdict], list[Sweep]]:
    """Verdicts and sweeps of a capture."""
    play = Playback(path)
    sweeps: list[Sweep] = []
    verdicts: list[Verdict] = []
    classifier = Classifier(model, play, load_settings().classifier)
    parts = play, play, SweepCutter(play.format, SweepConfig()), classifier, play
    observers = [OnSweep(lambda sweep, verdict: sweeps.append(sweep))]
    box = Box(*parts, port=StdoutPort(play.commands), observers=observers)
    while not play.finished:
        verdicts += box.step()
    return verdicts, sweeps


def all_values(v: Verdict) -> tuple[object, ...]:
    """The values that a replay must repeat."""
    return v.sweep, v.status, v.label, v.fused, v.lost, v.scores.tobytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a capture is written."""
    return tmp_path / "capture"


def test_frames_before_the_skin_counts_as_streaming_are_not_replayed(path):
    """After it was too fast, for seconds."""
    capture = CaptureWriter(path, profile("matrix").format, profile("matrix"))
    wired = WiredSkin("matrix", rate=2.0, tap=capture)
    wired.seconds(4)
    assert wired.sensor.state == "mismatch"
    wired.port.period_ns = wired.format.period_ns
    wired.port.begun_ns = wired.clock.now_ns() - round(wired.port._next * wired.port.period_ns)
    later = wired.seconds(10)
    capture.close()
    assert wired.sensor.state == "streaming"
    play, parts = Playback(path), []
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
def test_a_capture_gives_the_same_verdicts_bit_for_bit(rigged, default_bundle, path):
    """With drift, losses, an unplugged skin and NEW."""
    rng = np.random.default_rng(5)
    acts = list(script.tubes(1010, 8, only="wood"))
    acts[3] = rig.Act(acts[3].frames, acts[3].start, acts[3].stop, acts[3].label, new_object=True)
    simulated = devices.build(skin.FORMAT, acts, rig.VirtualClock(), "sim")

    def latency() -> int:
        spike = (rng.random() < 0.01) * rng.uniform(5e6, 4e7)
        return int(rng.exponential(100_000) + spike)

    simulated.backend.board = rig.ReadoutBoard(
        skin.FORMAT, simulated.robot, simulated.clock, ppm=80, latency=latency
    )
    simulated.backend.mangle = lambda data: b"" if rng.random() < 0.001 else data
    begin = simulated.clock.now_ns()
    simulated.backend.at(begin + 9 * SECOND, simulated.backend.unplug)
    simulated.backend.at(begin + 10 * SECOND, simulated.backend.plug)
    capture = CaptureWriter(path, skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    verdicts, sweeps = played(path, default_bundle)
    assert list(map(all_values, verdicts)) == list(map(all_values, first))
    assert "sensor-lost" in {str(v.status) for v in first}
    assert max(v.fused for v in first) > 1
    for a, b in zip(box.kept, sweeps, strict=True):
        assert a.frames.taxels.tobytes() == b.frames.taxels.tobytes()
        assert (a.frames.t_ns == b.frames.t_ns).all()


@pytest.mark.slow
def test_commands_are_part_of_a_capture(rigged, default_bundle, path):
    """NEW and ABORT: sweeps are fused and end as before."""
    simulated = tubes(1014, 5, only="wood")
    capture = CaptureWriter(path, skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: box.box.answered == 1)
    assert ",NEW,ok" in box.ask("$PPLP,NEW")
    first += box.until(lambda: box.box.answered == 3)
    first += box.seconds(2)
    os.write(box.far_end, b"$PPLP,ABORT\r\n")
    first += box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    assert [v.fused for v in first] == [1, 1, 2, 0, 3]
    verdicts, _ = played(path, default_bundle)
    assert list(map(all_values, verdicts)) == list(map(all_values, first))


def test_a_capture_of_a_skin_that_sent_another_format(rigged, default_bundle, path):
    """`sensor-lost` both times; a cut record ends it."""
    simulated = tubes(1015, 2)
    count = itertools.count()
    other = packets.pack(0, 0, np.zeros((1, 2, 2), np.uint8))
    simulated.backend.mangle = lambda data: other if next(count) == 200 else data
    capture = CaptureWriter(path, skin.FORMAT)
    box = rigged(simulated, capture=capture)
    first = box.until(lambda: simulated.finished(box.box.answered))
    capture.close()
    verdicts, _ = played(path, default_bundle)
    assert first[0].status == "sensor-lost"
    assert [v.status for v in verdicts] == [v.status for v in first]
    data, whole = path.read_bytes(), list(map(all_values, verdicts))
    for size, answered in ((len(data) - 7, 2), (len(data) * 2 // 3, 1), (1000, 0)):
        path.write_bytes(data[:size])
        assert list(map(all_values, played(path, default_bundle)[0])) == whole[:answered]


def test_a_restart_keeps_the_capture_before(tmp_path, path, logged):
    """The next number; too many refuse the start."""
    for edges in range(3):
        capture = CaptureWriter(path, skin.FORMAT)
        capture.triggered(7, [Edge(EdgeKind.START, 7)] * edges)
        capture.close()
    sizes = [(tmp_path / name).stat().st_size for name in ("capture.1", "capture.2", "capture")]
    assert sizes == sorted({*sizes})
    assert str(path) in logged[-1]
    assert logged[-1].endswith("capture.2")
    for i in range(3, MOST_KEPT + 1):
        (tmp_path / f"capture.{i}").touch()
    with pytest.raises(ConfigError, match="99 older"):
        CaptureWriter(path, skin.FORMAT)
    assert path.stat().st_size == sizes[-1]


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        (b"GIF89a", "not a capture"),
        (b"PPLPCAP1\x02\x00\x00\x00{}", "head cannot be read"),
        (b"PPLPCAP1\x05\x00\x00\x00{nope", "head cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_other_files_are_named(path, content, hint):
    """The error says that the file is not a capture, or is not there."""
    if content:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=hint):
        Playback(path)


def test_speed_and_force_are_part_of_a_capture(path):
    """Edges come back with them, and edges without them, too."""
    plain, with_speed = Edge(EdgeKind.STOP, 5), Edge(EdgeKind.START, 6, 30.0)
    capture = CaptureWriter(path, skin.FORMAT)
    capture.triggered(7, [plain])
    capture.triggered(8, [plain, with_speed, Edge(EdgeKind.START, 7, 0.1, 1.5)])
    capture.command(9, "START,30")
    capture.close()
    play = Playback(path)
    assert play.edges(7) == [plain]
    assert play.edges(8) == [plain, with_speed, Edge(EdgeKind.START, 7, 0.1, 1.5)]
    play.read()
    assert [command.line for command in play.commands()] == ["START,30"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0])
def test_a_record_that_was_never_written_is_refused(path, value):
    """A speed that the box cannot have received, and a record of an unknown kind."""
    capture = CaptureWriter(path, skin.FORMAT)
    capture.triggered(7, [Edge(EdgeKind.START, 6, value)])
    capture.close()
    with pytest.raises(FormatError, match=r"2 .* \d+"):
        Playback(path)
    capture = CaptureWriter(path, skin.FORMAT)
    capture.transfer(1, b"data")
    capture.close()
    data = bytearray(path.read_bytes())
    data[-17] = 9
    path.write_bytes(data)
    with pytest.raises(FormatError, match="kind 9"):
        Playback(path)


def kept(n: int) -> Sweep:
    """Sweep number `n` of 40 frames."""
    frames = Frames(np.arange(40) + 5, np.arange(40), np.full((40, 4, 4), n, np.uint8))
    return Sweep(n, 7, 40, Status.OK, frames)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("json", lambda text: None),
        ("json", lambda text: b"{}"),
        ("json", lambda text: b"3"),
        ("json", lambda text: text.replace(b'"schema": 1', b'"schema": 7')),
        ("json", lambda text: text.replace(b'"rows": 4', b'"rows": 3')),
        ("npy", lambda data: b"nonsense"),
        ("npy", lambda data: b""),
        ("npy", lambda data: toy_bundle.npy(np.array([{}]))),
    ],
)
def test_broken_recordings_are_named(tmp_path, name, spoil):
    """A missing or broken sidecar, an unknown schema, another grid, a broken array, a pickle."""
    save(tmp_path / "s.npy", kept(1), skin.FORMAT)
    path = tmp_path / f"s.{name}"
    if (spoiled := spoil(path.read_bytes())) is None:
        path.unlink()
    else:
        path.write_bytes(spoiled)
    with pytest.raises(FormatError, match=r"s\.(npy|json)"):
        load(tmp_path / "s.npy")


def test_a_name_that_cannot_be_taken_leaves_nothing(tmp_path):
    """If the second of the two files cannot be renamed, the first file is removed, too."""
    (tmp_path / "sweep-000001.npy").mkdir()
    with pytest.raises(OSError, match="directory"):
        save(tmp_path / "sweep-000001.npy", kept(1), skin.FORMAT)
    assert [p.name for p in tmp_path.iterdir()] == ["sweep-000001.npy"]
