"""Reads fields such as material and force from file names.

A pattern such as "{material}_{force:d}N_{trial}.csv" says where each field stands in a path.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.files.table import normal
from palpate_train.data.group_values import declared, measured, unit_after, unit_in_name

FIELD = re.compile(r"\{(\w*)(?::([^{}]*))?\}")
KINDS = {"": r"[^/]+", "d": r"-?\d+", "f": r"-?\d+(?:\.\d+)?"}
"""Regular expression of each kind of field: any text without a slash, a whole number, a number."""
GROUP = re.compile(r"[a-z]\w*")
EXAMPLE = "'{material}_{force:d}N_{trial}.csv'"


@dataclass(frozen=True)
class NamePattern:
    """A pattern over paths below a folder, or over names of arrays; `{}` matches text that is
    ignored.

    option: its name in messages. Raises FormatError if the pattern cannot be read.
    """

    text: str
    option: str = "--pattern"

    def __post_init__(self) -> None:
        text = normal(self.text).replace("\\", "/").removeprefix("./").lstrip("/")
        object.__setattr__(self, "text", text)
        names = self.names
        rest = FIELD.sub("", self.text)
        if "{" in rest or "}" in rest:
            raise FormatError(
                f"{self.option} {self.text!r} has an unmatched brace; write e.g. {EXAMPLE}"
            )
        if "*" in rest:
            raise FormatError(f"{self.option} {self.text!r} has a *; write {{}} for any text")
        for name, kind in FIELD.findall(self.text):
            if name and (names.count(name) > 1 or not GROUP.fullmatch(name)):
                raise FormatError(
                    f"{self.option}: {name!r} stands twice or is not a name; "
                    "use lower-case letters, and each name once"
                )
            if kind not in KINDS:
                raise FormatError(
                    f"{self.option}: {kind!r} is not a kind of field; "
                    f"use {{{name}}}, {{{name}:d}} (whole) or {{{name}:f}}"
                )
        if "recording" in names:
            raise FormatError(
                f"{self.option}: each file or array is a recording; "
                "call {recording} something else, e.g. {trial}"
            )

    @property
    def names(self) -> list[str]:
        return [name for name, _ in FIELD.findall(self.text) if name]

    def kind(self, name: str) -> str:
        """The kind of the field `name`, of KINDS."""
        return next(found[2] or "" for found in FIELD.finditer(self.text) if found[1] == name)

    def behind(self, name: str) -> str:
        """The text of the pattern behind the field `name`, up to the next field."""
        end = next(found.end() for found in FIELD.finditer(self.text) if found[1] == name)
        return self.text[end:].partition("{")[0]

    def read(self, path: str) -> dict[str, str] | None:
        """The fields of a path, or None if it does not match the pattern.

        Raises FormatError if it matches in several ways, or but for capitals.
        """
        short, long = (re.fullmatch(self._expression(how), normal(path)) for how in ("+?", "+"))
        if not short and re.fullmatch(self._expression("+"), normal(path), re.IGNORECASE):
            raise FormatError("its name has other capitals than the pattern; write both alike")
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


def group(pattern: NamePattern | None, name: str, texts: Sequence[str]) -> tuple[NDArray[Any], str]:
    """The values [N] of the field `name`, whose `texts` stand in N names if the pattern has it, and
    their unit, "" if no name gives one.

    The unit stands behind the field in the pattern, as in {force:d}N, in every text, as in 5N, or
    at the end of the field's name, as in speed_mm_s.
    """
    of_name = pattern if pattern and name in pattern.names else None
    kind = of_name.kind(name) if of_name else ""
    values, unit = (declared(texts, kind), "") if kind else measured(texts)
    if values.dtype.kind == "U":
        return values, ""
    behind = unit_after(of_name.behind(name)) if of_name else ""
    return values, unit or behind or unit_in_name(name)
