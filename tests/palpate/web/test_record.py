"""The page of a recording: the loop carries out orders, refuses others, never waits."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from palpate.cli.main import main
from palpate.core.clock import SystemClock
from palpate.core.config import TriggerConfig
from palpate.core.errors import ApplianceError, ConfigError, FormatError
from palpate.core.sentences import Reply
from palpate.core.sweep_file import sidecar
from palpate.core.types import Status
from palpate.io.robot_link import Command
from palpate.sim import skin
from palpate.sweeps import sweep_folder
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.web import record, server
from palpate.web.access import ROLES, Access
from palpate.web.record import MOST_WAITING, RecordPage, order
from palpate.web.server import PageServer
from tests.factories.browser import WAIT_S, until
from tests.factories.page_client import EventReader, PageAddress, ask, port, status
from tests.factories.recorded_page import KIND, RecordedPage, key_of, ordered
from tests.factories.simulated_box import idle_devices
from tests.factories.slow_disk import SlowDisk, full

ALLOWED = ("MATERIAL", "POSITION", "SESSION", "NEXT", "DISCARD")
WOOD = {"command": "MATERIAL", "text": "wood"}


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[RecordedPage]:
    """A recording with a page, whose turns the test takes."""
    one = RecordedPage(tmp_path, Labels("metal", "1"))
    with one.page:
        yield one
    one.recording.close()


class Asking:
    """Orders on their way, each in a thread of its own."""

    def __init__(self, recorded: RecordedPage, *bodies: dict[str, str]) -> None:
        key, self.answers = key_of(recorded.page.server), []
        self.threads = [
            threading.Thread(
                target=lambda b=body: self.answers.append(ordered(recorded.page.server, key, b))
            )
            for body in bodies
        ]
        for thread in self.threads:
            thread.start()

    def finished(self) -> list[int]:
        """The status of each answer, when all are there."""
        for thread in self.threads:
            thread.join(WAIT_S)
        return [status(answer) for answer in self.answers]


def waiting(recorded: RecordedPage) -> int:
    """How many commands wait for the loop."""
    return recorded.page._queue._waiting.qsize()


@pytest.mark.parametrize(
    ("body", "command"),
    [
        (b'{"command": "MATERIAL", "text": " a b "}', Command("MATERIAL", "a b")),
        (b'{"command": "POSITION", "text": "\\n7\\t"}', Command("POSITION", "7")),
        (b'{"command": "SESSION", "text": ""}', Command("SESSION")),
        (b'{"command": "NEXT"}', Command("NEXT")),
        (b'{"command": "DISCARD", "text": "7"}', Command("DISCARD", "7")),
    ],
)
def test_an_order_is_a_command_of_the_serial_line(body, command):
    """With its text, or without one."""
    assert order(body, ALLOWED) == command


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"\xff\xfe",
        b"[" * 1000,
        b'{"text": "wood"}',
        b'{"command": ["NEXT"]}',
        b'{"command": "START"}',
        b'{"command": "next"}',
        b'{"command": "MATERIAL", "text": 7}',
        b'{"command": "NEXT", "more": 1}',
        b'{"command": "NEXT", "text": "7"}',
        b'{"command": "DISCARD", "text": "-1"}',
        '{"command": "DISCARD", "text": "²"}'.encode(),
        b'{"command": "MATERIAL\\n"}',
    ],
)
def test_what_is_no_order(body):
    """Each is refused with one line that describes an order."""
    with pytest.raises(FormatError, match=r"^[^\n]+$"):
        order(body, ALLOWED)


@pytest.mark.parametrize("text", ["-1", "a,b", "blé", "x" * 25, "a\nb", "$"])
@pytest.mark.parametrize("name", record.LABELS)
def test_a_bad_label_is_refused_as_the_command_refuses_it(tmp_path, name, text):
    """In the command's words, before the loop or a capture gets the order."""
    recording = RecordingSession(
        tmp_path, skin.FORMAT, Labels(), idle_devices().clock, lambda line: None
    )
    with pytest.raises(ApplianceError) as by_command:
        recording.commands[name](text)
    with pytest.raises(ConfigError) as by_page:
        order(json.dumps({"command": name, "text": text}).encode(), ALLOWED)
    assert str(by_page.value) == str(by_command.value)


