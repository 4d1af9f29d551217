"""What a setting may hold. In: fields of the settings' dataclasses. Out: their values checked, and what is allowed.

The dataclass field is the one place for a value's type, default and limits; `config` reads files by it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_args, get_origin

_Number = TypeVar("_Number", int, float)


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
            names = isinstance(value, list) and all(isinstance(v, str) and v for v in value)
            return tuple(value) if names else None
        if self.hint in (str, bool):
            return value if type(value) is self.hint else None
        if type(value) not in (int, self.hint) or not self.limits["least"] <= value <= self.limits["most"]:
            return None
        return None if "step" in self.limits and value % self.limits["step"] else self.hint(value)

    @property
    def allowed(self) -> str:
        """What `fit` takes, for a person."""
        if get_origin(self.hint) is Literal:
            return "one of " + ", ".join(json.dumps(v) for v in get_args(self.hint))
        if self.hint not in (int, float):
            return {bool: "true or false", str: "a string in quotes"}.get(self.hint, 'names such as ["GPIO16"]')
        kind = "a whole number" if self.hint is int else "a number"
        kind = f"a multiple of {self.limits['step']}" if "step" in self.limits else kind
        return f"{kind} from {self.limits['least']} to {self.limits['most']}"
