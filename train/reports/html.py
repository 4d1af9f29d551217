"""The room of pages. In: texts, tables and pictures. Out: one HTML file that needs nothing else and reads on a phone.

No script, no font, no address outside: it opens from a folder without a network. Wide tables scroll in their own box;
colours follow the reader's choice of light or dark.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from train.reports.plot_style import FONT, ROLES

DARK = {"accent": "#58a6ff", "ink": "#e6edf3", "grey": "#9ea7b3", "faint": "#343b44", "paper": "#0d1117"}
"""The roles of ink.ROLES by night."""
PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
:root {{ {light} }}
@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}
body {{ margin: 0 auto; padding: 1rem; max-width: 40rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.5 {font}; overflow-wrap: break-word; }}
h1 {{ font-size: 1.6rem; line-height: 1.2; }}
h2 {{ font-size: 1.2rem; margin: 2.5rem 0 .5rem; }}
p {{ margin: .6rem 0; }}
figure {{ margin: 1rem 0; }}
figure svg {{ display: block; width: 100%; height: auto; }}
figcaption, small {{ color: var(--grey); font-size: .875rem; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }}
th, td {{ padding: .25rem .7rem .25rem 0; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--faint); }}
th {{ color: var(--grey); font-weight: normal; vertical-align: bottom; }}
th:first-child, td:first-child, .text {{ text-align: left; }}
td.text {{ white-space: normal; min-width: 9rem; }}
.note {{ border-left: 4px solid var(--accent); padding: .1rem 0 .1rem .9rem; }}
.stop {{ border: 2px solid var(--ink); padding: .4rem .9rem; font-weight: bold; }}
summary {{ cursor: pointer; color: var(--accent); }}
code {{ font-size: .9em; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def page(title: str, *body: str) -> str:
    """The whole file; body: HTML, as the functions below give it."""
    light, dark = (" ".join(f"--{k}: {v};" for k, v in roles.items()) for roles in (ROLES, DARK))
    return PAGE.format(title=escape(title), light=light, dark=dark, font=FONT, body="\n".join(body))


def heading(text: str) -> str:
    """A section begins."""
    return f"<h2>{escape(text)}</h2>"


def text(*sentences: str, kind: str = "") -> str:
    """A paragraph. kind: "note" for what must be seen, "stop" for what must not be missed."""
    opening = f'<p class="{kind}">' if kind else "<p>"
    return f"{opening}{escape(' '.join(s for s in sentences if s))}</p>"


def figure(svg: str, caption: str, *more: str) -> str:
    """A picture with its caption; more: HTML that belongs to it."""
    return "\n".join(["<figure>", svg, f"<figcaption>{escape(caption)}</figcaption>", *more, "</figure>"])


def table(head: Sequence[str], rows: Sequence[Sequence[str]], texts: Sequence[int] = ()) -> str:
    """A table that scrolls by itself where it is wide. texts: columns of running text."""
    kinds = [' class="text"' if i in texts else "" for i in range(len(head))]

    def line(tag: str, cells: Sequence[str]) -> str:
        inner = (f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))
        return f"<tr>{''.join(inner)}</tr>"

    lines = [line("th", head), *(line("td", row) for row in rows)]
    return '<div class="wide"><table>\n' + "\n".join(lines) + "\n</table></div>"


def folded(title: str, inner: str) -> str:
    """HTML that opens at a touch."""
    return f"<details><summary>{escape(title)}</summary>\n{inner}\n</details>"
