"""The page of `palpate watch --web` in a browser: content, use, three sizes."""

from __future__ import annotations

import re

import numpy as np
import pytest

from palpate.core.config import WatchConfig
from palpate.web.access import Access
from tests.factories import feed_lines
from tests.factories.browser import LOOKS, SIZES, BrowsedPage, until
from tests.factories.install_scripts import page_secrets
from tests.factories.shown_page import NOW_S, Shown, opened

pytestmark = pytest.mark.slow


def test_people_read_display_names_and_programs_labels(browser, shown, tmp_path):
    """Card, list, counts and probabilities have the name in any language; the CSV has the label."""
    shown.board.take(feed_lines.hello(displays={"wood": "Holz, <b>geölt</b>"}))
    shown.take(feed_lines.verdict(41, 390.0, "wood"))
    seen = opened(browser, shown, rows=41)
    until(lambda: seen.text("#label") == "Holz, <b>geölt</b>")
    assert "Holz, <b>geölt</b>" in seen.page.locator(".row").first.inner_text()
    until(lambda: "Holz, <b>geölt</b>" in seen.page.locator("#tally th").all_text_contents())
    assert seen.page.locator("#scores span").first.inner_text() == "Holz, <b>geölt</b>"
    with seen.page.expect_download() as begun:
        seen.page.keyboard.press("s")
    begun.value.save_as(tmp_path / "shift.csv")
    text = (tmp_path / "shift.csv").read_text("utf-8")
    assert ",wood," in text
    assert "Holz" not in text
    assert not seen.errors


def test_a_sweep_without_a_label_says_why(browser, shown):
    """The card has words for an operator, the fold the reason; the probabilities are gone."""
    seen = opened(browser, shown)
    shown.board.take(feed_lines.verdict(41, 390.0, status="sensor-lost"))
    until(lambda: seen.text("#status") == "sensor-lost")
    assert (seen.text("#label"), seen.text("#advice")) == ("Skin lost", "Check the skin's cable.")
    assert seen.text("#sure") == ""
    assert not seen.page.is_visible("#detail")
    seen.page.focus("#why summary")
    seen.page.keyboard.press("Enter")
    until(lambda: "lost" in seen.text("#detail"))
    assert seen.page.locator("#scores li").count() == 0


def test_probabilities_signal_and_spectrogram_of_a_chosen_sweep(browser, shown):
    """The last, or a clicked one while kept."""
    seen = opened(browser, shown)
    scores = seen.page.locator("#scores li").all_inner_texts()
    assert len(scores) == 6
    assert scores[0].split("\n") == [feed_lines.LABELS[40 % 6], "96.2\xa0%"]
    until(lambda: "2.0" in str(seen.page.get_attribute("#signal", "aria-label")))
    assert re.search(
        r"strongest at about [57]0 Hz", seen.page.get_attribute("#spectrogram", "aria-label")
    )
    seen.page.click(".row:nth-child(3)")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 38"))
    shown.board.take(feed_lines.verdict(41, 390.0, "wood"))
    until(lambda: seen.text("#label") == "wood")
    assert seen.text("#sweep-title").startswith("Sweep 38")
    seen.page.click("#follow")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 41"))
    assert not seen.page.is_visible("#follow")
    # no `sweep` line came with it
    until(lambda: "kept" in str(seen.page.get_attribute("#signal", "aria-label")))
    assert not seen.errors


def test_the_shift_is_filtered_by_status(browser, shown):
    """A button for each status with its count; several at a time; `all` again."""
    seen = opened(browser, shown)
    buttons = seen.page.locator("#filter button")
    assert buttons.all_inner_texts() == ["all 40", "ok 36", "unsure 2", "gap 1", "no-contact 1"]
    buttons.nth(2).click()
    until(lambda: seen.page.locator(".row").count() == 2)
    assert buttons.nth(2).get_attribute("aria-pressed") == "true"
    buttons.nth(3).click()
    until(lambda: seen.page.locator(".row").count() == 3)
    shown.board.take(feed_lines.verdict(41, 390.0, "wood", "unsure"))
    until(lambda: seen.page.locator(".row").count() == 4)
    assert buttons.nth(2).inner_text() == "unsure 3"
    buttons.nth(0).click()
    until(lambda: seen.page.locator(".row").count() == 41)


