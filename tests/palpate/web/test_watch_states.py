"""The states of `palpate watch --web` from two metres, and its use on a tablet."""

from __future__ import annotations

import csv
import io
import re
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.client.verdicts import VerdictFile
from palpate.web.access import Access
from tests.factories import feed_lines
from tests.factories.browser import LOOKS, SIZES, BrowsedPage, until
from tests.factories.feed_lines import verdict
from tests.factories.shown_page import NOW_S, Shown, opened

pytestmark = pytest.mark.slow

MOVED = "moved 2.2 mm too far towards row 1"
OFF = "no palpate offers its feed there: the box is off or restarting; start it"


def sweep(label: str = "wood", status: str = "ok", **more: Any) -> Callable[[Shown], None]:
    """Sweep 41 with this answer, of a box that runs."""

    def act(shown: Shown) -> None:
        shown.board.take(feed_lines.hello())
        shown.board.take(feed_lines.health(NOW_S))
        shown.board.take(verdict(41, 395.0, label, status, **more))

    return act


def off(shown: Shown) -> None:
    shown.board.take({"type": "closed", "why": OFF})


def restarted(shown: Shown) -> None:
    off(shown)
    shown.board.take(feed_lines.hello(pid=72))
    shown.board.take(feed_lines.health(NOW_S, pid=72))


def no_skin(shown: Shown) -> None:
    shown.board.take(feed_lines.health(NOW_S, skin="absent", trouble="none on USB", ready=False))


STATES: list[tuple[Callable[[Shown], None], str, str, str, str]] = [
    (sweep(), "good", "ok", "wood", ""),
    (sweep(status="unsure"), "warn", "unsure", "Unsure", "Sweep again."),
    (sweep(status="unknown"), "warn", "unknown", "Unknown", "Not like any taught material."),
    (sweep(moved=MOVED), "warn", "displaced", "wood", "The skin has moved: align it."),
    (sweep(status="unknown", moved=MOVED), "warn", "displaced", "Displaced", "The skin has moved"),
    (sweep(status="short"), "bad", "short", "Too short", "Slide for longer than 2 s."),
    (sweep(status="sensor-lost"), "bad", "sensor-lost", "Skin lost", "Check the skin's cable."),
    (no_skin, "bad", "no skin", "No skin", "Check its cable."),
    (off, "away", "off", "The box is off or restarting", "Last heard at "),
    (restarted, "plain", "", "Ready", "No sweep yet since the box was started."),
]
"""What happens; tone and status of the card; its words and its advice, or how that begins."""


@LOOKS
def test_each_state_is_told_from_two_metres(browser, shown, width, height, scheme):
    """By colour, shape and word, with what to do, readable."""
    # At one moment: width of the page, letters of label and advice, end of the advice (0: hidden),
    # parts of the card that lie on the part above or beyond its end, what the label cuts
    measured = """() => {
      const parts = [...document.querySelectorAll("#verdict > *")].filter((e) => e.checkVisibility());
      const inner = (e) => [e, ...e.querySelectorAll("svg, span")].map((one) => one.getBoundingClientRect());
      const ends = parts.map((e) => Math.max(...inner(e).map((box) => box.bottom)));
      const below = parts.filter((e, i) => i && e.getBoundingClientRect().top < ends[i - 1] - 1);
      const end = document.querySelector("#verdict").getBoundingClientRect().bottom;
      const overlaps = [...below, ...parts.filter((e, i) => ends[i] > end)].map((e) => e.id);
      const [label, advice] = ["#label", "#advice"].map((id) => document.querySelector(id));
      const size = (e) => parseFloat(getComputedStyle(e).fontSize), told = advice.getBoundingClientRect();
      const cut = [label.scrollWidth - label.clientWidth, label.scrollHeight - label.clientHeight];
      const shown = told.width && told.height ? told.bottom : 0;
      return [document.documentElement.scrollWidth, size(label), size(advice), shown, overlaps, cut];
    }"""  # noqa: E501

    def fits(seen: BrowsedPage, width: int, height: int) -> None:
        """The card is in sight without scrolling, its words are large enough and whole."""
        wide, label, advice, end, overlaps, cut = seen.page.evaluate(measured)
        assert wide <= width
        assert label >= (48 if width > 400 else 36)
        assert end == 0 or advice >= 22
        assert end <= height
        assert overlaps == []
        assert cut[1] <= 12  # the descent of letters with a line height of 1
        assert cut[0] <= 1

    def shows(seen: BrowsedPage, tone: str, status: str, words: str, advice: str) -> None:
        """The card comes to show this."""
        until(lambda: seen.text("#label") == words and seen.text("#status") == status)
        assert seen.page.get_attribute("#verdict", "data-tone") == tone
        assert (seen.text("#advice") if advice else "").startswith(advice)

    back = "getComputedStyle(document.querySelector('#verdict')).backgroundColor"
    seen = BrowsedPage(browser, shown.server.address + "/#watch", (width, height), scheme)
    until(lambda: seen.page.locator(".row").count() == 40)
    looks = {tone: set() for tone in ("good", "warn", "bad", "away", "plain")}
    for act, *told in STATES:
        act(shown)
        shows(seen, *told)
        looks[told[0]].add((seen.page.evaluate(back), seen.page.get_attribute("#sign path", "d")))
        for _ in ("on", "off"):
            assert seen.legibility()[1] == []
            fits(seen, width, height)
            seen.page.keyboard.press("f")
    assert [len(one) for one in looks.values()] == [1] * 5
    colours, signs = zip(*(one.pop() for one in looks.values()), strict=True)
    assert len({*colours}) == len({*signs}) == 5
    assert not seen.errors


