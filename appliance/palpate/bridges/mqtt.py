"""The box at an MQTT broker: verdicts, state and Home Assistant's discovery (docs/robots/mqtt.md).

Each connection has a client object of its own: paho keeps unsent messages, so the same object
would send them after a reconnection, and we would send our copy. Everything runs in one thread; the
news of the box comes in another and wakes it.
"""

from __future__ import annotations

import json
import math
import re
import select
import socket
import ssl
import threading
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from palpate.bridges.mqtt_content import discovery, state, verdict
from palpate.bridges.options import read_login
from palpate.bridges.results import KEPT, Results
from palpate.bridges.source import COMMANDS, source_of
from palpate.client.answers import Answer
from palpate.client.box import Heard
from palpate.core import wall_clock
from palpate.core.clock import Clock
from palpate.core.errors import AddressError, ApplianceError, CommandRefused, ConfigError
from palpate.core.log import SparseLog, log
from palpate.core.retry import retried

PORTS = {"mqtt": 1883, "mqtts": 8883}
MOST_BYTES = 1024
"""Largest packet that the broker may send: commands are short."""
HEADER, LARGEST = 16, 268_435_455
"""Most bytes of a message around topic and content, and of one for which a broker sets no limit."""
FLYING = 16
"""Messages that the broker has not acknowledged, at most; the others wait here, in order. paho
would let more wait without a bound, verdicts behind all else. Brokers may allow fewer."""
LATE_NS = 1_000_000_000
"""A verdict that is sent so long after it was heard is marked late."""
KEEPALIVE_S = 20
"""The broker sends the last will if it hears nothing for half as long again."""
CONNECT_S = 5.0
LASTS_NS = 60_000_000_000
"""After a shorter connection the next one waits, longer each time, as if there were no broker: two
boxes of one name take it from each other."""
TICK_S = 0.5
"""Longest time between two looks at the state of the box and at the end of the program."""
MOST_COMMANDS, PAUSE_NS = 50, 2_000_000_000
"""Commands in a second. After more the bridge asks the broker for no commands for this time: it
would read them in place of the acknowledgements that verdicts wait for."""
BUFFER = 16 * 1024
"""Bytes that wait to be read; behind more of them, acknowledgements would come seconds late."""
AT_ONCE = 64
"""Packets that are read before verdicts are looked at again."""
SECONDS = re.compile(r"\d{10}(\.\d*)?", re.ASCII)
"""Seconds since 1970, as the replies have them; a date without hyphens has fewer digits."""
WITH_WILL = ReasonCode(PacketTypes.DISCONNECT, "Disconnect with will message")
BROKEN = (OSError, ValueError, TypeError, LookupError, AttributeError)
"""What paho raises for packets that are none, and for a connection that is not to be had."""


class BoundedClient(paho.Client):
    """Raises ValueError at a packet that is larger, or has another QoS than the bridge asks for:
    the library would keep both without a bound."""

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > MOST_BYTES:
            raise ValueError(f"a packet of {bufsize} bytes")
        return super()._sock_recv(bufsize)

    def _handle_publish(self) -> MQTTErrorCode:
        if self._in_packet["command"] & 0b110:
            raise ValueError("a message that asks for an acknowledgement")
        return super()._handle_publish()


@dataclass(frozen=True, slots=True)
class Broker:
    """Where the broker is. ca: file with the certificates to trust, "" for the system's.
    user: "" for none."""

    host: str
    port: int
    tls: bool = False
    ca: str = ""
    user: str = ""
    password: str = field(default="", repr=False)

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def broker(url: str, login: str, ca: str) -> Broker:
    """The broker at mqtt://HOST[:PORT] or mqtts://HOST[:PORT]. login: file with the user on its
    first line and the password on its second, "" for none. Raises ConfigError."""
    try:
        parts = urlsplit(url)
        scheme, host, port = parts.scheme, parts.hostname or "", parts.port
    except ValueError:
        scheme, host, port = "", "", None
    if scheme not in PORTS or not host or "@" in url or parts.path.strip("/"):
        raise ConfigError(
            f"--broker {url.rpartition('@')[2]}: not a broker's address; use mqtt://HOST:PORT or "
            "mqtts://HOST:PORT, and --login for user and password"
        )
    if ca and not Path(ca).is_file():
        raise ConfigError(f"--ca {ca}: there is no such file; name a file with certificates (PEM)")
    user, password = read_login(Path(login)) if login else ("", "")
    return Broker(host, port or PORTS[scheme], scheme == "mqtts", ca, user, password)