def test_a_moved_skin_and_the_way_back(browser, shown):
    """The verdict leads to the view with the direction in which to move the skin."""
    seen = opened(browser, shown)
    moved = "moved 2.2 mm too far towards row 1"
    shown.board.take(feed_lines.verdict(41, 390.0, "wood", moved=moved))
    until(lambda: seen.text("#moved") == "moved 2.2 mm too far towards row 1: align the skin")
    seen.page.click("#moved a")
    seen.state("off")
    until(lambda: seen.page.is_visible("#message"))
    assert seen.text("#message").endswith("towards row 1")
    assert seen.page.is_visible("#push")
    assert seen.page.locator("#way").evaluate("e => e.style.visibility") == "visible"
    assert not seen.page.is_visible("#watch")
    seen.page.click("text=Watch")
    until(lambda: seen.page.is_visible("#label"))
    assert seen.page.locator("#watch .skin svg").count() == 1


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_large_skin_is_drawn_without_numbers(browser, shown, width, height):
    """12 x 32 taxels: numbers of rows and columns do not overlap; the ring is large."""
    shape = {"rows": 12, "cols": 32, "rate_hz": 100.0, "window": 200, "dtype": "uint16"}
    known = {"contact": 5.0, "place": None, "unloaded": 0.0, "fingertip": "first-column"}
    shown.board.take(feed_lines.hello(format=shape, alignment=known))
    for i in range(20):
        taxels = np.zeros((12, 32))
        taxels[4:6, 10:14] = 200 * (i > 9)
        shown.board.take(feed_lines.frame(380 + i / 20, taxels))
    seen = opened(browser, shown, width, height)
    until(lambda: seen.page.locator(".tile").count() == 12 * 32)
    assert seen.text("#skin-title") == "Skin"  # of the only finger
    assert seen.page.locator(".count").count() == 0
    boxes = [one.bounding_box() for one in seen.page.locator("svg .name").all()]
    assert len(boxes) == 4 + 9 + 1
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            apart = max(
                one["x"] - other["x"] - other["width"],
                other["x"] - one["x"] - one["width"],
                one["y"] - other["y"] - other["height"],
                other["y"] - one["y"] - one["height"],
            )
            assert apart >= -1
    assert seen.page.locator("#centre").bounding_box()["width"] > 12


def test_loss_latency_and_the_box(browser, shown):
    """In words beside their pictures; bundle and trial by name."""
    seen = opened(browser, shown)
    assert re.fullmatch(r"med.* 1\.\d ms, .* 1\.\d ms", seen.text("#latency-said"))
    assert seen.text("#loss-said").startswith("3 of 270,003 ")
    assert "minutes" in seen.page.get_attribute("#loss", "aria-label")
    facts = seen.text("#facts dl")
    for text in ("9f3c2a1b", "on trial: 12 of 20", "4x4 uint8 at 750 Hz", "process 71"):
        assert text in facts
    shown.board.take(feed_lines.health(380.0, loss_known=False, lost_frames=2))
    until(lambda: "least" in seen.text("#loss-said"))


def test_unsigned_bundles_are_told_at_the_top(browser, shown):
    """While a setting allows them, at every size, without scrolling."""
    for text in ("", "bundles are allowed: classifier.allow_unsigned = true"):
        shown.board.take(feed_lines.health(380.0, unsigned=text))
        for width, height in SIZES:
            seen = opened(browser, shown, width, height)
            until(lambda: seen.page.locator("#unsigned").is_visible() == bool(text))  # noqa: B023
            if text:
                box = seen.page.locator("#unsigned").bounding_box()
                assert 0 <= box["x"] < box["x"] + box["width"] <= width
                assert box["y"] < height / 2
                assert "allow_unsigned" in seen.text("#facts")


