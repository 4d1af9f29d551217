"""The interactive chart in a headless browser: every control works, and no request leaves the page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.factories.chart_data import DOTS, FRONT
from train.reports import chart_report, pareto

NAMES = [pareto.name(one) for one in DOTS]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page's address, in a folder."""
    return chart_report.write(tmp_path_factory.mktemp("chart"), DOTS).as_uri()


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
        """Load it, with what was chosen in the address."""
        self.page.goto("about:blank")
        self.page.goto(self.address + choice)
        return self

    def places(self) -> dict[int, tuple[float, float]]:
        """Where each dot that is shown stands, by its number."""
        return {int(i): (x, y) for i, x, y in self.page.evaluate("""() => [...document.querySelectorAll('.dot')]
            .filter((d) => d.style.display !== 'none').map((d) => {
                const m = new DOMMatrix(d.style.transform); return [d.dataset.i, m.e, m.f]; })""")}  # fmt: skip

    def best(self) -> list[int]:
        """Numbers of the dots on the front, from the left."""
        there = self.places()
        marked = self.page.eval_on_selector_all(".dot.best", "all => all.map((d) => Number(d.dataset.i))")
        return sorted((i for i in marked if i in there), key=lambda i: there[i])

    def stairs(self) -> str:
        """The path of the front."""
        return str(self.page.get_attribute("#stairs", "d"))

    def tip(self) -> str:
        """The text of the tip; "" where there is none."""
        return str(self.page.inner_text("#tip")) if self.page.is_visible("#tip") else ""

    def rows(self) -> list[str]:
        """The table's first column."""
        return [text.removeprefix("○ ") for text in self.page.locator("tbody th").all_inner_texts()]


@pytest.fixture
def seen(browser: Any, file: str) -> Iterator[BrowsedChart]:
    """The page on a desktop; nothing may appear on the console, and nothing but the file may be requested."""
    context = browser.new_context(viewport={"width": 1000, "height": 800}, reduced_motion="reduce")
    one = BrowsedChart(context.new_page(), file)
    yield one.open()
    assert one.troubles == []
    assert {url.split("#")[0] for url in one.asked} <= {file, "about:blank"}
    context.close()


def test_it_shows_all_dots_and_the_front(seen: BrowsedChart):
    """As Python found it: further right is dearer, further up more accurate; the still picture gives way."""
    there = seen.places()
    assert len(there) == len(DOTS)
    assert seen.best() == FRONT["speed"]
    assert seen.stairs().count("H") == len(FRONT["speed"])
    assert there[0][0] < there[2][0] < there[5][0]
    assert there[4][1] > there[0][1] > there[2][1]
    assert not seen.page.is_visible("#still")


@pytest.mark.parametrize("cost", pareto.COSTS)
def test_every_axis_moves_the_dots_and_draws_the_front_anew(seen: BrowsedChart, cost: str):
    """For every pair of axes the page's front is Python's."""
    before = seen.places(), seen.stairs()
    for accuracy in ("lopo", "speed"):
        seen.page.select_option("#x", cost)
        seen.page.select_option("#y", accuracy)
        spots = pareto.placed(DOTS, cost, accuracy)
        assert set(seen.best()) == {DOTS.index(spot[0]) for spot in spots if spot[3]}
        assert set(seen.places()) == {DOTS.index(spot[0]) for spot in spots}
        if accuracy == "lopo":
            assert (seen.places(), seen.stairs()) != before


def test_hovering_names_a_dot_and_its_figures(seen: BrowsedChart):
    """Near a dot its name is shown, with its interval and what beats it; away from all dots nothing is."""
    x, y = seen.places()[3]
    frame = seen.page.locator("#plot svg").bounding_box()
    seen.page.mouse.move(frame["x"] + x + 6, frame["y"] + y + 6)
    for text in ("H-svm float", "L and H", "93.0 %", "91.0 – 95.0 %", "0.5 ms", "behind compact-20k int8"):
        assert text in seen.tip()
    seen.page.mouse.move(frame["x"] + 60, frame["y"] + 20)
    assert seen.tip() == ""


