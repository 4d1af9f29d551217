"""The page of `palpate skin show` in a real browser, at three widths, light and dark."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import pytest

from palpate.core.clock import SystemClock
from palpate.tools.skin_monitor import LiveView
from palpate.web.access import Access
from palpate.web.server import PageServer
from tests.factories.browser import LOOKS, BrowsedPage, contrast, until

pytestmark = pytest.mark.slow

LOAD = tuple(
    tuple(tuple(float(20 * a + 10 * r + c) for c in range(4)) for r in range(3)) for a in range(3)
)
VIEW = LiveView(
    *(1, "sim", "mine 3x4x3 int16 at 100 Hz", "streaming", "", (3, 4, 3), LOAD, 63.0, 99.8, LOAD),
    *(("1.2 axis 3",), ("2.1 axis 1",), (), 12345, None),
)


@pytest.fixture
def page() -> Iterator[PageServer]:
    """A page that shows VIEW, at any free port."""
    with PageServer("skin.html", Access(0), SystemClock().now_ns) as one:
        one.show(VIEW)
        yield one


def test_it_shows_loads_figures_and_faults(browser, page):
    """A map for each axis; faulty taxels outlined; unknown loss is not called 0."""
    seen = BrowsedPage(browser, page.address)
    until(lambda: seen.text("#rate") == "99.8 Hz")
    assert seen.text("#lost") == "cannot be known"
    assert re.match("stuck: 1.2 .*dead: 2.1 ", seen.text("#faults"))
    assert seen.page.is_visible("#simulated")
    assert seen.page.locator("figure").count() == 3
    shown = seen.page.locator(".taxel").all_text_contents()
    assert shown == [f"{load:.0f}" for axis in LOAD for row in axis for load in row]
    faulty = seen.page.eval_on_selector_all(".taxel.faulty", "all => all.map(e => e.title)")
    assert [title.split(":")[0] for title in faulty] == ["taxel 2.1 axis 1", "taxel 1.2 axis 3"]
    asked = {request.removeprefix(page.address).split("?")[0] for request in seen.requests}
    scripts = {f"/{name}.js" for name in ("old", "skin_show", "events", "parts", "skin")}
    assert asked <= {"/", "/page.css", "/events", "/logo.svg"} | scripts
    assert not seen.errors


def test_a_skin_that_is_gone_and_a_box_that_is_dead_are_told_apart(browser, page):
    """A missing skin has a reason, a dead box has no news; news bring the page back."""
    seen = BrowsedPage(browser, page.address)
    page.show(replace(VIEW, number=2, state="lost", trouble="the skin was unplugged"))
    until(lambda: seen.text("#state") == "lost")
    assert seen.text("#trouble") == "the skin was unplugged"
    until(lambda: seen.text("#state") == "no connection")
    page.show(replace(VIEW, number=3))
    until(lambda: seen.text("#state") == "streaming")
    assert not seen.page.is_visible("#trouble")


@LOOKS
def test_nothing_is_cut_off(browser, page, width, height, scheme):
    """No wider than the screen; counts have a contrast of 4.5 at least (WCAG 2.1, 1.4.3)."""
    colours = "all => all.map(e => getComputedStyle(e).%s.match(/\\d+/g).slice(0, 3).map(Number))"
    seen = BrowsedPage(browser, page.address, (width, height), scheme)
    until(lambda: seen.text("#rate") == "99.8 Hz")
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
    tiles, counts = (
        seen.page.eval_on_selector_all(".taxel", colours % which)
        for which in ("backgroundColor", "color")
    )
    assert len(tiles) == 36
    assert min(contrast(*pair) for pair in zip(tiles, counts, strict=True)) >= 4.5
