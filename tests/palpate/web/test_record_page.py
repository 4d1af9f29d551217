"""The page of `palpate record --web` in a browser: content, labels, three sizes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from palpate.core.clock import SystemClock
from palpate.core.sweep_file import sidecar
from palpate.core.types import Status
from palpate.sweeps.recording import Labels
from palpate.web.access import Access
from tests.factories.browser import LOOKS, BrowsedPage, until
from tests.factories.page_client import port
from tests.factories.recorded_page import TAUGHT, RecordedPage

pytestmark = pytest.mark.slow

SECOND, JS = 1_000_000_000, "text/javascript"


def begun(folder: Path, access: Access | None = None) -> RecordedPage:
    """A recording of two materials at two positions, with a sweep too many and some too few."""
    one = RecordedPage(folder, Labels("metal", "1", "monday"), target=3, access=access)
    for material, position, sweeps in (("metal", "1", 4), ("metal", "2", 3), ("wood", "1", 1)):
        for name, text in (("MATERIAL", material), ("POSITION", position)):
            one.recording.commands[name](text)
        for _ in range(sweeps):
            one.recording.sweep(*one.answered(Status.RECORDED), {})
    return one


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[RecordedPage]:
    """The recording, with a page that is served."""
    one = begun(tmp_path)
    with one:
        yield one


def opened(browser: Any, recorded: RecordedPage) -> BrowsedPage:
    """The page in a browser, with its content."""
    seen = BrowsedPage(browser, recorded.page.server.address, (1024, 768))
    until(lambda: seen.page.locator("#counts button").count() == 4)
    until(lambda: seen.page.locator(".skin .tile").count() == 16)
    return seen


def labels(recorded: RecordedPage) -> tuple[str, str, str]:
    """The current labels."""
    about = recorded.recording.about()
    return about["material"], about["position"], about["session"]


def test_what_is_there_and_what_is_missing(browser, recorded):
    """Materials by positions, with recorded and missing sweeps; the trigger in words."""
    seen = opened(browser, recorded)
    assert seen.page.locator("#counts th").all_inner_texts() == ["1", "2", "metal", "wood"]
    fields = seen.page.locator("#counts button")
    assert fields.all_inner_texts() == ["4 of 3", "3 of 3", "1 of 3", "0 of 3"]
    assert [one.get_attribute("class") for one in fields.all()] == ["done", "done", "", ""]
    pressed = [one.get_attribute("aria-pressed") for one in fields.all()]
    assert pressed == ["false", "false", "true", "false"]
    assert seen.text("#missing").endswith("wood at 2: 3")
    assert seen.text("#now") == "wood at 1"
    assert "START and STOP" in seen.text("#trigger")
    assert seen.page.is_visible("#simulated")
    recorded.sweep()
    until(lambda: fields.nth(2).inner_text() == "2 of 3")
    assert not seen.errors


def test_the_last_sweep_with_its_checks(browser, recorded):
    """Status, checks, path and signal, also of a faulty sweep and without a window."""
    seen = opened(browser, recorded)
    number = recorded.sweep()
    until(lambda: seen.text("#outcome") == f"wood at 1, stored as sweep-{number:06d}")
    assert "nothing" in seen.text("#check")
    until(lambda: "2.0" in str(seen.page.get_attribute("#signal", "aria-label")))
    assert "spectrogram" in seen.page.get_attribute("#spectrogram", "aria-label")
    recorded.sweep(Status.NO_CONTACT, "taxel 2.2 is loaded most, with 1 count")
    until(lambda: seen.text("#status") == "no-contact")
    assert "2.2" in seen.text("#check")
    recorded.sweep(Status.SHORT)
    until(lambda: seen.text("#status") == "short")
    until(lambda: seen.text("#outcome") == "not stored, since it has no window")
    assert seen.page.get_attribute("#signal", "aria-label") == "it has no window"
    assert not seen.errors


def test_labels_are_set_with_the_keyboard(browser, recorded, tmp_path):
    """Tab reaches every control, Enter sets the labels, and the stored sweep has them."""
    seen, stops = opened(browser, recorded), []
    for _ in range(12):
        seen.page.keyboard.press("Tab")
        stops.append(
            seen.page.evaluate("document.activeElement.id || document.activeElement.textContent")
        )
        outline = seen.page.evaluate("getComputedStyle(document.activeElement).outlineWidth")
        assert float(outline.removesuffix("px")) >= 2
    controls = ["start", "stop", "material", "position", "session", "set", "next", "rename"]
    assert stops == [*controls, "4 of 3", "3 of 3", "1 of 3", "0 of 3"]
    seen.page.focus("#material")
    seen.page.keyboard.press("Control+A")
    seen.page.keyboard.type("plastic rough")
    seen.page.keyboard.press("Tab")
    seen.page.keyboard.type("07")
    seen.page.keyboard.press("Enter")
    until(lambda: seen.text("#now") == "plastic rough at 07")
    assert seen.text("#said") == "material, position set"
    seen.page.focus("#next")
    seen.page.keyboard.press("Space")
    until(lambda: seen.text("#now") == "plastic rough at 08")
    assert seen.page.input_value("#position") == "08"
    number = recorded.sweep()
    about = sidecar(tmp_path / f"sweep-{number:06d}.npy")
    set_ = [about[name] for name in ("material", "position", "session")]
    assert set_ == ["plastic rough", "08", "monday"]
    assert not seen.errors


def test_labels_are_set_in_fields_and_in_the_table(browser, recorded):
    """The reason of a refusal stands beside the field, which keeps the text; a good label removes
    it. What a person types stays when the robot sets labels. A cell of the table sets two labels
    and keeps the focus."""
    seen = opened(browser, recorded)
    for wrong in ("-wood", "<b>wood</b>", "a,b"):
        seen.page.fill("#material", wrong)
        seen.page.click("#set")
        until(lambda wrong=wrong: f"material '{wrong}'" in seen.text("#said"))
        assert seen.page.get_attribute("#material", "aria-invalid") == "true"
        assert seen.page.input_value("#material") == wrong
        assert labels(recorded) == ("wood", "1", "monday")
    assert seen.page.locator("#said b").count() == 0
    seen.page.focus("#counts button[aria-label='wood at 2: 0 of 3']")
    seen.page.keyboard.press("Enter")
    until(lambda: labels(recorded) == ("wood", "2", "monday"))
    assert seen.page.evaluate("document.activeElement.textContent") == "0 of 3"
    seen.page.fill("#material", "paper")
    seen.page.click("#set")
    until(lambda: seen.text("#said") == "material set")
    assert seen.page.get_attribute("#material", "aria-invalid") is None
    assert labels(recorded) == ("paper", "2", "monday")
    seen.page.fill("#material", "pap")
    recorded.recording.commands["POSITION"]("9")
    until(lambda: seen.page.input_value("#position") == "9")
    assert seen.page.input_value("#material") == "pap"
    assert [one for one in seen.errors if "409" not in one] == []


def test_start_and_stop(browser, recorded):
    """By the buttons while they act, and by Space, except in a field."""
    seen = opened(browser, recorded)
    until(lambda: seen.text("#call") == "Press Start, Space or the pedal")
    for button, other, state in (("#start", "#stop", "sweeping"), ("#stop", "#start", "ready")):
        until(lambda button=button: not seen.page.is_disabled(button))
        assert seen.page.is_disabled(other)
        seen.page.click(button)
        until(lambda state=state: seen.text("#state") == state)
    seen.page.click("#counts button[aria-label='metal at 2: 3 of 3']")
    until(lambda: seen.text("#said") == "now metal at 2")
    for state, words in (("sweeping", "Slide now"), ("ready", "Press Start, Space or the pedal")):
        seen.page.keyboard.press("Space")
        until(lambda state=state: seen.text("#state") == state)
        assert seen.text("#call") == words
    seen.page.focus("#material")
    seen.page.keyboard.type("a b")
    assert "a b" in seen.page.input_value("#material")
    sweeps = [command for command in recorded.done if command in ("START", "STOP")]
    assert sweeps == ["START", "STOP"] * 2
    assert not seen.errors


@pytest.mark.parametrize("teaching", [False, True], ids=["record", "teach"])
def test_without_a_material_nothing_is_started(browser: Any, tmp_path: Path, teaching: bool):
    """The page asks for a name first, and Start can do nothing until there is one."""
    start = "#sweep-button" if teaching else "#start"
    with RecordedPage(tmp_path, Labels("", "1"), teaching=teaching) as one:
        seen = BrowsedPage(browser, one.page.server.address)
        until(lambda: seen.text("#state") == "ready")
        assert seen.page.get_attribute(start, "aria-disabled") == "true"
        seen.page.keyboard.press("Space")
        one.recording.commands["MATERIAL"]("wood")
        seen.page.wait_for_selector(f"{start}:not([aria-disabled=true])")
        assert "START" not in one.done


@LOOKS
@pytest.mark.parametrize("teaching", [False, True], ids=["record", "teach"])
def test_timed_sweeps_are_counted_down(browser, tmp_path, width, height, scheme, teaching):
    """In sight, in letters of 96 px or more; a skin that is away has no countdown."""
    with RecordedPage(tmp_path, Labels("metal", "1"), teaching=teaching) as one:
        seen = BrowsedPage(browser, one.page.server.address, (width, height), scheme)
        for sweeping, words in ((False, "Next sweep in"), (True, "Slide now")):
            due_ns = SystemClock().now_ns() + 60 * SECOND
            one.health = one.health._replace(due_ns=due_ns, sweeping=sweeping, ready=not sweeping)
            until(lambda words=words: seen.text("#call") == words and seen.text("#countdown"))
            before = float(seen.text("#countdown"))
            assert 5 < before < 70  # the page learns the clock late by the delay of an event
            until(lambda before=before: float(seen.text("#countdown")) < before)
            box = seen.page.locator("#countdown").bounding_box()
            assert box["height"] >= 96
            assert box["y"] + box["height"] <= height
            assert seen.legibility()[1] == []
        one.health = one.health._replace(skin="lost", trouble="unplugged", due_ns=0)
        until(lambda: seen.text("#call") == seen.text("#countdown") == "")
        assert not seen.errors


def test_the_sweep_on_the_button_is_discarded(browser, recorded, tmp_path):
    """The button has the number of the sweep, and then that of the sweep before."""
    seen = opened(browser, recorded)
    number = recorded.sweep()
    until(lambda: seen.text("#discard") == f"Discard sweep {number}")
    seen.page.click("#discard")
    until(lambda: seen.text("#outcome") == "wood at 1, discarded")
    assert not (tmp_path / f"sweep-{number:06d}.npy").exists()
    assert seen.text("#said") == f"sweep {number} discarded"
    until(lambda: seen.text("#discard") == f"Discard sweep {number - 1}")


def test_a_recorder_that_ends_and_comes_back_while_the_page_is_open(browser, tmp_path):
    """Controls are off; then a new key."""
    first = begun(tmp_path / "a")
    with first:
        seen = opened(browser, first)
        address = Access(port(first.page.server))
    until(lambda: "connection" in seen.text("#banner"))
    assert seen.text("#state") == "no connection"
    for one in seen.page.locator("button").all():
        assert one.is_disabled()
    seen.page.fill("#material", "paper")
    seen.page.keyboard.press("Enter")
    assert first.done == []
    with begun(tmp_path / "b", address) as second:
        until(lambda: not seen.page.is_visible("#banner"))
        until(lambda: not seen.page.is_disabled("#set"))
        assert seen.page.input_value("#material") == "paper"
        seen.page.click("#set")
        until(lambda: labels(second) == ("paper", "1", "monday"))


CUT = """() => [...document.querySelectorAll("main :not(svg *, #counts)")]
  .filter((e) => getComputedStyle(e).display !== "inline")
  .filter((e) => e.scrollWidth > e.clientWidth + 1)
  .map((e) => e.outerHTML.slice(0, 60))"""
"""Elements whose content is cut; the table may scroll within itself."""


@LOOKS
def test_every_text_of_it_can_be_read(browser, recorded, width, height, scheme):
    """Contrast of 4.5 (WCAG 2.1, 1.4.3); the longest names fit."""
    recorded.recording.commands["MATERIAL"]("corrugated cardboard 2mm")
    for position in range(3, 15):
        recorded.recording.commands["POSITION"](f"{position}")
        recorded.sweep()
    recorded.sweep(Status.STUCK_TAXEL, "taxel 1.4")
    seen = BrowsedPage(browser, recorded.page.server.address, (width, height), scheme)
    until(lambda: seen.page.locator("#counts button").count() == 3 * 14)
    seen.page.fill("#session", "-")
    seen.page.click("#set")
    until(lambda: "cannot" in seen.text("#said"))
    away = recorded.health._replace(skin="lost", trouble="the skin was unplugged", ready=False)
    for act in (lambda: None, lambda: setattr(recorded, "health", away)):
        act()
        until(lambda act=act: seen.page.is_visible("#banner") == (recorded.health is away))
        assert seen.page.is_disabled("#start") == (recorded.health is away)
        texts, faint = seen.legibility()
        assert texts > 60
        assert faint == []
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
        assert seen.page.evaluate(CUT) == []
    assert [one for one in seen.errors if "409" not in one] == []


def test_everything_on_it_has_a_role_and_a_name(browser, recorded):
    """Sections, fields, pictures and buttons have names for screen readers, which speak changes."""
    seen = opened(browser, recorded)
    assert set(seen.unnamed()) <= {"banner", "said"}
    assert seen.page.get_attribute("#said", "role") == "status"
    assert seen.page.get_attribute("#now", "aria-live") == "polite"
    assert json.dumps(seen.requests).count(".js") == 7


PRESS = ":not([aria-disabled=true])"


def test_a_sweep_with_the_wrong_material_is_moved(browser: Any, recorded: RecordedPage):
    """One press; renamed; Undo takes back the last."""
    seen = opened(browser, recorded)
    recorded.sweep()
    until(lambda: seen.text("#outcome").startswith("wood at 1, stored"))
    assert not seen.page.is_visible("#move")
    assert not seen.page.is_visible("#undo")
    seen.page.click("#counts button >> nth=0")
    until(lambda: seen.text("#said") == "now metal at 1")
    seen.page.click(f"#move{PRESS}")
    until(lambda: seen.text("#outcome").startswith("metal at 1, stored"))
    assert recorded.recording.materials() == {"metal": 8, "wood": 1}
    assert not seen.page.is_visible("#move")
    seen.page.fill("#material", "Eiche, geölt")
    seen.page.click(f"#rename{PRESS}")
    until(lambda: seen.text("#now") == "Eiche, geölt at 1")
    assert recorded.recording.materials() == {"Eiche geoelt": 8, "wood": 1}
    for left in ({"metal": 8, "wood": 1}, {"metal": 7, "wood": 2}):
        seen.page.click(f"#undo{PRESS}")
        until(lambda left=left: recorded.recording.materials() == left)
    until(lambda: not seen.page.is_visible("#undo"))
    assert not seen.errors


def test_a_press_before_the_answer_to_another_is_said(browser: Any, recorded: RecordedPage):
    """It is lost, and the page says so once the first is answered."""
    seen = opened(browser, recorded)
    both = "[...document.querySelectorAll('#counts button')].slice(0, 2)"
    seen.page.evaluate(f"() => {{ for (const one of {both}) one.click(); }}")
    until(lambda: seen.text("#said").startswith("a press was ignored"))
    assert seen.text("#now") == "metal at 1"
    assert not seen.errors


def test_a_sweep_that_looks_like_another_material_is_moved(browser: Any, tmp_path: Path):
    """One press on the page that teaches; there is no button to a material that is not taught."""
    with RecordedPage(tmp_path, Labels("metal", "1"), teaching=True) as one:
        number = one.sweep()
        suspect = {"sweep": f"sweep-{number:06d}", "looks_like": "wood", "text": "like wood"}
        suspects = [suspect, suspect | {"looks_like": "felt", "text": "like felt"}]
        learnt = {"accuracy": 0.9, "low": 0.8, "high": 1, "text": "", "advice": ""}
        held = {**TAUGHT["teach"], "materials": {"metal": 1, "wood": 0}}
        one.more = {"teach": held | {"learnt": learnt | {"suspects": suspects}}}
        seen = BrowsedPage(browser, one.page.server.address)
        until(lambda: seen.page.locator("#suspects li").count() == 2)
        assert seen.page.locator("#suspects button").count() == 1
        seen.page.click("#suspects button")
        until(lambda: one.recording.materials() == {"wood": 1})
        seen.page.fill("#name", "iron")
        seen.page.click(f"#rename{PRESS}")
        until(lambda: one.recording.about()["material"] == "iron")
        until(lambda: seen.page.input_value("#name") == "")  # once the reply has come
        assert not seen.errors


def test_the_bar_shows_the_steps_and_the_time_of_use(browser: Any, tmp_path: Path):
    """Each step with its share and the seconds left; it moves before the first share is known."""
    with RecordedPage(tmp_path, Labels("metal", "1"), teaching=True) as one:
        seen = BrowsedPage(browser, one.page.server.address)
        for step, done, left_s, words in (
            ("start", 0.0, None, "waiting for the processor, for"),
            ("heads", 0.06, 9.3, "about 10 s left"),
            ("bundle", 0.2, 4.0, "about 4 s left"),
        ):
            using = {"step": step, "done": done, "left_s": left_s}
            one.more = {"teach": {**TAUGHT["teach"], "using": using}}
            until(lambda words=words: words in seen.text("#left"))
            bar = seen.page.locator("#progress")
            assert bar.get_attribute("value") == (str(done) if done else None)
            assert seen.page.is_visible("#using")
        one.more = {"teach": {**TAUGHT["teach"], "using": None}}
        until(lambda: seen.page.is_hidden("#using"))
        assert not seen.errors


@LOOKS
@pytest.mark.parametrize("teaching", [False, True])
def test_a_person_sees_each_control_of_a_page(
    browser: Any, tmp_path: Path, width: int, height: int, scheme: str, teaching: bool
):
    """Nothing is covered, cut, too faint or too small."""
    # Controls that a finger misses
    small = """() => [...document.querySelectorAll("button, input")]
      .filter((e) => e.checkVisibility() && e.getBoundingClientRect().height < 40)
      .map((e) => e.id)"""
    # Pairs of controls and titles that lie on each other
    covered = """() => {
      const seen = [...document.querySelectorAll("button, input, h2, #what, #now, #call")]
        .filter((e) => e.checkVisibility()).map((e) => [e, e.getBoundingClientRect()]);
      const meet = (p, q) => Math.min(p.right, q.right) - Math.max(p.left, q.left) > 1
        && Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top) > 1;
      return seen.flatMap(([a, p], i) => seen.slice(i + 1).filter(([, q]) => meet(p, q))
        .map(([b]) => `${a.id} on ${b.id}`));
    }"""
    with RecordedPage(tmp_path, Labels("metal", "1"), teaching=teaching) as one:
        number = one.sweep()
        suspect = {"sweep": f"sweep-{number:06d}", "looks_like": "wood", "text": "like wood"}
        learnt = {"accuracy": 0.9, "low": 0.8, "high": 1, "text": "so it is", "advice": "look"}
        held = {**TAUGHT["teach"], "materials": {"metal": 1, "wood": 3}}
        if teaching:
            one.more = {"teach": held | {"learnt": learnt | {"suspects": [suspect]}}}
        seen = BrowsedPage(browser, one.page.server.address, (width, height), scheme)
        for order in (("MOVE", f"{number},wood"), ("MATERIAL", "metal")):
            one.recording.commands[order[0]](order[1])
        for where in ("#move", "#undo", "#rename"):
            until(lambda where=where: seen.page.is_visible(where))
        assert seen.page.evaluate(covered) == []
        assert seen.page.evaluate(small) == []
        assert seen.page.evaluate(CUT) == []
        assert seen.legibility()[1] == []
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
        assert not seen.errors


OLDER = """
for (const [of, name] of [[Array.prototype, "at"], [Element.prototype, "replaceChildren"],
  [String.prototype, "replaceAll"], [AbortSignal, "timeout"], [Object, "hasOwn"]]) delete of[name];
