"""Reads a scene.toml: options of a command in a file, one key for each option.

docs/choose/tubes.toml is an example. An option of the command line replaces that of the file.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate.core.text import closest

PATHS = ("--set",)
"""Options whose values may be files relative to the scene's folder."""


def words(path: Path, command: argparse.ArgumentParser) -> list[str]:
    """The options in the file as words of the command line.

    Raises FormatError with the file, the key and its value, and OSError if it cannot be read.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise FormatError(f"{path.name}: not TOML: {e}; mend this line") from e
    actions = command._option_string_actions  # argparse has no public way to list them
    known = sorted({name for name in actions if name.startswith("--")} - {"--help", "--scene"})
    found: list[str] = []
    for key, value in table.items():
        option = f"--{key}"
        if option not in known:
            near = closest(option, tuple(known), cutoff=0.6)
            every = ", ".join(name[2:] for name in known)
            hint = f"did you mean {near[0][2:]!r}?" if near else f"use {every}"
            raise FormatError(f"{path.name}: key {key} is unknown; {hint}")
        found += _option(path, option, value, actions[option])
    return found


def _option(path: Path, option: str, value: Any, action: argparse.Action) -> list[str]:
    """The words of one key."""
    many = action.nargs == "+" or isinstance(action, argparse._AppendAction)
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise _refused(path, option, value, "true or false")
        return [option] * value
    values = value if isinstance(value, list) and many else [value]
    plain = [isinstance(one, str | int | float) and not isinstance(one, bool) for one in values]
    if not values or not all(plain):
        raise _refused(path, option, value, "a text or a number" + ", or a list of them" * many)
    texts = [_located(path, str(one)) if option in PATHS else str(one) for one in values]
    if action.nargs == "+":
        return [option, *texts]
    return [f"{option}={text}" for text in texts]


def _located(path: Path, text: str) -> str:
    """`text` with environment variables replaced, and a file relative to the scene's folder."""
    full = os.path.expandvars(text)
    if "$" in full:
        raise FormatError(
            f"{path.name}: set: {text!r} names a variable that is not set; set it to a folder"
        )
    return full if full.startswith("sim:") else str(path.parent / full)


def _refused(path: Path, option: str, value: Any, use: str) -> FormatError:
    return FormatError(f"{path.name}: {option[2:]} = {value!r} is not allowed; use {use}")
