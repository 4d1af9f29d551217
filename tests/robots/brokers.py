"""Debian's mosquitto on a free port, and its clients."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import pytest

from tests.factories.bridges import LONG_S, eventually

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")


def required() -> None:
    """Skip the test without mosquitto; CI has it (PALPATE_MOCKS)."""
    lacking = "mosquitto is not installed; apt-get install mosquitto mosquitto-clients"
    if not MOSQUITTO or not shutil.which("mosquitto_sub"):
        pytest.fail(lacking) if os.environ.get("PALPATE_MOCKS") else pytest.skip(lacking)


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Mosquitto:
    """A broker that can be stopped and started again. more: further lines of its settings."""

    def __init__(self, folder: Path, *more: str, anonymous: bool = True) -> None:
        self.port, self.url = free_port(), ""
        self.url = f"mqtt://127.0.0.1:{self.port}"
        self._settings = folder / "mosquitto.conf"
        lines = [f"listener {self.port} 127.0.0.1", f"allow_anonymous {str(anonymous).lower()}"]
        lines += ["persistence true", f"persistence_location {folder}/"]
        # it gives root's rights away, and could not read files of the test
        self._settings.write_text("\n".join([*lines, "user root", *more, ""]))
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start it and wait until it listens."""
        assert MOSQUITTO
        words = [MOSQUITTO, "-c", str(self._settings)]
        self._process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        eventually(self._listens)

    def stop(self) -> None:
        """End it; it keeps its sessions."""
        if self._process:
            self._process.terminate()
            self._process.wait(LONG_S)
            self._process = None

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


class TopicFlood:
    """Publishes these texts with QoS 0 as fast as mosquitto_pub can. sent: texts so far."""

    def __init__(self, port: int, topic: str, texts: list[str]) -> None:
        self.sent, self._ending = 0, threading.Event()
        self._block = "".join(f"{text}\n" for text in texts * 50)
        self._count = 50 * len(texts)
        words = ["mosquitto_pub", "-h", "127.0.0.1", "-p", str(port), "-t", topic, "-l"]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, text=True)
        self._thread = threading.Thread(target=self._send, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._ending.set()
        self._process.kill()
        self._process.wait(LONG_S)
        self._thread.join(LONG_S)

    def _send(self) -> None:
        assert self._process.stdin
        with suppress(OSError):  # it has ended
            while not self._ending.is_set():
                self._process.stdin.write(self._block)
                self.sent += self._count


class Subscriber:
    """Reads `topic` with mosquitto_sub, which shares no code with the bridge's client, without the
    commands, which are countless in a flood. messages: (topic, text) in order. heard: is called
    with each. kept: the broker keeps what comes while it is away."""

    def __init__(
        self,
        port: int,
        topic: str = "#",
        heard: Callable[[str, str], None] | None = None,
        *,
        kept: bool = False,
    ) -> None:
        self.messages: list[tuple[str, str]] = []
        self._heard, self._to = heard, ("-h", "127.0.0.1", "-p", str(port))
        words = ["mosquitto_sub", *self._to, "-q", "1", "-F", "%t %p", "-t", topic, "-t", "test/up"]
        words += ["-T", "palpate/+/command"]
        words += ["-c", "-i", "reader"] if kept else []
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        # retained, so it comes as soon as the subscription stands
        self.publish("test/up", "yes", retain=True)
        eventually(lambda: self.last("test/up") == "yes")
        return self

    def __exit__(self, *reason: object) -> None:
        self._process.kill()
        self._process.wait(LONG_S)
        self._thread.join(LONG_S)

    def publish(self, topic: str, *texts: str, retain: bool = False) -> None:
        """Send messages with mosquitto_pub."""
        words = ["mosquitto_pub", *self._to, "-q", "1", "-t", topic, *(["-r"] if retain else [])]
        sent = "".join(f"{text}\n" for text in texts)
        subprocess.run([*words, "-l"], input=sent, text=True, check=True, timeout=LONG_S)

    def last(self, topic: str) -> str:
        """The newest text of a topic that ends so, "" for none."""
        return next((text for name, text in reversed([*self.messages]) if name.endswith(topic)), "")

    def all(self, topic: str) -> list[Any]:
        """The JSON of all messages of a topic that ends so."""
        return [json.loads(text) for name, text in [*self.messages] if name.endswith(topic)]

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            topic, _, text = line.rstrip("\n").partition(" ")
            self.messages.append((topic, text))
            if self._heard:
                self._heard(topic, text)
