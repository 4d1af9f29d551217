"""Figures of results in README and pages. In: files of results. Out: documents, with each
text between its markers.

The one list of what stands where: `python -m train.studies figures` writes it all, and a test fails where a
document differs.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.reports import provenance
from train.studies import bench_table, contact_table, marked_text

README, ALIGN = "README.md", "docs/how-to/align.md"
SPECIFICATIONS = "docs/reference/specifications.md"
BENCH, ALIGNMENT, DEVELOPMENT = (
    "docs/bench.json",
    "docs/alignment/place.json",
    "docs/development/results.json",
)
MADE_BY = {
    BENCH: "make bench",
    ALIGNMENT: "python -m train.studies alignment --out docs/alignment",
    DEVELOPMENT: "python -m train.studies development",
}


def picture_note(figures: Any) -> str:
    """Under a picture: that it tells of an older default, or nothing."""
    older = provenance.of(figures).older
    return f"*{older}*" if older else ""


@dataclass(frozen=True, slots=True)
class DocumentFigure:
    """What stands in a document between <!-- marker --> and <!-- /marker -->: `text` of a file of
    results."""

    document: str
    marker: str
    results: str
    text: Callable[[Any], str]


FIGURES = (
    DocumentFigure(README, "front", DEVELOPMENT, picture_note),
    DocumentFigure(SPECIFICATIONS, "bench", BENCH, bench_table.table),
    DocumentFigure(ALIGN, "moved", ALIGNMENT, contact_table.sentence),
    DocumentFigure("docs/alignment/README.md", "alignment", ALIGNMENT, contact_table.table),
)


def written(document: str, root: Path) -> str:
    """A document with all its figures. Raises FormatError where results are missing or of another
    kind, or its markers are."""
    text = (root / document).read_text(encoding="utf-8")
    for figure in FIGURES:
        if figure.document == document:
            text = marked_text.insert(text, figure.marker, _text(figure, root), document)
    return text


def write(root: Path = Path()) -> list[str]:
    """Put all figures into the documents below `root`; the documents that were not as they are now.
    Raises as `written`."""
    texts = {
        name: written(name, root) for name in dict.fromkeys(figure.document for figure in FIGURES)
    }
    changed = [
        name for name, text in texts.items() if text != (root / name).read_text(encoding="utf-8")
    ]
    for name in changed:
        put(root / name, texts[name].encode())
    return changed


def _text(figure: DocumentFigure, root: Path) -> str:
    try:
        return figure.text(json.loads((root / figure.results).read_bytes()))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as e:
        made = MADE_BY[figure.results]
        raise FormatError(
            f"{figure.results} does not hold the figures of {figure.marker!r}: {e!r}; run `{made}`"
        ) from e
