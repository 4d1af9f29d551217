"""The MQTT bridge at mosquitto, seen by mosquitto_sub; and brokers that refuse or close."""

from __future__ import annotations

import json
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import pytest

from palpate.bridges.source import COMMANDS
from palpate.client.verdicts import VerdictFile
from palpate.core import config, retry
from palpate.core.errors import ConfigError
from palpate.service.network import box_name
from tests.factories.bridges import LONG_S, bridge, eventually
from tests.factories.paths import NO_SITE
from tests.factories.speaking_box import SpeakingBox, result, state
from tests.robots.brokers import Mosquitto, Subscriber, TopicFlood, free_port, required

mqtt = pytest.importorskip("palpate.bridges.mqtt", reason="palpate[mqtt] is not installed")
broker = pytest.importorskip("palpate.bridges.mqtt").broker
pytestmark = pytest.mark.usefixtures("hurried")


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker for everybody."""
    required()
    with Mosquitto(tmp_path) as one:
        yield one


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pauses of hundredths of a second between two tries."""
    monkeypatch.setattr(retry, "FIRST_S", 0.02)
    monkeypatch.setattr(retry, "MOST_S", 0.05)


def options(server: Mosquitto, box: SpeakingBox, *more: str) -> tuple[str, ...]:
    """The options of a bridge from the box to the broker."""
    return ("--port", str(box.path), "--broker", server.url, "--name", "b1", *more)


def online(box: SpeakingBox, one: Subscriber) -> None:
    """Wait until the box is heard through the bridge, which opens the line in its own time."""
    eventually(lambda: box.say(state()) or one.last("b1/status") == "online")


@pytest.mark.slow
def test_another_client_reads_the_verdict(server, box):
    """mosquitto_sub gets verdict, state and status, and the same retained ones later."""
    with Subscriber(server.port, "palpate/#") as one, bridge("mqtt", *options(server, box)):
        online(box, one)
        box.say(result(7, label="paper"), state(answered=1))
        eventually(lambda: one.last("/verdict") and '"answered": 1' in one.last("/state"))
        fields = json.loads(one.last("/verdict"))
        wanted = {"sweep": 7, "status": "ok", "label": "paper", "material": "paper"}
        assert fields | wanted | {"probability": 0.9, "late": False} == fields
        assert json.loads(one.last("/state"))["ready"] is True
        assert one.last("/status") == "online"
        with Subscriber(server.port, "palpate/#") as later:
            for topic in ("/status", "/verdict", "/state"):
                eventually(lambda topic=topic: later.last(topic) == one.last(topic))


@pytest.mark.slow
def test_nothing_is_lost_while_the_broker_is_away(server, box, monkeypatch):
    """The newest come in order, marked late; older ones are counted."""
    monkeypatch.setattr(mqtt, "KEPT", 50)
    monkeypatch.setattr(mqtt, "LATE_NS", 200_000_000)
    with bridge("mqtt", *options(server, box)):
        with Subscriber(server.port) as before:
            online(box, before)
        server.stop()
        for number in range(1, 61):
            box.say(result(number))
        threading.Event().wait(0.5)
        server.start()
        with Subscriber(server.port) as one:
            eventually(lambda: '"dropped": 10' in one.last("/state"))
            box.say(state(), result(61))
            eventually(lambda: one.all("/verdict")[-1:] and one.all("/verdict")[-1]["sweep"] == 61)
            # what was sent before this client subscribed, only the retained one is left of
            found = {each["sweep"]: each["late"] for each in one.all("/verdict")}
            assert [*found] == sorted(found)
            assert not found.pop(61)
            assert all(found.values())


@pytest.mark.slow
def test_the_backlog_is_complete(server, box):
    """A session that outlives the broker's pause gets all 200 verdicts in order."""
    with Subscriber(server.port, kept=True) as one, bridge("mqtt", *options(server, box)):
        online(box, one)
        server.stop()
        for number in range(1, 201):
            box.say(result(number))
        server.start()
        eventually(lambda: one.last("/verdict") and one.all("/verdict")[-1]["sweep"] == 200)
        assert [*dict.fromkeys(e["sweep"] for e in one.all("/verdict"))] == [*range(1, 201)]


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["stopped", "box"])
def test_the_status_when_it_ends(server, box, ending):
    """offline, retained: when the bridge ends, and when the box is not heard."""
    with Subscriber(server.port) as one:
        with bridge("mqtt", *options(server, box)):
            online(box, one)
            if ending == "box":
                eventually(lambda: one.last("/status") == "offline")
        eventually(lambda: one.last("/status") == "offline")
        said = [text for name, text in one.messages if name.endswith("/status")]
        assert "online" in said[: said.index("offline", said.index("online"))]


