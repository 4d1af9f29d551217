"""Serves a page that shows a state that changes: of `palpate align`, of `palpate skin show`. In: States. Out: the page
and the newest of them, to browsers on this machine.

It listens on 127.0.0.1 alone and only answers GET on two paths; of a request nothing beyond the head is read. The
server runs in its own thread, so that no slow browser keeps the loop from reading the skin. The two share one value,
the newest state, which is replaced as a whole. `palpate run` does not use this module.
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
from typing import Any, Protocol, Self

from appliance.core.clock import Clock
from appliance.core.errors import ConfigError

HERE = "127.0.0.1"
PAGE = Path(__file__).with_name("page.html")
NAMES = ("localhost", HERE)
"""Names by which a browser may ask for this machine. Another name belongs to another site that points here (DNS
rebinding)."""
DEADLINE_NS = 2_000_000_000
"""Limit from the start of a connection to the end of the request's head, and again for the answer."""
MOST_HEAD = 8192
"""Most bytes of a request that are read."""
MOST_OPEN = 16
"""Most connections at a time; a further one is closed at once."""
POLL_S = 0.2
"""How often the server checks whether it shall stop."""


def policy(page: str) -> str:
    """Content security policy of the page: its own script and styles, by their hashes, and requests to this server."""

    def hashes(tag: str) -> str:
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.S)
        return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(t.encode()).digest()).decode()}'" for t in texts)

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class PageHandler(BaseHTTPRequestHandler):
    """One request. The library parses its head; the answer is what the server has under that path."""

    server: Server
    server_version, sys_version = "palpate", ""

    def setup(self) -> None:
        """Read the head within MOST_HEAD and DEADLINE_NS; what comes after it is ignored."""
        super().setup()
        self.rfile = io.BytesIO(self._head())
        self.connection.settimeout(DEADLINE_NS / 1e9)  # `sendall` counts it for the whole answer

    def _head(self) -> bytes:
        """Up to the empty line and what came with it; nothing where the limit is reached or the other side closes
        first. Raises TimeoutError at the deadline."""
        clock, head = self.server.clock, b""
        until_ns = clock.now_ns() + DEADLINE_NS
        while b"\r\n\r\n" not in head:
            left_ns, free = until_ns - clock.now_ns(), MOST_HEAD - len(head)
            if left_ns <= 0:
                raise TimeoutError
            self.connection.settimeout(left_ns / 1e9)
            if not free or not (more := self.connection.recv(free)):
                return b""
            head += more
        return head

    def parse_request(self) -> bool:
        """Refuse a request that is meant for another site."""
        if not super().parse_request():
            return False
        if self.headers.get("Host", "").rsplit(":", 1)[0] not in NAMES:
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return False
        return True

    def do_GET(self) -> None:
        """Answer `/` and `/state`; any other path is not found."""
        if self.path not in self.server.content:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        kind, body = self.server.content[self.path]
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def end_headers(self) -> None:
        """Add the headers that every answer has, errors too."""
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
        """Print nothing: the terminal shows the skin."""


class Server(ThreadingHTTPServer):
    """One thread for each connection; these are few and short. content: content type and body by path."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = (
        2 * MOST_OPEN
    )  # with less, the kernel lets a connection wait a second that would be refused at once

    def __init__(self, port: int, clock: Clock, page: str) -> None:
        self.clock, self.policy = clock, policy(page)
        self.content = {"/": ("text/html; charset=utf-8", page.encode()), "/state": ("application/json", b"null")}
        self._free = threading.Semaphore(MOST_OPEN)
        super().__init__((HERE, port), PageHandler)

    def server_bind(self) -> None:
        """Bind as TCPServer does: HTTPServer would ask a name server for this machine's name, and wait for it."""
        socketserver.TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Accept a connection unless there are MOST_OPEN."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one connection in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a browser that has closed its connection."""


class State(Protocol):
    """What a page shows."""

    def json(self) -> dict[str, Any]:
        """It as the page reads it."""
        ...


class Page:
    """Shows States on the page of the file `page` at http://127.0.0.1:`port`, 0 for any that is free. Raises
    ConfigError where it cannot be used."""

    def __init__(self, port: int, clock: Clock, page: Path = PAGE) -> None:
        try:
            self._server = Server(port, clock, page.read_text(encoding="utf-8"))
        except (OSError, OverflowError) as e:
            raise ConfigError(f"port {port} of {HERE} cannot be used: {e}; name another with --web PORT") from e
        self.address = f"http://{HERE}:{self._server.server_address[1]}"

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, args=(POLL_S,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, view: State) -> None:
        """Make `view` the newest state."""
        self._server.content["/state"] = "application/json", json.dumps(view.json(), allow_nan=False).encode()
