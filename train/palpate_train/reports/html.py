"""Renders templates as HTML pages, each a single file.

A page loads no font and no other file, so that it opens from a folder without a network; it can be
read on a phone. All values in a template are escaped, except pictures, which `picture` marks as
SVG. A page of the project itself has a link to its README (`home`), a `header` and, if its figures
are of an older default, a warning in the first line.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from palpate.core.storage import put
from palpate_train.reports import formatting
from palpate_train.reports.plot_style import DARK, FONT, LIGHT
from palpate_train.reports.provenance import Provenance

TEMPLATES = Path(__file__).with_name("templates")
HOME = "../../README.md"
"""README, from the page of a study in the site (results/NAME/)."""
FRAMES = (
    (r"<th(?=[ >])(?![^>]*\bscope=)", '<th scope="col"'),
    (
        r'<div class="wide"(?![^>]*\btabindex)',
        '<div class="wide" tabindex="0" role="region" aria-label="table, scrolls sideways"',
    ),
)
"""Attributes of every table, in all templates: a screen reader announces the headings, and the
arrow keys scroll the table."""
PERCENT: dict[str, Callable[..., str]] = {
    "percent": formatting.percent,
    "exact_percent": formatting.exact_percent,
    "interval": formatting.interval,
    "estimate": formatting.estimate,
}
CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Escapes, and marks of direction."""
UNBROKEN = "\N{NO-BREAK SPACE}%"
"""Keeps number and sign on one line of a page."""
FILTERS: dict[str, Callable[..., str]] = {
    "points": formatting.points,
    "seconds": formatting.seconds,
    "sentence": lambda text: text[:1].upper() + text[1:],
    "unbroken": lambda text: (
        type(text)(text.replace(" %", UNBROKEN)) if isinstance(text, str) else text
    ),
    "one_line": lambda text: type(text)(
        " ".join(text.split())
    ),  # what is escaped stays so, and is not escaped twice
}
"""Filters of all templates; the filters of PERCENT keep number and sign on one line of a page."""


def render(
    template: str,
    folder: Path = TEMPLATES,
    *,
    header: Provenance | None = None,
    home: str = "",
    **data: Any,
) -> str:
    """The page that a template of `folder` makes of `data`; templates/base.html.j2 has what all
    pages share.

    header: where its figures are from. home: the address of README, of the project's pages.
    """
    page = (
        _environment(folder, True)
        .get_template(template)
        .render(provenance=header, home=home, **data)
    )
    for pattern, framed in FRAMES:
        page = re.sub(pattern, framed, page)
    return page


def render_text(template: str, **data: Any) -> str:
    """Render plain text for a terminal, without escapes."""
    return _environment(TEMPLATES, False).get_template(template).render(**data)


def picture(svg: str) -> Markup:
    """An SVG of plot_style.to_svg, whose texts are escaped already, for a page to hold as it is."""
    return Markup(svg)


def publish(out: Path, page: str) -> Path:
    """Write a page into the folder `out`; its path."""
    put(out / "index.html", page.encode(), parents=True)
    return out / "index.html"


def _environment(folder: Path, escape: bool) -> Environment:
    made = Environment(
        loader=FileSystemLoader([folder, TEMPLATES]),
        autoescape=escape,
        finalize=_without_controls,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= FILTERS | (
        {name: _unbroken(show) for name, show in PERCENT.items()} if escape else PERCENT
    )
    made.globals |= {
        "font": Markup(FONT),
        "light": Markup(LIGHT),
        "dark": Markup(DARK),
    }
    return made


def _without_controls(value: Any) -> Any:
    """A text from a file that may control the terminal that shows the page as text."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return CONTROLS.sub("?", value)
    return value


def _unbroken(show: Callable[..., str]) -> Callable[..., str]:
    def shown(*values: Any, **options: Any) -> str:
        return show(*values, **options).replace(" %", UNBROKEN)

    return shown
