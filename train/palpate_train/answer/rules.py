"""The optional rules of the answer by name, in the order of palpate.answer.rules, in which they are
left out on trial.

Export, score and card use this table. A bundle holds the rules that pay on the user's own sweeps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, get_args, get_type_hints

from palpate.answer.rules import Rules
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate.core.errors import FormatError
from palpate_train.answer.rule import Rule

FIGURES = "rules"
"""Key of the figures in a manifest."""


def _twins() -> Iterator[Mapping[str, Rule]]:
    """The `RULES` of the twin of each module that has parameters of the box."""
    for hint in get_type_hints(Rules).values():
        name = f"{__package__}.fit_{get_args(hint)[0].__module__.rpartition('.')[2]}"
        if find_spec(name):
            yield getattr(import_module(name), "RULES", {})


RULES = {name: rule for twin in _twins() for name, rule in twin.items()}


@dataclass(frozen=True)
class Asked:
    """Rules that a bundle has if they can be fitted, and rules that it lacks, whatever they pay.
    Raises FormatError for a rule in both."""

    kept: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if both := set(self.kept) & set(self.left_out):
            raise FormatError(f"rule {min(both)!r} is both kept and left out; name it once")


ALL = Asked()
"""All rules that pay."""


def present(bundle: Bundle) -> list[str]:
    """The rules that a bundle has."""
    return [
        name for name, rule in RULES.items() if rule.without(bundle).manifest != bundle.manifest
    ]


def without(bundle: Bundle, names: Iterable[str]) -> Bundle:
    """The bundle in memory without these rules. Raises FormatError if it has not all of them."""
    there = present(bundle)
    for name in names:
        if name not in there:
            raise FormatError(
                f"{bundle.manifest.name} has no rule {name!r}; leave out some of "
                f"{', '.join(there) or 'none'}"
            )
        bundle = RULES[name].without(bundle)
    return bundle


def text(manifest: Manifest) -> str:
    """Why a bundle has each rule or lacks it, a line a rule; "" if no rule was judged."""
    found = manifest.figures.get(FIGURES, {})
    return "\n".join(f"{RULES[name].what}: {_why(of)}" for name, of in found.items())


def _why(of: Mapping[str, Any]) -> str:
    if of["because"] == "absent":
        return "your recordings do not give one"
    if of["because"] == "asked":
        return "kept, as you asked" if of["kept"] else "left out, as you asked"
    if not of["kept"]:
        return "not needed in your recordings"
    (right, fewer), (wrong, more), n = of["right"], of["wrong"], of["of"]
    return (
        f"kept; without it {fewer} instead of {right} of {n} altered sweeps are classified "
        f"correctly, and {more} instead of {wrong} labels of them and of junk are wrong"
    )
