"""The pages of results: each is a template on the results of one study.

`make site` publishes them. A page needs no font and no address outside of its folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate_studies import (
    development_report,
    paper_report,
    stress_report,
    uncertainty_report,
)
from palpate_studies.study import DATA, Rendered, read, results_file
from palpate_train.reports import html

BOX_ON_HARD = {"accuracy", "wrong_share", "network"}
"""Keys of the box's answers to T-HARD's sweeps in the results of `alignment`."""


@dataclass(frozen=True, slots=True)
class Page:
    """The page of a study. keys: that its results have. render: makes page and pictures of the
    results and of the folder that holds them."""

    keys: tuple[str, ...]
    render: Callable[[Any, Path], Rendered]


PAGES: Mapping[str, Page] = {
    "development": Page(
        ("methods", "runs", "cases", "results", "left_out"),
        lambda results, _: development_report.render(results),
    ),
    "stress-fabrics": Page(
        ("methods", "box"), lambda results, _: stress_report.render(results, "stress-fabrics")
    ),
    "stress": Page(("methods", "box"), lambda results, _: stress_report.render(results)),
    "certainty": Page(
        ("calibration", "early"), lambda results, _: uncertainty_report.render(results)
    ),
    "paper": Page(
        ("table", "results"),
        lambda results, folder: paper_report.render(results, box_on_hard(folder)),
    ),
}


def write(wanted: Sequence[str], out: Path, folder: Path = DATA) -> list[Path]:
    """Write the pages `wanted`, or all, into folders of `out`, with the results that they
    link to; the paths of the pages.

    Raises FormatError for an unknown page, and for results that are missing or of another study.
    """
    if unknown := [name for name in wanted if name not in PAGES]:
        raise FormatError(f"no page {', '.join(unknown)}; there are {', '.join(PAGES)}")
    made = []
    for name in wanted or PAGES:
        file, page = results_file(name, folder), PAGES[name]
        results = read(file, *page.keys)
        text, _ = page.render(results, folder)
        made.append(html.publish(out / name, text))
        (out / name / file.name).write_bytes(file.read_bytes())
    return made


def box_on_hard(folder: Path) -> Mapping[str, Any] | None:
    """The answers of the packaged bundle to T-HARD's sweeps, from the results of `alignment` in
    `folder`; None if they are not there."""
    file = results_file("alignment", folder)
    point = read(file).get("T-HARD", {}) if file.exists() else {}
    return point if point.keys() >= BOX_ON_HARD else None
