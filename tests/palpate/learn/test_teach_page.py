"""The page of `palpate teach` in a browser, with the program as a process and a skin on a serial
line: from a box without a bundle to right verdicts on four materials."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest

from palpate.client.feed import Feed
from palpate.core.config import FEED
from palpate.sweeps.sweep_folder import NOT_THIS
from tests.factories import deliveries
from tests.factories.browser import BrowsedPage, until
from tests.factories.taught_skin import PITCHES, SLIDE_S, TaughtBox, taught_box

pytestmark = [deliveries.NEEDED, pytest.mark.slow, pytest.mark.thorough]  # a fit, in minutes
EACH, TRIES = 8, 3
"""Sweeps of each material, and slides until its name has to come: a model of few sweeps calls some
unknown."""
WAIT_MS = 240_000
COUNTED_S = 20
"""Time from the end of a sweep until the page counts it."""


@pytest.fixture
def box() -> Iterator[TaughtBox]:
    """A box with its page."""
    with taught_box() as one:
        one.start("--sweeps", str(EACH))
        yield one


class Hand:
    """A person with gloves: presses buttons, and counts how often."""

    def __init__(self, browser: Any, box: TaughtBox) -> None:
        self.seen = BrowsedPage(browser, box.address, (1024, 768))
        self.box, self.clicks = box, 0
        self.page = self.seen.page
        self.page.set_default_timeout(WAIT_MS)

    def press(self, where: str) -> None:
        """Press a button once it can be pressed."""
        self.page.wait_for_selector(f"{where}:not([aria-disabled=true])")
        self.page.click(where)
        self.clicks += 1

    def add(self, material: str) -> None:
        """Name a material."""
        self.page.fill("#name", material)
        self.press("#add button")
        self.until("#what", lambda text: text == material)

    def slide(self, material: str) -> None:
        """One sweep, by the pedal (the space bar), while the robot slides."""
        before = self.page.inner_text("#sweep-title")
        self.page.wait_for_selector("#sweep-button:not([aria-disabled=true])")
        self.box.skin.material = material
        time.sleep(0.3)
        self.page.keyboard.press("Space")
        time.sleep(SLIDE_S + 0.4)
        self.page.keyboard.press("Space")
        self.box.skin.material = ""
        number = 1 if before == "Last sweep" else int(before.split()[1].strip(",")) + 1
        self.until("#sweep-title", lambda text: text.startswith(f"Sweep {number},"))

    def slide_until_counted(self, material: str) -> None:
        """One sweep that counts: a busy machine may cut a slide short, and a person slides
        again."""
        before = self.seen.text("#count")
        for _ in range(TRIES):
            self.slide(material)
            with suppress(AssertionError):
                return self.until("#count", lambda text: text != before, COUNTED_S)
        pytest.fail(self.seen.text("#outcome"))

    def until(
        self, where: str, done: Callable[[str], bool], wait_s: float = WAIT_MS / 1000
    ) -> None:
        """Wait until the text of an element is as wanted."""
        end = time.monotonic() + wait_s
        while not done(self.seen.text(where)):
            assert time.monotonic() < end, (where, self.seen.text(where), self.box.log[-2000:])
            self.page.wait_for_timeout(50)


def test_from_nothing_to_right_verdicts_on_four_materials(browser, box):
    """By the page alone. The machine's time is measured, and clicks are counted."""
    hand = Hand(browser, box)
    assert "materials" in hand.seen.text("#accuracy")
    for material in PITCHES:
        hand.add(material)
        for _ in range(EACH + TRIES):  # a busy machine may cut a slide short: once more
            hand.slide(material)
            if "enough" in hand.seen.text("#count"):
                break
    hand.press("#other")
    hand.until("#what", lambda text: text == NOT_THIS)
    hand.slide("glass")
    hand.until("#materials", lambda text: f"{NOT_THIS}: 1" in text)
    learnt = re.compile(r" of (\d+) sweeps ")
    hand.until("#learnt", lambda text: any(int(n) >= 4 * EACH for n in learnt.findall(text)))
    assert "between" in hand.seen.text("#accuracy")
    begun = time.monotonic()
    hand.press("#use")
    hand.page.wait_for_selector("#done:visible")
    waited = time.monotonic() - begun
    assert "taught" in (learnt_of := hand.seen.text("#learnt"))
    assert sum(material in learnt_of for material in PITCHES) == 2  # most alike
    assert (box.folder / "enrolment" / "key").exists()  # the bench had none
    with Feed(box.folder / "run" / FEED) as feed:
        hello = feed.read(60)
    assert hello
    assert set(hello["labels"]) == set(PITCHES)
    slides = {}
    for material in PITCHES:
        for slide in range(1, TRIES + 1):
            hand.slide(material)
            if (said := hand.seen.text("#what")) == material:
                slides[material] = slide
                break
            assert said not in PITCHES  # unknown or unsure, not another name
    assert slides.keys() == PITCHES.keys()
    hand.press("#done")
    assert box.process
    assert box.process.wait(60) == 0
    assert not [e for e in hand.seen.errors if "ERR_" not in e and "Failed to load" not in e]
    print(json.dumps({"clicks": hand.clicks, "waited_s": round(waited, 1), "slides": slides}))


