"""The serial line over TCP: the sentences and commands of peers; the pseudo-terminal; limits."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress

import pytest
import serial

from palpate.bridges import tcp
from palpate.bridges.server import QUIET_S, TcpServer
from palpate.bridges.source import LinkPort
from palpate.client.box import Palpate
from palpate.core.errors import CommandRefused, ConfigError
from palpate.core.sentences import Sentence, read, sentence
from tests.factories.bridges import LONG_S, bridge, eventually
from tests.factories.paths import ROOT
from tests.factories.speaking_box import LABELS, finger, result, state

pytestmark = pytest.mark.usefixtures("hurried")

Address = tuple[str, int]


def url(address: Address) -> str:
    """The URL for the client."""
    return f"socket://{address[0]}:{address[1]}"


def test_the_client_works_through_it(box):
    """A sweep from end to end, and the answer of a hand with its fingers."""
    with (
        bridge("tcp", "--port", box.path, "--allow-writes") as address,
        Palpate(url(address), timeout_s=LONG_S) as client,
    ):
        client.wait_ready(LONG_S)
        client.start(speed_mm_s=30.5, force_n=1.5)
        client.stop()
        assert client.result(LONG_S).label == "wood"
        assert client.labels() == LABELS
        box.say(finger("left", 7), finger("right", 7, "no-contact", "", "0.000"), result(7))
        fingers = client.result(LONG_S).fingers
        assert [(of.finger, of.label) for of in fingers] == [("left", "wood"), ("right", "")]
    assert [s.fields for s in box.heard if s.kind == "START"] == [["30.5", "1.5"]]


def test_the_short_form_fits_a_string_of_80_characters(box):
    """The longest of each kind: status, label, probability."""
    long_label = "plastic very rough, black"[:24].replace(",", " ")
    longest = (
        *(1_234_567, "1234567.123", "displaced", long_label, "0.987", "0.981", 12, 1234, "1234.56"),
        *("9f3c2a1b", "replay", "1.00", "a long detail about taxels that are broken"),
    )
    lines = [sentence("RES", *longest), state(), result(2)]
    with (
        bridge("tcp", "--port", box.path, "--short") as address,
        socket.create_connection(address, timeout=LONG_S) as peer,
    ):
        peer.sendall(b"$PPLP,START\r\n")
        heard = peer.recv(4096)
        box.say(*lines)
        while heard.count(b"\n") < 1 + len(lines):
            heard += peer.recv(4096)
    found = [line + b"\n" for line in heard.split(b"\n")[:-1]]
    assert all(len(line) <= 80 for line in found)
    told = [read(line) for line in found]
    assert [one.kind for one in told] == ["ANS", "RES", "STA", "RES"]
    assert all(one.summed and not one.error for one in told)
    assert told[0].fields[:2] == ["START", "error"]
    assert told[1].fields[:5] == [str(value) for value in longest[:5]]
    assert told[3].fields == read(result(2)).fields[: len(told[3].fields)]


def test_without_leave_questions_alone_are_passed_on(box):
    """STATE, ID and LABEL are answered; the box never hears what would change something."""
    with (
        bridge("tcp", "--port", box.path) as address,
        Palpate(url(address), timeout_s=LONG_S) as client,
    ):
        assert client.state().skin == "streaming"
        assert client.identify().name == "mine"
        for ask in (client.start, client.stop, client.tare, client.new_object, client.abort):
            with pytest.raises(CommandRefused, match="read-only"):
                ask()
    assert {s.kind for s in box.heard} == {"STATE", "ID"}


def test_every_peer_hears_everything_and_noise_stays_out(box):
    """The same sentences for two peers, answers to the asker alone."""
    with bridge("tcp", "--port", box.path) as address:
        peers = [socket.create_connection(address, timeout=LONG_S) for _ in range(2)]
        for peer, command in zip(peers, (b"ID", b"STATE"), strict=True):
            peer.sendall(b"$PPLP," + command + b"\r\n")
            # so it is served by now
            assert peer.recv(4096).startswith(b"$PPLP,ANS," + command + b",ok,")
        box.say(result(1).replace(b"wood", b"wo0d"), b"\xff\xfe\r\n", state(), result(2))
        for peer in peers:
            heard = b""
            while not heard.endswith(result(2)):
                heard += peer.recv(4096)
            assert heard == state() + result(2)
            peer.close()


def test_what_a_peer_says_wrong_is_answered_to_it_alone(box):
    """Noise, an endless line and a wrong checksum: an error each; the box hears none of it."""
    with bridge("tcp", "--port", box.path, "--allow-writes") as address:
        with socket.create_connection(address, timeout=LONG_S) as peer:
            peer.sendall(b"hello\r\n" + b"x" * 100_000 + b"\r\n$PPLP,START*00\r\n$PPLP,ID\r\n")
            heard = b""
            while b"ANS,ID" not in heard:
                heard += peer.recv(4096)
        assert heard.count(b",error,") == 3
        assert b"without an end" in heard
    assert [s.kind for s in box.heard] == ["ID"]


START = b"$PPLP,START\r\n"
BROWSERS = {
    "a form": (b"POST / HTTP/1.1\r\nHost: box:1503\r\n\r\n" + START,),
    "a long path": (b"POST /" + b"a" * 3000 + b" HTTP/1.1\r\n\r\n" + START,),
    "in pieces": (b"PO", b"ST", b" ", b"/ HTTP/1.1\r\n" + START),
    "a preflight of all": (b"OPTIONS * HTTP/1.1\r\n" + START,),
    "a WebSocket": (b"GET ws://box:1503/ HTTP/1.1\r\n" + START,),
    "a proxy": (b"CONNECT box.example:1503 HTTP/1.1\r\n" + START,),
    "a ticket of TLS": (b"\x16\x03\x01\x02\x00\r\n" + START,),
}
"""What the page of anybody can make a browser send to this port, in pieces."""


@pytest.mark.parametrize("pieces", BROWSERS.values(), ids=BROWSERS)
def test_a_browser_commands_nothing(box, pieces):
    """It is dropped at its first bytes, with leave to write; the other peer is served."""
    with bridge("tcp", "--port", box.path, "--allow-writes") as address:
        with socket.create_connection(address, timeout=LONG_S) as page:
            page.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with suppress(ConnectionError):
                for piece in pieces:
                    page.sendall(piece)
            assert b"ANS" not in all_of(page)
        with socket.create_connection(address, timeout=LONG_S) as peer:
            peer.sendall(b"PPLP ID\r\n")
            assert b"ANS,ID,ok" in peer.recv(4096)
    assert {s.kind for s in box.heard} == {"ID"}


def test_a_line_that_is_gone(box):
    """A command is answered with the reason; when the line is back the same connection works."""

    def ask_often(client: Palpate) -> None:
        """Ask until the bridge has noticed that the line is gone."""
        for _ in range(1000):
            client.ask("ID", timeout_s=LONG_S)

    with (
        bridge("tcp", "--port", box.path, "--allow-writes") as address,
        Palpate(url(address), timeout_s=LONG_S) as client,
    ):
        client.wait_ready(LONG_S)
        box.unplug()
        with pytest.raises(CommandRefused, match=r"was lost|cannot be opened|does not take"):
            ask_often(client)
        box.plug_in()
        assert client.wait_ready(LONG_S).ready


def all_of(peer: socket.socket) -> bytes:
    """All bytes until the connection ends."""
    got = b""
    with peer, suppress(ConnectionError):  # reset: what waited is gone
        while more := peer.recv(1 << 16):
            got += more
    return got


def test_a_peer_that_never_reads_is_given_up(box):
    """It fills its buffer and is dropped; the other peer gets every sentence."""
    with bridge("tcp", "--port", box.path) as address:
        deaf = socket.socket()
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        deaf.connect(address)
        with socket.create_connection(address, timeout=LONG_S) as peer:
            peer.sendall(b"$PPLP,ID\r\n")
            heard = peer.recv(4096)
            for number in range(1, 5_001):
                box.say(result(number))
                if number % 20 == 0:  # the pseudo-terminal holds 4 kB
                    while not heard.endswith(result(number)):
                        heard += peer.recv(1 << 16)
            assert heard.count(b"$PPLP,RES,") == 5_000
        deaf.settimeout(LONG_S)
        assert all_of(deaf).count(b"$PPLP,RES,") < 5_000


def test_a_dead_peer_is_found_by_the_kernel():
    """Keep-alive within minutes, so that a live peer may be silent as long as it likes."""

    async def run() -> list[int]:
        server = TcpServer(lambda peer: asyncio.sleep(LONG_S), most=1)
        await server.open("127.0.0.1", 0)
        await asyncio.open_connection(*server.address)
        while not server.peers:
            await asyncio.sleep(0)
        (peer,) = server.peers
        kept = peer._writer.get_extra_info("socket")
        names = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        return [
            kept.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
            *(kept.getsockopt(socket.IPPROTO_TCP, name) for name in names),
        ]

    on, idle_s, every_s, times = asyncio.run(run())
    assert on
    assert idle_s + every_s * times <= 300


class DeafPort:
    """A port that accepts all bytes."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.in_waiting = 0

    def read(self, size: int) -> bytes:
        """Nothing comes."""
        threading.Event().wait(0.01)
        return b""

    def write(self, data: bytes) -> None:
        """Keep it."""
        self.written.append(data)

    def close(self) -> None:
        """Nothing to close."""


