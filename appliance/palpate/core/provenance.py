"""The commit of this checkout and the processor of this machine, for result files."""

from __future__ import annotations

import subprocess
from pathlib import Path


def commit() -> str:
    """The commit of this code, with + if files have changed; "unknown" outside a checkout."""
    here = str(Path(__file__).parent)
    command = ["git", "-C", here, "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def processor() -> str:
    """The name of the board or the processor; "" if there is none."""
    board, names = Path("/proc/device-tree/model"), Path("/proc/cpuinfo")
    if board.is_file():
        return board.read_text().strip("\0\n ")
    lines = names.read_text().splitlines() if names.is_file() else []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "")
