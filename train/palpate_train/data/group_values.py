"""Values of a group: whole numbers, numbers, or names, as the files say them.

A group keeps its values: a force of 0.5 is 0.5, a speed "slow" is "slow", and "01" is not 1.
Numbers may have a unit, in which values of joined sets are brought together.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

Array = NDArray[Any]
WHOLE = re.compile(r"-?[1-9][0-9]{0,8}|0")
NUMBER = re.compile(r"-?(?:0|[1-9][0-9]{0,8})(?:\.[0-9]+)?")
"""Texts that are numbers. 07 is not, or it would equal 7."""
MEASURED = re.compile(r"(-?[0-9.]+) ?([A-Za-zµ%/_]+)")
_SCALES = {
    "N": {"N": "1", "mN": "1/1000"},
    "kPa": {"kPa": "1", "Pa": "1/1000"},
    "mm/s": {"mm/s": "1", "um/s": "1/1000", "cm/s": "10", "m/s": "1000"},
    "mm": {"mm": "1", "um": "1/1000", "cm": "10"},
    "s": {"s": "1", "ms": "1/1000"},
    "Hz": {"Hz": "1", "kHz": "1000"},
    "g": {"g": "1", "kg": "1000"},
    "deg": {"deg": "1"},
    "rpm": {"rpm": "1"},
    "%": {"%": "1"},
}
UNITS = {
    unit: (base, Fraction(factor))
    for base, units in _SCALES.items()
    for unit, factor in units.items()
}
"""Each unit as a multiple of the unit to which units of its kind are converted."""
SPELLED = (
    {re.sub("/", mark, unit): unit for unit in UNITS if "/" in unit for mark in ("_", "-", "p")}
    | {unit.replace("/", ""): unit for unit in ("mm/s", "um/s", "cm/s")}
    | {unit: unit for unit in UNITS}
    | {"pct": "%", "µm/s": "um/s", "µm": "um"}
)
"""Units as names of files and groups spell them, in which no slash can stand."""
BEHIND = re.compile(
    rf"({'|'.join(map(re.escape, sorted(SPELLED, key=len, reverse=True)))})(?![A-Za-z0-9])"
)


def text_of(value: Any) -> str:
    """A value as text: 0.5, 100, slow."""
    if isinstance(value, float | np.floating):
        return np.format_float_positional(value, trim="-")
    return str(value)


def typed(texts: Sequence[str]) -> Array:
    """The values [N] of `texts`: whole numbers or numbers if all texts are, else the texts.

    Texts that would become the same number, such as 1 and 1.0, stay texts.
    """
    different = set(texts)
    if all(map(WHOLE.fullmatch, different)):
        return np.array([int(text) for text in texts])
    if all(map(NUMBER.fullmatch, different)) and len(set(map(float, different))) == len(different):
        return np.array([float(text) for text in texts])
    return np.array(texts, dtype=str)


def measured(texts: Sequence[str]) -> tuple[Array, str]:
    """As `typed`, with the unit if every text is a number with the same known unit, as 5N; else
    with ""."""
    found = [MEASURED.fullmatch(text) for text in texts]
    units = {one and SPELLED.get(one[2]) for one in found}
    if len(units) == 1 and (unit := units.pop()):
        values = typed([one[1] for one in found if one])
        if values.dtype.kind != "U":
            return values, unit
    return typed(texts), ""


def declared(texts: Sequence[str], kind: str) -> Array:
    """The values [N] of texts that a pattern declares as numbers: kind "d" for whole ones, "f" for
    any. Whole numbers of more than 18 digits stay texts."""
    if kind == "f":
        return np.array([float(text) for text in texts])
    if max(map(len, texts)) > 18:
        return np.array(texts, dtype=str)
    return np.array([int(text) for text in texts])


def unit_after(text: str) -> str:
    """The unit at the beginning of `text`, which stands behind a number in a name; "" if there is
    none."""
    found = BEHIND.match(text)
    return SPELLED[found[1]] if found else ""


def unit_in_name(name: str) -> str:
    """The unit at the end of a group's name, as in force_n and speed_mm_s; "" if there is none."""
    lower = {spelled.lower(): unit for spelled, unit in SPELLED.items()}
    parts = name.lower().split("_")
    for start in range(1, len(parts)):
        if unit := lower.get("_".join(parts[start:])):
            return unit
    return ""


def listed(column: Array, unit: str, text: str) -> list[Any]:
    """The values that `text` lists, separated by commas, in the type of `column`.

    A number may have the group's unit behind it. A name that contains commas is found too. Raises
    FormatError for a text that is not a number if the column holds numbers.
    """
    if column.dtype.kind == "U":
        whole = text.strip()
        return [whole] if whole in column else [part.strip() for part in text.split(",")]
    return [_number(part.strip(), unit) for part in text.split(",")]


def _number(text: str, unit: str) -> int | float:
    bare = text
    if (found := MEASURED.fullmatch(text)) and SPELLED.get(found[2]) == unit:
        bare = found[1]
    try:
        return int(bare)
    except ValueError:
        pass
    try:
        number = float(bare)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise FormatError(f"{text!r} is not a number{f' in {unit}' if unit else ''}")
    return number


def joined(name: str, parts: Sequence[Array], units: Sequence[str]) -> tuple[Array, str]:
    """The values of the group `name` in several sets, one after the other, and their unit.

    Numbers are brought to the unit of the first set; the unit is "" unless all sets have one. If
    some sets hold numbers and others names, all become names. Raises FormatError if units are of
    different kinds.
    """
    named = [unit for unit in units if unit]
    for unit in named:
        if UNITS[unit][0] != UNITS[named[0]][0]:
            raise FormatError(
                f"group {name!r} is in {named[0]} in one set and in {unit} in another; "
                "give one of the groups another name"
            )
    if any(part.dtype.kind == "U" for part in parts):
        return np.concatenate([_texts(part) for part in parts]), ""
    same = [
        _converted(part, u, named[0]) if u else part for part, u in zip(parts, units, strict=True)
    ]
    return np.concatenate(same), named[0] if len(named) == len(parts) else ""


def _texts(values: Array) -> Array:
    return values if values.dtype.kind == "U" else np.array([text_of(v) for v in values.tolist()])


def _converted(values: Array, unit: str, wanted: str) -> Array:
    factor = UNITS[unit][1] / UNITS[wanted][1]
    if factor == 1:
        return values
    # one rounding: 300 mN are 0.3 N, not 0.30000000000000004
    scaled: Array = values * factor.numerator / factor.denominator
    return scaled