def test_labels_from_the_page_are_those_of_the_stored_sweep(rigged, tmp_path):
    """On a whole box, by the page alone, after the robot had set other labels."""
    simulated, box = idle_devices(), None
    recording = RecordingSession(
        tmp_path, skin.FORMAT, Labels(), simulated.clock, lambda line: None
    )
    page = RecordPage(
        Access(0),
        skin.FORMAT,
        "sim",
        TriggerConfig(mode="serial"),
        recording.about,
        lambda command: box.box.obey(command),
        simulated.clock,
    )
    box = rigged(
        simulated,
        ("trigger.mode=serial",),
        observers=[recording, page],
        commands=recording.commands,
    )

    def by_page(name: str, text: str = "") -> object:
        answers: list[bytes] = []
        body = {"command": name, "text": text}
        thread = threading.Thread(
            target=lambda: answers.append(ordered(page.server, page.server.key, body))
        )
        thread.start()
        until(lambda: page._queue._waiting.qsize() == 1)
        box.box.step()
        thread.join(WAIT_S)
        assert status(answers[0]) == 200
        return json.loads(answers[0].partition(b"\r\n\r\n")[2])

    with page:
        box.seconds(1)
        assert ",MATERIAL,ok,paper,,*" in box.ask("$PPLP,MATERIAL,paper")
        assert by_page("MATERIAL", "plastic rough") == ["plastic rough", "", ""]
        assert by_page("POSITION", "09") == ["plastic rough", "09", ""]
        assert by_page("NEXT") == ["plastic rough", "10", ""]
        assert by_page("SESSION", "monday") == ["plastic rough", "10", "monday"]
        assert by_page("START") == []
        box.seconds(3)
        assert by_page("STOP") == []
        box.until(lambda: box.box.answered == 1)
        about = sidecar(tmp_path / "sweep-000001.npy")
        labels = [about[name] for name in ("material", "position", "session")]
        assert labels == ["plastic rough", "10", "monday"]
        assert by_page("DISCARD", "1") == [1, 0, "sweep-000001"]
        assert not (tmp_path / "sweep-000001.npy").exists()
    assert not any(",ANS,START" in line or ",ANS,NEXT" in line for line in box.heard)


def test_the_page_hears_what_there_is(recorded):
    """All of the recording; the skin while a browser is connected."""
    reader = EventReader(recorded.page.server)
    assert reader.until("key") == recorded.page.server.key
    until(lambda: recorded.page.server.watched)
    recorded.turn()
    told = {"material": "metal", "position": "1", "counts": [], "last": None}
    assert reader.until("recording").items() >= told.items()
    assert recorded.sweep(detail="contact not checked") == 1
    assert reader.until("sweep")["detail"] == "contact not checked"
    recorded.turn()
    said = reader.until("recording")
    told = {"counts": [["metal", "1", 1]], "missing": "missing: metal at 1: 2", "discard": 1}
    assert said.items() >= told.items()
    assert (said["last"]["outcome"], said["last"]["detail"]) == ("stored", "sweep-000001")
    before = recorded.page._view_ns
    until(lambda: (recorded.turn(), recorded.page._view_ns != before)[1])
    assert reader.until("view")["shape"] == [4, 4]
    reader.socket.close()


REFUSED: list[tuple[int, dict[str, str | None]]] = [
    (403, {"X_Palpate_Key": None}),
    (403, {"X_Palpate_Key": "wrong"}),
    (403, {"X_Palpate_Key": "ö"}),
    (403, {"Origin": None}),
    (403, {"Origin": "null"}),
    (403, {"Origin": "http://evil.example"}),
    (403, {"Origin": "http://localhost"}),
    (403, {"Origin": "http://localhost:1"}),
    (415, {"Content_Type": None}),
    (415, {"Content_Type": "text/plain"}),
    (415, {"Content_Type": "application/x-www-form-urlencoded"}),
]


