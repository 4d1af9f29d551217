"""Serves a page and its events to browsers, with tornado, and takes orders of the page.

The server runs in a thread of its own, so that no browser keeps the program waiting. It answers GET
of the paths it was given, and reads only the head of a request. A new browser gets the kept events,
then the new events (server-sent events); a browser that comes back gets the events it has missed.
The program alone decides about orders: a page without orders is read-only
(docs/decisions/0011-pages.md).
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import secrets
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from heapq import merge
from pathlib import Path
from typing import Any, Self
from weakref import WeakSet

from palpate.core.errors import AddressError, ApplianceError, ConfigError, FormatError, NoAnswer
from palpate.core.log import TroubleLog
from palpate.core.status import WORDS
from palpate.service.network import announce
from palpate.web import local_users
from palpate.web.access import ROLES, Access

try:
    from tornado.httpserver import HTTPServer
    from tornado.iostream import StreamClosedError
    from tornado.netutil import bind_sockets
    from tornado.template import Loader
    from tornado.web import Application, HTTPError, RequestHandler
except ImportError as e:
    raise ConfigError(
        "--web needs tornado, which is not installed; pip install 'palpate[page]'"
    ) from e

FOLDER = Path(__file__).with_name("page")
KINDS = {
    ".svg": "image/svg+xml",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Server": "palpate",
}
"""Permissions of the page in a browser, in every answer, errors included."""
HEAD_S = 5.0
"""Time limit for a request's head, including the handshake of TLS, and for a connection without a
request."""
MOST_HEAD = 8192
"""Most bytes of a request."""
MOST_OPEN = 64
"""Most connections at a time. A browser opens up to six."""
MOST_WAITING = 100
"""Most events that wait for a browser. A browser that is further behind is disconnected, and gets
the kept events when it comes back."""
MOST_ORDER = 1024
"""Most bytes of an order."""
DONE_S = 3.0
"""Longest wait for the answer to an order."""
WRONG_S = 1.0
"""Delay of the answer to a wrong token."""
COOKIE = "__Host-palpate"
KEY = "X-Palpate-Key"
"""Header with the key of an order. The page gets the key with its events; another site cannot read
it."""
ENTRANCE = ("/enter.html", "/enter.js", "/old.js", "/page.css", "/logo.svg")
"""Files for a browser without a token; none of them is secret."""

Answer = Callable[[str], object | None]
"""The content for JSON by the last part of a path, or an iterator of parts of a CSV file; None for
an unknown path. It may wait for the disk."""
Orders = Callable[[bytes, str], Future[Any]]
"""Takes an order of a browser with this role (access.ROLES) without waiting. Its future gives the
answer for JSON, or an ApplianceError if the order is refused."""


class EventLog:
    """The events of a program, with numbers.

    Of each name the newest `kept[name]` events are kept, or the newest event if `kept` lacks the
    name. run: distinguishes this server from the next, which counts anew.
    """

    def __init__(self, kept: Mapping[str, int]) -> None:
        self.run = secrets.token_hex(4)
        self._kept = kept
        self._number = 0
        self._events: dict[str, deque[tuple[int, bytes]]] = {}

    def add(self, name: str, content: object) -> bytes:
        """Add an event and return its text for browsers."""
        self._number += 1
        data = json.dumps(content, allow_nan=False, separators=(",", ":"))
        event = f"id: {self.run}-{self._number}\nevent: {name}\ndata: {data}\n\n".encode()
        kept = self._events.setdefault(name, deque(maxlen=self._kept.get(name, 1)))
        kept.append((self._number, event))
        return event

    def since(self, last: str) -> list[bytes]:
        """The events after the event `last` ("": all), in order."""
        run, _, number = last.partition("-")
        after = int(number) if run == self.run and number.isdecimal() and len(number) < 20 else 0
        first = [] if after else [f"event: begin\ndata: {json.dumps(self.run)}\n\n".encode()]
        return first + [event for number, event in merge(*self._events.values()) if number > after]


class PageServer:
    """Serves the page `name` of FOLDER and the other files there, at `access`.

    kept: as for EventLog. now_ns: the clock of the events' time stamps. answers: functions for
    content on request, by the first part of its path. orders: takes the page's POSTs to /order;
    None for a page that is read-only. Raises AddressError if the address is in use or not there
    yet, ConfigError if it cannot be used at all.
    """

    def __init__(
        self,
        name: str,
        access: Access,
        now_ns: Callable[[], int],
        kept: Mapping[str, int] | None = None,
        answers: Mapping[str, Answer] | None = None,
        orders: Orders | None = None,
    ) -> None:
        self.access, self.now_ns, self.answers, self.orders = access, now_ns, answers or {}, orders
        self.events, self.key = EventLog(kept or {}), secrets.token_urlsafe()
        if orders:
            self.events.add("key", self.key)
        self.queues: set[asyncio.Queue[bytes]] = set()
        self.answering: set[asyncio.Task[Any]] = set()
        self.wrong = TroubleLog("page")
        self.files = page_files()
        self.files["/"] = self.files[f"/{name}"]
        self.reading = asyncio.Lock()  # one answer at a time, in one more thread
        self._stop = asyncio.Event()
        self.server: LimitedServer | None = None
        try:
            self._tls = access.tls()
            if not 0 <= access.port <= 65535:  # the resolver would take it modulo 65536
                raise ValueError("ports are numbers from 0 to 65535")
            self._sockets = bind_sockets(access.port, access.address, backlog=2 * MOST_OPEN)
        except (OSError, ValueError) as e:
            where = f"port {access.port} of {access.address}"
            passing = isinstance(e, OSError) and not isinstance(e, PermissionError)
            raise (AddressError if passing else ConfigError)(
                f"{where} cannot be used: {e}; name another with --web PORT"
            ) from e
        self.address = access.url(self._sockets[0].getsockname()[1])

    def __enter__(self) -> Self:
        # tornado logs each malformed request, and the terminal may show a skin
        logging.getLogger("tornado").addHandler(logging.NullHandler())
        logging.getLogger("tornado").propagate = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=self._loop.run_until_complete, args=(self._serve(),), daemon=True
        )
        self._thread.start()
        self._unannounce = announce("page", *self._sockets[0].getsockname()[:2])
        return self

    def __exit__(self, *_: object) -> None:
        self._unannounce()
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        self._loop.close()

    @property
    def watched(self) -> bool:
        return bool(self.queues)

    def publish(self, name: str, content: object) -> None:
        """Send an event to all browsers, and keep it. It never waits. Raises ValueError for a
        number that JSON lacks."""
        json.dumps(content, allow_nan=False)  # an error belongs to the caller, not to the thread
        self._loop.call_soon_threadsafe(self._spread, name, content)

    def show(self, view: Any) -> None:
        """Make `view`, which has `json()`, the newest event of this name."""
        self.publish("view", view.json())

    def _spread(self, name: str, content: object) -> None:
        event = self.events.add(name, content)
        for queue in [*self.queues]:
            if queue.full():
                self.queues.remove(queue)  # its handler ends at its next event
            else:
                queue.put_nowait(event)

    async def _serve(self) -> None:
        routes = [(r"/events", EventsHandler), (r"/(\w+)/(\d{1,9})", AnswerHandler)]
        routes += [(r"/order", OrderHandler)] if self.orders else []
        application = Application(
            [(path, handler, {"page": self}) for path, handler in routes],
            default_handler_class=FileHandler,
            default_handler_args={"page": self},
            log_function=lambda handler: None,
        )
        server = self.server = LimitedServer(
            application,
            ssl_options=self._tls,
            max_header_size=MOST_HEAD,
            max_body_size=MOST_ORDER if self.orders else 0,
            max_buffer_size=1 << 16,
            idle_connection_timeout=HEAD_S,
            body_timeout=HEAD_S,
            chunk_size=MOST_HEAD,
        )
        server.add_sockets(self._sockets)
        await self._stop.wait()
        if self.answering:
            await asyncio.wait(self.answering, timeout=DONE_S)
        server.stop()
        await server.close_all_connections()
        await asyncio.sleep(0)  # cancelled handlers end


def page_files() -> dict[str, tuple[str, bytes]]:
    """Type and content of each file of FOLDER, by its path. Pages are in the frame that all of them
    share, frame.html; /statuses.js holds the words of the table of statuses."""
    frames = Loader(str(FOLDER), autoescape=None, whitespace="all")
    statuses = {str(s): [w.colour, w.word, w.advice] for s, w in WORDS.items()}
    files = {
        f"/{f.name}": (
            KINDS[f.suffix],
            frames.load(f.name).generate() if f.suffix == ".html" else f.read_bytes(),
        )
        for f in FOLDER.iterdir()
        if f.suffix in KINDS and f.name != "frame.html"
    }
    script = f"export const STATUSES = {json.dumps(statuses)};\n".encode()
    return files | {"/statuses.js": (KINDS[".js"], script)}


class LimitedServer(HTTPServer):
    """tornado's server with at most MOST_OPEN connections. A further connection takes the place of
    the oldest that has sent no allowed request, else of the oldest. admitted: connections that have
    sent an allowed request."""

    def initialize(self, *args: Any, **options: Any) -> None:
        super().initialize(*args, **options)
        self._open: list[Any] = []  # the oldest first
        self.admitted: WeakSet[Any] = WeakSet()

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Accept a connection, and close another if the server is full."""
        self._open = [one for one in self._open if not one.closed()]
        if len(self._open) >= MOST_OPEN:
            waiting = (one for one in self._open if one not in self.admitted)
            next(waiting, self._open[0]).close()
        self._open.append(stream)
        super().handle_stream(stream, address)


