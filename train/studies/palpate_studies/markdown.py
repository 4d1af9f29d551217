"""Tables in Markdown, and the text of a command in a document, between two markers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from palpate.core.errors import FormatError


def table(head: Sequence[str], rows: Iterable[Sequence[object]], about: str = "") -> str:
    """A table with these cells, below a paragraph `about` it."""
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (head, *rows)]
    lines.insert(1, "|---" * len(head) + "|")
    return "\n".join([about, "", *lines] if about else lines)


def insert(document: str, name: str, text: str, path: str) -> str:
    """`document` with `text` between <!-- NAME --> and <!-- /NAME -->.

    Raises FormatError with the document's `path` if it does not have this pair of markers exactly
    once.
    """
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    before, found, rest = document.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed or begin in after:
        raise FormatError(
            f"{path} has not one pair of markers {begin} and {end}; "
            "put them where the table belongs"
        )
    return f"{before}{begin}\n{text}\n{end}{after}"
