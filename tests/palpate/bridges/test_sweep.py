"""A sweep by command, against a box that is played on a pseudo-terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from palpate.bridges import sweep
from palpate.bridges.source import FeedSource, LineSource
from palpate.bridges.sweep import CommandedSweep
from palpate.client.answers import Answer
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError, CommandRefused, ConfigError, LinkLost, NoAnswer
from palpate.core.sentences import Sentence, sentence
from palpate.core.status import Status
from tests.factories.bridges import LONG_S, eventually
from tests.factories.speaking_box import SpeakingBox, obeying, result, state


class Wanted(NamedTuple):
    """Parameters of a sweep."""

    new_object: bool = False
    slide_s: float = 0.05
    timeout_s: float = LONG_S
    speed_mm_s: float = 0.0
    force_n: float = 0.0


class Hurried(SystemClock):
    """A clock that advances by a second with each reading."""

    def __init__(self) -> None:
        self._looks = 0

    def now_ns(self) -> int:
        """The time now."""
        self._looks += 1
        return self._looks * 10**9


class Swept:
    """A box, a source that hears it, and a sweep that can be canceled."""

    def __init__(self, path: Path) -> None:
        self.box = SpeakingBox(path)
        self.phases: list[str] = []
        self.canceled = threading.Event()
        self.at_phase: Callable[[str], object] = lambda phase: None
        self.source = LineSource(str(path), heard=lambda news: self.sweep.notice(news))
        self.use(SystemClock())

    def use(self, clock: SystemClock) -> None:
        """Another sweep, with this clock."""
        self.sweep = CommandedSweep(
            self.source, canceled=self.canceled.is_set, say=self._say, clock=clock
        )

    def run(self, **terms: float | bool) -> Answer:
        """Sweep."""
        return self.sweep.run(Wanted(**terms))

    def has_heard(self, *names: str) -> bool:
        """Whether these are the commands that the box has heard, without questions; waits for
        them."""
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


def test_start_slide_stop_answer(swept: Swept):
    """The commands in order, and NEW only if it is requested."""
    answer = swept.run()
    assert (answer.status, answer.label, answer.sweep) == (Status.OK, "wood", 1)
    assert swept.has_heard("START", "STOP")
    assert swept.phases == ["sliding", "judging"]
    swept.run(new_object=True)
    assert swept.has_heard("START", "STOP", "NEW", "START", "STOP")


def test_start_has_the_speed_and_force_of_the_goal(swept: Swept):
    """0 is not sent."""
    swept.run(speed_mm_s=30.5)
    swept.run(force_n=1.5)
    swept.run()
    started = [s.fields for s in swept.box.heard if s.kind == "START"]
    assert started == [["30.5"], ["", "1.5"], []]


def test_an_early_answer_ends_the_slide(swept: Swept):
    """It is said, STOP follows at once, and it is the answer."""
    swept.box.script = saying(START=result(1, share="0.40"))
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).early
    assert swept.phases == ["sliding", "early"]
    assert swept.has_heard("START", "STOP")


def test_a_fault_ends_the_slide(swept: Swept):
    """A sweep that fails while the finger slides is answered at once; STOP closes it."""
    swept.box.script = saying(START=result(1, "sensor-lost", ""))
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).status is Status.SENSOR_LOST
    assert swept.phases == ["sliding"]
    assert swept.has_heard("START", "STOP")


def test_a_sweep_of_another_is_not_stopped(swept: Swept):
    """Another's START ends the sweep, which is answered `no-stop`: the STOP is the other's."""
    swept.box.script = saying(START=result(1, "no-stop", ""))
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).status is Status.NO_STOP
    assert swept.source.send("TARE")
    assert swept.has_heard("START", "TARE")


def test_an_answer_counts_although_stop_fails(swept: Swept):
    """The line is lost after an early answer: the answer is valid."""
    swept.box.script = saying(START=result(1, share="0.40"))
    swept.at_phase = lambda phase: phase == "early" and swept.box.unplug()
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).early


def test_stop_from_elsewhere(swept: Swept):
    """With slide_s = 0 another's STOP is waited for and none is sent."""
    swept.at_phase = lambda phase: swept.source.send("STOP")
    assert swept.run(slide_s=0.0).known
    assert swept.has_heard("START", "STOP")
    swept.at_phase = lambda phase: None
    swept.box.script = saying(START=result(2, share="0.40"))
    assert swept.run(slide_s=0.0).early
    assert swept.has_heard("START", "STOP", "START")


def test_canceled_while_sliding(swept: Swept):
    """The box aborts its sweep, and that is the answer."""
    swept.box.script = saying(ABORT=result(1, "aborted", ""))
    swept.at_phase = lambda phase: swept.canceled.set()
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).status is Status.ABORTED
    assert swept.has_heard("START", "ABORT")


def test_canceled_when_the_answer_came(swept: Swept):
    """The box has nothing to abort any more: the answer that it gave is the answer."""

    def script(heard: Sentence) -> list[bytes]:
        if heard.kind == "ABORT":
            return [result(1), sentence("ANS", "ABORT", "error", "no sweep is open")]
        return obeying(heard)

    swept.box.script = script
    swept.at_phase = lambda phase: swept.canceled.set()
    assert swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S).known


def test_canceled_before_start(swept: Swept):
    """No sweep is begun."""
    swept.canceled.set()
    with pytest.raises(CommandRefused, match="canceled before START"):
        swept.run()
    assert swept.has_heard()


