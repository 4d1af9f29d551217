"""Readers of numeric options, which raise FormatError with the allowed values."""

from __future__ import annotations

import math
from collections.abc import Callable

from palpate.core.errors import FormatError


def whole(name: str, least: int) -> Callable[[str], int]:
    """A reader of the option `name`, a whole number from `least` on. Any other text raises
    FormatError."""

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
    """A reader of the option `name`, a number that passes `fits`. Any other text raises FormatError
    with the `allowed` range."""

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
    """A reader of the option `name`, a number above 0."""
    return number(name, lambda x: x > 0, "above 0")


def span(name: str, example: str) -> Callable[[str], range]:
    """A reader of the option `name`, a whole number or FIRST-LAST. Any other text raises
    FormatError with an `example`."""

    def read(text: str) -> range:
        first, _, last = text.partition("-")
        if not (
            first.isdecimal() and (last or first).isdecimal() and int(last or first) >= int(first)
        ):
            raise FormatError(f"{name} {text} cannot be read; write FIRST-LAST, e.g. {example}")
        return range(int(first), int(last or first) + 1)

    return read
