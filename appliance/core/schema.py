"""What a setting may hold. In: fields of dataclasses, values from files. Out: these checked, and what is allowed.

The dataclass field is the one place for a value's type, default and limits; `config` reads files by it. What comes as
JSON is made by it too.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

_Number = TypeVar("_Number", int, float)
_Kind = TypeVar("_Kind")


def number(default: _Number, least: _Number, most: _Number, **more: object) -> _Number:
    """A number field with its limits. more: `step` for whole multiples only, `hex` for how it is printed."""
    return field(default=default, metadata={"least": least, "most": most, **more})


def gpio_line() -> str:
    """A field that names a GPIO line; "" is not wired."""
    return field(default="", metadata={"line": True})


@dataclass(frozen=True, slots=True)
class Key:
    """A field as a key of the files."""

    hint: Any
    default: Any
    limits: Mapping[str, Any]

    def fit(self, value: Any) -> Any:
        """`value` as the field's type, or None where it is not allowed."""
        if get_origin(self.hint) is Literal:
            return value if value in get_args(self.hint) else None
        if get_origin(self.hint) is tuple:
            names = isinstance(value, list) and all(_fits(v, str) and v for v in value)
            return tuple(value) if names else None
        if self.hint in (str, bool):
            return value if _fits(value, self.hint) else None
        if type(value) not in (int, self.hint) or not self.limits["least"] <= value <= self.limits["most"]:
            return None
        return None if "step" in self.limits and value % self.limits["step"] else self.hint(value)

    @property
    def allowed(self) -> str:
        """What `fit` takes, for a person."""
        if get_origin(self.hint) is Literal:
            return "one of " + ", ".join(json.dumps(v) for v in get_args(self.hint))
        if self.hint not in (int, float):
            plain = {bool: "true or false", str: "a string in quotes, without control characters"}
            return plain.get(self.hint, 'names such as ["GPIO16"]')
        kind = "a whole number" if self.hint is int else "a number"
        kind = f"a multiple of {self.limits['step']}" if "step" in self.limits else kind
        return f"{kind} from {self.limits['least']} to {self.limits['most']}"


def typed(kind: type[_Kind], table: Any) -> _Kind:
    """The dataclass `kind` from a JSON object, lists as tuples where it holds tuples. Raises TypeError naming the field.

    Whatever is accepted can be reckoned with and shown: whole numbers where they belong, finite ones, printable texts.
    """
    hints = get_type_hints(kind)
    if not isinstance(table, dict) or not table.keys() <= hints.keys():
        wrong = sorted(table.keys() - hints.keys()) if isinstance(table, dict) else table
        raise TypeError(f"{wrong!r} is none of {', '.join(hints)}")
    values = {n: tuple(v) if get_origin(hints[n]) is tuple and isinstance(v, list) else v for n, v in table.items()}
    for name, value in values.items():
        if isinstance(value, str) and not value.isprintable():
            raise TypeError(f"{kind.__name__}.{name} = {value!r} cannot be shown")
    made = kind(**values)  # what a class says of its own values is closer to them than their types
    for name, value in values.items():
        if not _fits(value, hints[name]):
            wanted = getattr(hints[name], "__name__", hints[name])
            raise TypeError(f"{kind.__name__}.{name} = {value!r} is not of type {wanted}")
    return made


def _fits(value: Any, hint: Any) -> bool:
    """Whether a field of type `hint` may hold `value` from a file."""
    if get_origin(hint) is UnionType:
        return any(_fits(value, part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        return type(value) is tuple and all(_fits(v, get_args(hint)[0]) for v in value)
    if get_origin(hint) is dict:
        return type(value) is dict and all(_fits(v, get_args(hint)[1]) for v in value.values())
    if hint in (int, float):  # none of more than 64 bits, infinite or NaN
        return type(value) in (int, hint) and abs(value) <= (
            sys.float_info.max if type(value) is float else sys.maxsize
        )
    return hint is Any or (type(value) is hint and (hint is not str or value.isprintable()))
