"""Rate, noise, load and faults of a skin are those that were put into its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.core.types import Frames, SweepFormat
from palpate.tools import skin_monitor
from palpate.tools.skin_monitor import STUCK_S, LiveView, SkinMonitor, line

RATE = 100


def frames(taxels: np.ndarray, first: int = 0) -> Frames:
    """Frames with these taxels, 10 ms apart."""
    seq = first + np.arange(len(taxels), dtype=np.int64)
    return Frames(seq * 10_000_000, seq, taxels)


def signal(
    seconds: float, shape: tuple[int, ...] = (3, 4), noise: float = 2.0, seed: int = 1
) -> np.ndarray:
    """Noise around 50 raw counts, [n, *shape]."""
    return np.random.default_rng(seed).normal(50, noise, (round(seconds * RATE), *shape))


def monitor(taxels: np.ndarray, dtype: str = "float32", piece: int = 7) -> dict[str, object]:
    """The measurements of a monitor that gets these taxels piece by piece."""
    rows, cols, *axes = taxels.shape[1:]
    watched = SkinMonitor(SweepFormat(rows, cols, RATE, 2 * RATE, dtype, *axes))
    for at in range(0, len(taxels), piece):
        watched.take(frames(taxels[at : at + piece].astype(dtype), at))
    return watched.measured()


def at(taxels: np.ndarray, *changes: tuple[object, float]) -> np.ndarray:
    """Taxels with other values at these places."""
    for place, value in changes:
        taxels[place] = value
    return taxels


ALL, LONG = slice(None), STUCK_S + 1
LEFT_OUT = signal(6, noise=0.5)
LEFT_OUT[300:] += 100
LEFT_OUT[300:, 2, 1] -= 100
ENDS = at(signal(1), ((ALL, 1, 1), 255), ((ALL, 0, 0), 0))


@pytest.mark.parametrize(
    ("taxels", "dtype", "kind", "names"),
    [
        (at(signal(LONG), ((ALL, 0, 3), 255)), "float32", "stuck", ("1.4",)),
        (at(signal(4), ((ALL, 0, 3), 255)), "float32", "stuck", ()),
        (np.full((1000, 3, 4), 7.0), "float32", "stuck", (skin_monitor.ALL,)),
        (np.full((4, 3, 4), 7.0), "float32", "stuck", ()),
        (at(signal(LONG, (2, 2, 3)), ((ALL, 1, 0, 2), 0)), "float32", "stuck", ("2.1 axis 3",)),
        (LEFT_OUT, "float32", "dead", ("3.2",)),
        (signal(6), "float32", "dead", ()),
        (ENDS, "uint8", "saturated", ("2.2",)),
        (ENDS * 1e6, "float32", "saturated", ()),
    ],
)
def test_faulty_taxels_are_named(taxels, dtype, kind, names):
    """Still among moving, without load, at the type's end; or all still."""
    found = monitor(taxels, dtype)
    assert found[kind] == names
    axes = taxels.shape[3:] or (1,)
    assert np.array(found["load"]).shape == (*axes, *taxels.shape[1:3])


def test_rate_noise_and_load_are_measured_from_the_second_frame_on():
    """A slow touch is load; a new skin starts anew."""
    found = monitor(signal(4))
    assert found["rate_hz"] == pytest.approx(RATE, rel=1e-6)
    assert np.array(found["noise"]) == pytest.approx(np.full((1, 3, 4), 2.0), rel=0.25)
    taxels = signal(4)
    taxels[200:, 1, 2] += np.linspace(0, 400, 200)
    found = monitor(taxels)
    load = np.array(found["load"])[0]
    assert load.argmax() == 1 * 4 + 2
    assert load[1, 2] > 380
    assert found["full"] == pytest.approx(load.max(), rel=0.01)
    assert np.array(found["noise"]).max() < 4
    watched = SkinMonitor(SweepFormat(3, 4, RATE, 200, "float32"))
    assert watched.measured() == {}
    watched.take(frames(signal(1)))
    assert watched.measured()["rate_hz"]
    watched.reset()
    assert watched.measured() == {}


VIEW = LiveView(
    *(7, "usb", "flexitac 2x3 uint8 at 100 Hz", "streaming", "", (2, 3, 1)),
    load=(((0, 1, 2), (30, 60, 120)),),
    full=120,
    rate_hz=99.84,
    noise=(((1, 1, 2), (1, 1, 9)),),
    frames=12345,
    lost=3,
)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "streaming: 99.8 Hz, 12,345 frames, 3 lost, noise 1, at most 9 raw counts"),
        ({"lost": None, "unit": "N"}, "loss cannot be known, noise 1, at most 9 N"),
        ({"stuck": ("1.2",), "dead": ("2.1", "2.2")}, "; stuck: 1.2; dead: 2.1, 2.2"),
        ({"dead": tuple(f"1.{i}" for i in range(30))}, "1.7 and 22 more"),
        ({"source": "sim", "state": "absent", "trouble": "plug it in"}, "absent: plug it in"),
    ],
)
def test_a_line_has_rate_loss_noise_and_faults(changes, words):
    """Many faulty taxels are counted; a skin that does not stream says why."""
    shown = line(replace(VIEW, **changes))
    assert words in shown
    assert shown.startswith("SIMULATED") == ("source" in changes)
