"""Browsers without a screen: plain connections to a page's server, and their bytes."""

import json
import socket
import ssl
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from palpate.web.server import PageServer
from tests.factories.browser import WAIT_S


@dataclass(frozen=True)
class PageAddress:
    """A page of another process."""

    address: str


Page = PageServer | PageAddress


def port(page: Page) -> int:
    return int(page.address.rsplit(":", 1)[1])


def connected(page: Page, tls: ssl.SSLContext | None = None) -> socket.socket:
    plain = socket.create_connection(("127.0.0.1", port(page)), timeout=WAIT_S)
    return tls.wrap_socket(plain, server_hostname="localhost") if tls else plain


def received_by(one: socket.socket) -> bytes:
    """All bytes until the other side closes."""
    received = b""
    with suppress(ConnectionResetError):
        while more := one.recv(65536):
            received += more
    return received


def ask(
    page: Page,
    path: str = "/",
    method: str = "GET",
    host: str = "localhost",
    more: str = "",
    tls: ssl.SSLContext | None = None,
    body: bytes = b"",
) -> bytes:
    """The answer to one request, head and body."""
    with connected(page, tls) as one:
        head = f"{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{more}\r\n"
        with suppress(
            BrokenPipeError, ConnectionResetError
        ):  # the server may refuse a request before it has read all of it
            one.sendall(head.encode() + body)
        return received_by(one)


def status(answer: bytes) -> int:
    """The status of an answer, 0 without an answer."""
    return int(answer.split()[1]) if answer else 0


class EventReader:
    """A browser that listens to the events. last: the number of its last event."""

    def __init__(self, page: Page, last: str = "") -> None:
        self.socket = connected(page)
        self.socket.sendall(f"GET /events?last={last} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        self.last, self._rest = "", b""
        while b"\r\n\r\n" not in self._rest:
            if not (more := self.socket.recv(65536)):
                raise EOFError
            self._rest += more
        head, _, self._chunks = self._rest.partition(b"\r\n\r\n")
        assert b"text/event-stream" in head
        self._text = b""

    def next(self) -> tuple[str, Any]:
        """Name and content of the next event. Raises EOFError when the server has closed."""
        while b"\n\n" not in self._text:
            self._read_chunk()
        event, _, self._text = self._text.partition(b"\n\n")
        fields = dict(line.split(": ", 1) for line in event.decode().split("\n"))
        self.last = fields.get("id", self.last)
        return fields["event"], json.loads(fields["data"])

    def until(self, name: str) -> Any:
        """The content of the next event of this name."""
        while (event := self.next())[0] != name:
            pass
        return event[1]

    def _read_chunk(self) -> None:
        while (end := self._chunks.find(b"\r\n")) < 0 or len(self._chunks) < end + 4 + int(
            self._chunks[:end], 16
        ):
            if not (more := self.socket.recv(65536)):
                raise EOFError
            self._chunks += more
        size = int(self._chunks[:end], 16)
        if not size:
            raise EOFError
        self._text += self._chunks[end + 2 : end + 2 + size]
        self._chunks = self._chunks[end + 4 + size :]