@pytest.mark.slow
def test_commands_only_where_they_are_allowed(server, box):
    """Without --allow-writes none; with it neither retained nor unknown ones."""
    with Subscriber(server.port) as one:
        with bridge("mqtt", *options(server, box)):
            online(box, one)
            one.publish("palpate/b1/command", "START")
        assert "START" not in [each.kind for each in box.heard]
        one.publish("palpate/b1/command", "TARE", retain=True)
        with bridge("mqtt", *options(server, box, "--allow-writes")):
            eventually(lambda: one.last("b1/status") == "offline")
            online(box, one)
            for number, command in enumerate(("NEW", "START", "FORMAT", "STOP"), 1):
                one.publish("palpate/b1/command", command)
                eventually(lambda number=number: len(one.all("/reply")) == number)
    assert [e.kind for e in box.heard if e.kind in COMMANDS] == ["NEW", "START", "STOP"]
    assert ["error" in each["reply"] for each in one.all("/reply")] == [False, False, True, False]


@pytest.mark.slow
def test_results_that_a_client_missed(server, box, tmp_path, monkeypatch):
    """Asked by time, also without --allow-writes, the bridge sends its results of this run; after a
    restart of both it sends those of the file, too. Other texts are refused."""
    file = tmp_path / "verdicts.db"
    settings = config.load(None, [f"bridge.memory={file}"], site=NO_SITE)
    monkeypatch.setattr(config, "load", lambda board: settings)
    began = datetime.now(UTC)
    rows = VerdictFile(file)
    for number in range(1, 4):
        rows.add(began.timestamp() + number / 1e6, {"sweep": number, "status": "ok", "label": "x"})
    rows.close()
    with Subscriber(server.port) as one, bridge("mqtt", *options(server, box)):
        online(box, one)
        now = datetime.now(UTC)
        times = (began.isoformat(), now.isoformat(), str(now.timestamp()), "yesterday")
        for number, since in enumerate(times, 1):
            box.say(result(10 + number))
            eventually(lambda n=number: f'"sweep": {10 + n}' in one.last("/verdict"))
            one.publish("palpate/b1/since", since)
            eventually(lambda n=number: len(one.all("/reply")) == n)
        before, after, numbered, wrong = (each["reply"] for each in one.all("/reply"))
        assert [row["sweep"] for row in before] == [1, 2, 3, 11]
        assert [(row["sweep"], row["probability"]) for row in after] == [(11, 0.9), (12, 0.9)]
        assert [row["sweep"] for row in numbered] == [11, 12, 13]
        assert "yesterday" in wrong


@pytest.mark.slow
def test_a_flood_of_commands(server, box, monkeypatch):
    """Commands come as fast as a client can send them, for as long as 20 verdicts take: every
    verdict is there before the flood ends, few commands reach the box, and one that is sent
    after the flood is obeyed."""
    monkeypatch.setattr(mqtt, "PAUSE_NS", 200_000_000)
    with Subscriber(server.port) as one, bridge("mqtt", *options(server, box, "--allow-writes")):
        online(box, one)
        flooding = TopicFlood(server.port, "palpate/b1/command", ["TARE", "x" * 900])
        with flooding:
            for number in range(1, 21):
                box.say(state(), result(number))
                eventually(lambda n=number: n in {e["sweep"] for e in one.all("/verdict")})
            sent = flooding.sent
        assert sent > 5000
        assert len([each for each in box.heard if each.kind == "TARE"]) < sent / 20
        assert any("error" in each["reply"] for each in one.all("/reply"))
        eventually(
            lambda: one.publish("palpate/b1/command", "NEW") or "NEW" in [e.kind for e in box.heard]
        )


@pytest.mark.slow
def test_login_and_a_wrong_one(tmp_path, box, caplog):
    """The right password is taken; a wrong one is refused, with a reason, and tried again."""
    required()
    users = tmp_path / "users"
    subprocess.run(
        ["mosquitto_passwd", "-b", "-c", users, "box", "s3cret"], check=True, timeout=LONG_S
    )
    login = tmp_path / "login"
    login.touch(0o600)
    with Mosquitto(tmp_path, f"password_file {users}", anonymous=False) as server:
        login.write_text("box\nnot-s3cret\n")
        with bridge("mqtt", *options(server, box, "--login", str(login))):
            eventually(lambda: "not authorized" in caplog.text)
        login.write_text("box\ns3cret\n")
        with bridge("mqtt", *options(server, box, "--login", str(login))):
            eventually(lambda: "connected to" in caplog.text)
    assert "s3cret" not in caplog.text


