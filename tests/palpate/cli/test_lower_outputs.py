"""After the end of a program, the command of systemd sets its lines low."""

from __future__ import annotations

import re

import pytest

from palpate.cli import lower_outputs
from palpate.core import config
from palpate.sim import gpio, rig


@pytest.fixture
def chip() -> gpio.SimGpio:
    """The header of the board files, as its kernel names the lines."""
    return gpio.SimGpio(rig.VirtualClock(), {"/dev/gpiochip0": [f"GPIO{i}" for i in range(28)]})


def test_all_outputs_are_requested_low_and_given_back(chip, monkeypatch, capsys):
    """Each once, at its low level, and released; inputs stay; without a board nothing."""
    asked = []
    request = chip.request_lines
    monkeypatch.setattr(
        chip, "request_lines", lambda *a, **k: asked.append(a[1]) or request(*a, **k)
    )
    assert lower_outputs.main(["--board", "rpi5"], chip) == 0
    ((lines, settings),) = [item for one in asked for item in one.items()]
    output = config.load("rpi5").output
    names = [
        output.ready,
        output.busy,
        output.fault,
        output.decided,
        output.result_valid,
        *output.class_bits,
    ]
    assert sorted(f"GPIO{offset}" for offset in lines) == sorted(names)
    assert settings.direction is chip.line.Direction.OUTPUT
    assert settings.output_value is chip.line.Value.INACTIVE
    assert chip.requests == []
    assert lower_outputs.main(["--set", "output.ready="], chip) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--board", "rpi5"], 69, "cannot request gpio lines .*errno 16.*another program"),
        (["--board", "rpi9"], 78, "board = 'rpi9' has no board-NAME.toml"),
    ],
)
def test_what_cannot_be_lowered_is_said(chip, args, code, message, capsys):
    """Lines of others, or unreadable settings: one line and the exit code of the kind."""
    request = chip.request_lines("/dev/gpiochip0", {(23,): chip.LineSettings()})
    assert lower_outputs.main(args, chip) == code
    error = capsys.readouterr().err
    assert error.startswith("palpate: outputs may not be low: ")
    assert error.count("\n") == 1
    assert re.search(message, error)
    assert chip.requests == [request]