def test_a_flood_of_commands_does_not_reach_the_box(monkeypatch):
    """Of many commands at once one is sent, the next after its pause, whichever peer's."""
    monkeypatch.setattr(tcp, "PACE_S", 3600.0)
    monkeypatch.setattr(tcp, "ANSWER_S", 0.01)
    port = DeafPort()

    async def run() -> None:
        bridge = tcp.TcpBridge(
            "x", lambda: port, writes=True, most=9, loop=asyncio.get_running_loop()
        )
        flood = [asyncio.create_task(bridge._ask(Sentence("STATE"))) for _ in range(200)]
        while not port.written:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)
        for task in flood:
            task.cancel()
        bridge.close()

    asyncio.run(run())
    assert port.written == [sentence("STATE")]


def test_a_box_that_does_not_answer(monkeypatch):
    """The peer gets an error; an answer that comes too late, or to another command, is dropped."""
    monkeypatch.setattr(tcp, "ANSWER_S", 0.1)
    monkeypatch.setattr(tcp, "PACE_S", 0.0)

    async def run() -> list[bytes]:
        bridge = tcp.TcpBridge("x", DeafPort, writes=True, most=9, loop=asyncio.get_running_loop())
        said = [await bridge._ask(Sentence("START"))]
        bridge._heard(Sentence("ANS", "START,ok", summed=True))
        asking = asyncio.create_task(bridge._ask(Sentence("STOP")))
        while "STOP" not in bridge._asked:
            await asyncio.sleep(0)
        bridge._heard(Sentence("ANS", "START,ok", summed=True))
        bridge._heard(Sentence("ANS", "STOP,ok", summed=True))
        said.append(await asking)
        bridge.close()
        return said

    late, right = asyncio.run(run())
    assert late.startswith(b"$PPLP,ANS,START,error,the box has not answered within 0.1 s")
    assert right == sentence("ANS", "STOP", "ok")