def test_a_box_that_dies_and_comes_back_while_the_page_is_open(browser, shown):
    """Off since when and why; then the new box."""
    seen = opened(browser, shown)
    assert not seen.page.is_visible("#banner")
    shown.board.take({"type": "closed", "why": "the box is stopping"})
    until(lambda: seen.page.is_visible("#banner"))
    said = re.compile(r"The box is off or restarting, last heard (?:(\d+) min )?(\d+) s ago")

    def age_s() -> int:
        minutes, seconds = said.fullmatch(seen.text("#banner")).groups("0")
        return 60 * int(minutes) + int(seconds)

    before = age_s()
    assert seen.text("#state") == "box off"
    assert seen.text("#label").startswith("The box is off")
    assert re.match(r".* \d\d:\d\d:\d\d, .* ago\.", seen.text("#advice"))
    assert seen.text("#sure").startswith(f"Before that: {feed_lines.LABELS[40 % 6]}, ")
    seen.page.click("#why summary")
    assert seen.text("#detail") == "the box is stopping"
    until(lambda: age_s() > before)
    shown.board.take(feed_lines.hello(pid=72, bundle="aaaa0001"))
    shown.board.take(feed_lines.health(NOW_S, pid=72, bundle="aaaa0001", model="tubes 4, 6 labels"))
    until(lambda: seen.text("#bundle") == "tubes 4, 6 labels")  # of the second line
    assert not seen.page.is_visible("#banner")
    assert seen.text("#state") == "ready"
    assert seen.text("#label") == "Ready"
    assert seen.text("#advice").startswith("No sweep yet")
    assert "aaaa0001" in seen.text(".note")
    assert seen.page.locator(".row").count() == 40
    assert not seen.errors


def test_a_page_program_that_dies_and_comes_back(browser):
    """The page says so at once; the new program's content replaces the old."""
    first = Shown(Access(0))
    with first:
        first.shift()
        seen = opened(browser, first)
        access = Access(int(first.server.address.rsplit(":", 1)[1]))
    until(lambda: "connection" in seen.text("#banner"))
    seen.page.click("#why summary")
    assert "again" in seen.text("#detail")
    second = Shown(access)
    with second:
        second.board.take(feed_lines.hello())
        second.board.take(feed_lines.health(NOW_S))
        until(lambda: not seen.page.is_visible("#banner"))
        until(lambda: seen.page.locator(".row").count() == 0)
        until(lambda: seen.text("#state") == "ready")


def test_it_is_used_with_the_keyboard(browser, shown):
    """Tab has a visible focus; arrows choose a sweep, space a status."""
    seen = opened(browser, shown)
    seen.page.focus("#home-link")  # an address with a view begins at that view
    stops = []
    for _ in range(13):
        seen.page.keyboard.press("Tab")
        stops.append(
            seen.page.evaluate("document.activeElement.id || document.activeElement.textContent")
        )
        outline = seen.page.evaluate("getComputedStyle(document.activeElement).outlineWidth")
        assert float(outline.removesuffix("px")) >= 2
    filters = ["all 40", "ok 36", "unsure 2", "gap 1", "no-contact 1"]
    views = ["Start", "Watch", "Align", "History"]
    more = "Today, 30 days, and all sweeps as CSV"
    assert stops == [*views, "full", "tone", more, *filters, "rows"]
    seen.page.keyboard.press("ArrowDown")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 39"))
    seen.page.keyboard.press("End")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 1,"))
    active = seen.page.get_attribute("#rows", "aria-activedescendant")
    assert seen.page.locator(f"#{active}").get_attribute("aria-selected") == "true"
    for _ in range(4):
        seen.page.keyboard.press("Shift+Tab")
    seen.page.keyboard.press("Space")
    until(lambda: seen.page.locator(".row").count() == 36)


def test_everything_has_a_role_and_a_name(browser, shown):
    """Names for screen readers, which speak urgent changes."""
    seen = opened(browser, shown)
    assert set(seen.unnamed()) <= {"banner"}
    assert seen.page.get_attribute("#banner", "role") == "status"
    assert seen.page.get_attribute("#label", "aria-live") == "polite"
    assert seen.page.locator("[role=listbox] [role=option]").count() == 40
    assert seen.page.locator("nav a[aria-current=page]").inner_text() == "Watch"


