"""The client of the serial line: a scripted box, noise, unplugging, silence, the real program."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from socket import create_server, socket

import pytest
import serial

from palpate.client import line
from palpate.client.answers import Answer, BoxState
from palpate.client.box import KEPT, Palpate
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError, CommandRefused, FormatError, LinkLost, NoAnswer
from palpate.core.sentences import sentence
from palpate.core.status import Status
from tests.factories.bridges import eventually
from tests.factories.speaking_box import LABELS, SpeakingBox, finger, obeying, result, state

pytestmark = pytest.mark.usefixtures("hurried")

LONG_S = 30.0
"""A deadline that nothing reaches."""
SHORT_S = 0.05
"""One that is meant to pass."""


@pytest.fixture
def speaking(tmp_path: Path) -> Iterator[SpeakingBox]:
    """A box that obeys."""
    with SpeakingBox(tmp_path / "line") as one:
        yield one


@pytest.fixture
def box(speaking: SpeakingBox) -> Iterator[Palpate]:
    """A client of it, connected."""
    with Palpate(str(speaking.path), timeout_s=LONG_S) as client:
        client.wait_ready(LONG_S)
        yield client


@pytest.mark.parametrize(
    ("values", "fields"),
    [
        ({}, []),
        ({"speed_mm_s": 30}, ["30"]),
        ({"speed_mm_s": 30.5, "force_n": 0.000025}, ["30.5", "0.000025"]),
        ({"force_n": 1 / 3}, ["", "0.333333"]),
    ],
)
def test_start_has_speed_and_force(speaking, box, values, fields):
    """As decimals without an exponent; an unknown value stays empty."""
    box.start(**values)
    assert speaking.heard[-1].kind == "START"
    assert speaking.heard[-1].fields == fields


def test_a_sweep_by_command_and_what_the_box_is(box, speaking):
    """The example of the module; then state, identity, labels and tare."""
    assert box.state().frames == 3000
    assert (box.identify().name, box.identify().skin) == ("mine", "skin-4x4 A0017 1.2.0")
    assert box.labels() == LABELS
    assert box.ask("LABEL,1") == box.ask("LABEL", "1")
    assert box.tare() == "16 taxels"
    box.new_object()
    box.start()
    box.stop()
    answer = box.result(LONG_S)
    assert (answer.known, answer.label, answer.latency_ms) == (True, "wood", 1.25)
    assert [s.kind for s in speaking.heard][-3:] == ["NEW", "START", "STOP"]
    assert all(s.summed for s in speaking.heard)


def test_the_answer_of_a_hand_has_those_of_its_fingers(speaking, box):
    """FIN before RES, of this sweep alone, not counted as answers."""
    speaking.say(finger("left", 6))
    speaking.say(finger("left", 7))
    speaking.say(finger("right", 7, "no-contact", "", "0.000"))
    speaking.say(result(7))
    answer = box.result(LONG_S)
    assert [(f.finger, f.sweep, f.status, f.label) for f in answer.fingers] == [
        ("left", 7, "ok", "wood"),
        ("right", 7, "no-contact", ""),
    ]
    assert answer.finger == ""
    speaking.say(result(8))
    assert box.result(LONG_S).fingers == ()
    assert box.damaged == 0


def test_answers_are_given_in_order_with_their_gaps(speaking):
    """Sweeps 2 and 3 were answered but not heard; 3 comes late after all. REC and kinds of later
    versions are skipped. A listener hears answers and states once each."""
    heard: list[Answer | BoxState] = []
    with Palpate(str(speaking.path), timeout_s=LONG_S, listener=heard.append) as box:
        box.wait_ready(LONG_S)
        speaking.say(state(), sentence("REC", 7, "stored", 5), sentence("NEW", 1))
        speaking.say(result(1), result(4, "unsure"), result(3), result(5), state(answered=5))
        found = [box.result(LONG_S) for _ in range(4)]
        box.state()
        assert [one.missed for one in found] == [0, 2, 0, 0]
        assert [one.status for one in found[:2]] == [Status.OK, Status.UNSURE]
        assert (box.missed, box.restarts, box.damaged) == (1, 0, 0)
    assert [type(one) for one in heard] == [BoxState, *[Answer] * 4, BoxState]


def test_a_restart_of_the_program_is_no_gap(speaking, box):
    """Told once, whatever shows it first; answers meanwhile are counted."""
    speaking.say(result(40), state(answered=40), result(1), state(answered=1))
    box.result(LONG_S)
    assert box.result(LONG_S).missed == 0
    speaking.say(state(answered=3), state(answered=1), result(2))
    assert box.result(LONG_S).missed == 0
    assert (box.restarts, box.missed) == (2, 1)


def test_damage_is_counted_and_never_believed(speaking, box):
    """A flipped character, a missing checksum, noise, an endless line, a status of a newer box: no
    answer, a count, and the gap at the next. An ANS without a checksum answers nothing."""
    speaking.say(
        result(1),
        result(2).replace(b"wood", b"wo0d"),
        b"$PPLP,RES,3\r\n",
        b"\xff\xfe\r\n",
        b"x" * 5000,
        b"\r\n",
        result(4),
    )
    assert [box.result(LONG_S).sweep, box.result(LONG_S).missed] == [1, 2]
    assert box.damaged == 4
    assert "without" in box.damage
    speaking.say(result(5, "sideways"))
    box.state()
    with pytest.raises(NoAnswer, match="'sideways'"):
        box.result(SHORT_S)
    speaking.script = lambda s: [sentence("ANS", s.kind, "ok").partition(b"*")[0] + b"\r\n"]
    with pytest.raises(NoAnswer):
        box.ask("NEW", timeout_s=SHORT_S)
    eventually(lambda: box.damaged == 6)


@pytest.mark.parametrize("kind", ["START", ""])
def test_a_command_that_is_refused(speaking, box, kind):
    """The box's reason is raised, also for a command that was damaged on its way. The late answer
    to an abandoned command is not taken for that to the next command."""
    speaking.script = lambda s: [sentence("ANS", kind, "error", "set trigger.mode")]
    with pytest.raises(CommandRefused, match="trigger"):
        box.start()
    speaking.script = lambda s: [sentence("ANS", "TARE", "error", "late"), *obeying(s)]
    assert box.state().skin == "streaming"


@pytest.mark.parametrize(
    ("ask", "answer"),
    [
        (Palpate.state, sentence("ANS", "STATE", "ok")),
        (Palpate.state, sentence("ANS", "STATE", "ok", "now", "streaming")),
        (Palpate.identify, sentence("ANS", "ID", "ok", "mine")),
        (Palpate.labels, sentence("ANS", "LABEL", "ok", 2, "wood", 3)),
        (Palpate.labels, sentence("ANS", "LABEL", "ok")),
    ],
)
def test_an_answer_of_another_form(speaking, box, ask, answer):
    """Fields that are missing are an error, not a guess."""
    speaking.script = lambda s: [answer]
    with pytest.raises(FormatError):
        ask(box)


@pytest.mark.parametrize("ask", [Palpate.state, Palpate.result, Palpate.wait_ready])
def test_a_silent_box(speaking, box, ask):
    """Nothing is waited for without end."""
    speaking.script = lambda s: []
    with pytest.raises(NoAnswer, match=r"within 0\.05 s"):
        ask(box, SHORT_S)


@pytest.mark.parametrize(
    ("said", "why"), [(("lost",), "the skin is lost"), (("streaming",), "a sweep is open")]
)
def test_a_box_that_is_not_ready(speaking, box, said, why):
    """The reason stands in the error."""
    fields = state(*said, sweeping=int(said[0] == "streaming")).decode().strip()[10:-3].split(",")
    speaking.script = lambda s: [sentence("ANS", "STATE", "ok", *fields)]
    with pytest.raises(NoAnswer, match=why):
        box.wait_ready(SHORT_S)


def waiting(job: Callable[[], object]) -> tuple[threading.Thread, list[ApplianceError]]:
    """Run a job in a thread; the errors that end it."""
    errors: list[ApplianceError] = []

    def run() -> None:
        try:
            job()
        except ApplianceError as e:
            errors.append(e)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


@pytest.mark.parametrize("job", [lambda box: box.ask("TEST"), lambda box: box.result(LONG_S)])
def test_unplugging_ends_every_wait(speaking, box, job):
    """A pending command ends at once; after plugging in the client goes on."""
    speaking.script = lambda s: [] if s.kind == "TEST" else obeying(s)
    thread, errors = waiting(lambda: job(box))
    if "result" not in job.__code__.co_names:
        speaking.wait_for("TEST")
    speaking.unplug()
    thread.join(LONG_S / 2)
    assert not thread.is_alive()
    assert isinstance(errors[0], LinkLost)
    with pytest.raises(LinkLost):
        box.start()
    speaking.plug_in()
    assert box.wait_ready(LONG_S).ready
    eventually(lambda: box.trouble == "")


def test_a_port_is_not_closed_while_a_command_is_written():
    """The reading thread waits, and the command fails as lost."""
    began, closed, early = threading.Event(), threading.Event(), []

    class FailingPort:
        """It is lost as soon as something is written to it."""

        port, in_waiting = "/dev/none", 0

        def read(self, n: int) -> bytes:
            if began.wait(0.01):
                raise OSError("unplugged")
            return b""

        def write(self, data: bytes) -> None:
            began.set()
            early.append(closed.wait(0.2))

        def close(self) -> None:
            closed.set()

    with Palpate("/dev/none", opener=FailingPort) as box:
        with pytest.raises(LinkLost, match="unplugged"):
            box.ask("TEST", timeout_s=LONG_S)
        eventually(closed.is_set)
    assert early[0] is False


def test_a_port_that_is_not_there(tmp_path):
    """Commands fail at once and name it, `wait_ready` at its deadline."""
    with Palpate(str(tmp_path / "ttyUSB0")) as box:
        with pytest.raises(NoAnswer, match=r"0\.05 s: .*ttyUSB0"):
            box.wait_ready(SHORT_S)
        with pytest.raises(LinkLost, match="ttyUSB0"):
            box.tare()
        with pytest.raises(LinkLost, match="ttyUSB0"):
            box.result(LONG_S)

    def refuse() -> None:
        raise serial.SerialException(13, "permission denied")

    with Palpate("COM7", opener=refuse) as box, pytest.raises(NoAnswer, match="permission"):
        box.wait_ready(SHORT_S)


def test_old_answers_are_dropped(speaking, box):
    """Of too many the oldest, counted; a late one by `wait_ready` and by `start`."""
    for number in range(1, KEPT + 3):
        speaking.say(result(number))
        if number % 16 == 0:
            box.state()  # the line can hold some kilobytes
    box.state()
    assert box.result(LONG_S).sweep == 3
    assert box.missed == 2
    for forget in (lambda: box.wait_ready(LONG_S), box.start):
        speaking.say(result(8, label="paper"))
        box.state()  # its answer comes after that
        forget()
        with pytest.raises(NoAnswer):
            box.result(SHORT_S)


def test_sentences_arrive_whole_and_threads_do_not_mix(speaking, box):
    """A read gives 4,095 bytes at most; two threads that ask get their own answers."""
    told = state() * (40_000 // len(state()))
    speaking.say(result(1), told, result(2), told, result(3))
    assert [box.result(LONG_S).sweep for _ in range(3)] == [1, 2, 3]
    assert (box.damaged, box.missed) == (0, 0)
    names: list[str] = []
    threads = [waiting(lambda: names.append(box.identify().name))[0] for _ in range(8)]
    states = [box.state().skin for _ in range(8)]
    for thread in threads:
        thread.join(LONG_S)
    assert (names, states) == (["mine"] * 8, ["streaming"] * 8)


def test_a_socket_in_place_of_a_port():
    """`socket://host:port` by pyserial; closed or silent, it is opened again."""

    class ShiftedClock(SystemClock):
        """The real clock, which a test can put forward."""

        ahead_ns = 0

        def now_ns(self) -> int:
            """Real time plus an added time."""
            return super().now_ns() + self.ahead_ns

    def accepted(server: socket) -> socket | None:
        """The next connection, None where none has come yet."""
        return server.accept()[0] if select.select([server], [], [], 0.1)[0] else None

    clock = ShiftedClock()
    with create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LONG_S)
        with Palpate(
            f"socket://127.0.0.1:{server.getsockname()[1]}", timeout_s=LONG_S, clock=clock
        ) as box:
            first, _ = server.accept()
            first.sendall(result(1))
            assert box.result(LONG_S).label == "wood"
            first.close()
            silent, _ = server.accept()
            third = silent
            while third is silent:
                clock.ahead_ns += 2 * line.SILENT_NS
                third = accepted(server) or silent
            eventually(lambda: box.trouble == "")
            third.sendall(result(2))
            assert box.result(LONG_S).sweep == 2
            silent.close()
            third.close()
