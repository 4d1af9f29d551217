"""Names of materials: checks that the box can send them, and renames them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from palpate.core import names as core
from palpate.core.errors import FormatError
from palpate.core.names import LABEL
from palpate.core.text import closest
from palpate_train.data.files.table import normal
from palpate_train.data.sets import Dataset

ALLOWED = "1 to 24 letters, digits, spaces, '.', '_' or '-', the first a letter or a digit"
REMEDY = "give each another name with --rename OLD=NEW"


def unsendable(names: Iterable[str]) -> str:
    """A message that lists the `names` the box cannot send and the allowed characters, or ""."""
    if not (bad := [name for name in names if not LABEL.fullmatch(name)]):
        return ""
    listed = ", ".join(f"{name!r} ({len(name)} characters)" for name in bad)
    return f"the box cannot send {listed}; a label is {ALLOWED}"


def sendable(names: Iterable[str]) -> dict[str, str]:
    """For each of `names` the label that the box sends; no two have the same."""
    names = sorted(set(names))
    found = {name: name for name in names if LABEL.fullmatch(name)}
    for number, name in enumerate(names, 1):
        if name not in found:
            found[name] = core.sendable(name, found.values(), f"material {number}")
    return found


def check(sweeps: Dataset) -> Dataset:
    """Return the set itself. Raises FormatError listing every material that the box cannot
    send."""
    if why := unsendable(sweeps.materials):
        raise FormatError(f"{sweeps.source}: {why}; {REMEDY}")
    return sweeps


def parse_renames(texts: Sequence[str]) -> dict[str, str]:
    """New names by old names, from texts OLD=NEW of the option --rename.

    Raises FormatError if a text cannot be read, or if an old name gets two new names.
    """
    pairs: dict[str, str] = {}
    for text in texts:
        old, separator, new = normal(text).rpartition("=")
        if not (separator and old and new):
            raise FormatError(f"--rename {text!r} cannot be read; write OLD=NEW")
        if pairs.setdefault(old, new) != new:
            raise FormatError(
                f"--rename gives {old!r} two names, {pairs[old]!r} and {new!r}; give it one"
            )
    return pairs


def check_renames(pairs: Mapping[str, str], names: Iterable[str]) -> None:
    """Raises FormatError if an old name of `pairs` is not among `names`."""
    known = tuple(dict.fromkeys(names))
    for old in pairs:
        if old not in known:
            near = closest(old, known, cutoff=0.6)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
            raise FormatError(f"--rename: there is no material {old!r}; {hint}")


def renamed(sweeps: Dataset, pairs: Mapping[str, str]) -> Dataset:
    """The set with new names of materials, in the same order.

    Materials that get the same name are merged. Display names stay.
    """
    if not set(pairs) & set(sweeps.materials):
        return sweeps
    names = [pairs.get(name, name) for name in sweeps.materials]
    materials = tuple(dict.fromkeys(names))
    labels = np.array([materials.index(name) for name in names])[sweeps.labels]
    displays = {pairs.get(name, name): text for name, text in sweeps.displays.items()}
    return replace(sweeps, labels=labels, materials=materials, displays=displays)
