"""Options of command lines: from a table, and types of options for a new folder or file. An
ending that belongs to something else is refused while the command line is read, before any work."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Row = tuple[str, str | None, Mapping[str, Any]]
"""An option: its flag, its help, and the rest as argparse has it."""

OF_FILES = (
    ".csv", ".h5", ".hdf5", ".html", ".json", ".jsonl", ".mat", ".md", ".npy", ".npz", ".onnx",
    ".pdf", ".png", ".svg", ".toml", ".txt", ".xlsx", ".zip",
)  # fmt: skip
"""Endings that no folder has. Others may be part of its name, as in bundle-1.2."""


def add_options(command: ArgumentParser, names: str, table: Mapping[str, Row]) -> None:
    """Add options by their names in `table`; names with | between them exclude each other."""
    for word in names.split():
        group: Any = command.add_mutually_exclusive_group() if "|" in word else command
        add_rows(group, *(table[name] for name in word.split("|")))


def add_rows(command: Any, *rows: Row) -> None:
    """Add options to a parser or a group."""
    for flag, help, how in rows:
        command.add_argument(flag, help=help, **how)


def folder(text: str) -> Path:
    """The path of a folder. Raises ArgumentTypeError for the name of a file."""
    path = Path(text)
    if path.suffix.lower() in OF_FILES and not path.is_dir():
        why = f"{text} would be a folder, not a {path.suffix} file"
        raise ArgumentTypeError(f"{why}; leave the ending out")
    return path


def file(*endings: str) -> Callable[[str], Path]:
    """A reader of the path of a file with one of these endings, or none."""

    def read(text: str) -> Path:
        path, known = Path(text), " or ".join(endings)
        if path.suffix.lower() not in ("", *endings):
            why = f"{text} would not be a {path.suffix} file"
            raise ArgumentTypeError(f"{why}; use a name that ends in {known}")
        return path

    return read