"""


def test_orders_of_an_older_browser_are_sent(browser: Any, recorded: RecordedPage):
    """Of 2020; an error of script stops no later order."""
    older = lambda context: context.add_init_script(OLDER)  # noqa: E731
    seen = BrowsedPage(browser, recorded.page.server.address, prepare=older)
    until(lambda: seen.page.locator("#counts button").count() == 4)
    seen.page.click("#next:not([aria-disabled=true])")
    until(lambda: seen.text("#said") == "next position")
    assert not seen.errors
    seen.page.evaluate("window.kept = window.fetch; window.fetch = undefined")
    seen.page.click("#next:not([aria-disabled=true])")
    until(lambda: seen.page.evaluate("true") and seen.errors)  # which brings the browser's news
    assert "no connection" not in seen.text("#said")
    seen.page.evaluate("window.fetch = window.kept")
    seen.page.click("#next:not([aria-disabled=true])")
    until(lambda: recorded.done.count("NEXT") == 2)


def test_a_browser_that_is_too_old_says_so(browser: Any, recorded: RecordedPage):
    """Its modules do not run: one sentence, by a script that it understands."""
    newer = lambda route: route.fulfill(body="a ??== 1", content_type=JS)  # noqa: E731
    prepare = lambda context: context.route("**/parts.js", newer)  # noqa: E731
    seen = BrowsedPage(browser, recorded.page.server.address, prepare=prepare)
    until(lambda: seen.page.is_visible("#banner"))
    assert "too old" in seen.text("#banner")


@LOOKS
def test_finish_ends_the_page_in_words(
    browser: Any, tmp_path: Path, width: int, height: int, scheme: str
):
    """Done, with the way to the other page, and no red bar when the program has gone."""
    with RecordedPage(tmp_path, Labels("metal", "1"), teaching=True) as one:
        seen = BrowsedPage(browser, one.page.server.address, (width, height), scheme)
        trying = {"model": "mine 1", "labels": ["metal"], "displays": {}, "taught": "here"}
        one.more = {"trying": trying | {"alike": ["metal", "wood"]}}
        one.recording.commands["DONE"] = lambda text: []
        until(lambda: seen.text("#learnt").endswith("metal and wood"))
        seen.page.click("#done:not([aria-disabled=true])")
        until(lambda: seen.text("#what") == "Done")
    until(lambda: seen.text("#state") == "finished")
    seen.page.wait_for_timeout(1500)
    assert not seen.page.is_visible("#banner")
    assert seen.text("#count").startswith("The box works")
    assert seen.legibility()[1] == []
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_hidden_tab_lets_its_stream_go(browser: Any, recorded: RecordedPage):
    """A browser has six connections to a box, for all of its tabs; seen again it goes on."""
    hiding = (
        "let seen = 'visible'; window.show = (s) => { seen = s; "
        "document.dispatchEvent(new Event('visibilitychange')); };"
        "Object.defineProperty(document, 'visibilityState', {get: () => seen});"
    )
    prepare = lambda context: context.add_init_script(hiding)  # noqa: E731
    seen = BrowsedPage(browser, recorded.page.server.address, prepare=prepare)
    until(lambda: len(recorded.page.server.queues) == 1)
    seen.page.evaluate("window.show('hidden')")
    until(lambda: not recorded.page.server.queues, 30)
    seen.page.evaluate("window.show('visible')")
    until(lambda: len(recorded.page.server.queues) == 1)
    number = recorded.sweep()
    until(lambda: seen.text("#sweep-title").startswith(f"Sweep {number},"))
    assert not seen.errors


def test_a_material_may_be_called_as_things_of_script(browser, recorded):
    """`constructor` and `toString` are names like others."""
    seen = opened(browser, recorded)
    for name in ("constructor", "valueOf", "toString"):
        seen.page.fill("#material", name)
        seen.page.press("#material", "Enter")
        until(lambda name=name: seen.text("#now") == f"{name} at 1")
        assert name in seen.page.locator("#counts th").all_inner_texts()
        assert seen.page.input_value("#material") == name
    assert not seen.errors


def test_a_material_has_a_name_in_any_language(browser, recorded, tmp_path):
    """Shown as written; command and sweep have a label in ASCII, the sidecar both."""
    seen = opened(browser, recorded)
    seen.page.fill("#material", "Holz, geölt")
    seen.page.press("#material", "Enter")
    until(lambda: seen.text("#now") == "Holz, geölt at 1")
    assert recorded.done == ["MATERIAL,Holz geoelt"]
    assert seen.page.input_value("#material") == "Holz, geölt"
    number = recorded.sweep()
    until(lambda: seen.text("#outcome").startswith("Holz, geölt at 1, stored"))
    assert "Holz, geölt" in seen.page.locator("#counts th").all_inner_texts()
    about = sidecar(tmp_path / f"sweep-{number:06d}.npy")
    assert (about["material"], about["display"]) == ("Holz geoelt", "Holz, geölt")
    assert not seen.errors
