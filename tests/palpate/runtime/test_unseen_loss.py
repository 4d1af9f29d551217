"""A skin that does not count its frames: each sentence, status and sidecar says so."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from palpate.core.observer import Observer
from palpate.core.types import Frames
from palpate.io import skins
from palpate.io.skin_profile import from_json
from palpate.service import status
from palpate.sim import devices, skin
from palpate.sweeps.capture import CaptureWriter, Playback
from tests.factories.simulated_box import Rigged, idle_devices
from tests.factories.skin_wires import WiredSkin

pytestmark = pytest.mark.slow
Make = Callable[..., Rigged]
MATRIX = {"about": "a", "source": "s", "codec": "fixed", "marker": "aa55", "rate_hz": 750}
PROFILE = from_json(MATRIX, "test")


def on_a_matrix(
    rigged: Make, monkeypatch: pytest.MonkeyPatch, capture: CaptureWriter | None = None, **more
) -> tuple[Rigged, WiredSkin]:
    """A box whose skin is a matrix of 4x4 at 750 Hz, with a marker and nothing else."""
    simulated = idle_devices()
    more_of = {"clock": simulated.clock, "tap": capture, "grid": "4x4", "rate_hz": 750.0}
    wired = WiredSkin("matrix", skin.FORMAT, rate=7.5, **more_of)
    wired.port.frames = lambda i: b"\xaa\x55" + bytes((k + i) % 97 for k in range(16))
    monkeypatch.setattr(skins, "sensor", lambda settings, format, devices, tap: wired.sensor)
    return rigged(simulated, capture=capture, **more), wired


def swept(box: Rigged) -> str:
    """The RES sentence of a sweep of 3 s."""
    box.seconds(1)
    box.pulse(devices.START, 0.5)
    box.pulse(devices.STOP, 3.5)
    box.until(lambda: any(",RES," in line for line in box.heard))
    return next(line for line in box.heard if ",RES," in line)


def test_it_is_said_everywhere(rigged, monkeypatch):
    """Field 14 of RES, 18 of STA, words; frames are used as usual."""

    class Circumstances(Observer):
        """Keeps the circumstances of each sweep, which sidecars hold."""

        def __init__(self) -> None:
            self.kept: list[dict] = []

        def sweep(self, sweep, verdict, circumstances) -> None:
            self.kept.append(dict(circumstances))

    observer = Circumstances()
    box, _ = on_a_matrix(rigged, monkeypatch, observers=[observer])
    fields = swept(box).rpartition("*")[0].split(",")[2:]
    assert (len(fields), fields[13]) == (14, "1")
    box.seconds(2)
    last = next(line for line in reversed(box.heard) if ",STA," in line)
    state = last.rpartition("*")[0].split(",")[2:]
    assert (len(state), state[17]) == (18, "1")
    (about,) = observer.kept
    assert (about["loss_known"], about["device"]["board"]) == (False, "matrix")
    assert len(box.kept[0].frames) == skin.FORMAT.window
    health = box.box.health._asdict()
    assert health["loss_known"] is False
    report = {**health, "running": True, "pid": 1, "version": "", "since_ns": 0, "verdicts": []}
    assert any("least" in line for line in status.lines(report, 10**12))


def test_a_board_that_counts_says_nothing_of_it(rigged):
    """Sentences for readout boards of PROTOCOL.md do not have the fields."""
    box = rigged(idle_devices())
    assert len(swept(box).split(",")) == 15
    assert box.box.health.loss_known


@pytest.mark.parametrize("pause_s", [0.0, 0.4])
def test_a_capture_of_such_a_skin(rigged, monkeypatch, tmp_path, pause_s):
    """It holds the profile, so its bytes give the same frames again."""
    path = tmp_path / "capture"
    capture = CaptureWriter(path, skin.FORMAT, PROFILE)
    box, wired = on_a_matrix(rigged, monkeypatch, capture)
    frames: list[Frames] = []
    read = wired.sensor.read
    wired.sensor.read = lambda: (frames.append(read()), frames[-1])[1]
    box.seconds(1)
    wired.clock.sleep_until(wired.clock.now_ns() + round(pause_s * 1e9))
    box.seconds(2)
    capture.close()
    play, again = Playback(path), []
    while not play.finished:
        again.append(play.read())
        play.edges(play.now_ns())
    seen, replayed = Frames.joined(frames), Frames.joined(again)
    assert len(seen) > 2000
    for name in ("t_ns", "seq", "taxels"):
        assert (getattr(seen, name) == getattr(replayed, name)).all()
    assert not play.loss_known
