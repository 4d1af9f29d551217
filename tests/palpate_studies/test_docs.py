"""Results in docs/data, the pages of them, and the pictures of written pages.

Each is in a list of the commands, has its header and can be read.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from palpate_studies import pages, reports
from palpate_train.metrics import score
from palpate_train.reports import html, provenance
from tests.factories import rendered
from tests.factories.paths import ROOT
from tests.factories.study_pages import RESULTS
from tests.rig import soak, soak_page

DOCS = ROOT / "docs"
HTML = (
    *(f"{name}/index.html" for name in pages.PAGES),
    "soak/index.html",
)
SVG = sorted(DOCS.rglob("*.svg"))
MARKDOWN = [*ROOT.glob("*.md"), *sorted(DOCS.rglob("*.md"))]
CURVES = [*RESULTS.glob("cnn-curve-*.json")]
"""The results of `paper` contain their last points."""
METHODS = {"method", "methods", "shipped"}
"""Keys of results about methods, which depend on the default method."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the pages of all results in docs/data."""
    out = tmp_path_factory.mktemp("site") / "results"
    pages.write((), out, RESULTS)
    results = json.loads((RESULTS / "soak.json").read_bytes())
    page, svg = soak_page.render(results)
    html.publish(out / "soak", {"index": page}, {"soak": svg}, provenance.of(results))
    return out


def name(path: Path) -> str:
    """The id of a test."""
    return str(path.relative_to(ROOT))


def about_a_default(figures: Any) -> bool:
    """Whether figures are about methods or a bundle, at any depth."""
    if isinstance(figures, dict):
        return (
            bool(METHODS & figures.keys())
            or "bundle" in figures
            or any(map(about_a_default, figures.values()))
        )
    return isinstance(figures, list) and any(map(about_a_default, figures))


def test_every_result_about_a_default_is_listed():
    """Nobody would notice that a result outside of the list of `reports` is stale. Git holds no
    built page.
    """
    assert list(DOCS.rglob("*.html")) == []
    results = [
        path for path in DOCS.rglob("*.json") if about_a_default(json.loads(path.read_bytes()))
    ]
    assert len(results) >= 5
    listed = {*CURVES, *(DOCS / report.file for report in reports.REPORTS)}
    assert [name(path) for path in results if path not in listed] == []


PACKAGED = re.compile(
    r"box ships (?:now, )?bundle (?P<ships>[0-9a-f]{8})|default \d+, (?P<shown>[0-9a-f]{8})"
    r"|(?P<listed>[0-9a-f]{8})  default \d"
)


@pytest.mark.parametrize("path", MARKDOWN, ids=name)
def test_no_page_shows_another_bundle_as_the_packaged_one(path: Path):
    """Examples come from today's bundle, and warnings of older results name it."""
    found = {found[found.lastgroup or 0] for found in PACKAGED.finditer(path.read_text("utf-8"))}
    assert found <= {score.shipped()}


def test_every_picture_is_shown_once_at_least():
    """Every picture in docs is on a page."""
    text = "".join(path.read_text() for path in MARKDOWN)
    pictures = [*SVG, *DOCS.rglob("*.png")]
    assert [name(path) for path in pictures if f"{path.name})" not in text] == []


@pytest.mark.parametrize("report", reports.REPORTS, ids=lambda report: report.name)
def test_results_say_where_they_are_from(report: reports.ResultFile):
    """The commit, and the other fields of their provenance."""
    assert provenance.read(DOCS / report.file).commit


def test_a_page_shows_its_results_and_says_first_if_they_are_older(drawn: Path):
    """Its header and that of its pictures are the header of its results.

    If they are of another default, the first line below the title says so.
    """
    for page in drawn.glob("*/*.html"):
        shown = provenance.read(RESULTS / f"{page.parent.name}.json")
        assert provenance.read(page) == shown, page
        assert {provenance.read(path) for path in page.parent.glob("*.svg")} <= {shown}
        first = re.search(r"</h1>\s*(?:<p[^>]*>(.*?)</p>)?", page.read_text(), re.DOTALL)
        assert shown.older in (first[1] or ""), page
        assert f'<nav><a href="{html.HOME}">' in page.read_text()
    assert {str(path.relative_to(drawn)) for path in drawn.glob("*/*.html")} == set(HTML)


def test_the_soak_is_drawn_of_its_results(tmp_path: Path):
    """Without a new record its results stay the same byte for byte, as the build of the site
    needs.
    """
    file = tmp_path / "soak.json"
    file.write_bytes((RESULTS / "soak.json").read_bytes())
    assert soak.draw([tmp_path], file, tmp_path / "page")
    assert file.read_bytes() == (RESULTS / "soak.json").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("width", rendered.WIDTHS)
@pytest.mark.parametrize("page", HTML)
def test_a_page_can_be_read(browser: Any, drawn: Path, page: str, width: int, scheme: str):
    """On a phone, a tablet and a desk, light and dark, nothing is cut off and every axis has a
    title.

    The contrast is at least 4.5. Tables have heads, and take the focus if they scroll. No brace is
    left.
    """
    assert rendered.faults(browser, rendered.address(drawn / page), width, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("path", SVG, ids=name)
def test_a_picture_can_be_read(browser: Any, path: Path, scheme: str):
    """The picture alone, as Markdown shows it, light or dark as its reader has chosen."""
    assert rendered.faults(browser, rendered.address(path), 1024, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", HTML)
def test_the_keyboard_goes_home_first_and_into_every_table(browser: Any, drawn: Path, name: str):
    """The first Tab reaches the link to README, and the focus is visible there."""
    context = browser.new_context()
    page = context.new_page()
    page.goto(rendered.address(drawn / name))
    page.keyboard.press("Tab")
    found = page.evaluate(
        "[document.activeElement.getAttribute('href'), "
        "getComputedStyle(document.activeElement).outlineStyle]"
    )
    context.close()
    assert found == [html.HOME, "solid"]


@pytest.mark.parametrize("path", MARKDOWN, ids=name)
def test_no_brace_was_left_in_a_text(path: Path):
    """Outside of code no {name} is left where a value belongs."""
    text = re.sub(
        r"^```.*?^```|^ {4}.*?$|`[^`]*`|<!--.*?-->",
        "",
        path.read_text(),
        flags=re.DOTALL | re.MULTILINE,
    )
    assert re.findall(r"\{[a-z_]*\}", text) == []