def test_a_role_has_its_orders_and_those_of_the_roles_before(tmp_path):
    """A refused one does not reach the loop."""

    class Obedient(RecordedPage):
        """Notes each command, and does nothing."""

        def obey(self, command: Command) -> Reply:
            self.done.append(command.line)
            return []

    tokens = tuple(f"{role}0123456789abcdef" for role in ROLES)
    with Obedient(tmp_path, Labels(), access=Access(0, tokens=tokens), teaching=True) as one:
        for asked, codes in (("START", (409, 200, 200)), ("USE", (409, 409, 200))):
            for token, code in zip(tokens, codes, strict=True):
                bearer = {"Authorization": f"Bearer {token}"}
                answer = ordered(one.page.server, one.page.server.key, {"command": asked}, **bearer)
                assert status(answer) == code, (asked, token)
        assert status(ordered(one.page.server, one.page.server.key, {"command": "START"})) == 401
        assert one.done == ["START", "START", "USE"]


def test_an_order_of_another_site_is_refused(recorded):
    """Requests that a page of another site can send are refused: wrong or missing key, another
    origin, a content type without preflight, other methods, a preflight among them, and a name that
    is not this machine's. Each run has a key of its own."""
    page, key = recorded.page.server, key_of(recorded.page.server)
    assert key != PageServer("watch.html", Access(0), SystemClock().now_ns).key
    for answer, changed in REFUSED:
        assert status(ordered(page, key, WOOD, **changed)) == answer, changed
    here = f"localhost:{port(page)}"
    others = (("GET", here), ("PUT", here), ("OPTIONS", here), ("POST", "evil"), ("POST", ""))
    for method, host in others:
        more = f"Origin: http://{host}\r\nX-Palpate-Key: {key}\r\nContent-Type: {KIND}\r\n"
        more += "Content-Length: 2\r\n"
        answer = 421 if method == "POST" else 405
        assert status(ask(page, "/order", method, host, more, body=b"{}")) == answer, method
    assert waiting(recorded) == 0
    assert recorded.recording.about()["material"] == "metal"


@pytest.mark.parametrize("chunked", [False, True])
def test_too_large_a_body_is_refused(recorded, chunked):
    """Announced or in chunks, it is not read to its end; the next request is answered."""
    page = recorded.page.server
    body = json.dumps({"command": "MATERIAL", "text": "x" * 2000}).encode()
    more: dict[str, str | None] = {}
    if chunked:
        body = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
        more = {"Content_Length": None, "Transfer_Encoding": "chunked"}
    assert status(ordered(page, page.key, body, **more)) in (0, 400)
    assert waiting(recorded) == 0
    assert status(ask(page)) == 200


def test_refusals_say_why(recorded, tmp_path):
    """With the value; labels stay; orders that wait at the end are refused."""
    page = recorded.page.server
    answer = ordered(page, page.key, {"command": "MATERIAL", "text": "-1"})
    assert (status(answer), b"text/plain" in answer, b"'-1'" in answer) == (409, True, True)
    assert status(ordered(page, page.key, b"{}")) == 400
    asking = Asking(recorded, {"command": "DISCARD"})
    until(lambda: waiting(recorded) == 1)
    recorded.turn()
    assert asking.finished() == [409]
    assert recorded.recording.about()["material"] == "metal"
    ending = RecordedPage(tmp_path / "another", Labels())
    with ending.page:
        asking = Asking(ending, WOOD, WOOD)
        until(lambda: waiting(ending) == 2)
    assert asking.finished() == [503, 503]
    assert all(b"ended" in answer for answer in asking.answers)
    assert ending.done == []
    ending.recording.close()


def test_many_requests_wait_in_bounds_and_the_loop_takes_one_a_turn(recorded, monkeypatch):
    """Beyond MOST_WAITING they are refused at once; each turn takes one."""
    monkeypatch.setattr(server, "DONE_S", 60.0)  # a busy machine sends the requests slowly
    asking = Asking(recorded, *[WOOD] * (MOST_WAITING + 6))
    until(lambda: len(asking.answers) == 6)
    assert waiting(recorded) == MOST_WAITING
    assert {status(answer) for answer in asking.answers} == {503}
    assert b"16 commands" in asking.answers[0]
    for done in range(1, MOST_WAITING + 1):
        recorded.turn()
        assert len(recorded.done) == done
    assert sorted(asking.finished()) == [200] * MOST_WAITING + [503] * 6


