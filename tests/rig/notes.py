"""The outcome of each injected fault: a line from each test in build/rig/faults.jsonl."""

import json
import os
from collections.abc import Callable
from pathlib import Path

from tests.rig.emulated_machines import ROOT

FILE = ROOT / "build" / "rig" / "faults.jsonl"

Count, Note = Callable[[int, int], int], Callable[[str, str, int], None]
"""The fixtures `count` and `note`."""
HOW = os.environ.get("PALPATE_RIG", "")
"""How the virtual box is tested: quick, full, or not at all."""


def write(test: str, fault: str, outcome: str, times: int, file: Path = FILE) -> None:
    """Add a line."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as f:
        f.write(
            json.dumps({"test": test, "fault": fault, "outcome": outcome, "times": times}) + "\n"
        )
