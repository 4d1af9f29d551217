"""Dataclasses as schemas of files: values from TOML or JSON are checked and converted to the types
of fields.

A field is the only place for a value's type, default and limits. TOML tables are read with `keys`
and `read_table`, JSON objects with `typed`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, partial
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from palpate.core.errors import BundleError, ConfigError
from palpate.core.text import closest, shown

_Kind = TypeVar("_Kind")
_hints: Callable[[Any], dict[str, Any]] = cache(partial(get_type_hints, include_extras=True))


@dataclass(frozen=True, slots=True)
class Within:
    """Bounds of a number, or of the length of a tuple or text: Annotated[float, Within(0, 1)]."""

    least: float
    most: float

    def __str__(self) -> str:
        if self.least == LEAST:
            return "above 0" + f" up to {self.most:g}" * (self.most < MOST)
        return f"from {self.least} to {self.most}" if self.most < MOST else f"from {self.least} on"


LEAST, MOST = 2.0**-126, (2 - 2**-23) * 2.0**127
"""The range of float32, in which a box computes."""
Positive = Annotated[float, Within(LEAST, MOST)]
"""A number above 0."""


def fixed(value: _Kind) -> _Kind:
    """A field that files cannot set: a constant next to the settings it belongs to."""
    return field(default=value, metadata={"fixed": True})


def gpio_line() -> str:
    """A field with the name of a GPIO line; "" means not wired."""
    return field(default="", metadata={"line": True})


def custom(default: Any, allowed: str, read: Callable[[Any], Any]) -> Any:
    """A field with its own reader. allowed: the allowed values, for messages. read: returns the
    converted value, or None if the value is not allowed."""
    return field(default=default, metadata={"allowed": allowed, "read": read})


@dataclass(frozen=True, slots=True)
class Key:
    """A field of a dataclass as a key of TOML. hint: its type. metadata: of the field."""

    hint: Any
    default: Any
    metadata: Mapping[str, Any]

    def fit(self, value: Any) -> Any:
        """`value` as the field's type, or None if it is not allowed."""
        if "read" in self.metadata:
            return self.metadata["read"](value)
        value = _nested(self.hint, value)
        if not _fits(value, self.hint) or (type(value) is tuple and "" in value):
            return None
        return float(value) if type(self.default) is float else value

    @property
    def allowed(self) -> str:
        """The values that `fit` accepts, for a person."""
        return str(self.metadata.get("allowed", _words(self.hint)))


def keys(kind: Any) -> dict[str, Key]:
    """The fields of the dataclass `kind` as keys of a TOML table, by name; without fixed ones."""
    hints = _hints(kind)
    return {
        f.name: Key(hints[f.name], f.default, f.metadata)
        for f in fields(kind)
        if "fixed" not in f.metadata
    }


def read_table(known: Mapping[str, Key], table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The values of a TOML table as their fields' types, by name. Raises ConfigError naming
    `where`, the name, and for a value what is allowed."""
    values = {}
    for name, value in table.items():
        if name not in known:
            raise unknown(name, known, where, known)
        values[name] = known[name].fit(value)
        if values[name] is None:
            allowed = known[name].allowed
            raise ConfigError(f"{where}: {name} = {shown(value)} is not allowed; use {allowed}")
    return values


def unknown(
    name: str, known: Iterable[str], where: str, full_names: Iterable[str] = ()
) -> ConfigError:
    """The error for a name that is not `known`, with the same key of another section among the
    `full_names`, or a close name."""
    last = name.rpartition(".")[2]
    near = [k for k in full_names if k.endswith(f".{last}")] or closest(name, known)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    return ConfigError(f"{where}: {name if name.isprintable() else shown(name)} is unknown; {hint}")


def typed(kind: type[_Kind], table: Any) -> _Kind:
    """A `kind` (a dataclass) from a JSON object. Lists become tuples and objects dataclasses as its
    fields require.

    Accepts only values that can be computed with and printed: integers for int, finite numbers,
    printable strings. Raises TypeError naming the field, and the errors of the dataclass for its
    values.
    """
    hints = _hints(kind)
    if not isinstance(table, dict) or not table.keys() <= hints.keys():
        wrong = sorted(table.keys() - hints.keys()) if isinstance(table, dict) else table
        raise TypeError(f"{wrong!r} is none of {', '.join(hints)}")
    values = {name: _nested(hints[name], value) for name, value in table.items()}
    for name, value in values.items():
        if isinstance(value, str) and not value.isprintable():
            raise TypeError(f"{kind.__name__}.{name} = {value!r} cannot be shown")
    # first, because the error of a class about its values is more specific than their types
    made = kind(**values)
    for name, value in values.items():
        if not _fits(value, hints[name]):
            raise TypeError(f"{kind.__name__}.{name} = {value!r} must be {_words(hints[name])}")
    return made


def check(rule: Any, where: str) -> None:
    """Raises BundleError for a field of a rule of a bundle, a dataclass, whose value its type does
    not allow. where: the rule's name in the manifest."""
    for name, hint in _hints(type(rule)).items():
        if not _fits(value := getattr(rule, name), hint):
            raise BundleError(
                f"{where}.{name} {shown(value)} must be {_words(hint)}; export the bundle again"
            )


def _words(hint: Any) -> str:
    """The allowed values of a type, for a person."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind is Annotated:
        sized = get_origin(parts[0]) is tuple or parts[0] is str
        return f"{_words(parts[0])}{', its length' * sized} {parts[1]}"
    if kind in (UnionType, Union):
        return " or ".join(map(_words, parts))
    if kind is tuple:
        return f"a list, each {_words(parts[0])}"
    if kind is Literal:
        return "one of " + ", ".join(map(json.dumps, parts))
    plain: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false"}
    plain |= {str: "a string in quotes, without control characters", type(None): "null"}
    return plain.get(hint, getattr(hint, "__name__", str(hint)))


def _nested(hint: Any, value: Any) -> Any:
    """A JSON value for a field of type `hint`: lists as tuples, objects as dataclasses."""
    if get_origin(hint) is Annotated:
        return _nested(get_args(hint)[0], value)
    if get_origin(hint) is tuple and isinstance(value, list):
        return tuple(_nested(get_args(hint)[0], v) for v in value)
    if get_origin(hint) is dict and isinstance(value, dict):
        return {name: _nested(get_args(hint)[1], v) for name, v in value.items()}
    alternatives = get_args(hint) if get_origin(hint) in (UnionType, Union) else (hint,)
    kind: Any = next((k for k in alternatives if is_dataclass(k)), None)
    if kind is None or value is None or isinstance(value, kind):
        return value
    return typed(kind, value)


def _fits(value: Any, hint: Any) -> bool:
    """Whether `value` from a file is allowed for a field of type `hint`."""
    if get_origin(hint) is Annotated:
        base, bounds = get_args(hint)
        size = len(value) if isinstance(value, tuple | str) else value
        return _fits(value, base) and bool(bounds.least <= size <= bounds.most)
    if get_origin(hint) in (UnionType, Union):
        return any(_fits(value, part) for part in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_origin(hint) is tuple:
        return type(value) is tuple and all(_fits(v, get_args(hint)[0]) for v in value)
    if get_origin(hint) is dict:
        return type(value) is dict and all(_fits(v, get_args(hint)[1]) for v in value.values())
    if hint in (int, float):
        most = MOST if type(value) is float else sys.maxsize
        return type(value) in (int, hint) and abs(value) <= most
    return hint is Any or (type(value) is hint and (hint is not str or value.isprintable()))