@pytest.mark.slow
def test_tls(tmp_path, box, caplog):
    """With the broker's certificate in --ca the bridge connects; without it, it is refused."""
    required()
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    words = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    words += ["-nodes", "-days", "2", "-subj", "/CN=broker", "-keyout", str(key)]
    words += ["-addext", "subjectAltName=IP:127.0.0.1", "-out", str(certificate)]
    subprocess.run(words, check=True, timeout=LONG_S, capture_output=True)
    with Mosquitto(tmp_path, f"certfile {certificate}", f"keyfile {key}") as server:
        secure = ("--port", str(box.path), "--broker", server.url.replace("mqtt:", "mqtts:"))
        with bridge("mqtt", *secure):
            eventually(lambda: "certificate verify failed" in caplog.text)
        assert "connected to" not in caplog.text
        with bridge("mqtt", *secure, "--ca", str(certificate)):
            eventually(lambda: "connected to" in caplog.text)


def test_a_file_of_certificates_that_holds_none(tmp_path, box, caplog):
    """A reason is logged, and the bridge goes on until asked: the file may be mended."""
    (tmp_path / "ca.pem").write_text("no certificate")
    words = ("--broker", "mqtts://127.0.0.1:9", "--ca", str(tmp_path / "ca.pem"))
    with bridge("mqtt", "--port", str(box.path), *words):
        eventually(lambda: "certificate" in caplog.text)
        assert "Traceback" not in caplog.text


@pytest.mark.slow
def test_a_broker_that_refuses_verdicts(tmp_path, box):
    """Each that its rules refuse is counted as dropped."""
    required()
    rules = [f"topic write {name}" for name in ("palpate/b1/state", "palpate/b1/status", "test/#")]
    (tmp_path / "rules").write_text("\n".join(["topic read #", *rules, ""]))
    with (
        Mosquitto(tmp_path, f"acl_file {tmp_path / 'rules'}") as server,
        Subscriber(server.port, "palpate/#") as one,
        bridge("mqtt", *options(server, box)),
    ):
        online(box, one)
        box.say(result(1), result(2))
        eventually(lambda: '"dropped": 2' in one.last("/state"))
    assert one.last("/verdict") == ""


@pytest.mark.slow
def test_a_broker_that_takes_small_packets_alone(tmp_path, box, caplog):
    """The discovery is left out, and said; verdicts come."""
    required()
    with (
        Mosquitto(tmp_path, "max_packet_size 1000") as server,
        Subscriber(server.port, "#") as one,
        bridge("mqtt", *options(server, box)),
    ):
        online(box, one)
        box.say(result(1))
        eventually(lambda: one.last("/verdict") != "")
    assert "max_packet_size" in caplog.text
    assert one.last("/config") == ""


