"""The pages under docs/ as their readers have them: each is in the list of `reports`, has its
header, and can be read."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.factories import rendered
from tests.factories.paths import ROOT
from train.reports import html, provenance
from train.studies import docs_pages, paper_experiment
from train.studies.docs_pages import DocsPage

DOCS = ROOT / "docs"
HTML = sorted(DOCS.rglob("*.html"))
SVG = sorted(DOCS.rglob("*.svg"))
MARKDOWN = [*ROOT.glob("*.md"), *sorted(DOCS.rglob("*.md"))]
CURVE = DOCS / "paper" / paper_experiment.CURVE
"""Which the paper's page takes up into its results."""
METHODS = {"method", "methods", "shipped"}
"""Keys of results that tell of methods, and so of the default."""


def name(path: Path) -> str:
    """For a test's id."""
    return str(path.relative_to(ROOT))


def tells_of_a_default(figures: Any) -> bool:
    """Whether figures are of methods or of a bundle, wherever they say so."""
    if isinstance(figures, dict):
        return (
            bool(METHODS & figures.keys())
            or "bundle" in figures
            or any(map(tells_of_a_default, figures.values()))
        )
    return isinstance(figures, list) and any(map(tells_of_a_default, figures))


def test_every_page_and_every_result_that_tells_of_a_default_is_listed():
    """What lies under docs/ is found, not listed: a page that `reports` does not know would grow
    stale unseen."""
    folders = {
        (DOCS / page.file).parent for page in docs_pages.PAGES if page.file.endswith(".html")
    }
    assert [name(path) for path in HTML if path.parent not in folders] == []
    results = [
        path for path in DOCS.rglob("*.json") if tells_of_a_default(json.loads(path.read_bytes()))
    ]
    assert len(results) >= 5
    listed = {CURVE, *(DOCS / page.results for page in docs_pages.PAGES)}
    assert [name(path) for path in results if path not in listed] == []


@pytest.mark.parametrize("page", docs_pages.PAGES, ids=lambda page: page.name)
def test_a_page_shows_its_results_and_says_first_if_they_are_older(page: DocsPage):
    """Its header is that of the file beside it: commit, sets, seeds; where the default was another
    one, the first line behind the title says so."""
    shown = provenance.read(DOCS / page.results)
    assert shown.commit
    beside = HTML if page.file.endswith(".html") else []
    for path in {
        DOCS / page.file,
        *(other for other in beside if other.parent == (DOCS / page.file).parent),
    }:
        assert provenance.read(path) == shown, path
        if path.suffix == ".html":
            first = re.search(r"</h1>\s*(?:<p[^>]*>(.*?)</p>)?", path.read_text(), re.DOTALL)
            assert shown.older in (first[1] or ""), (
                f"{path}: python -m train.studies reports, or reports --draw"
            )
        elif path.suffix == ".md":
            assert f" -->\n> **{shown.older}**\n" in path.read_text() or not shown.older


@pytest.mark.parametrize(
    "page", [page for page in docs_pages.PAGES if "/" in page.file], ids=lambda page: page.name
)
def test_a_page_and_its_pictures_are_of_the_same_run(page: DocsPage):
    """Every picture in its folder has the header of its results."""
    pictures = [path for path in SVG if path.parent == (DOCS / page.file).parent]
    assert {provenance.read(path) for path in pictures} <= {provenance.read(DOCS / page.results)}


@pytest.mark.parametrize("path", HTML, ids=name)
def test_a_page_leads_home_and_has_its_pictures_beside_it(path: Path):
    """To README, which is there; for those who see no HTML a README.md in its folder shows a
    picture and names the page."""
    assert f'<nav><a href="{html.HOME}">' in path.read_text()
    assert (path.parent / html.HOME).resolve() == ROOT / "README.md"
    beside = (path.parent / "README.md").read_text()
    assert re.search(r"!\[[^\]]+\]\([^)]+\.(svg|png)\)", beside)
    assert "(index.html)" in beside


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("width", rendered.WIDTHS)
@pytest.mark.parametrize("path", HTML, ids=name)
def test_a_page_can_be_read(browser: Any, path: Path, width: int, scheme: str):
    """On a phone, a tablet and a desk, by day and by night: no column or text is cut off, every
    axis has a title, contrast is 4.5 at least, tables have heads and take the focus where they
    scroll, and no brace was left."""
    assert rendered.faults(browser, rendered.address(path), width, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("path", SVG, ids=name)
def test_a_picture_can_be_read(browser: Any, path: Path, scheme: str):
    """By itself, as Markdown shows it: light or dark as its reader has chosen."""
    assert rendered.faults(browser, rendered.address(path), 1024, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize("path", HTML, ids=name)
def test_the_keyboard_goes_home_first_and_into_every_table(browser: Any, path: Path):
    """The first Tab is on the way back to README; the focus can be seen there."""
    context = browser.new_context()
    page = context.new_page()
    page.goto(rendered.address(path))
    page.keyboard.press("Tab")
    found = page.evaluate(
        "[document.activeElement.getAttribute('href'), getComputedStyle(document.activeElement).outlineStyle]"
    )
    context.close()
    assert found == [html.HOME, "solid"]


@pytest.mark.parametrize("path", MARKDOWN, ids=name)
def test_no_brace_was_left_in_a_text(path: Path):
    """Outside of code no {name} stands where a value belongs."""
    text = re.sub(
        r"^```.*?^```|^ {4}.*?$|`[^`]*`|<!--.*?-->",
        "",
        path.read_text(),
        flags=re.DOTALL | re.MULTILINE,
    )
    assert re.findall(r"\{[a-z_]*\}", text) == []
