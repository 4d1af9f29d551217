"""Pages of results: each is sound, says where its figures are from, and can be read."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_studies import pages, reports
from palpate_train.metrics import score
from palpate_train.reports import html, provenance
from tests.factories import development_data, rendered, stress_data
from tests.factories.page_reader import PageReader
from tests.factories.paths import ROOT
from tests.factories.study_pages import RESULTS, committed, published
from tests.rig import soak

DOCS = ROOT / "docs"
HTML = tuple(f"{name}/index.html" for name in pages.PAGES)
METHODS = {"method", "methods", "shipped"}
"""Keys of results about methods, which depend on the default method."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the pages of all results in docs/data."""
    out = tmp_path_factory.mktemp("site") / "results"
    pages.write((), out, RESULTS)
    return out


def name(path: Path) -> str:
    """The id of a test."""
    return str(path.relative_to(ROOT))


@pytest.mark.slow
@pytest.mark.parametrize("page", HTML)
def test_a_page_is_sound(drawn: Path, page: str):
    """Tags close, nothing is missing; its header, or its first line, says the default."""
    text = (drawn / page).read_text()
    read = PageReader(text)
    assert read.faults == []
    assert not re.search(r"[{}]", read.text)
    elsewhere = re.compile(r"/|(?!data:|https://doi\.org/)\w+:")
    assert not any(elsewhere.match(link) for link in read.links)
    assert text.count("<table") == len(re.findall(r'<div class="wide".*?<table', text))
    about = provenance.read(RESULTS / f"{Path(page).parent.name}.json")
    assert provenance.read(drawn / page) == about
    first = re.search(r"</h1>\s*(?:<p[^>]*>(.*?)</p>)?", text, re.DOTALL)
    assert about.older in (first[1] or "")
    assert f'<nav><a href="{html.HOME}">' in text


@pytest.mark.slow
def test_a_page_shows_the_figures_of_its_results(drawn: Path):
    """Materials, shares, sums and origin."""
    text = PageReader((drawn / "certainty" / "index.html").read_text()).text
    text, results = text.replace("\N{NO-BREAK SPACE}", " "), committed("certainty")
    facts = [f"{100 * results['early']['share']:.1f} % of the window"]
    for material, m in results["unknown"]["materials"].items():
        facts.append(f"{material} {100 * m['false_known']:.1f} % {100 * m['kept']:.1f} %")
    facts += [str(results[key]) for key in ("set", "test", "digest", "commit", "machine")]
    assert [fact for fact in facts if fact not in text] == []


def test_a_page_links_to_its_results_and_an_unknown_one_is_an_error(tmp_path: Path):
    """They lie beside it; nothing is written for an unknown one."""
    with pytest.raises(FormatError, match="nobody"):
        pages.write(["nobody"], tmp_path / "out", RESULTS)
    assert not (tmp_path / "out").exists()
    page = published("stress", stress_data.figures(), tmp_path)
    assert json.loads((page.parent / "stress.json").read_text())["test_sweeps"] == 100
    assert "stress.json" in PageReader(page.read_text()).links


def test_every_result_about_a_default_is_listed():
    """Nobody would notice that a result outside of the list of `reports` is stale."""

    def about_a_default(figures: Any) -> bool:
        """Whether figures are about methods or a bundle, at any depth."""
        if isinstance(figures, dict):
            keys = METHODS & figures.keys() or "bundle" in figures
            return bool(keys) or any(map(about_a_default, figures.values()))
        return isinstance(figures, list) and any(map(about_a_default, figures))

    assert list(DOCS.rglob("*.html")) == []
    found = [one for one in DOCS.rglob("*.json") if about_a_default(json.loads(one.read_bytes()))]
    listed = {DOCS / report.file for report in reports.REPORTS}
    assert [name(path) for path in found if path not in listed] == []
    assert all(provenance.read(path).commit for path in listed)


def test_no_document_shows_another_bundle_as_the_packaged_one_or_a_brace():
    """Examples come from today's bundle."""
    packaged = re.compile(
        r"box ships (?:now, )?bundle (?P<ships>[0-9a-f]{8})|default \d+, (?P<shown>[0-9a-f]{8})"
        r"|(?P<listed>[0-9a-f]{8})  default \d"
    )
    markdown = [*ROOT.glob("*.md"), *sorted(DOCS.rglob("*.md"))]
    texts = {name(path): path.read_text("utf-8") for path in markdown}
    for page, text in texts.items():
        found = {found[found.lastgroup or 0] for found in packaged.finditer(text)}
        assert found <= {score.shipped()}, page
        plain = re.sub(r"(?ms)^```.*?^```|^ {4}.*?$|`[^`]*`|<!--.*?-->", "", text)
        assert re.findall(r"\{[a-z_]*\}", plain) == [], page


def test_the_soak_is_summed_up_of_its_records(tmp_path: Path):
    """Without a new record its results stay the same, and reach all targets."""
    file = tmp_path / "soak.json"
    file.write_bytes((RESULTS / "soak.json").read_bytes())
    assert soak.summed(tmp_path, file)
    assert json.loads(file.read_text()) == committed("soak")


@pytest.fixture(scope="module")
def readable(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """All pages by name, and two of invented results with every part."""
    folder = tmp_path_factory.mktemp("invented")
    return {page: drawn / page for page in HTML} | {
        "development": published("development", development_data.figures(), folder),
        "stress": published("stress", stress_data.figures(), folder),
    }


@pytest.mark.slow
@rendered.LOOKS
@pytest.mark.parametrize("page", [*HTML, "development", "stress"])
def test_a_page_can_be_read(
    browser: Any, readable: dict[str, Path], page: str, width: int, scheme: str
):
    """At three sizes nothing is cut, contrast is 4.5, axes and tables have heads."""
    assert rendered.faults(browser, rendered.address(readable[page]), width, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("path", sorted(DOCS.rglob("*.svg")), ids=name)
def test_a_picture_can_be_read(browser: Any, path: Path, scheme: str):
    """The picture alone, as Markdown shows it, light or dark as its reader has chosen."""
    assert rendered.faults(browser, rendered.address(path), 1024, scheme) == {}
