"""Examples in the documents are what the program prints today."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.campaigns import examples
from tests.campaigns.examples import LOADED, VERSION, StaleExample


@pytest.mark.slow
def test_the_documents_show_the_present_bundle():
    """No line of `palpate check` and no name of the packaged bundle is stale."""
    stale = [line for page in examples.pages(quick=True) for line in examples.differences(*page)]
    assert stale == [], "run python -m tests.campaigns examples"


def test_a_stale_page_is_found_and_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Another id, another version and another figure are named line by line, and written."""
    for folder in examples.FOLDERS:
        (tmp_path / folder).mkdir()
    page = tmp_path / "tutorials" / "first-start.md"
    page.write_text(
        "Text.\n\n    ok    bundle  old\n    ok    speed  3\n    kept 01234567  default 1\n"
        "    bundle   01234567\n    chosen: a; ...\n    on bundle 89abcdef\n"
    )
    run = lambda: "ok    bundle  new\nok    speed  3\nchosen: b; c\n"  # noqa: E731
    starts = ("ok    bundle", "ok    speed", "chosen: ")
    one = examples.Example("tutorials/first-start.md", starts, run)
    monkeypatch.setattr(examples, "EXAMPLES", (one,))
    ((path, text, new),) = examples.pages(quick=True, docs=tmp_path)
    assert path == page
    assert [line.partition(": ")[2] for line in examples.differences(path, text, new)] == [
        "ok    bundle  old -> ok    bundle  new",
        f"kept 01234567  default 1 -> kept {LOADED.id}  default {VERSION}",
        f"bundle   01234567 -> bundle   {LOADED.id}",
        "chosen: a; ... -> chosen: b; ...",
    ]


@pytest.mark.parametrize(
    ("text", "printed", "where"),
    [("    a 1", "b 2", "the output of its run has no"), ("    b 1", "a 2", "the page has no")],
)
def test_a_line_that_is_nowhere_is_named(text: str, printed: str, where: str):
    """An example that the run does not print, and one that the page has lost."""
    with pytest.raises(StaleExample, match=f"{where} line that begins with 'a '"):
        examples.updated(text, ("a ",), printed)