class _Handler(RequestHandler):
    """Common part of all requests: permissions and headers."""

    SUPPORTED_METHODS = ("GET",)

    def initialize(self, page: PageServer) -> None:
        self.page = page

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)

    async def prepare(self) -> None:
        """Refuse a request for another site, and a request without the token."""
        access, request = self.page.access, self.request
        stream = request.connection.stream if request.connection else None  # type: ignore[attr-defined]
        own = stream.socket.getsockname()[0] if stream and stream.socket else ""
        if not access.is_host(request.headers.get("Host", ""), own):
            why = "of another machine: name it in watch.address, or send Host localhost"
            raise HTTPError(421, reason=f"this name is {why}")
        scheme, _, given = request.headers.get("Authorization", "").partition(" ")
        given = given if scheme == "Bearer" else self.get_cookie(COOKIE, "") or ""
        self.role = access.role(given)
        if self.role:
            self._admit(stream)
            return
        if given:
            self.page.wrong.update(
                "a wrong token",
                f"page: wrong token from {request.remote_ip}; further wrong tokens are not logged",
            )
            await asyncio.sleep(WRONG_S)
            self.clear_cookie(COOKIE, path="/", secure=True)
        raise HTTPError(401)

    def _admit(self, stream: Any) -> None:
        """Note the connection of an allowed request. Without a token it must be of a user who may
        read the feed, too."""
        server = self.page.server
        if not (stream and stream.socket and server) or stream in server.admitted:
            return
        if not self.page.access.tokens:
            peer, own = stream.socket.getpeername()[:2], stream.socket.getsockname()[:2]
            if not local_users.may_see(local_users.owner(peer, own)):
                raise HTTPError(403, reason=f"only for root and group {local_users.GROUP}")
        server.admitted.add(stream)

    def write_error(self, status_code: int, **_: Any) -> None:
        self._say(f"{status_code} {self._reason}\n")

    def _say(self, text: str) -> None:
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(text)


