"""The optional rules of the answer by name, in the order in which they are left out on trial.

Export, score and card use this table. A bundle holds the rules that pay on the user's own sweeps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate.core.errors import FormatError
from palpate_train.answer import (
    fit_displacement,
    fit_disturbance,
    fit_early,
    fit_hum,
    fit_slide,
    fit_taxels,
    fit_unknown,
)
from palpate_train.data.sets import Dataset

FIGURES = "rules"
"""Key of the figures in a manifest."""


@dataclass(frozen=True)
class Rule:
    """A rule that a bundle may lack. what: for people. without: makes a bundle without it; the same
    bundle if it has none. limited: a manifest with its limits, from the counts of training sweeps.
    tried: whether recordings can show that it is not needed; no recording shows a material that was
    not taught, and an early answer saves time alone."""

    what: str
    without: Callable[[Bundle], Bundle]
    limited: Callable[[Manifest, Dataset], Manifest] = lambda manifest, train: manifest
    tried: bool = True


RULES: Mapping[str, Rule] = {
    "early": Rule("early answers", fit_early.without, tried=False),
    "disturbance": Rule("allowances for disturbances", fit_disturbance.without),
    "displacement": Rule(
        "a rule for displaced contacts", fit_displacement.without, fit_displacement.limited
    ),
    "vibration": Rule("a least vibration of slides", fit_slide.without_vibration),
    "slide": Rule("a least pattern of slides", fit_slide.without_pattern, fit_slide.limited),
    "hum": Rule("hum removal", fit_hum.without),
    "taxels": Rule("bridging of broken taxels", fit_taxels.without),
    "unknown": Rule("detection of unknown materials", fit_unknown.without, tried=False),
}


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
