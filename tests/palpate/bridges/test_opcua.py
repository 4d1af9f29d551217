"""The OPC UA bridge, seen by the library's client."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError
from tests.factories.bridges import LONG_S, bridge, eventually
from tests.factories.speaking_box import SpeakingBox, result, state
from tests.robots.attackers import HELLO

opcua_security = pytest.importorskip(
    "palpate.bridges.opcua_security", reason="palpate[opcua] is not installed"
)
ua = pytest.importorskip("asyncua.ua")
SECURE = pytest.importorskip("asyncua.crypto.security_policies").SecurityPolicyBasic256Sha256
Client = pytest.importorskip("asyncua.sync").Client

PASSWORD = "s3cret"
REFUSED = (ua.UaError, ConnectionError, TimeoutError, OSError)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The bridge's folder, with a login."""
    made = tmp_path / "opcua"
    made.mkdir()
    (made / "login").touch(0o600)
    (made / "login").write_text(f"plc\n{PASSWORD}\n")
    return made


@contextmanager
def served(box: SpeakingBox, folder: Path, *more: str) -> Iterator[str]:
    """A bridge from the box; yields its URL."""
    options = ("--port", str(box.path), "--folder", str(folder), "--name", "b1", *more)
    with bridge("opcua", *options) as (host, port):
        yield f"opc.tcp://{host}:{port}/"


@contextmanager
def reader(url: str) -> Iterator[Any]:
    """A client without a name and without encryption."""
    with Client(url, timeout=LONG_S) as one:
        yield one


@contextmanager
def user(url: str, tmp_path: Path, password: str = PASSWORD) -> Iterator[Any]:
    """An encrypted client with a password and a certificate of its own."""
    own = tmp_path / f"client-{password}"
    own.mkdir(exist_ok=True)
    opcua_security.own_certificate(own, "urn:test", "127.0.0.1")
    one = Client(url, timeout=LONG_S)
    one.set_user("plc")
    one.set_password(password)
    one.set_security(SECURE, str(own / "certificate.der"), str(own / "key.pem"))
    with one:
        yield one


def node(client: Any, path: str) -> Any:
    """The node at a path."""
    return client.get_node(f"ns=2;s={path}")


def value(client: Any, path: str) -> Any:
    """The value of a variable; None if its quality is bad."""
    read = node(client, path).read_data_value(raise_on_bad_status=False)
    return read.Value.Value if read.StatusCode.is_good() else None


def heard(box: SpeakingBox, client: Any) -> None:
    """Wait until the box is heard through the bridge, which opens the line in its own time."""
    path = "VisionStateMachine.Skin"
    eventually(lambda: box.say(state()) or value(client, path) == "streaming")


@pytest.mark.slow
def test_a_result_its_event_and_the_end_of_the_box(box, folder):
    """A result comes whole, and as an event; without the box nothing is good."""

    class Changes:
        """Keeps the notifications of a subscription."""

        def __init__(self) -> None:
            self.values: list[Any] = []
            self.events: list[Any] = []

        def datachange_notification(self, of: Any, found: Any, data: Any) -> None:
            self.values.append(found)

        def event_notification(self, event: Any) -> None:
            self.events.append(event)

    def quality(client: Any, path: str) -> str:
        """The name of a variable's status."""
        return str(node(client, path).read_data_value(raise_on_bad_status=False).StatusCode.name)

    with served(box, folder, "--anonymous") as url, reader(url) as client:
        eventually(
            lambda: box.say(state()) or value(client, "VisionStateMachine.Skin") == "streaming"
        )
        assert value(client, "VisionStateMachine.CurrentState").Text == "Ready"
        assert value(client, "VisionStateMachine.CurrentState.Number") == 6
        assert quality(client, "LastResult.Label") == "BadWaitingForInitialData"
        changes = Changes()
        subscription = client.create_subscription(0, changes)
        subscription.subscribe_data_change(node(client, "LastResult.ResultId"))
        kind = client.nodes.base_event_type.get_child("2:ResultReadyEventType")
        subscription.subscribe_events(client.nodes.server, kind)
        box.say(state(sweeping=1))
        eventually(lambda: value(client, "VisionStateMachine.CurrentState.Number") == 7)
        for number in range(1, 21):
            box.say(result(number, label="paper"))
        eventually(lambda: len(changes.events) == 20 and len(changes.values) >= 20)
        assert [event.JobId for event in changes.events] == [*range(1, 21)]
        assert [int(text.rpartition("-")[2]) for text in changes.values if text] == [*range(1, 21)]
        assert (changes.events[0].Label, changes.events[0].ResultState) == ("paper", 1)
        found = {
            name: value(client, f"LastResult.{name}") for name in ("Material", "Status", "JobId")
        }
        assert found == {"Material": "paper", "Status": "ok", "JobId": 20}
        assert value(client, "LastResult.Probability") == pytest.approx(0.9)
        assert value(client, "LastResult.EndTime") <= value(client, "LastResult.CreationTime")
        eventually(lambda: quality(client, "LastResult.Label") == "BadNoCommunication")
        assert quality(client, "VisionStateMachine.CurrentState") == "BadNoCommunication"
        eventually(lambda: box.say(state("absent")) or value(client, "LastResult.Label") == "paper")
        assert value(client, "VisionStateMachine.CurrentState").Text == "Error"


