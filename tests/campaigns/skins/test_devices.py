"""The box with an emulated skin: the recorded counts are the simulated ones."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from palpate.core import config, sweep_file, types
from palpate.core.types import Status
from palpate.io import skins
from palpate.sim import rig, script
from tests.campaigns.skins.command import main
from tests.factories.paths import NO_SITE
from tests.factories.skins import devices, sweeps
from tests.factories.skins.wires import WIRES

SEED, SWEEPS = 3, 2


def settings(name: str) -> config.Config:
    """The settings of a box with this skin."""
    return config.load(None, [f"skin.profile={name}"], site=NO_SITE)


@pytest.mark.slow
@pytest.mark.parametrize("name", WIRES)
def test_what_is_recorded_is_what_was_felt(name: str, tmp_path: Path) -> None:
    """`record --sim skin:wood --skin NAME`: each window is its slide's middle, to the count."""
    words = f"record --sim skin:wood --skin {name} --virtual --seed {SEED} --sweeps {SWEEPS} --out"
    assert main([*words.split(), str(tmp_path)]) == 0
    profile = skins.profile(settings(name))
    acts = islice(script.tubes(SEED, seen=sweeps.view(name, profile.format), only="wood"), SWEEPS)
    for path, act in zip(sorted(tmp_path.glob("*.npy")), acts, strict=True):
        sweep, format = sweep_file.load(path)
        assert format == profile.format
        assert (sweep.status, sweep.lost) == (Status.OK, 0)
        begin = (act.start + act.stop - format.window) / 2
        felt = [act.frames[int(begin + more) :][: format.window].astype(float) for more in (0, 0.5)]
        rounding = 0.006 if name == "reskin" else 0.0  # two digits after the point
        assert min(abs(sweep.frames.taxels - window).max() for window in felt) <= rounding


def test_unplugged_and_plugged_in_again() -> None:
    """The state shows it, the skin is used again, numbers go on in the next epoch."""
    chosen = settings("papillarray")
    profile = skins.profile(chosen)
    acts = script.tubes(1, seen=sweeps.view("papillarray", profile.format))
    played = devices.build("papillarray", profile, profile.format, acts, rig.VirtualClock(), "sim")
    sensor = skins.sensor(played.wire(chosen), profile.format, played)

    def until(state: str) -> list[int]:
        numbers: list[int] = []
        for _ in range(1000):
            numbers += sensor.read().seq.tolist()
            if sensor.state == state and (numbers or state != "streaming"):
                return numbers
        raise AssertionError(f"{sensor.state}: {sensor.trouble}")

    first = until("streaming")
    played.player.unplug()
    until("lost")
    until("absent")
    played.player.plug()
    second = until("streaming")
    assert sensor.counters.enumerations == 2
    assert second[0] >> types.EPOCH_BITS == (first[0] >> types.EPOCH_BITS) + 1
    assert (np.diff(second) == 1).all()
    assert sensor.counters.lost_frames == 0
    sensor.close()


def test_demo_without_a_bundle_for_the_skin(capsys: pytest.CaptureFixture[str]) -> None:
    """One line with the missing bundle and how to make it."""
    assert main(["demo", "--skin", "papillarray", "--virtual", "--sweeps", "1"]) == 65
    (line,) = capsys.readouterr().err.splitlines()
    for named in ("3x3x3 float32 at 1000 Hz", "4x4 uint8 at 750 Hz", "classifier.bundle=DIR"):
        assert named in line


@pytest.mark.slow
def test_replayed_set_through_the_bytes_of_a_skin(tmp_path: Path) -> None:
    """`--sim replay:SET --skin NAME` plays a set of that skin over its line."""
    format = skins.profile(settings("flexitac")).format
    rng = np.random.default_rng(1)
    samples = rng.integers(0, 200, (2, format.window, *format.shape)).astype(np.uint8)
    told = {"labels": [0, 1], "materials": ["a", "b"], "rate_hz": format.rate_hz}
    np.savez(tmp_path / "s.npz", samples=samples, **told)
    arguments = ["--sim", f"replay:{tmp_path / 's.npz'}", "--skin", "flexitac", "--virtual"]
    assert main(["record", *arguments, "--out", str(tmp_path / "kept")]) == 0
    kept = [
        sweep_file.load(path)[0].frames.taxels for path in sorted((tmp_path / "kept").glob("*.npy"))
    ]
    assert [window.tobytes() for window in kept] == [window.tobytes() for window in samples]