def test_canceled_and_not_answered(swept: Swept, monkeypatch: pytest.MonkeyPatch):
    """A box that does not answer an aborted sweep is not waited for without end."""
    monkeypatch.setattr(sweep, "ABORTED_S", 0.1)
    swept.at_phase = lambda phase: swept.canceled.set()
    with pytest.raises(NoAnswer, match=r"within 0\.1 s"):
        swept.run()


def test_no_answer_in_time(swept: Swept):
    """The reason names the time limit, and the box is not left with an open sweep."""
    swept.box.script = saying()
    with pytest.raises(NoAnswer, match=r"timeout_s = 0\.3"):
        swept.run(timeout_s=0.3)
    assert swept.has_heard("START", "STOP", "ABORT")


def test_an_answer_to_an_earlier_sweep_is_none_to_this(swept: Swept):
    """What came before START is forgotten."""
    swept.box.script = saying()
    swept.sweep.notice(Answer(6, 1.0, Status.OK, "paper", 0.9, 0.8, 1, 0, 1.0))
    with pytest.raises(NoAnswer, match="no answer within"):
        swept.run(timeout_s=0.3)


def test_unplugged_while_sliding(swept: Swept):
    """The reason is the line's, at once; plugged in again, the next sweep works."""
    swept.at_phase = lambda phase: swept.box.unplug()
    with pytest.raises(LinkLost, match="the box was lost during"):
        swept.run(slide_s=LONG_S, timeout_s=2 * LONG_S)
    swept.at_phase = lambda phase: None
    swept.box.plug_in()
    eventually(lambda: not swept.source.view().trouble)
    assert swept.run().known


def test_a_box_that_falls_silent(swept: Swept):
    """Without a sentence for 3.5 s the sweep ends, long before its time limit."""
    swept.use(Hurried())
    swept.box.script = saying()
    with pytest.raises(NoAnswer, match=r"nothing for 3\.5 s"):
        swept.run(slide_s=0.0, timeout_s=1000.0)
    assert swept.has_heard("START", "ABORT")


def test_a_box_that_speaks_is_waited_for(swept: Swept):
    """Each sentence begins the 3.5 s anew: only the time limit ends the wait."""
    swept.box.script = saying()
    spoken = CommandedSweep(
        swept.source,
        canceled=lambda: bool(spoken.notice(state())),
        say=lambda phase, answer: None,
        clock=Hurried(),
    )
    with pytest.raises(NoAnswer, match="timeout_s = 20"):
        spoken.run(Wanted(slide_s=0.0, timeout_s=20.0))


def test_a_box_that_refuses(swept: Swept):
    """Its reason is the reason; nothing of another's is aborted."""
    swept.box.script = lambda s: (
        [sentence("ANS", "START", "error", "set trigger.mode to serial")]
        if s.kind == "START"
        else obeying(s)
    )
    with pytest.raises(CommandRefused, match=r"trigger\.mode"):
        swept.run()
    assert swept.has_heard("START")


def test_a_box_that_is_not_ready(swept: Swept, monkeypatch: pytest.MonkeyPatch):
    """No sweep is begun; the reason names the missing condition."""
    monkeypatch.setattr(sweep, "READY_S", 0.3)
    absent = sentence(
        "ANS", "STATE", "ok", "9.000", "absent", 0, 0, 3000, 0, 0, 1, 0, "9f3c2a1b", "sim"
    )
    swept.box.script = lambda s: [absent] if s.kind == "STATE" else obeying(s)
    with pytest.raises(NoAnswer, match="the skin is absent"):
        swept.run()
    assert swept.has_heard()


def test_an_error_of_the_caller_leaves_no_sweep_open(swept: Swept):
    """A `say` that fails ends the sweep at the box, too, and is not hidden."""

    def fails(phase: str) -> None:
        raise RuntimeError("no publisher")

    swept.at_phase = fails
    with pytest.raises(RuntimeError, match="no publisher"):
        swept.run()
    assert swept.has_heard("START", "ABORT")


def test_the_feed_begins_nothing(tmp_path: Path):
    """It is read-only, and the error names it."""
    source = FeedSource(str(tmp_path / "feed.sock"))
    with pytest.raises(CommandRefused, match="the feed is read-only"):
        CommandedSweep(source, canceled=lambda: False, say=lambda phase, answer: None).run(Wanted())
    source.close()


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ({"slide_s": -1.0}, "slide_s = -1 is not a valid time from START to STOP; use 0 to 3600"),
        ({"slide_s": float("nan")}, "slide_s = nan is not a valid time"),
        ({"slide_s": float("inf")}, "slide_s = inf is not a valid time"),
        (
            {"slide_s": 3.0, "timeout_s": 3.0},
            "timeout_s = 3 is not a valid limit from START to the answer; use more than",
        ),
        ({"timeout_s": float("nan")}, "timeout_s = nan is not a valid limit"),
        ({"timeout_s": 3601.0}, "timeout_s = 3601 is not a valid limit"),
    ],
)
def test_times_that_cannot_be(swept: Swept, terms: dict[str, float], text: str):
    """Refused with the value, before anything is sent."""
    with pytest.raises(ConfigError, match=text):
        swept.run(**terms)
    assert swept.box.heard == []
    assert issubclass(ConfigError, ApplianceError)