def test_an_unsure_answer_shows_its_candidate_small(browser, shown):
    """The name of a material that the box does not answer for is never the large word."""
    seen = opened(browser, shown)
    for status in ("unsure", "undecided"):
        shown.board.take(verdict(41, 395.0, "wood", status))
        until(lambda: seen.text("#status") == status)  # noqa: B023
        assert "wood" not in seen.text("#label")
        assert seen.text("#sure") == "Perhaps wood, 48.1 %"
    shown.board.take(verdict(42, 396.0, "wood", "unsure", probability=0.9996))
    until(lambda: seen.text("#sure") == "Perhaps wood, 99.9 %")
    assert "99.9" in seen.text("#rows")
    assert "100.0" not in seen.text("#rows")


def test_an_open_sweep_does_not_wear_the_answer_of_the_last(browser: Any, shown: Shown):
    """Which is small until the new answer."""
    seen = opened(browser, shown)
    sweep()(shown)
    until(lambda: seen.text("#label") == "wood")
    shown.board.take(feed_lines.health(NOW_S, sweeping=True, ready=False))
    until(lambda: seen.text("#label") == "Sweeping")
    assert seen.page.get_attribute("#verdict", "data-tone") == "plain"
    assert "wood" in seen.text("#sure")
    shown.board.take(verdict(42, 399.0, "paper", "ok", share=0.5))
    until(lambda: seen.text("#label") == "paper")
    for sweeping in (False, True):
        ready = not sweeping
        shown.board.take(feed_lines.health(NOW_S, sweeping=sweeping, ready=ready))
    until(lambda: seen.text("#label") == "Sweeping")


def test_the_whole_screen_has_the_verdict_alone(browser, shown):
    """With a key or the button; the way back is the same key, or Escape."""
    seen = opened(browser, shown)
    seen.page.keyboard.press("f")
    until(lambda: not seen.page.is_visible("#latest"))
    box = seen.page.locator("#verdict").bounding_box()
    assert box["width"] * box["height"] > 0.8 * 1024 * 768
    assert seen.page.is_visible("#state")
    assert seen.page.get_attribute("#full", "aria-pressed") == "true"
    seen.page.keyboard.press("Escape")
    until(lambda: seen.page.is_visible("#latest"))
    seen.page.click("#full")
    until(lambda: not seen.page.is_visible("#latest"))
    seen.page.click("#full")
    until(lambda: seen.page.is_visible("#latest"))


