"""Texts and pictures of results in README and written pages.

FIGURES and PICTURES list them with their places. `python -m palpate_studies figures` writes all of
them, and a test fails if a document or a picture differs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate_studies import (
    bench_table,
    contact_plot,
    contact_table,
    development_report,
    marked_text,
    matrix_table,
    plots,
    quotes,
    recipe_page,
    reports,
    wrong_answers,
)
from palpate_studies.study import DATA, read, results_file
from palpate_train.reports import provenance

README, ALIGN = "README.md", "docs/how-to/align.md"
SPECIFICATIONS = "docs/reference/specifications.md"
RECIPE = "docs/recipe.md"
FIGURES_PAGE = "docs/explanation/figures.md"
ALIGNMENT, FABRICS = "docs/alignment/README.md", "docs/fabricslide/README.md"


@dataclass(frozen=True, slots=True)
class DocumentFigure:
    """A text between <!-- marker --> and <!-- /marker --> of a document. results: name of the file
    in docs/data. text: makes it of the results."""

    document: str
    marker: str
    results: str
    text: Callable[[Any], str]


@dataclass(frozen=True, slots=True)
class DocumentPicture:
    """A picture (SVG) that a document shows. results: name of the file in docs/data. draw: makes it
    of the results."""

    file: str
    results: str
    draw: Callable[[Any], str]


FIGURES = (
    DocumentFigure(README, "stress", "stress", wrong_answers.of_stress),
    DocumentFigure(README, "junk", "junk", wrong_answers.of_junk),
    DocumentFigure(README, "front", "development", development_report.caption),
    DocumentFigure(SPECIFICATIONS, "bench", "bench", bench_table.table),
    DocumentFigure(ALIGN, "moved", "alignment", contact_table.sentence),
    DocumentFigure(ALIGNMENT, "in short", "alignment", contact_table.headline),
    DocumentFigure(ALIGNMENT, "alignment", "alignment", contact_table.table),
    DocumentFigure(RECIPE, "recipe", "recipe", recipe_page.table),
    DocumentFigure(RECIPE, "loads", "recipe", recipe_page.loads),
    DocumentFigure(FABRICS, "matrix", "fabrics", matrix_table.headline),
    *(
        DocumentFigure(FIGURES_PAGE, f"quotes {study}", study, partial(quotes.table, study))
        for study in quotes.QUOTES
    ),
)
PICTURES = (
    DocumentPicture(
        "docs/front.svg",
        "development",
        development_report.front,
    ),
    DocumentPicture("docs/recipe.svg", "recipe", recipe_page.draw),
    DocumentPicture("docs/alignment/place.svg", "alignment", contact_plot.draw),
    DocumentPicture("docs/fabricslide/windows.svg", "fabrics", plots.matrix),
    DocumentPicture(
        "docs/fabricslide/recordings.svg",
        "fabrics",
        lambda results: plots.matrix(results, count="recording"),
    ),
)
HEADED = {ALIGNMENT: "alignment", FABRICS: "fabrics", RECIPE: "recipe"}
"""Pages about one file of results, which have its provenance behind their title."""


def written(document: str, root: Path) -> str:
    """A document with all its figures. Raises FormatError if results or markers are missing, or if
    the results are of another kind."""
    text = (root / document).read_text(encoding="utf-8")
    for figure in FIGURES:
        if figure.document == document:
            made = _of(figure.results, figure.marker, figure.text, root)
            text = marked_text.insert(text, figure.marker, made, document)
    if document in HEADED:
        results = read(results_file(HEADED[document], root / DATA))
        text = provenance.in_markdown(text, provenance.of(results))
    return text


def drawn(picture: DocumentPicture, root: Path) -> str:
    """A picture with its provenance. Raises FormatError as `written`."""
    svg = _of(picture.results, picture.file, picture.draw, root)
    about = provenance.of(read(results_file(picture.results, root / DATA)))
    return provenance.in_svg(svg, about) + "\n"


def write(root: Path = Path()) -> list[str]:
    """Write all figures and pictures below `root`; the files that changed. Raises as `written`."""
    texts = {
        name: written(name, root) for name in dict.fromkeys(figure.document for figure in FIGURES)
    } | {picture.file: drawn(picture, root) for picture in PICTURES}
    changed = [name for name, text in texts.items() if _there(root / name) != text]
    for name in changed:
        put(root / name, texts[name].encode(), parents=True)
    return changed


def _there(path: Path) -> str | None:
    return path.read_text(encoding="utf-8") if path.exists() else None


def _of(results: str, what: str, make: Callable[[Any], str], root: Path) -> str:
    file = results_file(results, DATA)
    try:
        return make(read(root / file))
    except (FormatError, LookupError, TypeError, AttributeError) as e:
        command = reports.named([results])[0].command
        raise FormatError(
            f"{file} does not hold the figures of {what!r}: {e!r}; run `{command}`"
        ) from e
