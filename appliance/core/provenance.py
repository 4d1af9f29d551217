"""Which code made a result. In: this checkout. Out: its commit, for result files."""

from __future__ import annotations

import subprocess
from pathlib import Path


def commit() -> str:
    """The commit that this code is of, with + where it was changed since; "unknown" outside a checkout."""
    here = str(Path(__file__).parent)
    command = ["git", "-C", here, "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
