"""The site holds every page, each link leads somewhere, references are of the code."""

import importlib.util
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests.factories.paths import ROOT


@pytest.fixture(scope="module")
def build() -> Iterator[ModuleType]:
    """docs/site/build.py as a module."""
    sys.path.insert(0, str(ROOT / "systemd"))
    path = ROOT / "docs" / "site" / "build.py"
    spec = importlib.util.spec_from_file_location("site_build", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.path.remove(str(ROOT / "systemd"))


@pytest.fixture(scope="module")
def sources(build: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gathered sources of the site, after a check that no link is broken."""
    out = tmp_path_factory.mktemp("site") / "src"
    assert build.gather(out) == []
    return out


def test_the_sources_hold_every_page(build: ModuleType, sources: Path):
    """README is the first page, every other page has its place in the contents, once."""
    names = set(build.pages()) - {"README.md"}
    assert len(names) > 40
    first = (sources / "index.md").read_text("utf-8")
    listed = re.findall(r"(?m)^([\w./-]+/?[\w.-]+)$", first.partition("```{toctree}")[2])
    assert sorted(f"{name}.md" for name in listed) == sorted(names)
    assert all((sources / name).is_file() for name in names)


def test_each_finding_is_on_a_page(sources: Path):
    """So a reader meets it; a link to a finding that was removed would be broken."""
    told = "".join(page.read_text("utf-8") for page in sources.glob("docs/reference/*.md"))
    found = [one.name for one in sorted((ROOT / "findings").glob("*.sh"))]
    assert found
    assert [name for name in found if f"findings/{name}" not in told] == []


def test_a_broken_link_is_named(build: ModuleType, tmp_path: Path):
    """Its page and its target; a picture outside of the project counts as broken."""
    lost: list[str] = []
    text = "[a](missing.md) ![b](../../../etc/hosts) [c](README.md#x) [d](https://e.org) `[e](f)`"
    assert "[c](index.md#x)" in build.linked(Path("README.md"), text, tmp_path, lost)
    assert [line.split(" is not")[0] for line in lost] == [
        "README.md: missing.md",
        "README.md: ../../../etc/hosts",
    ]


def test_pages_of_the_studies_are_listed_and_their_links_lead_into_the_site(
    build: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """By their titles; links to Markdown lead to the pages made of it, linked files come along."""

    def write(command: list[str], **_: object) -> None:
        page = command[-1] / "stress" / "index.html"
        page.parent.mkdir(parents=True)
        page.write_text(
            '<a href="../../README.md"><a href="../../docs/skins.md#load"><img src="stress.svg">'
        )
        page.with_name("stress.svg").write_text("<svg/>")

    monkeypatch.setattr(build.subprocess, "run", write)
    sources, site = tmp_path / "src", tmp_path / "site"
    build.results(sources)
    listed = (sources / build.RESULTS).read_text()
    assert f'<a href="results/stress/index.html">{build.RESULT_PAGES["stress"]}</a>' in listed
    build.take_over(Path("results/stress/index.html"), sources, site)
    shown = (site / "results" / "stress" / "index.html").read_text()
    assert re.findall(r'href="([^"]+)"', shown) == [
        "../../index.html",
        "../../docs/skins.html#load",
    ]
    assert (site / "results" / "stress" / "stress.svg").is_file()


def test_links_of_the_built_site_are_followed(build: ModuleType, tmp_path: Path):
    """A reference that is not there is printed with its page; those out of the site are not."""
    (tmp_path / "there.html").write_text('<a href="https://e.org"><img src="data:x">')
    (tmp_path / "a.html").write_text('<a href="there.html#x"> <a href="gone.html"> <a href="#b">')
    assert build.broken(tmp_path) == ["a.html: gone.html is not in the site"]


def test_the_reference_of_the_library_is_complete(sources: Path):
    """Every public name with parameters, members and docstrings."""
    page = (sources / "docs" / "reference" / "library.md").read_text("utf-8")
    assert "<!-- palpate" not in page
    from palpate_train import library  # only here: scikit-learn

    for name in library.__all__:
        what = getattr(library, name)
        assert f"\n## {name}\n" in page
        assert inspect.getdoc(what) in page
        for member, value in vars(what).items() if inspect.isclass(what) else ():
            if member.startswith("_") or not (callable(value) or isinstance(value, property)):
                continue
            assert inspect.getdoc(value), f"{name}.{member} has no docstring"
            assert f"\n### {name}.{member}\n" in page
            assert inspect.getdoc(value) in page
            function = value.fget if isinstance(value, property) else value
            for parameter in inspect.signature(function).parameters:
                assert parameter == "self" or parameter in page.partition(f"### {name}.{member}")[2]
    assert "PalpateClassifier(rate_hz=100.0, grid=None, group='position'" in page
    assert "load_bundle(path)" in page
