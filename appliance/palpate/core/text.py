"""Texts for people: characters that are safe to print, and close names for a misspelt one."""

from __future__ import annotations

import sys
from io import TextIOWrapper

TYPE_CHECKING = False  # `palpate status` starts sooner without typing
if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import TextIO


def replace_unprintable() -> None:
    """Show ? for a character that the terminal's encoding lacks: it must not end the program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def printable(text: str, instead: str = "?") -> str:
    """`text` with `instead` for characters that cannot be printed."""
    return "".join(c if c.isprintable() else instead for c in text)


def say(*lines: str, file: TextIO | None = None) -> None:
    """Print lines at once, each made printable, since a text from a file can hold escape sequences
    or a line break, which would forge another line. file: standard output if None."""
    for line in lines:
        print(printable(line), file=file, flush=True)


def shown(value: object) -> str:
    """A value from a file for a message of one line, cut at 80 characters."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of over 4300 digits; deeply nested tables
        return "(too large to show)"
    return text if len(text) <= 80 else f"{text[:77]}..."


def closest(name: str, known: Iterable[str], most: int = 1, cutoff: float = 0.5) -> list[str]:
    """Up to `most` of the `known` names that a misspelt `name` may stand for, the most similar
    first; case is ignored. cutoff: least similarity, 0 to 1 (difflib's ratio)."""
    from difflib import get_close_matches

    by_folded = {k.casefold(): k for k in known}
    return [by_folded[k] for k in get_close_matches(name.casefold(), by_folded, most, cutoff)]