class FileHandler(_Handler):
    """The page and its files. A browser without the token gets a page that asks for it."""

    def get(self) -> None:
        tokens = self.page.access.tokens
        if self.request.path == "/enter" and tokens:  # the token was right
            self.set_cookie(
                COOKIE,
                tokens[ROLES.index(self.role)],
                path="/",
                secure=True,
                httponly=True,
                samesite="Strict",
                max_age=365 * 24 * 3600,
            )
            self.set_status(204)
            return
        if self.request.path not in self.page.files or self.request.query:
            raise HTTPError(404)
        self._send(self.request.path)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Let a browser without a token enter it."""
        path = "/enter.html" if self.request.path == "/" else self.request.path
        if status_code == 401 and path in ENTRANCE:
            self.set_status(401 if path == "/enter.html" else 200)
            self._send(path)
            self.finish()
        else:
            super().write_error(status_code, **kwargs)

    def _send(self, path: str) -> None:
        kind, body = self.page.files[path]
        self.set_header("Content-Type", kind)
        self.write(body)


class AnswerHandler(_Handler):
    """Content that is computed on request."""

    async def get(self, name: str, which: str) -> None:
        """Answer with JSON, with a CSV file, or with 404."""
        answer = self.page.answers.get(name)
        content = await self._apart(answer, which) if answer else None
        if content is None:
            raise HTTPError(404)
        if isinstance(content, Iterator):
            try:
                return await self._file(content, f"palpate-{name}.csv")
            except ApplianceError as e:  # the file cannot be read; in its middle this ends the CSV
                self.set_status(503)
                return self._say(str(e))
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps(content, allow_nan=False, separators=(",", ":")))

    async def _apart(self, act: Callable[..., Any], *given: object) -> Any:
        """What `act` gives in another thread: a slow disk keeps no stream of events waiting."""
        async with self.page.reading:
            return await asyncio.to_thread(act, *given)

    async def _file(self, parts: Iterator[str], name: str) -> None:
        """Send parts as fast as the browser takes them."""
        part = await self._apart(next, parts, "")
        self.set_header("Content-Type", "text/csv; charset=utf-8")
        self.set_header("Content-Disposition", f'attachment; filename="{name}"')
        with suppress(StreamClosedError):
            while part:
                self.write(part)
                await self.flush()
                part = await self._apart(next, parts, "")


class OrderHandler(_Handler):
    """Orders of the page."""

    SUPPORTED_METHODS = ("POST",)

    async def prepare(self) -> None:
        """Refuse orders of other sites: they have another origin, and cannot read the key."""
        await super().prepare()
        headers, key = self.request.headers, self.page.key.encode()
        own = f"{self.request.protocol}://{headers['Host']}"
        ours = hmac.compare_digest(headers.get(KEY, "").encode(), key)
        if headers.get("Origin") != own or not ours:
            raise HTTPError(403)
        if headers.get("Content-Type") != "application/json":
            raise HTTPError(415)

    async def post(self) -> None:
        """Answer with the result of the order as JSON, or with the reason for a refusal as a
        line."""
        task = asyncio.current_task()
        assert task
        self.page.answering.add(task)
        task.add_done_callback(self.page.answering.discard)
        try:
            content = json.dumps(await self._done())
            self.set_header("Content-Type", "application/json")
            self.finish(content)
        except ApplianceError as e:
            code = 400 if isinstance(e, FormatError) else 503 if isinstance(e, NoAnswer) else 409
            self.set_status(code)
            self._say(str(e))

    async def _done(self) -> Any:
        """The result of an order. Raises ApplianceError if it is refused; NoAnswer if it is not
        carried out in time."""
        assert self.page.orders
        order = self.page.orders(self.request.body, self.role)
        try:
            async with asyncio.timeout(DONE_S):
                return await asyncio.shield(asyncio.wrap_future(order))
        except TimeoutError as e:
            known = (
                "it was not carried out; try again"
                if order.cancel()
                else "it may still be carried out; wait for it"
            )
            raise NoAnswer(f"no answer within {DONE_S:g} s; {known}") from e


class EventsHandler(_Handler):
    """The stream of events to a browser."""

    async def get(self) -> None:
        """Send the missed events, then each new event, until browser or page ends."""
        page, queue = self.page, asyncio.Queue[bytes](MOST_WAITING)
        self.set_header("Content-Type", "text/event-stream")
        self.set_header("X-Accel-Buffering", "no")  # or nginx keeps events until they are 4 kB
        now = f"event: now\ndata: {page.now_ns()}\n\n"
        if page.orders:
            now += f"event: role\ndata: {json.dumps(self.role)}\n\n"
        missed = page.events.since(self.get_query_argument("last", ""))
        page.queues.add(queue)
        self._queue = queue
        try:
            self.write(b"".join([now.encode(), *missed]))
            await self.flush()
            while queue in page.queues:
                self.write(await queue.get())
                await self.flush()
        except StreamClosedError:
            pass
        finally:
            page.queues.discard(queue)

    def on_connection_close(self) -> None:
        """Wake the handler up, so that it ends."""
        if (queue := getattr(self, "_queue", None)) in self.page.queues:
            self.page.queues.discard(queue)
            if queue.empty():
                queue.put_nowait(b"")
