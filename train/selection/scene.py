"""Scenes: the equipment and the task of an integrator, read from a scene.toml and checked.

docs/choose/tubes.toml shows every key. The dataclasses are the schema: the type and limits of a
field determine the allowed values in the file.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from appliance.bundle.bundle import LABEL
from appliance.core.errors import FormatError
from appliance.core.schema import closest, custom, keys, number, read_table
from train.data import sets
from train.data.labels import unsendable
from train.data.sets import Dataset
from train.evaluation import corruptions
from train.models import methods

REDUCTIONS = ("window", "rate", "taxels", "bits", "classes")
"""Properties of the sweeps that can be reduced."""
APPLICABLE = ("window", "rate", "taxels")
"""The reductions that the format of a bundle can hold. The others are only reported."""


def _text(default: str, form: re.Pattern[str] = LABEL) -> Any:
    def read(value: Any) -> Any:
        return value if isinstance(value, str) and form.fullmatch(value) else None

    return custom(default, "a text of 1 to 24 letters, digits, spaces, '.', '_' or '-'", read)


def _texts(value: Any) -> tuple[str, ...] | None:
    valid = (
        isinstance(value, list)
        and all(isinstance(v, str) and v for v in value)
        and len(set(value)) == len(value)
    )
    return tuple(value) if valid else None


def _list(default: tuple[str, ...] = (), of: tuple[str, ...] = ()) -> Any:
    def read(value: Any) -> Any:
        found = _texts(value)
        return None if found is None or (of and set(found) - set(of)) else found

    return custom(
        default, f"a list of some of {', '.join(of)}" if of else "a list of different texts", read
    )


def _severities(value: Any) -> dict[str, float] | None:
    numbers = isinstance(value, dict) and all(
        type(v) in (int, float) and v > 0 for v in value.values()
    )
    return {name: float(v) for name, v in value.items()} if numbers else None


def _merged(value: Any) -> dict[str, tuple[str, ...]] | None:
    if not isinstance(value, dict):
        return None
    found = {
        name: names
        for name, listed in value.items()
        if (names := _texts(listed)) and LABEL.fullmatch(name)
    }
    return found if len(found) == len(value) else None


@dataclass(frozen=True)
class Budget:
    """The limits of the board, in the terms of export.measure. A figure without a limit does not
    count.

    ms: processor time of a sweep in the box's classifier. kb: size of the whole bundle in units of
    1000 bytes. mb: resident memory of a process with the bundle in MiB. slower: assumed time on the
    board as a multiple of the time on this machine, until it is measured on the board.
    """

    ms: float = number(math.inf, 0.001, 1_000_000)
    kb: float = number(math.inf, 1, 1_000_000)
    mb: float = number(math.inf, 1, 1_000_000)
    slower: float = number(1.0, 0.01, 1000)


@dataclass(frozen=True)
class Scene:
    """The content of scene.toml. Only `sets` is required.

    name, version: of the bundle; default: the file's name, and "1". sets: as --set, files relative
    to scene.toml, $NAMES replaced by environment variables. only: as --only. materials: the
    materials to distinguish; all if empty. merge: new label by the labels that it replaces. varies:
    groups that differ between training and operation. folds: number of parts of each group (0: five
    for one group, four for two, else three). stress: severity by name of the corruption. accuracy:
    wanted accuracy; 0 for the highest possible. seeds: number of training seeds, from 1 on.
    methods: the candidates; the usual ones if empty. reduce: properties to try with reductions.
    apply: those reductions with which the bundle is packed. full_scale: the skin's highest raw
    count; 0 for the maximum of its type.
    """

    name: str = _text("")
    version: str = _text("1")
    sets: tuple[str, ...] = _list()
    only: tuple[str, ...] = _list()
    materials: tuple[str, ...] = _list()
    merge: Mapping[str, tuple[str, ...]] = custom(
        {}, "lists of materials by their new name", _merged
    )
    varies: tuple[str, ...] = _list()
    folds: int = number(0, 3, 20)
    stress: Mapping[str, float] = custom({}, "numbers above 0 by a stress's name", _severities)
    accuracy: float = number(0.0, 0, 1)
    seeds: int = number(1, 1, 20)
    methods: tuple[str, ...] = _list()
    reduce: tuple[str, ...] = _list(REDUCTIONS, REDUCTIONS)
    apply: tuple[str, ...] = _list(("window",), APPLICABLE)
    full_scale: float = number(0.0, 1, 1_000_000_000)
    budget: Budget = Budget()
    path: Path = Path()

    def sweeps(self) -> Dataset:
        """The sweeps of the sets, narrowed and merged. Raises FormatError with scene.toml and with
        the value that does not fit the sets."""
        whole = sets.join([sets.load(self._located(spec), 1) for spec in self.sets]).select(
            self.only
        )
        known = whole.materials
        for name in (*self.materials, *(m for names in self.merge.values() for m in names)):
            if name not in known:
                raise self._error("material", name, known)
        kept = [m for m in known if m in (self.materials or known)]
        new = {m: name for name, names in self.merge.items() for m in names}
        labels = tuple(dict.fromkeys(new.get(m, m) for m in kept))
        if bad := unsendable(labels):
            raise FormatError(f"{self.path.name}: {bad}; name each anew in [merge]")
        at = np.array([labels.index(new.get(m, m)) if m in kept else -1 for m in known])[
            whole.labels
        ]
        part = whole.take(at >= 0)
        part = (
            replace(part, labels=at[at >= 0], materials=labels)
            .require_materials()
            .require_pure_recordings()
        )
        for name in self.varies:
            if name not in {"recording", *part.groups}:
                raise self._error("varies", name, (*sorted(part.groups), "recording"))
        return part

    def _located(self, spec: str) -> str:
        """`spec` with environment variables replaced, and a file relative to scene.toml."""
        full = os.path.expandvars(spec)
        if "$" in full:
            raise FormatError(
                f"{self.path.name}: sets: {spec!r} names a variable that is not set; set "
                "it to a folder"
            )
        return full if full.startswith("sim:") else str(self.path.parent / full)

    def _error(self, key: str, value: str, known: tuple[str, ...]) -> FormatError:
        return FormatError(f"{self.path.name}: {key} {value!r} is unknown{_near(value, known)}")


def read(path: Path) -> Scene:
    """The scene in a file. Raises FormatError with the file, the key, its value and the allowed
    values."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise FormatError(f"{path.name}: not TOML: {e}") from e
    budget = table.pop("budget", {})
    if not isinstance(budget, dict):
        raise FormatError(
            f"{path.name}: budget = {budget!r} is not allowed; write a table [budget]"
        )
    name = re.sub(r"[^A-Za-z0-9 _.-]", "-", path.stem).lstrip(" _.-")[:24] or "scene"
    found = {"name": name} | _values(path.name, "", Scene, table)
    scene = Scene(
        **found, budget=Budget(**_values(path.name, "budget.", Budget, budget)), path=path
    )
    _check(scene, table)
    return scene