@pytest.mark.slow
def test_results_of_a_client_that_was_away(box, folder):
    """It asks by time, and gets them in order, at most as many as it wants."""
    with served(box, folder) as url, user(url, folder.parent) as client:
        eventually(
            lambda: box.say(state()) or value(client, "VisionStateMachine.Skin") == "streaming"
        )
        before = datetime.now(UTC) - timedelta(seconds=1)
        for number in range(1, 8):
            box.say(result(number, "unsure" if number == 3 else "ok"))
        eventually(lambda: value(client, "LastResult.JobId") == 7)
        get = node(client, "LastResult.GetResults")

        def results(*given: Any) -> list[Any]:
            return [json.loads(one) for one in node(client, "LastResult").call_method(get, *given)]

        since = ua.Variant(before, ua.VariantType.DateTime)
        found = results(since, 5)
        assert [each["sweep"] for each in found] == [1, 2, 3, 4, 5]
        assert (found[2]["status"], found[2]["probability"]) == ("unsure", 0.9)
        later = datetime.fromtimestamp(found[-1]["at"], UTC)
        rest = results(ua.Variant(later, ua.VariantType.DateTime), 0)
        assert [each["sweep"] for each in rest][-2:] == [6, 7]
        dates = ua.Variant([before, before], ua.VariantType.DateTime)
        for given in ((1, 5), (since, "x"), (dates, 5)):
            with pytest.raises(ua.uaerrors.BadInvalidArgument):
                results(*given)


@pytest.mark.slow
def test_methods_and_the_types_of_their_arguments(box, folder):
    """With --allow-writes methods reach the box. A number of any type is taken; a text, a boolean,
    a list, no number, one too large, too many or too few are refused, and the box hears nothing."""
    with served(box, folder, "--allow-writes") as url, user(url, folder.parent) as client:
        eventually(
            lambda: box.say(state()) or value(client, "VisionStateMachine.Skin") == "streaming"
        )
        machine = node(client, "VisionStateMachine")

        def call(name: str, *given: Any) -> None:
            machine.call_method(node(client, f"VisionStateMachine.{name}"), *given)

        wrong = (True, "5", [5.0, 5.0], float("nan"), -1.0, 1e9)
        for given in (*((5.0, each) for each in wrong), (), (5.0,), (5.0, 5.0, 5.0)):
            with pytest.raises(ua.UaStatusCodeError):
                call("Start", *given)
        assert not [one for one in box.heard if one.kind == "START"]
        call("Start", ua.Variant(40.0, ua.VariantType.Float), ua.Variant(2, ua.VariantType.Int16))
        call("Stop")
        box.wait_for("STOP")
        assert next(one for one in box.heard if one.kind == "START").fields[:2] == ["40", "2"]
        call("Tare")
        assert "TARE" in value(client, "VisionStateMachine.LastReply")
        with pytest.raises(ua.UaStatusCodeError):
            node(client, "LastResult.Label").write_value("wood")


@pytest.mark.slow
def test_users(box, folder, caplog):
    """Without --anonymous only the user with the password gets in, and only encrypted; without
    --allow-writes it finds no methods; with --anonymous, a reader calls none."""
    with served(box, folder) as url:
        with user(url, folder.parent) as client:
            names = [
                one.read_browse_name().Name
                for one in node(client, "VisionStateMachine").get_children()
            ]
            assert "CurrentState" in names
            assert "Start" not in names
        with pytest.raises(REFUSED), reader(url):
            pass
        with pytest.raises(REFUSED), user(url, folder.parent, "other"):
            pass
        assert "refused" in caplog.text
        assert PASSWORD not in caplog.text
    users = opcua_security.Login("plc", PASSWORD, SystemClock(), anonymous=False)
    assert users.get_user(None, "plc", PASSWORD, b"of a client")
    for given in (("plc", PASSWORD, None), ("plc", "", b"x"), (None, None, b"x"), ("", "", b"x")):
        assert users.get_user(None, *given) is None
    with served(box, folder, "--anonymous", "--allow-writes") as url, reader(url) as client:
        with pytest.raises(ua.UaStatusCodeError):
            node(client, "VisionStateMachine").call_method(node(client, "VisionStateMachine.Tare"))
        assert "TARE" not in [one.kind for one in box.heard]


