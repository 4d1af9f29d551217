"""The browser checks of the tests find each fault of a page, and none in a page without faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from palpate_train.reports import html, plot_style
from tests.factories import rendered

LONG = "an_unbroken_name_" * 12
GOOD = """{% extends "base.html.j2" %}{% import "parts.html.j2" as parts %}
{% block title %}Good{% endblock %}{% block body %}
{{ parts.targets([{"what": "accuracy where the skin was put back elsewhere",
                   "target": "≥ 97 %", "here": "98.1 % [96.1, 99.3]", "met": false}]) }}
{{ parts.table(["a", "b", "c", "d", "e", "f"], [["99.1 % [99.0, 99.2]"] * 6]) }}
<figure>{{ svg }}</figure>{% endblock %}"""


def page(folder: Path, body: str, **figure: str) -> str:
    """The address of a page with this body in the frame of all pages. figure: titles of its
    picture's axes."""
    one, axes = plot_style.single_axes(2.0, 0.1, 0.9, 0.3, 0.5)
    plot_style.set_ticks(axes.xaxis, (0, 0.5, 1), "s")
    plot_style.set_ticks(axes.yaxis, (0, 1), percent=True)
    axes.set_xlabel(figure.get("x", ""))
    axes.set_ylabel(figure.get("y", ""))
    (folder / "a.html.j2").write_text(body)
    svg = html.picture(plot_style.to_svg(one, "a picture"))
    (folder / "a.html").write_text(html.render("a.html.j2", folder, svg=svg))
    return rendered.address(folder / "a.html")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", rendered.SCHEMES)
@pytest.mark.parametrize("width", rendered.WIDTHS)
def test_a_good_page_has_no_fault(browser: Any, tmp_path: Path, width: int, scheme: str):
    """A page with a verdict, a wide table and a picture with titles."""
    assert rendered.faults(browser, page(tmp_path, GOOD, x="time", y="share"), width, scheme) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("page wider than the window", f"<p style='white-space: nowrap'>{LONG}</p>"),
        (
            "verdict out of sight",
            "<div class='wide' tabindex='0' role='region'>"
            "<table><tr><td style='padding-left: 30rem'></td>"
            "<td class='verdict'>reached</td></tr></table></div>",
        ),
        ("scrolls without keyboard", f"<div style='overflow-x: auto'><pre>{LONG}</pre></div>"),
        (
            "text outside its picture",
            "<svg viewBox='0 0 50 20'><text x='30' y='10'>60 minutes</text></svg>",
        ),
        (
            "head without scope",
            "<script>document.write('<table><tr><th\\x3ea</th></tr></table>')</script>",
        ),
        ("low contrast", "<p style='color: #999'>pale</p>"),
        (
            "low contrast",
            "<svg viewBox='0 0 90 20'><rect width='90' height='20' fill='#777'/>"
            "<text y='14' font-size='9' fill='#111'>dark</text></svg>",
        ),
        ("raw brace", "<p>sim:T-REAL:{{ '{w}' }}</p>"),
    ],
)
def test_each_fault_is_seen(browser: Any, tmp_path: Path, kind: str, body: str):
    """Only this fault is found, on a phone by day."""
    whole = (
        '{% extends "base.html.j2" %}{% block title %}Bad{% endblock %}{% block body %}'
        + body
        + "{% endblock %}"
    )
    assert list(rendered.faults(browser, page(tmp_path, whole), 390, "light")) == [kind]


@pytest.mark.slow
def test_an_axis_without_title_is_seen(browser: Any, tmp_path: Path):
    """Each axis without a title is found."""
    found = rendered.faults(browser, page(tmp_path, GOOD, x="time"), 390, "light")
    assert list(found) == ["axis without title"]
    assert len(found["axis without title"]) == 1