def _values(file: str, section: str, schema: type[Any], table: Mapping[str, Any]) -> dict[str, Any]:
    """The values of one table, each read by its field."""
    known = {name: key for name, key in keys(schema).items() if key.limits}
    return read_table(
        known,
        table,
        unknown=lambda name: FormatError(
            f"{file}: key {section}{name} is unknown{_near(name, tuple(known))}"
        ),
        refused=lambda why: FormatError(f"{file}: {section}{why}"),
    )


def _check(scene: Scene, table: Mapping[str, Any]) -> None:
    """Check conditions on several keys. Raises FormatError."""
    file = scene.path.name
    if not scene.sets:
        raise FormatError(f'{file}: no sets; name some, e.g. sets = ["recordings.npz"]')
    merged = [m for names in scene.merge.values() for m in names]
    for name in merged:
        if merged.count(name) > 1:
            raise FormatError(f"{file}: merge names {name!r} twice; a material goes into one label")
        if scene.materials and name not in scene.materials:
            raise FormatError(
                f"{file}: merge names {name!r}, which is not among materials; add it there"
            )
    known = tuple(methods.every())
    for name in scene.methods:
        if name not in known:
            raise FormatError(f"{file}: method {name!r} is unknown{_near(name, known)}")
    digital = {s.name: s for s in corruptions.CORRUPTIONS if s.only != "simulated"}
    for name, severity in scene.stress.items():
        if name not in digital:
            raise FormatError(
                f"{file}: stress {name!r} is unknown, or only for simulated "
                f"sweeps{_near(name, tuple(digital))}"
            )
        if severity > (most := digital[name].severities[-1]):
            raise FormatError(
                f"{file}: stress.{name} = {severity:g} is out of range; use up to {most:g} "
                f"{digital[name].unit}"
            )
    if "apply" in table and (unused := set(scene.apply) - set(scene.reduce)):
        raise FormatError(
            f"{file}: apply names {min(unused)!r}, which is not in reduce; add it there"
        )


def _near(value: str, known: tuple[str, ...]) -> str:
    close = closest(value, known, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else f"; use {', '.join(known)}"