@pytest.mark.slow
def test_hostile_bytes(box, folder, caplog):
    """Other protocols, endless messages, silent connections are closed; a client reads on, and the
    log does not fill."""
    with served(box, folder, "--anonymous") as url, reader(url) as client:
        port = int(url.rpartition(":")[2].strip("/"))
        endless = b"HELF" + (0xFFFFFFF0).to_bytes(4, "little")
        for head in (b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01", b"\0" * 64, endless):
            one = socket.create_connection(("127.0.0.1", port), timeout=LONG_S)
            with one, suppress(OSError):
                for _ in range(200):
                    one.sendall(head + b"\xff" * 60_000)
                while one.recv(4096):
                    pass
            box.say(state())
            assert client.nodes.server.get_children()
        for _ in range(50):  # asks much, and goes before the answers
            one = socket.create_connection(("127.0.0.1", port), timeout=LONG_S)
            one.sendall(HELLO * 50)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            one.close()
        silent = [socket.create_connection(("127.0.0.1", port), timeout=LONG_S) for _ in range(40)]
        assert client.nodes.server.get_children()
        for one in silent:
            one.close()
    assert not [one for one in caplog.records if one.name.startswith("asyncio")]


@pytest.mark.slow
def test_the_nodes_of_the_standard(box, folder):
    """A client that walks through the whole server finds each node that another refers to, with its
    type; and the status of the server, its limits and the fields of events are there."""
    with served(box, folder, "--anonymous") as url, reader(url) as client:
        known, waiting = set(), [client.nodes.root.nodeid]
        while waiting:
            known.add(at := waiting.pop())
            named = client.get_node(at).get_references()
            for one in named:
                if one.NodeId not in known and one.NodeId not in waiting:
                    waiting.append(one.NodeId)
            assert client.get_node(at).read_browse_name().Name
        identifiers = {one.Identifier for one in known if one.NamespaceIndex == 0}
        assert identifiers > {*range(1, 13), 58, 61, 63, 68, 84, 85, 2041, 2253}
        assert client.nodes.server_state.read_value() == ua.ServerState.Running
        limit = client.get_node(
            ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerRead
        )
        assert limit.read_value() == 10_000
        fields = {
            one.read_browse_name().Name for one in client.nodes.base_event_type.get_children()
        }
        assert fields > {"EventId", "EventType", "Message", "Severity", "SourceName", "Time"}


def test_without_a_login_it_does_not_start(box, tmp_path):
    """Neither a login nor --anonymous: refused with what to do."""
    with pytest.raises(ConfigError, match="--anonymous"), served(box, tmp_path / "none"):
        pass


def test_the_certificate_is_made_once(tmp_path):
    """The second start has the first one's, also of a box with a new name: clients compare the URI
    with the certificate. Others cannot read the key."""
    first = opcua_security.own_certificate(tmp_path / "a", "urn:x", "192.168.0.10")
    assert opcua_security.own_certificate(tmp_path / "a", "urn:y", "192.168.0.11") == first
    assert first[2] == "urn:x"
    assert (tmp_path / "a" / "key.pem").stat().st_mode & 0o077 == 0
    (tmp_path / "b").touch()
    with pytest.raises(ConfigError, match="--folder"):
        opcua_security.own_certificate(tmp_path / "b", "urn:x", "::")


@pytest.mark.parametrize("wrong", ["certificate.der", "key.pem", "other key.pem"])
def test_a_certificate_and_a_key_that_are_no_pair(tmp_path, wrong):
    """Of a copy that was cut short, or of two boxes: refused with what to do."""
    for name in ("a", "b"):
        opcua_security.own_certificate(tmp_path / name, "urn:x", "127.0.0.1")
    other, _, name = wrong.rpartition(" ")
    text = (tmp_path / "b" / name).read_bytes()
    (tmp_path / "a" / name).write_bytes(text if other else text[:50])
    with pytest.raises(ConfigError, match="delete both"):
        opcua_security.own_certificate(tmp_path / "a", "urn:x", "127.0.0.1")
