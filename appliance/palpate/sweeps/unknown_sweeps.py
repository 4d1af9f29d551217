"""Kept sweeps that the box has answered `unknown`, in groups that resemble one another: a material
that comes again and is worth a label."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core.errors import ApplianceError, FormatError
from palpate.core.log import log
from palpate.core.sweep_file import sidecar
from palpate.core.types import Status

ALIKE = re.compile(r"; as sweep (\d{1,9})$")
"""End of the detail of an answer, which names an earlier sweep of the same run."""


@dataclass(frozen=True, slots=True)
class UnknownGroup:
    """Sweeps of one unknown material. paths: of their files by number, in order. date: of the last
    sweep."""

    paths: dict[int, Path]
    date: str

    def __str__(self) -> str:
        return f"{len(self.paths)} sweeps: {', '.join(map(str, self.paths))}; the last {self.date}"


def groups(folder: Path, bundle: str) -> list[UnknownGroup]:
    """The groups of at least two sweeps in a folder that the bundle with the id `bundle` did not
    know, the largest first. A file that cannot be used is logged and left out."""
    joined: dict[int, int] = {}
    dates: dict[int, str] = {}
    paths: dict[int, Path] = {}
    for path in sorted(folder.glob("sweep-*.json")):
        try:
            number, before, date = _answer(path, bundle)
        except (FormatError, ValueError, TypeError, KeyError, AttributeError) as e:
            log.warning(f"{path} is left out: {e}")
            continue
        if not number:
            continue
        dates[number], joined[number], paths[number] = date, number, path.with_suffix(".npy")
        if before in joined:
            joined[number] = _first(joined, before)
    found: dict[int, list[int]] = {}
    for number in sorted(joined):
        found.setdefault(_first(joined, number), []).append(number)
    large = sorted((one for one in found.values() if len(one) > 1), key=len, reverse=True)
    return [UnknownGroup({n: paths[n] for n in one}, dates[one[-1]]) for one in large]


def chosen(found: list[UnknownGroup], number: int, folder: Path) -> UnknownGroup:
    """The group with the sweep `number`; for 0 the only group. Raises ApplianceError with the
    groups that there are."""
    if not found:
        raise ApplianceError(
            f"no unknown material was seen twice in {folder}: store.black_box = 500 keeps the last "
            "500 sweeps; make sweeps of the material, or teach it without --unknown"
        )
    fitting = [one for one in found if number in one.paths or not number]
    if len(fitting) != 1:
        shown = "; ".join(map(str, found))
        raise ApplianceError(f"name one of these by a sweep of it, --unknown NUMBER: {shown}")
    return fitting[0]


def _answer(path: Path, bundle: str) -> tuple[int, int, str]:
    """The number of an unknown sweep, that of the earlier sweep that it resembles, 0 for none, and
    its date; three times nothing for another answer."""
    about: dict[str, Any] = sidecar(path.with_suffix(".npy"))
    verdict = about.get("verdict", {})
    if verdict.get("status") != Status.UNKNOWN or verdict.get("bundle") != bundle:
        return 0, 0, ""
    run, alike = int(about.get("run", 0)), ALIKE.search(verdict["detail"])
    return run + int(about["id"]), run + int(alike[1]) if alike else 0, str(about.get("date", "?"))


def _first(joined: dict[int, int], number: int) -> int:
    while joined[number] != number:
        number = joined[number]
    return number
