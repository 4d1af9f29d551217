"""The interactive chart in a headless browser: every control works, no request leaves the page."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import numpy as np
import pytest

from tests.factories.chart_data import DOTS, FRONT, SHOWN
from tests.factories.study_pages import published
from train.studies import pareto

NAMES = [pareto.name(one) for one in DOTS]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of the page in a folder."""
    return published("chart", DOTS, tmp_path_factory.mktemp("chart")).as_uri()


class BrowsedChart:
    """The page as a reader sees it."""

    def __init__(self, page: Any, address: str) -> None:
        self.page, self.address = page, address
        self.troubles: list[str] = []
        page.on("console", lambda message: self.troubles.append(message.text))
        page.on("pageerror", lambda error: self.troubles.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
        self.asked: list[str] = []

    def open(self, choice: str = "") -> BrowsedChart:
        """Load it with these choices in the address."""
        self.page.goto("about:blank")
        self.page.goto(self.address + choice)
        return self

    def places(self) -> dict[int, tuple[float, float]]:
        """The position of each visible dot, by its number."""
        return {
            int(i): (x, y)
            for i, x, y in self.page.evaluate("""() => [...document.querySelectorAll('.dot')]
            .filter((d) => d.style.display !== 'none').map((d) => {
                const m = new DOMMatrix(d.style.transform); return [d.dataset.i, m.e, m.f]; })""")
        }

    def best(self) -> list[int]:
        """Numbers of the dots on the front, from the left."""
        there = self.places()
        marked = self.page.eval_on_selector_all(
            ".dot.best", "all => all.map((d) => Number(d.dataset.i))"
        )
        return sorted((i for i in marked if i in there), key=lambda i: there[i])

    def stairs(self) -> str:
        """The path of the front."""
        return str(self.page.get_attribute("#stairs", "d"))

    def tip(self) -> str:
        """The text of the tip, "" without a tip."""
        return str(self.page.inner_text("#tip")) if self.page.is_visible("#tip") else ""

    def rows(self) -> list[str]:
        """The rows of the table, by the names that commands use."""
        return list(self.page.locator("#table tbody th small").all_inner_texts())


@pytest.fixture
def seen(browser: Any, file: str) -> Iterator[BrowsedChart]:
    """The page on a desktop. The console must stay empty, and nothing but the file may be
    requested.
    """
    context = browser.new_context(viewport={"width": 1000, "height": 800}, reduced_motion="reduce")
    one = BrowsedChart(context.new_page(), file)
    yield one.open()
    assert one.troubles == []
    assert {url.split("#")[0] for url in one.asked} <= {file, "about:blank"}
    context.close()


def test_it_shows_all_dots_and_the_front(seen: BrowsedChart):
    """Each network is shown once, as Python found it: right is dearer, up is more accurate.

    The still picture disappears.
    """
    there = seen.places()
    assert sorted(there, key=lambda i: there[i]) == SHOWN
    assert seen.best() == FRONT["speed"]
    assert seen.stairs().count("H") == len(FRONT["speed"])
    assert there[0][0] < there[2][0] < there[6][0]
    assert there[4][1] > there[0][1] > there[2][1]
    assert not seen.page.is_visible("#still")


@pytest.mark.parametrize("cost", pareto.COSTS)
def test_every_axis_moves_the_dots_and_draws_the_front_anew(seen: BrowsedChart, cost: str):
    """For every pair of axes the page draws the front that Python computes."""
    before = seen.places(), seen.stairs()
    for accuracy in ("lopo", "speed"):
        seen.page.select_option("#x", cost)
        seen.page.select_option("#y", accuracy)
        spots = pareto.placed(DOTS, cost, accuracy)
        assert set(seen.best()) == {DOTS.index(spot.dot) for spot in spots if spot.best}
        assert set(seen.places()) == {DOTS.index(spot.dot) for spot in spots}
        if accuracy == "lopo":
            assert (seen.places(), seen.stairs()) != before


def test_hovering_names_a_dot_and_its_figures(seen: BrowsedChart):
    """Near a dot the tip shows its name, its interval and the dots that beat it.

    Elsewhere the tip is hidden.
    """
    x, y = seen.places()[3]
    frame = seen.page.locator("#plot svg").bounding_box()
    seen.page.mouse.move(frame["x"] + x + 6, frame["y"] + y + 6)
    for text in (
        "H, SVM",
        "H-svm float",
        "L and H",
        "93.0 %",
        "91.0 – 95.0 %",
        "0.5 ms",
        "behind Palpate, all views",
    ):
        assert text in seen.tip()
    seen.page.mouse.move(frame["x"] + 60, frame["y"] + 20)
    assert seen.tip() == ""


def test_a_tap_names_a_dot_on_a_phone(browser: Any, file: str):
    """A tap shows the tip inside the picture."""
    context = browser.new_context(
        viewport={"width": 360, "height": 700}, has_touch=True, reduced_motion="reduce"
    )
    seen = BrowsedChart(context.new_page(), file).open()
    seen.page.evaluate("document.getElementById('plot').scrollIntoView()")
    for i, (x, y) in seen.places().items():
        frame = seen.page.locator("#plot svg").bounding_box()
        seen.page.touchscreen.tap(frame["x"] + x, frame["y"] + y)
        assert NAMES[i] in seen.tip()
        tip = seen.page.locator("#tip").bounding_box()
        assert tip["x"] >= 0
        assert tip["x"] + tip["width"] <= 360
    context.close()


def test_filters_hide_dots_and_the_front_closes_up(seen: BrowsedChart):
    """Without int8 and MiniRocket other dots are on the front. When they return, all is as
    before.
    """
    seen.page.uncheck("#precision input[value=int8]")
    seen.page.uncheck("#family input[value=MiniRocket]")
    assert set(seen.places()) == {1, 3, 4}
    assert seen.best() == [1, 3]
    assert sorted(seen.rows()) == sorted(NAMES[i] for i in (1, 3, 4))
    seen.page.check("#precision input[value=int8]")
    seen.page.check("#family input[value=MiniRocket]")
    assert seen.best() == FRONT["speed"]


def test_nothing_left_is_no_trouble(seen: BrowsedChart):
    """If all dots are hidden, plot and table are empty."""
    for box in seen.page.locator("#precision input").all():
        box.uncheck()
    assert (seen.places(), seen.stairs(), seen.rows()) == ({}, "", [])


def test_scales_are_linear_or_logarithmic(seen: BrowsedChart):
    """Only on a logarithmic scale a factor of ten is equally long everywhere. Errors may be scaled
    by their root.
    """
    ratio = lambda there: (there[3][0] - there[2][0]) / (there[6][0] - there[3][0])  # noqa: E731
    assert ratio(seen.places()) == pytest.approx(
        np.log(12.5) / np.log(18), rel=0.01
    )  # .04 to .5 to 9 ms
    seen.page.uncheck("#xlog")
    assert ratio(seen.places()) == pytest.approx(0.46 / 8.5, rel=0.01)
    rise = lambda there: (there[4][1] - there[0][1]) / (there[0][1] - there[2][1])  # noqa: E731
    root = np.sqrt([0.4, 0.1, 0.05])
    assert rise(seen.places()) == pytest.approx((root[0] - root[1]) / (root[1] - root[2]), rel=0.01)
    seen.page.uncheck("#stretch")
    assert rise(seen.places()) == pytest.approx(0.3 / 0.05, rel=0.01)


def test_the_choice_is_in_the_address(seen: BrowsedChart):
    """Opening the address restores the choice. Unknown values are ignored."""
    seen.page.select_option("#x", "macs")
    seen.page.select_option("#y", "lopo")
    seen.page.uncheck("#xlog")
    seen.page.uncheck("#family input[value='L and H']")
    seen.page.locator("button[data-sort=cost]").click()
    there, address = seen.places(), seen.page.url
    seen.open("#" + address.split("#")[1])
    assert seen.places() == there
    assert (seen.page.input_value("#x"), seen.page.input_value("#y")) == ("macs", "lopo")
    assert not seen.page.is_checked("#xlog")
    assert not seen.page.is_checked("#family input[value='L and H']")
    assert seen.page.get_attribute("th[aria-sort]", "aria-sort") == "ascending"
    seen.open("#x=nothing&y=constructor&sort=cost")
    assert (seen.page.input_value("#x"), seen.page.input_value("#y")) == ("ms_p50", "speed")


def test_the_address_may_change_while_the_page_is_open(seen: BrowsedChart):
    """The page follows a link to another choice of itself."""
    seen.page.evaluate("location.hash = '#y=lopo'")
    seen.page.wait_for_function("document.getElementById('y').value === 'lopo'")
    assert seen.best() == FRONT["lopo"]


def test_the_keyboard_goes_from_dot_to_dot(seen: BrowsedChart):
    """All dots are one stop of Tab. Arrows go by cost, Home and End to the ends; Escape closes the
    tip.
    """
    order = [pareto.label(spot.dot) for spot in pareto.placed(DOTS, "ms_p50", "speed")]
    seen.page.locator("#family input").last.focus()
    seen.page.keyboard.press("Tab")
    assert seen.tip()
    seen.page.keyboard.press("Home")
    order_seen = [seen.tip().split("\n")[0]]
    for _ in order[1:]:
        seen.page.keyboard.press("ArrowRight")
        order_seen.append(seen.tip().split("\n")[0])
    assert order_seen == order
    seen.page.keyboard.press("ArrowLeft")
    assert order[-2] in seen.tip()
    seen.page.keyboard.press("Escape")
    assert seen.tip() == ""
    seen.page.keyboard.press("Tab")
    assert not seen.page.evaluate("document.activeElement.classList.contains('dot')")


def test_the_first_dot_may_be_hidden_and_tab_still_finds_one(seen: BrowsedChart):
    """The stop of Tab is a visible dot."""
    seen.page.uncheck("#family input[value=Palpate]")
    seen.page.locator("#family input").last.focus()
    seen.page.keyboard.press("Tab")
    assert seen.tip()


def test_dots_are_named_for_those_who_do_not_see_them(seen: BrowsedChart):
    """Each dot has its name and the two chosen figures for screen readers. The controls have
    labels.
    """
    assert seen.page.get_by_role("img", name="H, SVM: 93.0 %, 0.5 ms").count() == 1
    assert seen.page.get_by_label("accuracy", exact=True).count() == 1
    assert seen.page.get_by_label("stretched towards 100 %").count() == 1


@pytest.mark.slow
def test_the_table_is_sorted_by_what_was_chosen(seen: BrowsedChart):
    """It is sorted by accuracy at first, then by the chosen cost. Its head shows the order."""
    by_accuracy = sorted(DOTS, key=lambda one: (-one["accuracy"]["speed"]["mean"], one["ms_p50"]))
    assert seen.rows() == [pareto.name(one) for one in by_accuracy]
    seen.page.locator("button[data-sort=cost]").focus()
    seen.page.keyboard.press("Enter")
    assert seen.rows() == [pareto.name(one) for one in sorted(DOTS, key=lambda one: one["ms_p50"])]
    assert "time per sweep" in seen.page.inner_text("th[aria-sort=ascending]")


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 800])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_can_be_read(browser: Any, file: str, width: int, scheme: str):
    """No sideways scrolling, light and dark. The plot is as wide as the page and contains all
    names.
    """
    context = browser.new_context(
        viewport={"width": width, "height": 700}, color_scheme=scheme, reduced_motion="reduce"
    )
    page = BrowsedChart(context.new_page(), file).open().page
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    frame = page.locator("#plot svg").bounding_box()
    assert frame["width"] > 0.88 * width
    for name in page.locator("#names text").all():
        box = name.bounding_box()
        assert box["x"] >= frame["x"]
        assert box["x"] + box["width"] <= frame["x"] + frame["width"] + 1
    light = page.evaluate(
        "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"
    )
    assert (sum(light) > 600) == (scheme == "light")
    page.set_viewport_size({"width": 500, "height": 700})
    page.wait_for_function("document.querySelector('#plot svg').viewBox.baseVal.width < 500")
    context.close()


