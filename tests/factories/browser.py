"""A real browser for the tests of pages, and the page that it shows."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

BROWSERS = (
    *("chromium-headless-shell", "chromium", "chromium-browser"),
    *("google-chrome", "google-chrome-stable"),
)
WAIT_S = 60
SIZES = ((390, 844), (1024, 768), (1920, 1080))
"""Widths and heights of a phone, a tablet and a screen."""
LOOKS = pytest.mark.parametrize(
    ("width", "height", "scheme"),
    [
        pytest.param(*size, scheme, marks=[pytest.mark.thorough] * (scheme == other))
        for size, other in zip(SIZES, ("light", "dark", "light"), strict=True)
        for scheme in ("light", "dark")
    ],
)
"""Sizes and colour schemes. Colours depend on the scheme alone and places on the size alone: one
scheme for each size finds what is wrong in either. The other pairs are thorough."""


@contextmanager
def launched() -> Iterator[Any]:
    """The system's browser, otherwise playwright's. Skips the test if there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="make test installs playwright")
    with api.sync_playwright() as tool:
        path = next(filter(None, map(shutil.which, BROWSERS)), tool.chromium.executable_path)
        if not Path(path).exists():
            pytest.skip("no browser: apt-get install chromium-headless-shell")
        one = tool.chromium.launch(executable_path=path)
        yield one
        one.close()


def until(done: Callable[[], bool], wait_s: float = WAIT_S) -> None:
    """Wait for `done()`; fails after `wait_s`."""
    end = time.monotonic() + wait_s
    while not done():
        assert time.monotonic() < end, f"the condition did not hold within {wait_s} s"
        time.sleep(0.02)


COLOURS = """() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number), found = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walk.nextNode(); node; node = walk.nextNode()) {
    const one = node.parentElement, style = getComputedStyle(one);
    if (!node.textContent.trim() || !one.checkVisibility()) continue;
    if (["SCRIPT", "TITLE", "title"].includes(one.tagName)) continue;
    if (one.closest("svg .skin, .spoken") || one.classList.contains("count")) continue;
    let behind = one;
    while (behind && (rgb(getComputedStyle(behind).backgroundColor)[3] ?? 1) === 0)
      behind = behind.parentElement;
    const text = one instanceof SVGElement ? style.fill : style.color;
    const paper = getComputedStyle(behind ?? document.body).backgroundColor;
    found.push([node.textContent.trim(), rgb(text).slice(0, 3), rgb(paper).slice(0, 3)]);
  }
  return found;
}"""
"""Each visible text, its colour and its background.

Counts on taxels are left out, because their colours change.
"""


UNNAMED = """() => [...document.querySelectorAll(
    "section, canvas, meter, button, a, input, table, [role]")]
  .filter((e) => !(e.textContent.trim() || e.labels?.length
    || e.getAttribute("aria-label") || e.getAttribute("aria-labelledby"))).map((e) => e.id)"""


class BrowsedPage:
    """A page in a context of its own. size: width and height. prepare: called with the context
    before the page is opened. errors: the browser's messages. requests: the requested addresses."""

    def __init__(
        self,
        browser: Any,
        address: str,
        size: tuple[int, int] = (1280, 720),
        scheme: str = "light",
        prepare: Callable[[Any], object] = lambda context: None,
        **more: Any,
    ) -> None:
        viewport = dict(zip(("width", "height"), size, strict=True))
        self.context = browser.new_context(viewport=viewport, color_scheme=scheme, **more)
        prepare(self.context)
        self.page, self.errors, self.requests = self.context.new_page(), [], []
        self.page.on("console", lambda message: self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def state(self, wanted: str) -> None:
        """Wait until the page shows this state."""
        until(lambda: self.page.evaluate("document.body.dataset.state") == wanted)

    def text(self, where: str) -> str:
        """The text of an element, without non-breaking spaces."""
        return str(self.page.inner_text(where)).replace("\xa0", " ")

    def unnamed(self) -> list[str]:
        """The ids of parts without a name for a screen reader."""
        found: list[str] = self.page.evaluate(UNNAMED)
        return found

    def legibility(self) -> tuple[int, list[tuple[str, float]]]:
        """The number of texts, and the texts with a contrast below 4.5 (WCAG 2.1, 1.4.3)."""
        found = self.page.evaluate(COLOURS)
        texts = [(text, round(contrast(front, back), 2)) for text, front, back in found]
        return len(texts), [(text, ratio) for text, ratio in texts if ratio < 4.5]


def luminance(colour: Sequence[float]) -> float:
    """Relative luminance [0, 1] of red, green and blue [0, 255] (WCAG 2.1)."""
    parts = [part / 255 for part in colour]
    linear = [
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    ]
    return sum(w * part for w, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(one: Sequence[float], other: Sequence[float]) -> float:
    """Contrast of two colours, 1 to 21 (WCAG 2.1)."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)
