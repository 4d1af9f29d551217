"""The page of `palpate skin align` in a headless browser: alone, and as the command serves it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from math import dist, hypot
from pathlib import Path
from typing import Any

import pytest

from palpate.alignment.live import View
from palpate.answer.contact import ContactPositions
from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest
from palpate.core.clock import SystemClock
from palpate.web.access import Access
from palpate.web.server import PageServer
from tests.factories.browser import WAIT_S, BrowsedPage, contrast, luminance, until

pytestmark = pytest.mark.slow

PLACE = ContactPositions(4.0, (6.0, 6.4), (6.0, 5.8), 0.6)
LOADS = tuple(tuple(float(20 * r + c) for c in range(4)) for r in range(4))
VIEW = View(
    *(7, "usb", "tubes 3, 9f3c2a1b", "streaming", "off", "2.2 mm too far towards row 1"),
    *("move the skin", (4, 4), LOADS, 80.0, (3.8, 6.0), (6.0, 6.0), PLACE),
)


@pytest.fixture
def page() -> Iterator[PageServer]:
    """A page that shows VIEW, at any free port."""
    with PageServer("watch.html", Access(0), SystemClock().now_ns) as one:
        one.show(VIEW)
        yield one


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle with trained positions, on disk."""
    target = tmp_path_factory.mktemp("bundle")
    manifest = Manifest.parse((bundle.DEFAULT / bundle.MANIFEST).read_bytes())
    for name in manifest.files:
        (target / name).write_bytes((bundle.DEFAULT / name).read_bytes())
    (target / bundle.MANIFEST).write_bytes(replace(manifest, contact=PLACE).json())
    return target