class MqttBridge:
    """Publishes the news of the box at the broker, and answers. name: of the box, in topics. args:
    completed by `settle`. stopped: whether the program is to end."""

    def __init__(
        self, broker: Broker, name: str, args: Namespace, clock: Clock, stopped: Callable[[], bool]
    ) -> None:
        self.dropped = 0
        self._broker, self._name, self._base = broker, name, f"palpate/{name}"
        self._clock, self._stopped, self._writes = clock, stopped, args.allow_writes
        self._results = Results(args.memory)
        # each at most once: a late START would be a wrong one
        heeded = ("since", "command")[: 1 + self._writes]
        self._heeded = [(f"{self._base}/{topic}", 0) for topic in heeded]
        self._log = SparseLog(clock.now_ns)
        self._lock = threading.Lock()
        # verdicts that the broker has not acknowledged, and when they were heard
        self._waiting: deque[tuple[int, Mapping[str, Any]]] = deque(maxlen=KEPT)
        self._first = self._next = 0  # numbers of the first that waits and of the next to send
        self._flying: dict[int, int] = {}  # message id -> number of its verdict, -1 for another
        self._most, self._largest = FLYING, LARGEST
        self._said: dict[str, str] = {}  # what the retained topics hold
        self._refused = ""
        self._there = False
        self._replies: deque[str] = deque(maxlen=FLYING)
        self._commanding = threading.Lock()
        self._second_ns = self._commands = 0  # begin of a second, and the commands in it
        self._deaf_ns: float = 0  # until then commands are left out; 0: they are heard
        self._woken, self._wakes = socket.socketpair()
        for end in (self._woken, self._wakes):
            end.setblocking(False)
        self.source = source_of(args, self._take)

    def close(self) -> None:
        self.source.close()
        self._woken.close()
        self._wakes.close()

    def _take(self, news: Heard) -> None:
        """News of the box, in the thread that reads it."""
        if isinstance(news, Answer):
            # both clocks now: the box's own time may be of another computer
            fields = {"time": wall_clock.date(), **verdict(news)}
            self._results.add(wall_clock.seconds(), news)
            with self._lock:
                full = len(self._waiting) == KEPT
                self.dropped, self._first = self.dropped + full, self._first + full
                self._waiting.append((self._clock.now_ns(), fields))
        self._wake()

    def _wake(self) -> None:
        with suppress(OSError):  # full, so it wakes anyway; or closed
            self._wakes.send(b".")

    def session(self) -> None:
        """Connections, until one has lasted or the program ends."""
        with suppress(AddressError):  # the program ends
            retried(self._connection, self._clock, self._stopped, always=True)

    def _connection(self) -> None:
        """One connection to its end. Raises AddressError if there is none, or it did not last."""
        client, begin_ns = self._connect(), self._clock.now_ns()
        log.info(f"mqtt: connected to {self._broker}")
        self._next, self._said, self._deaf_ns = 0, {}, 0
        self._flying.clear()
        try:
            self._greet(client)
            while self._there and not self._stopped():
                self._publish(client)
                self._turn(client)
            if self._there:  # the will tells everybody
                client.disconnect(WITH_WILL)
                self._turn(client)
        except BROKEN as e:
            self._refused = f"a packet that cannot be read ({e or type(e).__name__})"
        finally:
            _end(client)
        if not self._stopped():
            other = f"without a reason; if again, another box may be named {self._name}: --name"
            why = f"mqtt: {self._broker} has ended the connection: {self._refused or other}"
            if self._clock.now_ns() - begin_ns < LASTS_NS:
                raise AddressError(why)
            log.warning(f"{why}; connecting again")

    def _connect(self) -> paho.Client:
        """A client that the broker has accepted. Raises AddressError."""
        client: paho.Client | None = None
        self._there, self._refused = False, ""
        end_ns = self._clock.now_ns() + round(CONNECT_S * 1e9)
        to, asks = self._broker, Properties(PacketTypes.CONNECT)
        asks.MaximumPacketSize = MOST_BYTES
        try:
            client = self._client()
            client.connect(to.host, to.port, KEEPALIVE_S, clean_start=True, properties=asks)
            line: Any = client.socket()
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            while not self._there and not self._refused and self._clock.now_ns() < end_ns:
                self._turn(client)
                if client.socket() is None:
                    self._refused = self._refused or "it has closed the connection"
        except BROKEN as e:
            self._there = False  # also behind the packet that accepts
            self._refused = str(getattr(e, "strerror", None) or e).lower() or type(e).__name__
        if client and self._there:
            return client
        _end(client)
        raise AddressError(
            f"broker {to}: {self._refused or f'no answer within {CONNECT_S:g} s'}; check "
            "its address, --login and --ca, and whether it speaks MQTT 5"
        )

    def _client(self) -> paho.Client:
        name = f"palpate-{self._name}"
        client = BoundedClient(CallbackAPIVersion.VERSION2, name, protocol=paho.MQTTv5)
        client.connect_timeout = CONNECT_S
        if self._broker.user:
            client.username_pw_set(self._broker.user, self._broker.password)
        if self._broker.tls:
            client.tls_set_context(ssl.create_default_context(cafile=self._broker.ca or None))
        client.will_set(f"{self._base}/status", "offline", qos=1, retain=True)
        client.on_connect = self._connected
        client.on_disconnect = self._disconnected
        client.on_publish = self._acknowledged
        client.on_message = self._command
        client.on_unsubscribe = self._deaf
        return client

    def _connected(self, client: Any, data: Any, flags: Any, why: ReasonCode, more: Any) -> None:
        self._there = not why.is_failure
        self._refused = str(why).lower() if why.is_failure else ""
        self._most = min(FLYING, getattr(more, "ReceiveMaximum", FLYING))
        self._largest = getattr(more, "MaximumPacketSize", LARGEST)

    def _disconnected(self, client: Any, data: Any, flags: Any, why: Any, more: Any) -> None:
        self._there = False
        if flags.is_disconnect_packet_from_server:
            self._refused = str(why).lower()
            if why == ReasonCode(PacketTypes.DISCONNECT, "Session taken over"):
                self._refused += f" by another box {self._name}: give each box its own --name"

    def _acknowledged(self, client: Any, data: Any, mid: int, why: ReasonCode, more: Any) -> None:
        done = self._flying.pop(mid, None)
        if why.is_failure:
            self._log.warning(f"mqtt: {self._broker} refuses a message: {why}; see its rules")
        with self._lock:
            self.dropped += why.is_failure and done is not None and done >= 0
            while done is not None and self._waiting and self._first <= done:
                self._waiting.popleft()
                self._first += 1

    def _greet(self, client: paho.Client) -> None:
        config = json.dumps(discovery(self._name, writes=self._writes))
        topic = f"homeassistant/device/palpate_{self._name}/config"
        size = len(config.encode()) + len(topic) + HEADER
        if size <= self._largest:
            self._send(client, topic, config)
        else:  # the broker would end the connection
            self._log.warning(
                f"mqtt: {self._broker} takes packets of {self._largest} bytes, the discovery has "
                f"{size}: Home Assistant will not find the box; raise max_packet_size there"
            )
        client.subscribe(self._heeded)

    def _publish(self, client: paho.Client) -> None:
        """Send new verdicts, state and replies."""
        now_ns = self._clock.now_ns()
        view = self.source.view()
        self._say(client, "status", "online" if view.alive(now_ns) else "offline")
        with self._lock:
            self._next = max(self._next, self._first)
            at = self._next - self._first
            due = [*islice(self._waiting, at, at + max(0, self._most - len(self._flying)))]
        for heard_ns, fields in due:
            text = json.dumps({**fields, "late": now_ns - heard_ns > LATE_NS})
            self._send(client, f"{self._base}/verdict", text, self._next)
            self._next += 1
        self._say(client, "state", json.dumps(state(view, self.dropped)))
        if self._deaf_ns and now_ns >= self._deaf_ns:
            self._deaf_ns = 0
            client.subscribe(self._heeded)
        while self._replies and not client.want_write():
            client.publish(f"{self._base}/reply", self._replies.popleft(), qos=0)

    def _say(self, client: paho.Client, topic: str, text: str) -> None:
        """Publish the content of a retained topic if it has changed."""
        if self._said.get(topic) != text and len(self._flying) < self._most:
            self._said[topic] = text
            self._send(client, f"{self._base}/{topic}", text)

    def _send(self, client: paho.Client, topic: str, text: str, number: int = -1) -> None:
        """Publish a retained message. number: of its verdict."""
        self._flying[client.publish(topic, text, qos=1, retain=True).mid] = number

    def _turn(self, client: paho.Client) -> None:
        """Wait for the broker or for news, and read and write. Raises BROKEN."""
        line = client.socket()
        if line is None:
            self._there = False
            return
        more = isinstance(line, ssl.SSLSocket) and line.pending() > 0
        writes = [line] if client.want_write() else []
        ready = select.select([line, self._woken], writes, [], 0 if more else TICK_S)
        if self._woken in ready[0]:
            self._woken.recv(4096)
        code = MQTTErrorCode.MQTT_ERR_SUCCESS
        for _ in range(AT_ONCE if more or line in ready[0] else 0):
            code = client.loop_read()
            if code or not select.select([line], [], [], 0)[0]:
                break
        if not code and line in ready[1]:
            code = client.loop_write()
        if code or client.loop_misc():
            self._there = False

    def _command(self, client: Any, data: Any, message: paho.MQTTMessage) -> None:
        """Begin a command or a question; its reply comes later."""
        if self._deaf_ns or self._flooded(client) or message.retain:
            return
        text = message.payload[:40].decode("ascii", "replace").strip()
        asks = message.topic.endswith("/since")
        if not asks and text not in COMMANDS:
            self._reply(text, f"error: not a command; use {', '.join(COMMANDS)}")
        elif not self._commanding.acquire(blocking=False):
            self._reply(text, "error: another command is under way; send it again")
        else:
            work = self._since if asks else self.source.send
            threading.Thread(target=self._carry_out, args=(text, work), daemon=True).start()

    def _flooded(self, client: paho.Client) -> bool:
        """Count a command; after too many, ask the broker for no more."""
        now_ns = self._clock.now_ns()
        if now_ns - self._second_ns > 1_000_000_000:
            self._second_ns, self._commands = now_ns, 0
        self._commands += 1
        if self._commands <= MOST_COMMANDS:
            return False
        self._deaf_ns = math.inf  # until the broker has stopped
        client.unsubscribe([topic for topic, _ in self._heeded])
        self._reply("", f"error: over {MOST_COMMANDS} commands in a second; pause for some seconds")
        self._log.warning("mqtt: a flood of commands; none is heard for some seconds")
        return True

    def _deaf(self, client: Any, data: Any, mid: int, why: Any, more: Any) -> None:
        self._deaf_ns = self._clock.now_ns() + PAUSE_NS

    def _carry_out(self, text: str, work: Callable[[str], Any]) -> None:
        try:
            said = work(text)
        except ApplianceError as e:
            self._log.warning(f"mqtt: {text}: {e}")
            said = f"error: {e}"
        finally:
            self._commanding.release()
        self._reply(text, said)

    def _since(self, text: str) -> list[Mapping[str, Any]]:
        """The results since a time, the oldest first. Raises CommandRefused."""
        try:
            at_s = float(text) if SECONDS.fullmatch(text) else wall_clock.read(text)
            return self._results.since(at_s)
        except (ValueError, OverflowError) as e:
            raise CommandRefused(f"{e}; send a time such as 2026-11-28T14:00:00+01:00") from e

    def _reply(self, text: str, said: object) -> None:
        self._replies.append(json.dumps({"command": text, "reply": said}))
        self._wake()


def _end(client: paho.Client | None) -> None:
    """Close the connection at once; without DISCONNECT the broker sends the will."""
    if client and (line := client.socket()):
        line.close()
