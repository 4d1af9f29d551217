"""A sweep by command, against a box that is played on a pseudo-terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pytest

from palpate.bridges import sweep
from palpate.bridges.source import FeedSource, LineSource
from palpate.bridges.sweep import CommandedSweep
from palpate.client.answers import Answer
from palpate.core.errors import ApplianceError, CommandRefused, ConfigError, LinkLost, NoAnswer
from palpate.core.sentences import Sentence, sentence
from palpate.core.status import Status
from tests.factories.bridges import LONG_S, eventually
from tests.factories.speaking_box import SpeakingBox, obeying, result, state

pytestmark = pytest.mark.usefixtures("hurried")


class Wanted(NamedTuple):
    """Parameters of a sweep."""

    new_object: bool = False
    slide_s: float = 0.05
    timeout_s: float = LONG_S
    speed_mm_s: float = 0.0
    force_n: float = 0.0


class Swept:
    """A box, a source that hears it, and a sweep that can be canceled."""

    def __init__(self, path: Path) -> None:
        self.box = SpeakingBox(path)
        self.phases: list[str] = []
        self.canceled = threading.Event()
        self.at_phase: Callable[[str], object] = lambda phase: None
        self.source = LineSource(str(path))
        self.sweep = CommandedSweep(
            self.source.client(), canceled=self.canceled.is_set, say=self._say
        )

    def run(self, **terms: float | bool) -> Answer:
        """Sweep."""
        return self.sweep.run(Wanted(**terms))

    def has_heard(self, *names: str) -> bool:
        """Whether the box has heard these commands, without questions; waits for them."""
        eventually(lambda: len(self._heard()) >= len(names))
        return self._heard() == [*names]

    def _heard(self) -> list[str]:
        return [s.kind for s in self.box.heard if s.kind != "STATE"]

    def _say(self, phase: str, answer: Answer | None) -> None:
        assert (answer is not None) == (phase == "early")
        self.phases.append(phase)
        self.at_phase(phase)


@pytest.fixture
def swept(tmp_path: Path) -> Iterator[Swept]:
    """A box that obeys."""
    one = Swept(tmp_path / "line")
    with one.box:
        yield one
        one.source.close()


def saying(**lines: bytes) -> Callable[[Sentence], list[bytes]]:
    """A box that obeys, and says this after its answer to a command."""

    def script(heard: Sentence) -> list[bytes]:
        return [obeying(heard)[0], *([lines[heard.kind]] if heard.kind in lines else [])]

    return script


EARLY, LONG = result(1, share="0.40"), {"slide_s": LONG_S, "timeout_s": 2 * LONG_S}


class SweepCase(NamedTuple):
    """lines: what the box says after its answer to a command. at: events of each phase.
    wanted: status, or the error and its reason. heard: the commands of the box."""

    lines: dict[str, bytes] | None
    wanted: Status | tuple[type[ApplianceError], str]
    heard: str
    phases: str
    terms: Mapping[str, float | bool] = MappingProxyType({})
    at: Callable[[Swept], object] = lambda swept: None


CASES = {
    "slide": SweepCase(None, Status.OK, "START STOP", "sliding judging"),
    "a new object": SweepCase(
        None, Status.OK, "NEW START STOP", "sliding judging", {"new_object": True}
    ),
    "an early answer": SweepCase({"START": EARLY}, Status.OK, "START STOP", "sliding early", LONG),
    "a fault": SweepCase(
        {"START": result(1, "sensor-lost", "")}, Status.SENSOR_LOST, "START STOP", "sliding", LONG
    ),
    "another's START: the STOP is the other's": SweepCase(
        {"START": result(1, "no-stop", "")}, Status.NO_STOP, "START", "sliding", LONG
    ),
    "the line is lost after the answer": SweepCase(
        *({"START": EARLY}, Status.OK, "START", "sliding early", LONG),
        lambda swept: swept.phases[-1] == "early" and swept.box.unplug(),
    ),
    "another's STOP": SweepCase(
        *(None, Status.OK, "START STOP", "sliding", {"slide_s": 0.0}),
        lambda swept: swept.source.send("STOP"),
    ),
    "canceled while sliding": SweepCase(
        *({"ABORT": result(1, "aborted", "")}, Status.ABORTED, "START ABORT", "sliding", LONG),
        lambda swept: swept.canceled.set(),
    ),
    "canceled and not answered": SweepCase(
        *(None, (NoAnswer, r"within 0\.1 s"), "START ABORT", "sliding", LONG),
        lambda swept: swept.canceled.set(),
    ),
    "no answer in time": SweepCase(
        {}, (NoAnswer, r"0\.3"), "START STOP ABORT", "sliding judging", {"timeout_s": 0.3}
    ),
    "unplugged": SweepCase(
        *(None, (LinkLost, "was lost"), "START", "sliding", LONG), lambda swept: swept.box.unplug()
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_becomes_of_a_sweep(swept, monkeypatch, name):
    """Answer or error, commands, phases; after an error no sweep is left open in reach."""
    case = CASES[name]
    monkeypatch.setattr(sweep, "ABORTED_S", 0.1 if name == "canceled and not answered" else LONG_S)
    if case.lines is not None:
        swept.box.script = saying(**case.lines)
    swept.at_phase = lambda phase: case.at(swept)
    if isinstance(case.wanted, Status):
        assert swept.run(**case.terms).status is case.wanted
    else:
        with pytest.raises(case.wanted[0], match=case.wanted[1]):
            swept.run(**case.terms)
    assert swept.has_heard(*case.heard.split())
    assert swept.phases == case.phases.split()
    if name == "unplugged":
        swept.at_phase = lambda phase: None
        swept.box.plug_in()
        eventually(lambda: not swept.source.view().trouble)
        assert swept.run().known


def test_a_sweep_has_its_own_goal_and_answer(swept):
    """0 is not sent; an answer that came before START is forgotten."""
    for terms in ({"speed_mm_s": 30.5}, {"force_n": 1.5}, {}):
        swept.run(**terms)
    started = [s.fields for s in swept.box.heard if s.kind == "START"]
    assert started == [["30.5"], ["", "1.5"], []]
    swept.box.script = saying()
    swept.box.say(result(6))
    eventually(lambda: swept.source.view().answer.sweep == 6)
    with pytest.raises(NoAnswer):
        swept.run(timeout_s=0.3)


def test_canceled_when_the_answer_came(swept):
    """The answer that came is the answer; before START nothing is begun."""
    nothing = sentence("ANS", "ABORT", "error", "no sweep is open")

    def script(heard: Sentence) -> list[bytes]:
        return [result(1), nothing] if heard.kind == "ABORT" else obeying(heard)

    swept.box.script = script
    swept.at_phase = lambda phase: swept.canceled.set()
    assert swept.run(**LONG).known
    with pytest.raises(CommandRefused, match="canceled"):
        swept.run()
    assert swept.has_heard("START", "ABORT")


def test_an_error_of_the_caller_leaves_no_sweep_open(swept):
    """A `say` that fails ends the sweep at the box, too, and is not hidden."""

    def fails(phase: str) -> None:
        raise RuntimeError("no publisher")

    swept.at_phase = fails
    with pytest.raises(RuntimeError, match="publisher"):
        swept.run()
    assert swept.has_heard("START", "ABORT")


def test_a_box_that_falls_silent(swept, monkeypatch):
    """After some seconds without a sentence, anew with each; then the time limit ends the wait."""
    monkeypatch.setattr(sweep, "STALE_S", 0.2)
    swept.box.script = saying()
    with pytest.raises(NoAnswer, match=r"0\.2 s"):
        swept.run(slide_s=0.0)
    assert swept.has_heard("START", "ABORT")
    spoken = CommandedSweep(
        swept.source.client(),
        canceled=lambda: bool(swept.box.say(state())),
        say=lambda phase, answer: None,
    )
    with pytest.raises(NoAnswer, match=r"timeout_s = 0\.6"):
        spoken.run(Wanted(slide_s=0.0, timeout_s=0.6))


def test_a_box_that_refuses_or_is_not_ready(swept, monkeypatch):
    """Its reason is the reason; nothing of another's is aborted."""
    refuses = sentence("ANS", "START", "error", "set trigger.mode to serial")
    swept.box.script = lambda s: [refuses] if s.kind == "START" else obeying(s)
    with pytest.raises(CommandRefused, match=r"trigger\.mode"):
        swept.run()
    assert swept.has_heard("START")
    monkeypatch.setattr(sweep, "READY_S", 0.3)
    fields = ("9.000", "absent", 0, 0, 3000, 0, 0, 1, 0, "9f3c2a1b", "sim")
    absent = sentence("ANS", "STATE", "ok", *fields)
    swept.box.script = lambda s: [absent] if s.kind == "STATE" else obeying(s)
    with pytest.raises(NoAnswer, match="absent"):
        swept.run()
    assert swept.has_heard("START")


def test_the_feed_begins_nothing(tmp_path):
    """It is read-only, and the error names it."""
    source = FeedSource(str(tmp_path / "feed.sock"))
    with pytest.raises(CommandRefused, match="read-only"):
        source.client()
    source.close()


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ({"slide_s": -1.0}, "slide_s = -1"),
        ({"slide_s": float("nan")}, "slide_s = nan"),
        ({"slide_s": float("inf")}, "slide_s = inf"),
        ({"slide_s": 3.0, "timeout_s": 3.0}, "timeout_s = 3"),
        ({"timeout_s": float("nan")}, "timeout_s = nan"),
        ({"timeout_s": 3601.0}, "timeout_s = 3601"),
    ],
)
def test_times_that_cannot_be(swept, terms, text):
    """Refused with the value, before anything is sent."""
    with pytest.raises(ConfigError, match=text):
        swept.run(**terms)
    assert swept.box.heard == []
