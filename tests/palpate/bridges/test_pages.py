"""The programs of docs/robots: Python, and URScript read as Python."""

from __future__ import annotations

import itertools
import json
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest

from palpate.client.box import Palpate
from palpate.core.errors import NoAnswer
from palpate.core.sentences import Sentence
from palpate.core.status import Status
from tests.factories.bridges import LONG_S, bridge, eventually
from tests.factories.paths import ROOT
from tests.factories.speaking_box import SpeakingBox, obeying, result, state
from tests.robots import ros

pytestmark = pytest.mark.usefixtures("hurried")

ROBOTS = ROOT / "docs" / "robots"
FAULTS = [s for s in Status if not s.classified and s not in (Status.UNKNOWN, Status.RECORDED)]


def answering(*statuses: str) -> Callable[[Sentence], list[bytes]]:
    """A script: each STOP is answered with the next status."""
    numbers, left = itertools.count(1), iter(statuses)

    def script(heard: Sentence) -> list[bytes]:
        answer = [result(next(numbers), next(left))] if heard.kind == "STOP" else []
        return [*obeying(heard)[:1], *answer]

    return script


def sweeps(box: SpeakingBox) -> list[str]:
    """The commands of sweeps that the box has heard."""
    return [s.kind for s in box.heard if s.kind in ("NEW", "START", "STOP")]


def test_python(box):
    """`unsure` is swept again without NEW, final ones are set aside, each fault is an error."""
    names: dict[str, Any] = {}
    exec((ROBOTS / "classify.py").read_text(), names)
    with Palpate(str(box.path), timeout_s=LONG_S) as client:
        box.script = answering(
            "unsure", "ok", "undecided", "unknown", "unsure", "unsure", "unsure", *FAULTS
        )
        assert names["classify"](client, lambda: None) == "wood"
        assert sweeps(box) == ["NEW", "START", "STOP", "START", "STOP"]
        assert [names["classify"](client, lambda: None) for _ in range(3)] == [None] * 3
        for status in FAULTS:
            with pytest.raises(RuntimeError, match=f"{status}: "):
                names["classify"](client, lambda: None)


class SocketOfUr:
    """`socket_*` of URScript, as the Script Directory describes them."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address, self._rest = address, ""
        self._socket: socket.socket | None = None

    def open(self, host: str, port: int, name: str) -> bool:
        """The page's address stands for that of the test's bridge."""
        assert (host, port, name) == ("192.168.0.10", 1503, "palpate")
        try:
            self._socket = socket.create_connection(self._address, timeout=LONG_S)
        except OSError:
            return False
        self._rest = ""
        return True

    def read(self, name: str, prefix: str = "", suffix: str = "", timeout: float = 2) -> str:
        """The text between prefix and suffix, without them; "" at the time-out."""
        deadline = threading.Event()
        timer = threading.Timer(timeout, deadline.set)
        timer.start()
        try:
            while not deadline.is_set():
                _, found, after = self._rest.partition(prefix)
                text, ended, rest = after.partition(suffix)
                if found and ended:
                    self._rest = rest
                    return text
                self._socket.settimeout(timeout)
                self._rest += self._socket.recv(4096).decode("ascii")
        except TimeoutError:
            return ""
        finally:
            timer.cancel()
        return ""

    def send_line(self, text: str, name: str) -> bool:
        """Send a line."""
        self._socket.sendall(text.encode() + b"\n")
        return True

    def close(self, name: str) -> None:
        """Close."""
        self._socket.close()


def urscript(program: str, **functions: Any) -> dict[str, Any]:
    """A program in URScript as Python, without `end` and `local`; functions: the controller's."""
    text = re.sub(r"(?m)^ *end\n", "", program).replace("local ", "")
    names: dict[str, Any] = {
        "str_find": lambda text, what, start=0: text.find(what, start),
        "str_len": len,
        "str_sub": lambda text, at, n: text[at : at + n],
        "str_cat": lambda a, b: a + b,
        "textmsg": lambda *texts: None,
        "movel": lambda pose, a, v: None,
        **functions,
    }
    exec(text, names)
    return names


def test_urscript_by_socket(box):
    """palpate_socket.script against a real bridge: a retry without NEW, each fault by its name."""

    def by_socket(address: tuple[str, int]) -> dict[str, Any]:
        """The program with a socket."""
        ur = SocketOfUr(address)
        return urscript(
            (ROBOTS / "palpate_socket.script").read_text(),
            socket_open=ur.open,
            socket_read_string=ur.read,
            socket_send_line=ur.send_line,
            socket_close=ur.close,
        )

    with bridge("tcp", "--port", box.path, "--allow-writes") as address:
        classify = by_socket(address)["palpate_classify"]
        box.script = answering("unsure", "ok", "undecided", "unknown", "unsure", "unsure", *FAULTS)
        assert classify("from", "to", 3) == "wood"
        assert sweeps(box) == ["NEW", "START", "STOP", "START", "STOP"]
        assert [classify("from", "to", 2) for _ in range(3)] == [""] * 3
        assert [classify("from", "to", 2) for _ in FAULTS] == [
            f"fault: {status}" for status in FAULTS
        ]