def test_a_command_that_waits_for_the_disk(monkeypatch):
    """Another peer's question is answered before it, and it gets its own answer later than any
    other command would; a second one waits for the first."""
    monkeypatch.setattr(tcp, "ANSWER_S", 0.1)
    monkeypatch.setattr(tcp, "PACE_S", 0.0)
    port = DeafPort()

    async def run() -> list[bytes]:
        bridge = tcp.TcpBridge(
            "x", lambda: port, writes=True, most=9, loop=asyncio.get_running_loop()
        )
        storing = [asyncio.create_task(bridge._ask(Sentence(kind))) for kind in ("DISCARD", "UNDO")]
        while sentence("DISCARD") not in port.written:
            await asyncio.sleep(0.01)
        said = [await bridge._ask(Sentence("STATE"))]
        asking = asyncio.create_task(bridge._ask(Sentence("LABEL")))
        while "LABEL" not in bridge._asked:
            await asyncio.sleep(0)
        bridge._heard(Sentence("ANS", "LABEL,ok", summed=True))
        said.append(await asking)
        assert sentence("UNDO") not in port.written
        bridge._heard(Sentence("ANS", "DISCARD,ok", summed=True))
        said.append(await storing[0])
        storing[1].cancel()
        bridge.close()
        return said

    state, label, discard = asyncio.run(run())
    assert b"ANS,STATE,error" in state
    assert label == sentence("ANS", "LABEL", "ok")
    assert discard == sentence("ANS", "DISCARD", "ok")