@pytest.fixture
def box(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """The running command with the simulated skin, and the address of its page."""
    command = [sys.executable, "-m", "palpate", "skin", "align", "--sim", "rest", "--web", "0"]
    with subprocess.Popen(
        [*command, "--set", f"classifier.bundle={folder}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    ) as run:
        address = run.stderr.readline().decode().partition("page: ")[2].strip()
        yield run, address
        run.stderr.close()
        run.kill()


def test_the_whole_way(browser, box):
    """The real command: the page waits, advises, follows a touch; then "no connection"."""
    # the page at one moment: a finger comes and goes, so two looks may be of two states
    moment = """() => {
      const text = (id) => document.getElementById(id).innerText.replaceAll("\u00a0", " ");
      const sight = (id) => document.getElementById(id)?.style.visibility;
      return {
        state: document.body.dataset.state, message: text("message"), hint: text("hint"),
        skin: text("state"), simulated: document.getElementById("simulated").checkVisibility(),
        trained: document.querySelectorAll("#align .trained").length, way: sight("way"),
        centre: sight("centre"),
        counts: [...document.querySelectorAll("#align .count")].map((e) => e.textContent),
      };
    }"""
    # Longest wait for one of the four touches, which are repeated every 16 s
    turn_s = 40

    def reached(seen: BrowsedPage, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The first moment of the page that is as wanted."""
        shown: dict[str, Any] = {}

        def look() -> bool:
            shown.update(seen.page.evaluate(moment))
            return wanted(shown)

        until(look, turn_s)
        return shown

    run, address = box
    seen = BrowsedPage(browser, address, (820, 1180))
    advice = re.compile(r"2\.\d mm too far towards row 1 and 2\.\d mm towards column 1")
    wanted = lambda shown: shown["state"] == "off" and bool(advice.fullmatch(shown["message"]))  # noqa: E731
    off = reached(seen, wanted)
    assert "move" in off["hint"]
    assert (off["simulated"], off["skin"]) == (True, "skin streaming")
    assert (off["trained"], off["way"]) == (2, "visible")
    reached(
        seen,
        lambda shown: (
            shown["state"] == "no-contact"
            and shown["centre"] == "hidden"
            and {*shown["counts"]} <= {"0", "1"}
        ),
    )
    seen.state("off")
    assert seen.errors == []
    run.send_signal(signal.SIGINT)
    assert run.wait(timeout=WAIT_S) in (0, 130)
    seen.state("no-connection")
    assert seen.text("#message") == "no connection"
    shared = ("old", "tablet", "statuses", "events", "parts", "skin", "plots", "start")
    watched = ("verdict", "sweeps", "history", "watch")
    files = {
        "/",
        "/page.css",
        "/logo.svg",
        "/events",
        *(f"/{name}.js" for name in shared + watched),
    }
    assert {url.removeprefix(address).split("?")[0] for url in seen.requests} <= files


def test_the_page_draws_what_the_box_says(browser, page):
    """Loads, points at their coordinates, and the message, also for screen readers."""

    def circles(seen: BrowsedPage, which: str) -> list[dict[str, float]]:
        """Centre and radius of each."""
        return seen.page.eval_on_selector_all(
            which,
            "all => all.map(e => ({cx: e.cx.baseVal.value, cy: e.cy.baseVal.value, r:"
            " e.r.baseVal.value}))",
        )

    seen = BrowsedPage(browser, page.address, (1180, 820))
    seen.state("off")
    assert seen.text("#message") == VIEW.message
    assert seen.page.text_content("#spoken").startswith(VIEW.message)
    assert seen.page.get_attribute("#spoken", "aria-live") == "polite"
    assert not seen.page.is_visible("#simulated")
    fills = seen.page.eval_on_selector_all(".tile", FILLS)
    assert all(
        light[2] - light[0] <= dark[2] - dark[0] for light, dark in pairwise(fills[:4])
    )  # bluer with the load
    assert fills[0] == [0xE9, 0xED, 0xF2]
    assert seen.page.locator(".count").all_text_contents() == [
        f"{load:.0f}" for row in LOADS for load in row
    ]
    centre = seen.page.evaluate("new DOMMatrix(document.getElementById('centre').style.transform)")
    assert (centre["e"], centre["f"]) == pytest.approx((6.0 / 4 * 100 + 50, 3.8 / 4 * 100 + 50))
    assert [e["r"] for e in circles(seen, ".halo")] == pytest.approx([15, 15])
    assert circles(seen, ".trained")[1] == pytest.approx({"cx": 195, "cy": 210, "r": 3.5})
    page.show(replace(VIEW, number=8, state="in-place", message="in place"))
    seen.state("in-place")
    assert seen.text("#message") == "✓ in place"
    assert not seen.page.is_visible("#way")
    assert not seen.page.is_visible("#push")
    absent = {"state": "no-skin", "skin": "absent", "message": "no skin: absent"}
    page.show(replace(VIEW, number=9, load=(), centre=None, **absent))
    seen.state("no-skin")
    assert seen.text("#state") == "skin absent"
    assert set(seen.page.locator(".count").all_text_contents()) == {""}
    other = {"shape": (2, 3), "load": ((1.0, 2, 3),) * 2, "centre": (0.5, 1.0)}
    bare = {"contact": None, "nearest": None, "state": "no-positions"}
    page.show(replace(VIEW, number=10, **other, **bare))
    seen.state("no-positions")
    assert seen.page.locator(".tile").count() == 6
    assert "0.5, column 1.0" in seen.text("#figures")
    assert seen.errors == []


FILLS = "all => all.map(e => getComputedStyle(e).fill.match(/\\d+/g).map(Number))"


@pytest.mark.parametrize(
    ("centre", "message", "way"),
    [
        ((2.0, 6.0), "4.0 mm too far towards row 1", (0, -1)),
        ((10.0, 6.0), "3.6 mm too far towards row 4", (0, 1)),
        ((6.4, 1.8), "4.0 mm too far towards column 1", (-1, 0)),
        ((6.0, 11.0), "5.0 mm too far towards column 4", (1, 0)),
    ],
)
def test_the_arrow_points_where_the_skin_has_to_go(browser, page, centre, message, way):
    """Towards the named row or column, drawn and in words."""
    nearest = min(
        zip(PLACE.rows_mm, PLACE.cols_mm, strict=True), key=lambda spot: dist(spot, centre)
    )
    page.show(replace(VIEW, message=message, centre=centre, nearest=nearest))
    seen = BrowsedPage(browser, page.address)
    seen.state("off")
    line = str(seen.page.locator("#way .line").get_attribute("d"))
    path = [float(n) for n in re.findall(r"-?[\d.]+", line)]
    drawn = path[2] - path[0], path[3] - path[1]
    turned = seen.page.evaluate(
        "new DOMMatrix(getComputedStyle(document.querySelector('#push path')).transform)"
    )
    pushed = turned["c"] * -1, turned["d"] * -1  # where the arrow's head, at (0, -1), has got to
    for arrow in (drawn, pushed):
        assert (arrow[0] * way[0] + arrow[1] * way[1]) / hypot(*arrow) > 0.9


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_count_can_be_read_on_its_taxel(browser, page, scheme):
    """A contrast of 4.5 from no load to the full one (WCAG 2.1, 1.4.3)."""
    rising = tuple(tuple(float(4 * r + c) for c in range(4)) for r in range(4))
    page.show(replace(VIEW, load=rising, full=15.0))
    seen = BrowsedPage(browser, page.address, scheme=scheme)
    seen.state("off")
    tiles, counts = (seen.page.eval_on_selector_all(which, FILLS) for which in (".tile", ".count"))
    assert len(tiles) == 16
    assert len({tuple(one) for one in counts}) == 2  # black on light ones, white on dark ones
    assert min(contrast(*pair) for pair in zip(tiles, counts, strict=True)) >= 4.5


@pytest.mark.parametrize(
    ("side", "at"),
    [
        ("first-row", "top"),
        ("last-row", "bottom"),
        ("first-column", "left"),
        ("last-column", "right"),
    ],
)
def test_the_picture_shows_which_end_is_the_fingertip(browser, page, side, at):
    """A cap at that side; where it is not set, the page says how to find it out."""

    def beyond(board: dict[str, float], box: dict[str, float]) -> str:
        """The side of the skin beyond which the middle of a box lies."""
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        out = {
            "left": board["x"] - x,
            "right": x - board["x"] - board["width"],
            "top": board["y"] - y,
        }
        out["bottom"] = y - board["y"] - board["height"]
        return max(out, key=lambda side: out[side])

    seen = BrowsedPage(browser, page.address, (1024, 768))
    seen.state("off")
    assert seen.page.locator(".finger").count() == 0
    assert "press" in seen.text("#where")
    page.show(replace(VIEW, number=8, fingertip=side))
    until(lambda: seen.page.locator(".finger").count() == 1)
    board, cap = (seen.page.locator(which).bounding_box() for which in (".board", ".finger"))
    assert beyond(board, cap) == at
    name = seen.page.locator("text=fingertip").last.bounding_box()
    assert beyond(board, name) == at
    assert min(name["x"], name["y"]) >= 0
    assert not seen.page.is_visible("#where")


def test_a_box_that_says_nothing_new_is_no_news(browser, page):
    """A loop that hangs behind a server: the page says so and shows no old picture."""
    seen = BrowsedPage(browser, page.address)
    seen.state("off")
    seen.state("no-connection")
    assert "answer" in seen.text("#hint")
    page.show(replace(VIEW, number=8))
    seen.state("off")


@pytest.mark.parametrize(
    ("width", "height", "scheme"),
    [(360, 640, "light"), (844, 390, "dark"), (820, 1180, "dark"), (1440, 900, "light")],
)
def test_it_fits_phone_tablet_and_desktop(browser, page, width, height, scheme):
    """All on one screen without scrolling, light and dark, with enough contrast."""

    def style(seen: BrowsedPage, what: str, name: str) -> list[float]:
        """A colour of an element, as red, green and blue."""
        text = seen.page.locator(what).evaluate(f"e => getComputedStyle(e).{name}")
        return [float(part) for part in re.findall(r"\d+", text)[:3]]

    longest = "12.5 mm too far towards column 4 and 10.5 mm towards row 4"
    page.show(replace(VIEW, message=longest, source="sim"))
    seen = BrowsedPage(browser, page.address, (width, height), scheme)
    seen.state("off")
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
    assert seen.page.evaluate("document.documentElement.scrollHeight") <= height
    board = seen.page.locator(".board").bounding_box()
    assert board["x"] >= 0
    assert board["y"] + board["height"] <= height
    assert min(board["width"], board["height"]) > 0.3 * min(width, height)
    for what in ("#message", "#hint", "#figures"):
        box = seen.page.locator(what).bounding_box()
        assert box["x"] + box["width"] <= width
        assert contrast(style(seen, what, "color"), style(seen, "body", "backgroundColor")) >= 4.5
    assert (luminance(style(seen, "body", "backgroundColor")) > 0.5) == (scheme == "light")
