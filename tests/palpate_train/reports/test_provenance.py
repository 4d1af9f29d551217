"""The header of pages, pictures and results, with a warning for older figures."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.core.errors import FormatError
from palpate_train.metrics import score
from palpate_train.reports import html, provenance
from palpate_train.reports.provenance import Provenance
from tests.factories.page_reader import PageReader

ABOUT = Provenance(
    ("abc", "def+"), ("12345678",), ("sim:T-REAL:1", "a & b <c>--d.npz"), (1, 2), "2026-11-22"
)


def as_html(about: Provenance, home: str = html.HOME) -> str:
    """A page with a title and one line."""
    folder = html.TEMPLATES
    return html.render("base.html.j2", folder, header=about, home=home)


def test_each_kind_of_file_has_one_header(tmp_path: Path):
    """Names may hold tags and quotes; a second takes the place of the first."""
    svg = '<svg xmlns="http://www.w3.org/2000/svg"><title>a</title></svg>'

    def written(folder: Path, about: Provenance) -> list[Path]:
        """One file of each kind with this header."""
        texts = {
            "a.html": as_html(about),
            "a.svg": provenance.in_svg(svg, about),
            "a.md": provenance.in_markdown("# Title\n\nText.\n", about),
        }
        for name, text in texts.items():
            (folder / name).write_text(text)
        return [folder / name for name in texts]

    for path in written(tmp_path, ABOUT):
        assert provenance.read(path) == ABOUT, path.name
    (tmp_path / "a.json").write_text(json.dumps({"commit": "abc", "bundle": "12345678", "seed": 3}))
    assert provenance.read(tmp_path / "a.json") == Provenance(("abc",), ("12345678",), (), (3,))
    other = replace(ABOUT, commit=("fff",), bundle=(score.shipped(),))
    assert provenance.in_svg(provenance.in_svg(svg, ABOUT), other) == provenance.in_svg(svg, other)
    page = "# Title\n\nText -- and <!-- a --> more.\n\n- line\n"
    again = provenance.in_markdown(provenance.in_markdown(page, ABOUT), other)
    assert again == provenance.in_markdown(page, other)
    assert again.endswith("-->" + page.removeprefix("# Title"))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no header",
        '<script type="application/json" id="provenance">{"commit": }</script>',
        '<script type="application/json" id="provenance">{"comit": []}</script>',
    ],
)
def test_a_file_without_header_is_named(tmp_path: Path, text: str):
    """A FormatError has the file's name and a remedy, also if the file is missing."""
    path = tmp_path / "index.html"
    if text:
        path.write_text(text)
    with pytest.raises(FormatError, match=r"index\.html"):
        provenance.read(path)


def test_the_header_is_collected_wherever_figures_say_it():
    """From joined runs, lists and sets of parts, but names that stand for several."""
    figures = {
        "runs": [
            {"methods": [name], "seeds": seeds, "commit": commit, "shipped": id, "date": date}
            for name, seeds, commit, id, date in (
                ("palpate", [1, 2], "a", "11111111", "2026-01-02"),
                ("minirocket", [3], "b", "22222222", "2026-01-03"),
            )
        ],
        "parts": {"hard": {"sets": ["sim:T-REAL:{w}"]}},
        "results": [{"method": "H-svm", "set": "sim:T-REAL:1", "seed": 4, "right": True}],
        "made": {"commit": "of the bundle", "set": "of the bundle", "seed": 9},
    }
    about = provenance.of(figures)
    assert about == Provenance(
        ("a", "b"), ("11111111",), ("sim:T-REAL:1",), (1, 2, 3, 4), "2026-01-03"
    )
    assert (
        provenance.of([{"commit": "a"}, {"commit": "a", "started": "2026-05-06T07:08"}]).date
        == "2026-05-06"
    )
    assert provenance.of(
        {"bundle": {"id": "33333333", "name": "mine"}, "shipped": "11111111"}
    ).bundle == ("33333333",)


def test_runs_and_pages_say_where_they_are_from():
    """Bundle, day and commit; a link before the title, the origin at the end."""
    known = score.provenance()
    assert known["shipped"] == score.shipped()
    assert re.fullmatch(r"[0-9a-f]{8}", known["shipped"])
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", known["date"])
    assert provenance.of({"method": "palpate"} | known).older == ""
    assert "default" in provenance.of({"method": "minirocket"} | known).older
    page = as_html(ABOUT)
    assert re.search(r"<nav><a .*README.*\n<h1>", page)
    assert "bundle 12345678, seeds" in PageReader(page).text
    assert "README" not in as_html(ABOUT, home="")


def test_a_page_of_an_older_default_says_so_in_its_first_line():
    """Below the title, in HTML and Markdown; not for today's default or for others."""
    now, text = (
        score.shipped(),
        f"Made with an older default, bundle 12345678; the box ships bundle {score.shipped()} now.",
    )
    assert ABOUT.older == text
    assert re.search(rf"</h1>\s*<p[^>]*older.*>{text}</p>", as_html(ABOUT))
    assert f"-->\n> **{text}**\n" in provenance.in_markdown("# Title\n\nText.\n", ABOUT)
    for about, home in ((replace(ABOUT, bundle=(now,)), html.HOME), (ABOUT, "")):
        assert "stop older" not in as_html(about, home)
    assert "older" not in provenance.in_markdown("# Title\n", replace(ABOUT, bundle=(now,)))
    both = replace(ABOUT, bundle=("87654321", now))
    assert "in part" in both.older
    assert "bundle 87654321;" in both.older


def test_every_table_has_a_frame(tmp_path: Path):
    """All headings have a scope, wide tables take the focus; a template's attributes stay."""
    (tmp_path / "a.html.j2").write_text(
        '<div class="wide"><table><thead><tr><th class="text">a</th></tr></thead>'
        '<tr><th scope="row">b</th></tr></table></div>'
    )
    page = html.render("a.html.j2", tmp_path)
    assert re.search(r'<th scope="col".*>a</th>', page)
    assert '<th scope="row">b</th>' in page
    assert "<thead>" in page
    assert re.match(r'<div .*tabindex="0".*<table>', page)