def test_a_tablet_stays_awake_and_sounds_on_a_refusal(browser, shown):
    """The screen is kept on; if wanted, a refusal sounds once, an answer not."""
    # notes how often its screen is kept on, and its tones in Hz
    tablet = """() => {
      window.locks = 0; window.tones = [];
      const lock = () => Object.assign(new EventTarget(), {released: false});
      const request = async () => { window.locks += 1; return window.lock = lock(); };
      Object.defineProperty(navigator, "wakeLock", {value: {request}});
      window.AudioContext = class {
        currentTime = 0;
        createOscillator() {
          const frequency = {}, start = () => { window.tones.push(frequency.value); };
          return {frequency, connect() {}, start, stop() {}};
        }
        resume() {}
      };
    }"""
    device = lambda context: context.add_init_script(f"({tablet})()")  # noqa: E731
    seen = BrowsedPage(browser, shown.server.address + "/#watch", prepare=device)
    until(lambda: seen.page.locator(".row").count() == 40)
    until(lambda: seen.page.evaluate("window.locks") == 1)
    assert "screen" in seen.text("#awake")
    seen.page.evaluate(
        "window.lock.released = true; document.dispatchEvent(new Event('visibilitychange'))"
    )
    until(lambda: seen.page.evaluate("window.locks") == 2)
    for number, pressed, tones in ((41, False, 0), (42, True, 2), (43, False, 4)):
        if pressed:
            seen.page.keyboard.press("t")
        shown.board.take(verdict(number, 395.0, status="unknown"))
        until(lambda: seen.text("#which").startswith(f"sweep {number},"))  # noqa: B023
        assert len(seen.page.evaluate("window.tones")) == tones
    shown.board.take(verdict(44, 395.0, "wood"))
    until(lambda: seen.text("#label") == "wood")
    assert len(seen.page.evaluate("window.tones")) == 4
    assert not seen.errors


def test_keys_lead_to_views_and_history(browser, shown):
    """A letter each, listed on the page; with Ctrl a letter belongs to the browser."""
    seen = opened(browser, shown)
    seen.page.keyboard.press("a")
    until(lambda: seen.page.is_visible("#align"))
    seen.page.keyboard.press("w")
    until(lambda: seen.page.is_visible("#watch"))
    seen.page.keyboard.press("h")
    seen.page.keyboard.press("ArrowDown")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 39"))
    seen.page.keyboard.press("l")
    until(lambda: seen.text("#sweep-title").startswith("Sweep 40"))
    seen.page.keyboard.press("Control+a")
    assert seen.page.is_visible("#watch")
    seen.page.click("summary:text('keys')")
    assert seen.page.locator("#keys dt").all_text_contents() == list("ftwaplhs")


def test_the_shift_is_counted_and_saved(browser, shown):
    """A sentence, a table, a CSV file, also of what came later."""
    seen = opened(browser, shown)
    shown.take(verdict(41, 395.0, "=1+1", detail='a "word", and more'))
    until(lambda: seen.text("#tally-counted").startswith("41 sweeps since "))
    assert re.search(r": 37.*90\.2.*, 2 .*, 2 ", seen.text("#tally-counted"))
    assert "palpate-bridge@memory" in seen.text("#tally-kept")
    lines = [one.split("\t") for one in seen.text("#tally table").splitlines()]
    assert lines[0] == ["material", "ok", "unsure", "all"]
    assert ["foam", "2", "2", "4"] in lines
    assert [line[0] for line in lines[-2:]] == ["gap", "no-contact"]
    assert sum(int(line[-1]) for line in lines[1:]) == 41
    with seen.page.expect_download() as download:
        seen.page.keyboard.press("s")
    text = Path(download.value.path()).read_bytes().decode()
    rows = list(csv.DictReader(io.StringIO(text, newline="")))
    assert [row["number"] for row in rows] == [str(n) for n in range(1, 42)]
    assert [rows[0][name] for name in ("sweep", "status", "label")] == ["1", "ok", "wood"]
    assert datetime.fromisoformat(rows[0]["time"]).tzinfo
    assert rows[10]["status"] == "gap"
    assert rows[40]["label"] == "'=1+1"
    assert rows[40]["detail"] == 'a "word", and more'