def test_what_the_box_ships_stands_out(seen: BrowsedChart):
    """Only its dot has a ring and its whole name. The project's other dots have shorter names."""
    ringed = seen.page.eval_on_selector_all(
        ".dot",
        "all => all.filter((d) => getComputedStyle(d.querySelector('.ship')).stroke !== "
        "'none').map((d) => Number(d.dataset.i))",
    )
    assert ringed == [2]
    names = seen.page.locator("#names text").all_text_contents()
    assert "Palpate, all views" in names
    assert "2.0 k weights" in names


def test_a_network_in_both_precisions_has_an_arrow(seen: BrowsedChart):
    """The arrow goes from float to int8. It is missing if one of them is filtered out."""
    (arrow,) = seen.page.locator("#arrows line").all()
    there = seen.places()
    ends = [float(arrow.get_attribute(key)) for key in ("x1", "x2", "y1", "y2")]
    assert ends[1::2] == pytest.approx(there[0], abs=0.01)
    assert ends[0] > ends[1]
    assert ends[2] < ends[3]  # .91 in float is above .90 in int8
    seen.page.uncheck("#precision input[value=float]")
    assert seen.page.locator("#arrows line").count() == 0


def test_the_axis_goes_to_all_and_shows_where_guessing_is(seen: BrowsedChart):
    """The last tick is 100 %, the line of chance is at 1/7, and ticks surround the most accurate
    dots.
    """
    ticks = [
        text.removesuffix(" %")
        for text in seen.page.locator("#grid text[text-anchor=end]").all_text_contents()
    ]
    assert {"90", "95", "99", "100"} < set(ticks)
    assert "guessing: 14.3" in " ".join(ticks)
    line, last = (
        seen.page.locator(f"#grid {which}").last for which in (".chance", "line:not(.chance)")
    )
    assert float(line.get_attribute("y1")) > max(y for _, y in seen.places().values())
    assert float(last.get_attribute("y1")) < min(y for _, y in seen.places().values())


