"""Readers of options that are numbers. In: what a person typed. Out: the number, or a FormatError
with what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable

from appliance.core.errors import FormatError


def whole(name: str, least: int) -> Callable[[str], int]:
    """Reads the option `name`, a whole number from `least` on; raises FormatError for anything
    else."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise FormatError(f"{name} {text} is out of range; use a whole number from {least} on")
        return value

    return read


def number(name: str, fits: Callable[[float], bool], allowed: str) -> Callable[[str], float]:
    """Reads the option `name`, a number that `fits`; raises FormatError for anything else, with
    what is `allowed`."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and fits(value)):
            raise FormatError(f"{name} {text} is out of range; use a number {allowed}")
        return value

    return read


def above_zero(name: str) -> Callable[[str], float]:
    """Reads the option `name`, a number above 0."""
    return number(name, lambda x: x > 0, "above 0")


def span(name: str, example: str) -> Callable[[str], range]:
    """Reads the option `name`, a whole number or FIRST-LAST; raises FormatError for anything else,
    with an `example`."""

    def read(text: str) -> range:
        first, _, last = text.partition("-")
        if not (
            first.isdecimal() and (last or first).isdecimal() and int(last or first) >= int(first)
        ):
            raise FormatError(f"{name} {text} cannot be read; write FIRST-LAST, e.g. {example}")
        return range(int(first), int(last or first) + 1)

    return read