def test_a_question_that_is_cancelled_as_its_answer_arrives_ends():
    """With 3.11's wait_for the bridge never ended."""

    async def run() -> bool:
        bridge = tcp.TcpBridge("x", DeafPort, writes=True, most=9, loop=asyncio.get_running_loop())
        asking = asyncio.create_task(bridge._ask(Sentence("STOP")))
        while "STOP" not in bridge._asked:
            await asyncio.sleep(0)
        await asyncio.sleep(0.05)
        bridge._pass_on(Sentence("ANS", "STOP,ok", summed=True))
        asking.cancel()
        await asyncio.wait([asking])
        bridge.close()
        return asking.cancelled()

    assert asyncio.run(run())


def test_a_silent_peer_makes_room():
    """A full server drops the peer that has been silent longest, none that has spoken lately."""

    async def run() -> None:
        server = TcpServer(lambda peer: asyncio.sleep(LONG_S), most=2)
        await server.open("127.0.0.1", 0)
        for _ in range(2):
            await asyncio.open_connection(*server.address)
        while len(server.peers) < 2:
            await asyncio.sleep(0)
        first, second = server.peers
        first.heard_s, second.heard_s = 100.0, 101.0
        assert not server._make_room(100.0 + QUIET_S - 0.1)
        assert server._make_room(100.0 + QUIET_S)
        assert server.peers == {second}

    asyncio.run(run())


def test_a_box_opens_what_the_bridge_makes(tmp_path):
    """--link for serial.port; earlier bytes are not read; it goes with the bridge."""
    path = tmp_path / "line"
    with bridge("tcp", "--link", path, "--allow-writes") as address:
        with (
            socket.create_connection(address, timeout=LONG_S) as peer,
            serial.Serial(str(path)) as near,
        ):
            peer.sendall(b"hello\r\n")
            assert b"not a command" in peer.recv(4096)  # so it is served by now
            near.write(state())  # stands for the box
            assert peer.recv(4096) == state()
        assert path.is_symlink()
    eventually(lambda: not path.is_symlink())


def test_a_link_that_was_left_behind(tmp_path):
    """The link of a killed bridge is replaced; another program's file is not."""
    path = tmp_path / "line"
    path.symlink_to("/dev/pts/999999")
    port = LinkPort(path)
    assert os.readlink(path) != "/dev/pts/999999"
    assert port.read(port.in_waiting or 1) == b""
    port.close()
    path.write_text("mine")
    with pytest.raises(ConfigError, match="name"):
        LinkPort(path)
    assert path.read_text() == "mine"


def test_a_link_that_nobody_reads(tmp_path):
    """Writing does not hang: if the buffer is full it raises."""
    port = LinkPort(tmp_path / "line")
    with pytest.raises(BlockingIOError):
        port.write(sentence("ID") * 10_000)
    port.close()


def test_it_ends_with_the_service_manager(box):
    """SIGTERM: exit code 0 within the time of one command, with a peer connected."""
    command = [*(sys.executable, "-m", "palpate", "bridge", "tcp"), *("--listen", "127.0.0.1:0")]
    with subprocess.Popen(
        [*command, "--port", str(box.path)], cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        line = process.stderr.readline()
        assert "--allow-writes" in line
        port = int(line.partition("127.0.0.1:")[2].partition(",")[0])
        with socket.create_connection(("127.0.0.1", port), timeout=LONG_S):
            process.send_signal(signal.SIGTERM)
            assert process.wait(LONG_S) == 0
