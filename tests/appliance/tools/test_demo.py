"""`palpate demo`: what it shows with and without a terminal."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from appliance.cli.main import main
from appliance.tools import demo
from tests.factories.simulated_box import numbered

VIRTUAL = ["--virtual", "--sweeps", "3", "--seed", "7"]


def test_demo_prints_plain_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]):
    """Each sweep with truth, verdict, bar and raw sentence; then the table."""
    assert main(["demo", *VIRTUAL]) == 0
    out = capsys.readouterr().out
    assert out.count("$PPLP,RES,") == 3
    assert out.count(" -> ") == 3
    assert "frames lost     0 of" in out
    assert "\033" not in out


def test_demo_raw_prints_sentences_alone(capsys: pytest.CaptureFixture[str]):
    """Nothing but sentences, the same in every run with the same seed."""
    assert main(["demo", "--raw", *VIRTUAL]) == 0
    first = capsys.readouterr().out
    assert all(line.startswith("$PPLP,") for line in first.splitlines())
    assert first.count(",RES,") == 3
    main(["demo", "--raw", *VIRTUAL])
    assert capsys.readouterr().out == first


@pytest.mark.slow
def test_demo_paints_on_a_terminal():
    """On a terminal the skin is drawn in 16 shaded cells and painted over."""
    far, near = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "appliance", "demo", "--virtual", "--sweeps", "1"], stdout=near, stderr=subprocess.PIPE
    ) as run:
        os.close(near)
        shown = b""
        try:
            while data := os.read(far, 65536):
                shown += data
        except OSError:  # the terminal's end where the last writer has gone
            pass
        assert run.wait() == 0
    os.close(far)
    first = shown.split(b"\033[12A")[0]
    assert first.count(b"\033[48;5;") == 32
    assert b"$PPLP,RES,1," in shown


def test_picture_shows_each_digit():
    """The picture's numbers are the newest frame's digits."""
    frame = numbered(1)
    text = "\n".join(demo.picture(frame[0]))
    assert all(f"{d:^6}" in text for d in frame.ravel())
