"""Helpers of tests on terminals: a wait for a program always ends, and reports the text shown so
far."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.factories import terminals


@pytest.mark.parametrize(
    "does",
    ["time.sleep(600)", "[print('again', flush=True) or time.sleep(.01) for _ in range(60000)]"],
)
def test_a_program_that_hangs_fails_the_test_with_what_it_has_shown(does: str):
    """A program that falls silent, and a program that prints the same for ever; neither outlives
    the wait."""
    far, near = os.openpty()
    code = f"import time; print('begun', flush=True); {does}"
    with subprocess.Popen([sys.executable, "-c", code], stdout=near) as run:
        os.close(near)
        shown = terminals.read(far, run, lambda shown: b"begun" in shown)
        with pytest.raises(
            AssertionError, match=r"did not end within 0\.2 s; it has shown b'begun"
        ):
            terminals.ended(run, shown, 0.2)
    assert run.returncode == -9
    os.close(far)
    far, near = os.openpty()
    with subprocess.Popen([sys.executable, "-c", code], stdout=near) as run:
        os.close(near)
        with pytest.raises(
            AssertionError, match=r"not done within 2 s; it has shown b'.*(begun|again)"
        ):
            terminals.read(far, run, limit_s=2)
    assert run.returncode == -9
    os.close(far)