@pytest.mark.parametrize(
    ("ready", "answers", "want"),
    [
        (True, [3], 3),
        (True, [0, 5], 5),
        (True, [0, 0, 0], 0),
        (False, [], -1),
        (True, [None], -2),
        (True, ["fault"], -3),
    ],
)
def test_urscript_by_lines(ready, answers, want):
    """palpate_lines.script: READY is waited for, code 0 is swept again, FAULT ends it."""
    inputs = {0: ready} | dict.fromkeys(range(1, 7), False)
    pulsed: list[int] = []
    left = iter(answers)

    def set_output(output: int, level: bool) -> None:
        if level:
            pulsed.append(output)
        if level and output == 0:
            inputs[1] = False
        if level and output == 1:
            answer = next(left)
            inputs[1], inputs[2] = answer is not None, answer == "fault"
            code = answer if isinstance(answer, int) else 0
            inputs.update({3 + bit: bool(code >> bit & 1) for bit in range(4)})

    program = urscript(
        (ROBOTS / "palpate_lines.script").read_text(),
        get_standard_digital_in=lambda n: inputs[n],
        set_standard_digital_out=set_output,
        sleep=lambda seconds: None,
    )
    assert program["palpate_classify"]("from", "to", 3) == want
    assert pulsed == [2, *[0, 1] * len(answers)]


@pytest.mark.parametrize(
    ("program", "settings"),
    [("Toucher", {"timeout_s": 20.0}), ("Sweeper", {"timeout_s": 20.0, "slide_s": 0.1})],
    ids=["services", "action"],
)
def test_ros(box, program, settings):
    """ros2_services.py, ros2_sweep.py: a node in a process of its own, by both."""
    ros.required()
    ros.messages_required()
    box.script = answering("unsure", "ok", "unknown", "stuck-taxel", "unsure", "unsure", "unsure")
    command = [
        str(ros.PYTHON),
        str(ROOT / "tests" / "robots" / "ros_page.py"),
        program,
        json.dumps(settings),
    ]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with ros.bridge("-p", f"port:={box.path}", "-p", "allow_writes:=true"), ros.peer() as peer:
        eventually(lambda: bool(box.say(state()) or peer.on("state")))
        with subprocess.Popen(command, env=ros.environment(), **pipes) as cell:
            action = (ROBOTS / "ros2_sweep.py").read_text()
            by_services = (ROBOTS / "ros2_services.py").read_text()
            cell.stdin.write(action if program == "Sweeper" else by_services)
            cell.stdin.close()
            told = [json.loads(cell.stdout.readline()) for _ in range(4)]
            cell.kill()
    assert told[:2] == ["wood", None]
    assert told[2].startswith("RuntimeError: ")
    assert "constant" in told[2]
    assert told[3] is None
    assert sweeps(box)[:5] == ["NEW", "START", "STOP", "START", "STOP"]


@pytest.mark.slow
@pytest.mark.thorough  # starts processes and waits for them
def test_the_manuals_client_without_hardware(tmp_path):
    """Its three commands: the program prints three answers, all `ok`."""
    text = (ROOT / "docs" / "how-to" / "write-a-client.md").read_text()
    blocks = [
        re.sub(r"(?m)^    ", "", block)
        for block in re.findall(r"(?:^    .*\n|^\n)+", text, re.M)
        if block.strip()
    ]
    commands, program = blocks[0].strip().splitlines(), blocks[1]
    line = str(tmp_path / "line")
    assert commands[2] == "python3 client.py"
    words = [command.replace("/tmp/palpate-line", line).split()[1:] for command in commands[:2]]
    assert [given[0] for given in words] == ["bridge", "run"]
    quiet = ["--set", "store.runtime="]
    command = [sys.executable, "-m", "palpate", *words[1], *quiet]
    with bridge(words[0][1], *words[0][2:]) as address, subprocess.Popen(command, cwd=ROOT) as run:
        try:
            client = program.replace("127.0.0.1:1503", f"{address[0]}:{address[1]}")
            assert client != program
            # the box needs a moment to start, as with a person in three terminals
            (tmp_path / "client.py").write_text(
                client.replace("as box:\n", "as box:\n    box.wait_ready(timeout_s=60)\n", 1)
            )
            done = subprocess.run(
                [sys.executable, tmp_path / "client.py"],
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                capture_output=True,
                text=True,
                timeout=120,
                check=False,
            )
        finally:
            run.terminate()
    told = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert told[0].startswith("BoxIdentity(name='default'")
    assert len(told) == 4
    assert [line.split()[0] for line in told[1:]] == ["ok"] * 3, told


@pytest.mark.slow
@pytest.mark.thorough  # starts processes and waits for them
def test_a_box_that_is_killed_and_started_again(tmp_path):
    """Killed within a sweep: the wait ends, the restart is counted, the client sweeps on."""
    command = [sys.executable, "-m", "palpate", "run", "--sim", "skin", "--trigger", "serial"]
    command += ["--set", f"serial.port={tmp_path / 'line'}", "--set", "store.runtime="]
    with (
        bridge("tcp", "--link", tmp_path / "line", "--allow-writes") as address,
        Palpate(f"socket://{address[0]}:{address[1]}", timeout_s=LONG_S) as client,
    ):
        for life in range(2):
            with subprocess.Popen(command, cwd=ROOT) as run:
                client.wait_ready(2 * LONG_S)
                for _ in range(2):
                    client.start()
                    client.abort()
                    assert client.result(LONG_S).status is Status.ABORTED
                    client.stop()
                assert (client.restarts, client.missed) == (life, 0)
                client.wait_ready(LONG_S)
                client.start()
                run.kill()
            with pytest.raises(NoAnswer):
                client.result(0.5)