@pytest.mark.parametrize(
    ("under_way", "why"), [(False, b"was not carried out"), (True, b"may still be carried out")]
)
def test_a_loop_that_is_late(recorded, monkeypatch, under_way, why):
    """After DONE_S: under way, or never taken up and never done later."""
    monkeypatch.setattr(server, "DONE_S", 0.05)
    answered, turns = threading.Event(), []
    if under_way:
        monkeypatch.setattr(recorded.page, "_obey", lambda command: [answered.wait(WAIT_S)])
        # the loop takes the order up before the page stops waiting, also on a busy machine
        monkeypatch.setattr(server, "DONE_S", 1.0)
    asking = Asking(recorded, WOOD)
    if under_way:
        until(lambda: waiting(recorded) == 1)
        turns = [threading.Thread(target=recorded.turn)]
        turns[0].start()
    assert asking.finished() == [503]
    assert why in asking.answers[0]
    answered.set()
    for turn in turns:
        turn.join()
    recorded.turn()
    assert recorded.done == []


@pytest.mark.parametrize(("works", "answer"), [(True, 200), (False, 409)])
def test_an_answer_that_waits_for_the_disk_reaches_the_page(tmp_path, monkeypatch, works, answer):
    """Once the disk has done it or failed; then the next turn shows the change."""
    monkeypatch.setattr(server, "DONE_S", 60.0)  # a busy machine is slow, too
    disk = SlowDisk()
    one = RecordedPage(tmp_path, Labels("metal"), disk=disk)
    with one.page:
        one.sweep()
        disk.settle()
        asking = Asking(one, {"command": "DISCARD"})
        until(lambda: waiting(one) == 1)
        one.turn()
        assert asking.answers == []
        assert one.page._state != ()
        if not works:
            monkeypatch.setattr(sweep_folder.storage, "sync", full)
        disk.settle()
        assert asking.finished() == [answer]
        assert one.page._state == ()
    said = b'[1, 0, "sweep-000001"]' if works else b"No space left"
    assert said in asking.answers[0]
    one.recording.close()


def test_a_sweep_is_drawn_once(recorded, monkeypatch):
    """Only the last sweep has a picture, and none without a window."""
    drawn: list[int] = []
    draw = record.picture
    monkeypatch.setattr(
        record, "picture", lambda window: (drawn.append(window.sweep), draw(window))[1]
    )
    page = recorded.page.server
    recorded.sweep()
    recorded.sweep()
    answers = [ask(page, f"/sweep/{n}") for n in (2, 2, 2, 1, 3)]
    assert [status(answer) for answer in answers] == [200, 200, 200, 404, 404]
    assert json.loads(answers[0].partition(b"\r\n\r\n")[2])["seconds"] == 2.0
    assert drawn == [2]
    recorded.sweep(Status.SHORT)
    assert status(ask(page, "/sweep/3")) == 404


@pytest.mark.slow
def test_the_command_records_what_its_page_orders(tmp_path):
    """The real command without a serial line; it ends with the page open."""
    words = "-m palpate record --sim skin --trigger serial --web 0 --set store.runtime= --out"
    command = [sys.executable, *words.split(), str(tmp_path)]
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    with subprocess.Popen(command, text=True, **pipes) as run:
        there = PageAddress(re.search(r"page: (http://127\.0\.0\.1:\d+)", run.stderr.readline())[1])
        draining = threading.Thread(target=run.stderr.read, daemon=True)
        draining.start()
        reader, key = EventReader(there), key_of(there)
        until(lambda: reader.until("recording")["skin"] == "streaming")
        assert status(ordered(there, key, WOOD)) == 200
        assert status(ordered(there, key, {"command": "START"})) == 200
        until(lambda: reader.until("recording")["sweeping"])
        assert status(ordered(there, key, {"command": "STOP"})) == 200
        until(lambda: reader.until("recording")["last"] is not None)
        run.send_signal(signal.SIGTERM)
        assert run.wait(timeout=WAIT_S) == 0
        with suppress(OSError), pytest.raises(EOFError):
            reader.until("nothing")
        draining.join(WAIT_S)


def test_a_serial_trigger_needs_a_line_or_a_page(capsys, tmp_path):
    """Without either, the error names the way by the page."""
    command = ["record", "--sim", "skin", "--trigger", "serial", "--out", os.fspath(tmp_path)]
    assert main(command) == ConfigError.exit_code
    assert "--web" in capsys.readouterr().err
