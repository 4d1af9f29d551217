"""The outcome of each injected fault: a line from each test, and the table fault x outcome as
Markdown.

Lines of all runs gather in build/rig/faults.jsonl. For each fault the run with the most repetitions
counts, and of such runs the last.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.factories.emulated_machines import ROOT

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


def table(file: Path = FILE) -> list[str]:
    """Lines of a Markdown table, with the faults of a test file together. Raises OSError if nothing
    was recorded."""
    best: dict[tuple[str, str], dict[str, Any]] = {}
    for line in file.read_text().splitlines():
        event = json.loads(line)
        key = event["test"].partition("::")[0], event["fault"]
        if key not in best or event["times"] >= best[key]["times"]:
            best[key] = event
    rows = [
        f"| {fault} | {event['outcome']} | {event['times']} |"
        for (_, fault), event in sorted(best.items())
    ]
    return ["| fault | what the box did | times |", "|---|---|---|", *rows]
