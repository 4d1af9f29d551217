"""The room of the page that shows how the skin is placed. In: Views. Out: the page and its state, to browsers on this machine.

It listens on 127.0.0.1 alone and only gives: two paths, GET, nothing that is sent is read beyond the head. The server has
a thread of its own, so that no browser, however slow, keeps the loop from reading the skin; between them there is one
value, the newest state, which is set whole. `palpate run` never comes here.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import socketserver
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from appliance.core.clock import Clock
from appliance.core.errors import ConfigError

if TYPE_CHECKING:
    from appliance.alignment.live import View

HERE = "127.0.0.1"
PAGE = Path(__file__).with_name("page.html")
NAMES = ("localhost", HERE)
"""How a browser may call this machine. Another name is another site's that points here (DNS rebinding)."""
DEADLINE_NS = 2_000_000_000
"""From a connection's begin to the end of its head, and again to that of the answer, whatever the other side does."""
MOST_HEAD = 8192
"""Bytes of a request that are read."""
MOST_OPEN = 16
"""Connections at a time; a further one is closed at once."""
POLL_S = 0.2
"""How soon the server notices that it shall stop."""


def policy(page: str) -> str:
    """What the page may do: run the script and the styles that are in it, known by their hashes, and ask this server."""

    def hashes(tag: str) -> str:
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.S)
        return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(t.encode()).digest()).decode()}'" for t in texts)

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class PageHandler(BaseHTTPRequestHandler):
    """One request. The library reads its head, this answers from what the server holds."""

    server: Server
    server_version, sys_version = "palpate", ""

    def setup(self) -> None:
        """Read the head, so much and so long and no more; what comes after it is nobody's."""
        super().setup()
        self.rfile = io.BytesIO(self._head())
        self.connection.settimeout(DEADLINE_NS / 1e9)  # of the whole answer, as `sendall` counts it

    def _head(self) -> bytes:
        """Up to the empty line and what came with it; nothing where the limit or the other side's end comes first. Raises
        TimeoutError at the deadline."""
        clock, head = self.server.clock, b""
        until_ns = clock.now_ns() + DEADLINE_NS
        while b"\r\n\r\n" not in head:
            left_ns, room = until_ns - clock.now_ns(), MOST_HEAD - len(head)
            if left_ns <= 0:
                raise TimeoutError
            self.connection.settimeout(left_ns / 1e9)
            if not room or not (more := self.connection.recv(room)):
                return b""
            head += more
        return head

    def parse_request(self) -> bool:
        """Refuse what is meant for another site."""
        if not super().parse_request():
            return False
        if self.headers.get("Host", "").rsplit(":", 1)[0] not in NAMES:
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return False
        return True

    def do_GET(self) -> None:
        """`/` and `/state`; there is nothing else."""
        if self.path not in self.server.held:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        kind, body = self.server.held[self.path]
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def end_headers(self) -> None:
        """What each answer says, errors too."""
        for name, value in (
            ("Content-Security-Policy", self.server.policy),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
        ):
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal shows the skin."""


class Server(ThreadingHTTPServer):
    """A thread for each connection, of which there are few and none lasts. held: content type and body by path."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 2 * MOST_OPEN  # or the kernel lets those wait a second whom this would turn away at once

    def __init__(self, port: int, clock: Clock, page: str) -> None:
        self.clock, self.policy = clock, policy(page)
        self.held = {"/": ("text/html; charset=utf-8", page.encode()), "/state": ("application/json", b"null")}
        self._room = threading.Semaphore(MOST_OPEN)
        super().__init__((HERE, port), PageHandler)

    def server_bind(self) -> None:
        """As of a plain server: the library's own would ask a name server for this machine's name, and wait for it."""
        socketserver.TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Take a connection on, where there are not too many."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """One connection, in its thread, to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that has left is no trouble of ours."""


class Page:
    """Shows Views at http://127.0.0.1:`port`, 0 for any that is free. Raises ConfigError where it cannot be had."""

    def __init__(self, port: int, clock: Clock) -> None:
        try:
            self._server = Server(port, clock, PAGE.read_text(encoding="utf-8"))
        except (OSError, OverflowError) as e:
            raise ConfigError(f"port {port} of {HERE} cannot be used: {e}; name another with --web PORT") from e
        self.address = f"http://{HERE}:{self._server.server_address[1]}"

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, args=(POLL_S,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, view: View) -> None:
        """The newest state."""
        self._server.held["/state"] = "application/json", json.dumps(view.json(), allow_nan=False).encode()
