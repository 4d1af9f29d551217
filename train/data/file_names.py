"""Reads fields such as material and force from file names.

A pattern such as "{material}_{force:d}N_{trial}.csv" says where each field stands in a path.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.data.files.table import normal
from train.data.readers import NUMBER, numbered

FIELD = re.compile(r"\{(\w*)(?::([^{}]*))?\}")
KINDS = {"": r"[^/]+", "d": r"-?\d+", "f": r"-?\d+(?:\.\d+)?"}
"""Regular expression of each kind of field: any text without a slash, a whole number, a number."""
GROUP = re.compile(r"[a-z]\w*")
EXAMPLE = "'{material}_{force:d}N_{trial}.csv'"


@dataclass(frozen=True)
class NamePattern:
    """A pattern over paths below a folder; `{}` matches text that is ignored.

    elsewhere: names of fields that stand elsewhere, so that the pattern need not hold them.
    Raises FormatError if the pattern cannot be read.
    """

    text: str
    elsewhere: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", normal(self.text))
        names = self.names
        rest = FIELD.sub("", self.text)
        if "{" in rest or "}" in rest:
            raise FormatError(
                f"--pattern {self.text!r} has an unmatched brace; write e.g. {EXAMPLE}"
            )
        if "material" not in (*names, *self.elsewhere):
            raise FormatError(
                f"--pattern {self.text!r} does not say where the material stands; "
                f"write e.g. {EXAMPLE}"
            )
        for name, kind in FIELD.findall(self.text):
            if name and (names.count(name) > 1 or not GROUP.fullmatch(name)):
                raise FormatError(
                    f"--pattern: {name!r} stands twice or is not a name; "
                    "use lower-case letters, and each name once"
                )
            if kind not in KINDS:
                raise FormatError(
                    f"--pattern: {kind!r} is not a kind of field; "
                    f"use {{{name}}}, {{{name}:d}} (whole) or {{{name}:f}}"
                )
        if "recording" in names:
            raise FormatError(
                "--pattern: each file is a recording; call {recording} something else, e.g. {trial}"
            )

    @property
    def names(self) -> list[str]:
        return [name for name, _ in FIELD.findall(self.text) if name]

    def read(self, path: str) -> dict[str, str] | None:
        """The fields of a path, or None if it does not match the pattern.

        Raises FormatError if it matches in several ways.
        """
        short, long = (re.fullmatch(self._expression(how), normal(path)) for how in ("+?", "+"))
        if not (short and long):
            return None
        if short.groups() != long.groups():
            a, b = (tuple(found.groupdict().items()) for found in (short, long))
            name, one, other = next(
                ((n, x, y) for (n, x), (_, y) in zip(a, b, strict=True) if x != y), ("{}", "", "")
            )
            raise FormatError(
                f"its name fits the pattern in several ways ({name} {one!r} or {other!r}); "
                "say which fields are numbers, e.g. {force:d}"
            )
        return short.groupdict()

    def _expression(self, how: str) -> str:
        """The pattern as a regular expression; `how` makes fields match shortest (+?) or longest
        (+)."""
        parts, end = [], 0
        for found in FIELD.finditer(self.text):
            name, kind = found.groups()
            fits = KINDS[kind or ""].replace("+", how, 1)
            parts += [
                re.escape(self.text[end : found.start()]),
                f"(?P<{name}>{fits})" if name else f"({fits})",
            ]
            end = found.end()
        return "".join([*parts, re.escape(self.text[end:])])


def group(texts: Sequence[str]) -> tuple[NDArray[Any], str]:
    """A number for each text [N], and an explanation of the numbers.

    Whole numbers keep their value, and the explanation is "". Other texts get their rank: by
    value if all are numbers, else by alphabet.
    """
    different = sorted(set(texts))
    if all(map(NUMBER.fullmatch, different)):
        return numbered(texts), ""
    with suppress(ValueError):  # some are not numbers
        different = sorted(different, key=float)
    rank = {text: i for i, text in enumerate(different)}
    return np.array([rank[text] for text in texts]), ", ".join(
        f"{i} = {text}" for text, i in rank.items()
    )
