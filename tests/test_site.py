"""The site that .github/workflows/site.yml publishes: its own steps gather the files, and every way
between them leads somewhere."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

WORKFLOW = ROOT / ".github" / "workflows" / "site.yml"
LINK = re.compile(r'\]\(([^)#\s]+)[^)]*\)|(?:href|src)="([^"#]+)[^"]*"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the workflow's step gathers from a clone."""
    clone = tmp_path_factory.mktemp("site") / "clone"
    subprocess.run(["git", "clone", "-q", "--depth", "1", f"file://{ROOT}", clone], check=True)
    (step,) = re.findall(r"- run: \|\n((?: {10}.*\n)+)", WORKFLOW.read_text())
    subprocess.run(["bash", "-euo", "pipefail", "-c", step], cwd=clone, check=True)
    return clone / "site"


def leads(page: Path, link: str) -> bool:
    """Whether a link of a page leads to something of the site, or out of it."""
    return bool(re.match(r"[a-z]+:", link)) or (page.parent / link).exists()


@pytest.mark.slow
def test_pages_and_pictures_of_the_site_are_found(site: Path):
    """Each relative link of a page, and each picture of README and the texts below docs/."""
    pages = [*site.rglob("*.html"), site / "README.md", *site.glob("docs/**/*.md")]
    assert len([page for page in pages if page.suffix == ".html"]) >= 4
    lost = []
    for page in pages:
        links = [one or other for one, other in LINK.findall(page.read_text(encoding="utf-8"))]
        shown = (
            links
            if page.suffix == ".html"
            else [link for link in links if link.endswith((".svg", ".png", ".html", ".md"))]
        )
        lost += [f"{page.relative_to(site)}: {link}" for link in shown if not leads(page, link)]
    assert lost == []


@pytest.mark.slow
def test_pages_of_the_site_lead_to_its_first_page(site: Path):
    """README is the page of the site's folder: no link goes to a file that Jekyll has renamed."""
    for page in site.rglob("*.html"):
        assert 'href="../../README.md"' not in page.read_text(encoding="utf-8")


def test_the_workflow_publishes_what_main_holds():
    """On main and by hand, with the rights that publishing needs and no more."""
    text = WORKFLOW.read_text()
    assert "branches: [main]" in text
    assert "workflow_dispatch:" in text
    assert re.findall(r"^  ([a-z-]+): (read|write)$", text, re.M) == [
        ("contents", "read"),
        ("pages", "write"),
        ("id-token", "write"),
    ]
    assert [
        action
        for action in re.findall(r"uses: (\S+)@v\d+", text)
        if not action.startswith("actions/")
    ] == []
