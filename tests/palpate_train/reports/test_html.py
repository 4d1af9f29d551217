"""Pages and their texts."""

import re
from pathlib import Path

import pytest

from palpate_train.reports import html
from tests.factories.paths import ROOT


def test_a_text_of_a_file_controls_no_terminal(tmp_path: Path):
    """A page is also read as text: escapes and marks of direction are shown as ?. Line breaks, and
    pictures of our own, stay."""
    (tmp_path / "page.html.j2").write_text("{{ name }}|{{ share | percent }}|{{ own }}")
    name = "a\x1b]0;b\x07\r\u202e<i>\nö"
    own = html.picture("<svg>\x0c</svg>")
    page = html.render("page.html.j2", tmp_path, name=name, share=0.5, own=own)
    assert page == "a?]0;b???&lt;i&gt;\nö|50.0\u00a0%|<svg>\x0c</svg>"


@pytest.mark.parametrize(
    "path", sorted((ROOT / "train").glob("**/templates/*.html.j2")), ids=lambda path: path.name
)
def test_sentences_of_a_page_have_a_space_between_them(path: Path):
    """Jinja drops the end of a line behind a block, so the text below begins with a space."""
    glued = re.findall(r"^.*[^\s>%}].*%\}\n(?=[A-Za-z])", path.read_text(), re.MULTILINE)
    assert [line for line in glued if not re.fullmatch(r"\s*\{%[^{}]*%\}\n", line)] == []
