"""The scripts of systemd/ that run on the box at its install, run on this machine."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from palpate.deployment.enrolment_key import EnrolmentKey
from tests.factories.paths import ROOT

SCRIPTS = ROOT / "systemd"


def run_here(code: str) -> str:
    """Output of Python code that imports the scripts, in a process of its own.

    Importing gevent here would change this process too much.
    """
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(SCRIPTS)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def enrolment_key(folder: Path) -> EnrolmentKey:
    """The box's key for enrolments, as the install makes it, but owned by this user."""
    if not shutil.which("ssh-keygen"):
        pytest.skip("needs ssh-keygen (apt-get install openssh-client)")
    made = f"enrolment_key.make({str(folder)!r}, os.getuid(), os.getgid())"
    code = f"import enrolment_key, os; print({made})"
    subprocess.run(["bash", "-euc", run_here(code)], check=True, capture_output=True, timeout=120)
    return EnrolmentKey(folder)


def page_secrets(folder: Path) -> None:
    """Token, key and certificate of the page, as the install makes them."""
    code = f"import page_secrets, os; print(page_secrets.make({str(folder)!r}, str(os.getgid())))"
    subprocess.run(["bash", "-euc", run_here(code)], check=True, capture_output=True, timeout=120)