def test_browsers_and_skin_come_and_go(browser, box):
    """Two browsers show the same; one that is closed in the middle of a sweep loses nothing; a skin
    that is unplugged is said, and teaching goes on when it is back; a killed program continues with
    what it had."""
    hand, other = Hand(browser, box), Hand(browser, box)
    hand.add("oak")
    hand.slide_until_counted("oak")
    other.until("#count", lambda text: text == f"sweep 2 of {EACH}")
    other.page.context.close()
    hand.slide_until_counted("oak")
    box.player.unplug()
    hand.page.wait_for_selector("#banner:visible")
    assert "skin" in hand.seen.text("#banner")
    box.player.plug()
    hand.page.wait_for_selector("#banner", state="hidden")
    hand.slide_until_counted("oak")
    box.stop(kill=True)
    hand.page.wait_for_selector("#banner:visible")
    hand.page.context.close()
    box.start("--sweeps", str(EACH))
    hand = Hand(browser, box)
    hand.page.wait_for_selector("text=oak: 3")
    hand.press("[data-forget=oak]")
    hand.page.wait_for_selector("text=oak: 3", state="detached")
    assert len(list((box.folder / "store" / "sweeps").glob("*.npy"))) == 3


def test_no_name_is_lost_while_the_page_cannot_send(browser, box):
    """Before the first event, and while an order is not answered, a typed name stays."""
    news = re.compile(r"/events\?")
    silent = lambda context: context.route(news, lambda route: route.abort())  # noqa: E731
    page = BrowsedPage(browser, box.address, prepare=silent).page
    context = page.context
    assert page.get_attribute("#add-button", "aria-disabled") == "true"
    page.fill("#name", "oak")
    page.press("#name", "Enter")
    assert "connection" in page.inner_text("#said")
    assert page.input_value("#name") == "oak"
    context.unroute(news)
    held: list[Any] = []
    context.route("**/order", lambda route: held.append(route))
    page.wait_for_selector("#add-button:not([aria-disabled=true])")
    page.press("#name", "Enter")
    until(lambda: page.evaluate("1") == 1 and bool(held))
    page.fill("#name", "cork")
    page.press("#name", "Enter")
    assert page.input_value("#name") == "cork"
    held[0].continue_()
    page.wait_for_selector("[data-material=oak]")
    assert page.input_value("#name") == "cork"


def test_the_page_refuses_what_cannot_be(browser, box):
    """A name that cannot be sent is refused with the reason; USE waits for two materials."""
    hand = Hand(browser, box)
    hand.page.fill("#name", "-oak")
    hand.press("#add button")
    hand.until("#said", lambda text: "cannot" in text)
    assert hand.page.get_attribute("#use", "aria-disabled") == "true"