def test_a_tap_names_a_dot_on_a_phone(browser: Any, file: str):
    """The tip is there after a tap and inside the picture."""
    context = browser.new_context(viewport={"width": 360, "height": 700}, has_touch=True, reduced_motion="reduce")
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
    """Without int8 and MiniRocket others are on the front; shown again, all is as before."""
    seen.page.uncheck("#precision input[value=int8]")
    seen.page.uncheck("#family input[value=MiniRocket]")
    assert set(seen.places()) == {1, 3, 4}
    assert seen.best() == [1, 3]
    assert sorted(seen.rows()) == sorted(NAMES[i] for i in (1, 3, 4))
    seen.page.check("#precision input[value=int8]")
    seen.page.check("#family input[value=MiniRocket]")
    assert seen.best() == FRONT["speed"]


def test_nothing_left_is_no_trouble(seen: BrowsedChart):
    """With all hidden there is an empty plot and an empty table."""
    for box in seen.page.locator("#precision input").all():
        box.uncheck()
    assert (seen.places(), seen.stairs(), seen.rows()) == ({}, "", [])


def test_scales_are_linear_or_logarithmic(seen: BrowsedChart):
    """A tenfold cost is equally far everywhere on a logarithmic scale, and not on a linear one; errors likewise."""
    ratio = lambda there: (there[3][0] - there[1][0]) / (there[5][0] - there[3][0])  # noqa: E731
    assert ratio(seen.places()) == pytest.approx(0.5, rel=0.01)  # .05 to .5 to 50 ms
    seen.page.uncheck("#xlog")
    assert ratio(seen.places()) == pytest.approx(0.45 / 49.5, rel=0.01)
    seen.page.check("#ylog")
    there = seen.places()
    assert (there[4][1] - there[0][1]) / (there[0][1] - there[2][1]) == pytest.approx(2.0, rel=0.01)  # .4 to .1 to .05


def test_the_choice_is_in_the_address(seen: BrowsedChart):
    """A choice is in the address, and opening that address restores it; values that do not exist are ignored."""
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
    """A link to another choice of the same page is followed."""
    seen.page.evaluate("location.hash = '#y=lopo'")
    seen.page.wait_for_function("document.getElementById('y').value === 'lopo'")
    assert seen.best() == FRONT["lopo"]


def test_the_keyboard_goes_from_dot_to_dot(seen: BrowsedChart):
    """One stop of Tab; arrows by cost, Home and End; Escape closes the tip."""
    order = [pareto.name(spot[0]) for spot in pareto.placed(DOTS, "ms_p50", "speed")]
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
    """The one stop of Tab is a dot that is shown."""
    seen.page.uncheck("#family input[value=Palpate]")
    seen.page.locator("#family input").last.focus()
    seen.page.keyboard.press("Tab")
    assert seen.tip()


def test_dots_are_named_for_those_who_do_not_see_them(seen: BrowsedChart):
    """Each has its name and the two figures chosen; the controls have labels."""
    assert seen.page.get_by_role("img", name="H-svm float: 93.0 %, 0.5 ms").count() == 1
    assert seen.page.get_by_label("accuracy", exact=True).count() == 1
    assert seen.page.get_by_label("log of the error").count() == 1


@pytest.mark.slow
def test_the_table_is_sorted_by_what_was_chosen(seen: BrowsedChart):
    """By accuracy first, by cost when asked; the head shows which."""
    by_accuracy = sorted(DOTS, key=lambda one: (-one["accuracy"]["speed"]["mean"], one["ms_p50"]))
    assert seen.rows() == [pareto.name(one) for one in by_accuracy]
    seen.page.locator("button[data-sort=cost]").focus()
    seen.page.keyboard.press("Enter")
    assert seen.rows() == [pareto.name(one) for one in sorted(DOTS, key=lambda one: one["ms_p50"])]
    assert "time, median" in seen.page.inner_text("th[aria-sort=ascending]")


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 800])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_can_be_read(browser: Any, file: str, width: int, scheme: str):
    """No sideways scrolling, by day and by night; the plot is as wide as the page; names stay inside it."""
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
    light = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (sum(light) > 600) == (scheme == "light")
    page.set_viewport_size({"width": 500, "height": 700})
    page.wait_for_function("document.querySelector('#plot svg').viewBox.baseVal.width < 500")
    context.close()


@pytest.mark.slow
def test_without_scripts_there_is_a_picture_and_a_table(browser: Any, file: str):
    """No control that does nothing."""
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(file)
    assert page.is_visible("#still svg")
    assert not page.is_visible("#controls")
    assert page.locator("#table tr").count() == 1 + len(DOTS)
    context.close()
