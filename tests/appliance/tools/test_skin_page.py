"""The page of `palpate skin show` in a real browser: what it shows of a skin, at three widths, in both modes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from appliance.alignment.web import Page
from appliance.core.clock import SystemClock
from appliance.tools import skin_show
from appliance.tools.skin_monitor import LiveView
from tests.factories.browser import BrowsedPage, until

LOAD = tuple(tuple(tuple(float(20 * a + 10 * r + c) for c in range(4)) for r in range(3)) for a in range(3))
VIEW = LiveView(
    1, "sim", "mine 3x4x3 int16 at 100 Hz", "streaming", "", (3, 4, 3), LOAD, 63.0, 99.8, LOAD, ("1.2 axis 3",),
    ("2.1 axis 1",), (), 12345, None,
)  # fmt: skip


@pytest.fixture
def page() -> Iterator[Page]:
    """A page that shows VIEW, at any free port."""
    with Page(0, SystemClock(), skin_show.PAGE) as one:
        one.show(VIEW)
        yield one


def test_the_page_is_one_file():
    """No address, no source, nothing that could send data."""
    text = skin_show.PAGE.read_text(encoding="utf-8")
    assert not re.search(r"https?://|\bsrc=|@import|url\(|<form|<a |innerHTML|eval\(|localStorage", text)


@pytest.mark.slow
def test_it_shows_loads_figures_and_faults(browser: Any, page: Page):
    """A map for each axis with its counts; faulty taxels outlined and named; loss that cannot be known is not called 0."""
    seen = BrowsedPage(browser.new_context(), page.address)
    until(lambda: seen.text("#rate") == "99.8 Hz")
    assert seen.text("#lost") == "cannot be known"
    assert seen.text("#faults") == "stuck: 1.2 axis 3; dead: 2.1 axis 1"
    assert seen.page.is_visible("#simulated")
    assert seen.page.locator("figure").count() == 3
    shown = seen.page.locator(".taxel").all_text_contents()
    assert shown == [f"{load:.0f}" for axis in LOAD for row in axis for load in row]
    faulty = seen.page.eval_on_selector_all(".taxel.faulty", "all => all.map(e => e.title)")
    assert [title.split(":")[0] for title in faulty] == ["taxel 2.1 axis 1", "taxel 1.2 axis 3"]
    assert {request.removeprefix(page.address) for request in seen.requests} == {"/", "/state"}
    assert not seen.errors
    seen.page.close()


@pytest.mark.slow
def test_a_skin_that_is_gone_and_a_box_that_is_dead_are_told_apart(browser: Any, page: Page):
    """The first says why, the second that nothing is heard; news bring the page back."""
    seen = BrowsedPage(browser.new_context(), page.address)
    page.show(replace(VIEW, number=2, state="lost", trouble="the skin was unplugged"))
    until(lambda: seen.text("#state") == "lost")
    assert seen.text("#trouble") == "the skin was unplugged"
    until(lambda: seen.text("#state") == "no connection")
    page.show(replace(VIEW, number=3))
    until(lambda: seen.text("#state") == "streaming")
    assert not seen.page.is_visible("#trouble")
    seen.page.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1024, 1920])
def test_nothing_is_cut_off(browser: Any, page: Page, width: int, scheme: Any):
    """No wider than the screen; counts have a contrast of 3 at least, which letters of this size need (WCAG 2.1, 1.4.3)."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    seen = BrowsedPage(context, page.address)
    until(lambda: seen.text("#rate") == "99.8 Hz")
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
    contrasts = seen.page.evaluate(CONTRAST)
    assert len(contrasts) == 36
    assert min(contrasts) >= 3
    context.close()


CONTRAST = """() => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = (rgb) => rgb.map(v => v / 255).map(v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
  const card = parts(getComputedStyle(document.querySelector("header")).backgroundColor);
  return [...document.querySelectorAll(".taxel")].map((tile) => {
    const style = getComputedStyle(tile), [r, g, b, a = 1] = parts(style.backgroundColor);
    const behind = light([r, g, b].map((v, i) => v * a + card[i] * (1 - a))), text = light(parts(style.color).slice(0, 3));
    return (Math.max(behind, text) + .05) / (Math.min(behind, text) + .05);
  });
}"""