def test_large_files_are_told_in_megabytes(seen: BrowsedChart):
    """50,000 KB are shown as 50 MB on the axis and in the table. No text contains "k KB"."""
    seen.page.select_option("#x", "file_kb")
    texts = " ".join(
        [*seen.page.locator("#grid text").all_text_contents(), seen.page.inner_text("#table")]
    )
    assert "50 MB" in texts
    assert "10 MB" in texts
    assert "k KB" not in texts


def test_what_was_not_measured_so_stands_last(seen: BrowsedChart):
    """Networks without this figure have a dash and no dot."""
    seen.page.select_option("#y", "lopo")
    assert [name.split()[0] for name in seen.rows()[-2:]] == ["minirocket", "minirocket"]
    assert "–" in seen.page.locator("#table tbody tr").last.inner_text()


def test_all_figures_can_be_had(seen: BrowsedChart):
    """A reader can download the file beside the page, and a sheet from the page itself.

    The sheet has a line for each precision, with shares from 0 to 1.
    """
    assert seen.page.get_attribute("a[download]:not([href^=data])", "href") == "chart.json"
    assert (Path(urlparse(seen.address).path).parent / "chart.json").exists()
    with seen.page.expect_download() as sheet:
        seen.page.click("a[href^='data:text/csv']")
    assert sheet.value.suggested_filename == "chart.csv"
    lines = list(csv.DictReader(sheet.value.path().read_text().splitlines()))
    assert [line["method"] for line in lines] == [one["method"] for one in DOTS]
    assert [float(line["a speed it never felt, mean"]) for line in lines] == [
        one["accuracy"]["speed"]["mean"] for one in DOTS
    ]
    assert lines[-1]["a position it never felt (simulated), mean"] == ""


@pytest.mark.slow
def test_without_scripts_there_is_a_picture_and_a_table(browser: Any, file: str):
    """Controls that would do nothing are hidden."""
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(file)
    assert page.is_visible("#still svg")
    assert not page.is_visible("#controls")
    assert page.locator("#table tr").count() == 1 + len(DOTS)
    context.close()
