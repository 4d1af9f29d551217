"""A skin with three axes through the whole box: wire, windows, answers, files, replay."""

from __future__ import annotations

import numpy as np

from palpate.core import config
from palpate.core.sweep_file import load
from palpate.runtime.replay import replay
from palpate.sim import devices, rig
from palpate.sweeps.black_box import BlackBox
from palpate.sweeps.capture import CaptureWriter
from tests.factories import toy_bundle
from tests.factories.paths import NO_SITE

OFF = 400
"""Frames before and after a sweep, in which nothing touches the skin."""


def test_answers_are_those_of_the_replay(rigged, tmp_path, capsys):
    """Labels are right; kept sweeps and capture replay bit for bit."""
    fmt = toy_bundle.THREE_AXES

    def act(z1: float, z2: float, label: str) -> rig.Act:
        """A sweep with this embedding."""
        slide = np.concatenate([toy_bundle.window(z1, z2, fmt)] * 2)
        off = np.zeros((OFF, *fmt.shape), fmt.numpy_type)
        return rig.Act(np.concatenate([off, slide, off]), OFF, OFF + len(slide) - 1, label)

    model = toy_bundle.load(tmp_path / "bundle", format=fmt)
    stuck = act(0, 0, "stuck")
    stuck.frames[OFF:-OFF, 1, 0, 0] = 5
    acts = [act(0.4, 0.2, "a"), act(5.7, 0.1, "b"), stuck, act(0.3, 6.2, "c")]
    simulated = devices.build(fmt, acts, rig.VirtualClock(), "sim")
    kept, capture = BlackBox(tmp_path / "kept", fmt, 9), CaptureWriter(tmp_path / "capture", fmt)
    box = rigged(simulated, model=model, observers=[kept], capture=capture)
    box.until(lambda: box.box.counters.frames > 60)
    assert "largest 0.0" in box.ask("$PPLP,TARE")
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    kept.close()
    capture.close()
    assert [(v.status, v.label) for v in verdicts] == [
        ("ok", "a"),
        ("ok", "b"),
        ("stuck-taxel", ""),
        ("ok", "c"),
    ]
    assert verdicts[2].detail == "taxel 2.1 axis 1"
    sweep, format = load(sorted((tmp_path / "kept").rglob("*.npy"))[1])
    assert (format, sweep.frames.taxels.shape) == (fmt, (20, 2, 2, 3))
    np.testing.assert_array_equal(
        np.ptp(sweep.frames.taxels, axis=0), np.tile([4, 4, 2], (2, 2, 1))
    )
    settings, printed = config.load(None, site=NO_SITE), []
    assert replay(tmp_path / "kept", settings, model, printed.append) == 0
    assert printed[-1] == "4 sweeps: 4 the same\n"
    assert replay(tmp_path / "capture", settings, model, printed.append) == 0
    heard = [
        line.replace(",sim,", ",replay,").rpartition("*")[0]
        for line in box.heard
        if ",RES," in line
    ]
    again = [
        line.rpartition("*")[0] for line in capsys.readouterr().out.splitlines() if ",RES," in line
    ]
    assert again == heard