def test_history_goes_on_after_a_restart(browser, tmp_path):
    """The page counts the verdicts of the file, and leaves out those before the period."""
    now = time.time()
    for start, ages_h in ((1, (40 * 24, 24 * 20, 24 * 10)), (4, (0.02, 0.01))):
        file = VerdictFile(tmp_path / "verdicts.db")
        for i, age_h in enumerate(ages_h):
            file.add(now - 3600 * age_h, verdict(start + i, 1.0, "wood", "unsure"))
        file.close()
    with Shown(Access(0), memory=tmp_path / "verdicts.db") as one:
        one.shift()
        seen = BrowsedPage(browser, one.server.address + "/#history")
        for period, counted in (("0", "2"), ("30", "4")):
            seen.page.click(f"[data-period='{period}']")
            until(lambda counted=counted: seen.text("#past-counted").startswith(f"{counted} sw"))
            until(lambda: seen.text("#trend-said").startswith("unsure 100.0 %"))
        assert seen.text("#past-kept") == ""
        with seen.page.expect_download() as download:
            seen.page.click("#rows-file")
        rows = list(csv.DictReader(Path(download.value.path()).read_text().splitlines()))
        assert [row["number"] for row in rows] == ["2", "3", "4", "5"]
        assert not seen.errors


def test_the_start_leads_to_each_page(browser, shown):
    """Views, other boxes, teaching; no link that runs a script."""
    evil, cell = "javascript:alert(1)", "https://cell-7.local:8137/"
    shown.boxes += [{"name": "evil", "address": evil}, {"name": "cell-7", "address": cell}]
    seen = BrowsedPage(browser, shown.server.address)
    until(lambda: "palpate, streaming" in seen.text("#there"))
    until(lambda: seen.text("#start-history").startswith("40 sweeps"))
    until(lambda: seen.page.locator("#boxes a").count() == 1)
    assert seen.page.get_attribute("#boxes a", "href") == cell
    for view in ("watch", "align", "history"):
        seen.page.click(f"#start [href='#{view}']")
        until(lambda view=view: seen.page.is_visible(f"main#{view}"))
        seen.page.click("#home-link")
        until(lambda: seen.page.is_visible("main#start"))
    assert seen.page.get_attribute("#start-teach", "href") is None
    shown.board.take(feed_lines.health(NOW_S, teach={"materials": {}}, recording={}))
    until(lambda: (seen.page.get_attribute("#start-teach", "href") or "").endswith(":8138/"))
    assert seen.page.get_attribute("#start-record", "href") is None
    assert not seen.errors


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_long_names_and_many_materials_are_not_cut(browser, shown, width, height):
    """24 characters, 26 materials: nothing is cut anywhere."""
    names = [f"Schaumstoff-beschichtet{chr(65 + i)}" for i in range(26)]
    shown.board.take(feed_lines.hello(labels=names))
    for i, name in enumerate(names):
        scores = [0.9 if j == i else 0.004 for j in range(26)]
        shown.take(verdict(41 + i, 395.0, name) | {"label": name, "scores": scores})
    seen = opened(browser, shown, width, height, rows=66)
    assert seen.page.locator("#scores li").count() == 6
    seen.page.click("#more")
    until(lambda: seen.page.locator("#scores li").count() == 26)
    until(lambda: seen.page.locator("#tally tbody tr").count() == 26 + 6 + 2)
    wide = seen.page.evaluate(
        "() => [...document.querySelectorAll('.row, .row *, #scores *, #tally *, #label')]"
        ".filter((e) => getComputedStyle(e).display !== 'inline')"
        ".filter((e) => e.scrollWidth > e.clientWidth + 1)"
        ".map((e) => e.outerHTML.slice(0, 60))"
    )
    assert wide == []
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_taxel_of_a_large_skin_tells_its_value(browser, shown):
    """Row, column and value, in newtons where the profile says newtons."""
    shape = {"rows": 16, "cols": 32, "rate_hz": 100.0, "window": 200, "dtype": "float32"}
    known = {"contact": 0.05, "place": None, "unloaded": 0.0, "fingertip": ""}
    for unit, said in (("N", "row 3, column 7: 1.25 N"), ("", "row 3, column 7: 1 raw counts")):
        shown.board.take(feed_lines.hello(format=shape, alignment=known, unit=unit))
        for i in range(20):
            taxels = np.zeros((16, 32))
            taxels[2, 6] = 1.25 * (i > 9)
            line = feed_lines.frame(380 + i / 20, taxels) | {"taxels": taxels.tolist()}
            shown.board.take(line)
        seen = opened(browser, shown)
        until(lambda: seen.page.locator(".tile").count() == 16 * 32)  # noqa: B023
        seen.page.locator("[data-row='2'][data-col='6']").first.hover()
        shown.board.take(line | {"time_ns": round(390 * feed_lines.SECOND)})
        until(lambda: seen.text("#taxel") == said)  # noqa: B023
        assert not seen.errors
