"""One run of a program: values that its parts only hand on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Log = Callable[[str], None]
"""Shows a line of progress."""


def no_log(line: str) -> None:
    """A log that drops every line."""


@dataclass(frozen=True)
class Run:
    """seed: of all random draws. log: shows progress. folder: keeps unfinished trainings, from
    which an interrupted run goes on with the same bits; None keeps none."""

    seed: int
    log: Log = no_log
    folder: Path | None = None

    def file(self, name: str) -> Path | None:
        """The file of this name in the folder, None without one."""
        return self.folder / name if self.folder else None