SHOWN = {
    "/#watch": "#label",
    "/#align": "#message",
    "/#start": "#there dd",
    "/#history": "#past td",
}
"""What is in sight once a view is drawn."""


@LOOKS
@pytest.mark.parametrize("at", SHOWN)
def test_every_text_can_be_read(browser, shown, width, height, scheme, at):
    """Contrast of 4.5, also with a banner and each tone; nothing too wide."""
    for number, status in enumerate(("unsure", "unknown", "gap", "aborted"), 41):
        moved = "moved 2 mm too far towards row 1"
        shown.board.take(feed_lines.verdict(number, 390.0, "wood", status, moved=moved))
    seen = BrowsedPage(browser, shown.server.address + at, (width, height), scheme)
    until(lambda: seen.page.locator(".row").count() == 44 or at != "/#watch")
    seen.state("off")
    for act in (lambda: None, lambda: shown.board.away("it was stopped")):
        act()
        until(lambda: seen.page.is_visible(SHOWN[at]))
        texts, faint = seen.legibility()
        assert texts > (100 if at == "/#watch" else 10)
        assert faint == []
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
    assert not seen.errors


def test_nothing_moves_when_something_new_comes(browser, shown):
    """Each section stays where it is over verdicts of all kinds, views and a box that goes away."""
    seen = opened(browser, shown)
    boxes = (
        "() => [...document.querySelectorAll('#watch > section')].map((e) => [e.offsetLeft,"
        " e.offsetTop, e.offsetWidth, e.offsetHeight])"
    )
    before = seen.page.evaluate(boxes)
    away = "moved 2.2 mm too far towards row 1 and 1.1 mm towards column 4"
    kinds = [("foam", "ok", ""), ("", "no-start", ""), ("plastic smooth", "unsure", away)]
    for number, (label, status, moved) in enumerate(kinds, 41):
        shown.board.take(feed_lines.verdict(number, 390.0, label, status, moved=moved))
        until(lambda number=number: seen.text("#which").startswith(f"sweep {number}"))
        shown.board.take(feed_lines.frame(380.0 + number, feed_lines.load(2.0, 2.0)))
        assert seen.page.evaluate(boxes)[:2] == before[:2]
    shown.board.away("it was stopped")
    until(lambda: seen.page.is_visible("#banner"))
    assert seen.page.evaluate(boxes)[:2] == before[:2]


def test_on_a_tablet_in_the_network(browser, tmp_path):
    """Over TLS the page asks for the token, and refuses a wrong token. The right token, or a link
    with it, opens the page; a reload needs no token. The address does not show it."""
    page_secrets(tmp_path)
    token = (tmp_path / "token-look").read_text().strip()
    shown = Shown(Access.configured(WatchConfig(address="0.0.0.0", folder=str(tmp_path)), 0))
    with shown:
        shown.shift()
        address = f"https://localhost:{shown.server.address.rsplit(':', 1)[1]}"
        seen = BrowsedPage(browser, address, ignore_https_errors=True)
        assert seen.page.evaluate("document.activeElement.id") == "token"
        for wrong, said in (
            ("nonsense", "this is not the token"),
            ("schlüssel €", "letters and digits"),
        ):
            seen.page.fill("#token", wrong)
            seen.page.keyboard.press("Enter")
            until(lambda said=said: said in seen.text("#said"))
        seen.page.fill("#token", token)
        seen.page.click("#go")
        until(lambda: seen.page.is_visible("#there dd"))
        seen.page.reload()
        until(lambda: seen.page.is_visible("#there dd"))
        assert token not in seen.page.url
        assert token not in "".join(seen.requests)
        other = BrowsedPage(browser, f"{address}/#{token}", ignore_https_errors=True)
        until(lambda: other.page.is_visible("#there dd"))
        assert token not in other.page.url