@contextmanager
def other_broker(box: SpeakingBox, silent_s: float) -> Iterator[socket.socket]:
    """A bridge's connection to a broker that the test plays, after the packet that opens it."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        other.settimeout(LONG_S)
        url = f"mqtt://127.0.0.1:{other.getsockname()[1]}"
        with bridge("mqtt", "--port", str(box.path), "--broker", url):
            line, _ = other.accept()
            with line:
                line.settimeout(silent_s)
                assert line.recv(4096)[0] == 0x10
                yield line


def test_a_broker_that_takes_few_messages_at_a_time(box):
    """No more are under way than it allows; it would end the connection."""

    def published(sent: bytes) -> int:
        """The number of PUBLISH packets."""
        found = at = 0
        while at < len(sent):
            size, shift, found, at = 0, 0, found + (sent[at] >> 4 == 3), at + 1
            while True:
                size, shift, at = size | (sent[at] & 127) << shift, shift + 7, at + 1
                if not sent[at - 1] & 128:
                    break
            at += size
        return found

    with other_broker(box, 0.5) as line:
        for number in range(20):
            box.say(state(), result(number))
        line.sendall(bytes([0x20, 6, 0, 0, 3, 0x21, 0, 2]))  # Receive Maximum 2
        sent = b""
        with suppress(TimeoutError):
            while more := line.recv(65536):
                sent += more
    assert published(sent) == 2


@pytest.mark.parametrize(
    ("begin", "why"),
    [
        (b"\x30\xff\xff\xff\x7f", "a packet of 268435455 bytes"),
        (b"\x34\x08\x00\x01t\x00\x01\x00hi", "asks for an acknowledgement"),
    ],
)
def test_a_broker_that_would_fill_the_memory(box, caplog, begin, why):
    """A message of 256 MiB, or one that waits for an acknowledgement, ends the connection."""
    with other_broker(box, LONG_S) as line:
        line.sendall(bytes([0x20, 3, 0, 0, 0]) + begin)
        eventually(lambda: why in caplog.text)
        assert "Traceback" not in caplog.text


@pytest.mark.slow
def test_two_boxes_of_one_name(server, box, caplog, tmp_path):
    """Each takes the connection of the other, with growing pauses, and the log names a cause."""
    other = ("--feed", tmp_path / "none", "--broker", server.url, "--name", "b1")
    with bridge("mqtt", *options(server, box)), bridge("mqtt", *other):
        eventually(lambda: "another box may be named b1" in caplog.text)
        assert "trying again" in caplog.text


@pytest.mark.parametrize("speech", [b"", b"HTTP/1.1 400\r\n\r\n", b"\x20\x03\x00\x00\x00\xff" * 9])
def test_no_broker_at_the_address(box, caplog, speech):
    """Whatever answers there: a reason is logged, and the bridge goes on until asked."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        ending = threading.Event()
        other.settimeout(0.1)

        def serve() -> None:
            while not ending.is_set():
                try:
                    connection, _ = other.accept()
                except TimeoutError:
                    continue
                with connection:
                    connection.sendall(speech)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            url = f"mqtt://127.0.0.1:{other.getsockname()[1]}"
            with bridge("mqtt", "--port", str(box.path), "--broker", url):
                eventually(lambda: "broker 127.0.0.1" in caplog.text or "ended" in caplog.text)
                assert "Traceback" not in caplog.text
        finally:
            ending.set()
            thread.join(LONG_S)


@pytest.mark.parametrize(
    "url", ["127.0.0.1", "http://x", "mqtt://", "mqtt://u:p@x", "mqtt://x/y", "mqtt://x:99999"]
)
def test_addresses_that_are_none(url):
    """Each is refused; a password in it is not repeated."""
    with pytest.raises(ConfigError) as refused:
        broker(url, "", "")
    assert "u:p" not in str(refused.value)


def test_login_files(tmp_path):
    """A file that all may read, or without two lines, is refused; so is a CA that is missing."""
    file = tmp_path / "login"
    file.write_text("a\nb\n")
    file.chmod(0o604)
    with pytest.raises(ConfigError, match="chmod"):
        broker("mqtt://x", str(file), "")
    file.chmod(0o600)
    assert broker("mqtts://x", str(file), "").user == "a"
    assert broker("mqtts://x", "", "").port == 8883
    file.write_text("\ufeffa\r\nb\r\n", "utf-8")  # of an editor of Windows
    found = broker("mqtts://x", str(file), "")
    assert (found.user, found.password) == ("a", "b")
    file.write_text("a")
    with pytest.raises(ConfigError, match="two lines"):
        broker("mqtt://x", str(file), "")
    with pytest.raises(ConfigError, match="PEM"):
        broker("mqtts://x", "", str(tmp_path / "none"))
    with pytest.raises(ConfigError, match="a/b"):
        box_name("a/b")
    assert box_name("")


def test_discovery_has_what_home_assistant_asks_for():
    """Each entity has a platform, an id of its own, and a topic; buttons only with writes."""
    read, written = (mqtt.discovery("b1", writes=writes) for writes in (False, True))
    for found in (read, written):
        ids = [each["unique_id"] for each in found["components"].values()]
        assert len({*ids}) == len(ids)
        assert found["origin"]["name"]
        assert found["device"]["identifiers"]
        for each in found["components"].values():
            topic = "command_topic" if each["platform"] == "button" else "state_topic"
            assert each[topic].startswith("palpate/b1/")
    pressed = {e["payload_press"] for e in written["components"].values() if "payload_press" in e}
    assert pressed == {*COMMANDS}
    assert not [e for e in read["components"].values() if e["platform"] == "button"]


def test_nobody_listens_at_the_port(box, caplog):
    """A warning says where, and the bridge goes on trying."""
    with bridge("mqtt", "--port", str(box.path), "--broker", f"mqtt://127.0.0.1:{free_port()}"):
        eventually(lambda: "--login" in caplog.text)
        assert "--login" in caplog.text
