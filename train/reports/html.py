"""Pages from templates. In: a template's name and its data. Out: one HTML file that needs nothing else.

No font and no address outside: a page opens from a folder without a network and reads on a phone. Whatever a template
prints is escaped, but for pictures, which `picture` marks as SVG.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from train.reports import formatting
from train.reports.plot_style import DARK_ROLES, FONT, ROLES

TEMPLATES = Path(__file__).with_name("templates")
PERCENT: dict[str, Callable[..., str]] = {
    "percent": formatting.percent,
    "exact_percent": formatting.exact_percent,
    "interval": formatting.interval,
    "estimate": formatting.estimate,
}
FILTERS: dict[str, Callable[..., str]] = {
    "points": formatting.points,
    "seconds": formatting.seconds,
    "sentence": lambda text: text[:1].upper() + text[1:],
    "one_line": lambda text: type(text)(" ".join(text.split())),  # what is escaped stays so, and is not escaped twice
}
"""Of all templates; those of PERCENT keep number and sign in one line of a page."""


def render(template: str, folder: Path = TEMPLATES, **data: Any) -> str:
    """The page that a template of `folder` makes of `data`; templates/base.html.j2 has what all pages share."""
    return _environment(folder, True).get_template(template).render(**data)


def render_text(template: str, **data: Any) -> str:
    """Plain text for a terminal, in which nothing is escaped."""
    return _environment(TEMPLATES, False).get_template(template).render(**data)


def picture(svg: str) -> Markup:
    """An SVG of plot_style.to_svg, whose texts are escaped already, for a page to hold as it is."""
    return Markup(svg)


def _environment(folder: Path, escape: bool) -> Environment:
    made = Environment(
        loader=FileSystemLoader([folder, TEMPLATES]),
        autoescape=escape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= FILTERS | ({name: _unbroken(show) for name, show in PERCENT.items()} if escape else PERCENT)
    made.globals |= {
        "font": Markup(FONT),
        "light": Markup(_variables(ROLES)),
        "dark": Markup(_variables(DARK_ROLES)),
    }
    return made


def _unbroken(show: Callable[..., str]) -> Callable[..., str]:
    def shown(*values: Any, **options: Any) -> str:
        return show(*values, **options).replace(" %", "\N{NO-BREAK SPACE}%")

    return shown


def _variables(roles: dict[str, str]) -> str:
    return " ".join(f"--{role}: {colour};" for role, colour in roles.items())
