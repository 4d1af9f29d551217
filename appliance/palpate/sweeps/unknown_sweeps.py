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

ALIKE = re.compile(r"; as sweep (\d{1,9})\b")
"""Part of an answer's detail, with the number of an earlier sweep of the same run."""


@dataclass(frozen=True, slots=True)
class UnknownGroup:
    """Sweeps of one unknown material, by number, and the date of the last."""

    paths: dict[int, Path]
    date: str

    def __str__(self) -> str:
        return f"{len(self.paths)} sweeps: {', '.join(map(str, self.paths))}; the last {self.date}"


def groups(folder: Path, bundle: str) -> list[UnknownGroup]:
    """The groups of at least two sweeps in a folder that the bundle with the id `bundle` did not
    know, the largest first. A file that cannot be used is logged and left out."""
    # the sweeps of each number's material; sweeps of one material share a list
    seen: dict[int, list[tuple[int, Path, str]]] = {}
    for path in sorted(folder.glob("sweep-*.json")):
        try:
            number, before, date = _answer(path, bundle)
        except (FormatError, ValueError, TypeError, KeyError, AttributeError) as e:
            log.warning(f"{path} is left out: {e}")
            continue
        if number:
            seen[number] = seen.get(before, [])
            seen[number].append((number, path.with_suffix(".npy"), date))
    shared = {id(one): one for one in seen.values() if len(one) > 1}
    large = sorted(shared.values(), key=len, reverse=True)
    return [UnknownGroup({n: path for n, path, _ in one}, one[-1][2]) for one in large]


def chosen(found: list[UnknownGroup], number: int, folder: Path) -> UnknownGroup:
    """The group with the sweep `number`; for 0 the only one. Raises ApplianceError."""
    if not found:
        raise ApplianceError(
            f"no unknown material was seen twice in {folder}; set store.black_box = 500, make"
            " sweeps of the material, or teach it without --unknown"
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
