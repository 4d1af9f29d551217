"""Reads HTML: its visible text, its addresses and what is wrong with its form."""

import re
from html.parser import HTMLParser

VOID = {"meta", "br", "!doctype", "path", "use", "image", "input", "rect", "circle", "line"}
HIDDEN = {"style", "script"}
LEFTOVERS = re.compile(r"\bNone\b|\bnan\b|Markup|Undefined")
"""What a template shows in place of a value that is missing."""
ELSEWHERE = re.compile(r"@import|url\((?!#)|<link")


class PageReader(HTMLParser):
    """A page's visible `text`; faults: open tags, missing values, other files."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.links: list[str] = []
        self._parts: list[str] = []
        self.feed(text)
        self.text = " ".join(" ".join(self._parts).split())
        self.faults = [*self.wrong, *self.open, *LEFTOVERS.findall(self.text)]
        self.faults += ELSEWHERE.findall(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the open element and every address."""
        self.links += [v or "" for k, v in attrs if k in ("href", "src", "xlink:href", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Check that the end tag closes the innermost open element."""
        if tag not in VOID and (not self.open or self.open.pop() != tag):
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in HIDDEN:
            self._parts.append(data)
