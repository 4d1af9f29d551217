"""The server of the pages: answers, refusals, faults."""

from __future__ import annotations

import re
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from palpate.core.config import WatchConfig
from palpate.core.errors import ConfigError
from palpate.web import server
from palpate.web.access import ROLES, Access
from palpate.web.server import MOST_HEAD, MOST_OPEN, MOST_WAITING, EventLog, PageServer
from tests.factories.browser import WAIT_S, until
from tests.factories.install_scripts import page_secrets
from tests.factories.page_client import EventReader, ask, connected, port, received_by, status


def now_ns() -> int:
    """The clock of the tests' pages."""
    return 5_000_000_000


@pytest.fixture
def page() -> Iterator[PageServer]:
    """A page at any free port, with an event."""
    with PageServer(
        "watch.html", Access(0), now_ns, {"row": 3}, {"sweep": {"7": {"seconds": 2.0}}.get}
    ) as one:
        one.publish("view", {"number": 1})
        yield one


@contextmanager
def guarded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[PageServer, str, ssl.SSLContext]]:
    """A page on the network as `make install` sets it up, a token, and its TLS context."""
    page_secrets(folder)
    settings = WatchConfig(address="0.0.0.0 localhost", folder=str(folder))
    token = (folder / "token-look").read_text().strip()
    with PageServer("watch.html", Access.configured(settings, 0), now_ns) as one:
        one.publish("view", {"number": 1})
        trusts = ssl.create_default_context(cafile=folder / "certificate.pem")
        yield one, token, trusts


def test_events_are_numbered_and_the_newest_are_kept():
    """So many a name; another server's browser gets all."""
    log = EventLog({"row": 2})
    for i in range(4):
        log.add("row", i)
        log.add("view", 10 * i)
    sent = b"".join(log.since("")).decode()
    assert re.findall(r"event: (\w+)\ndata: (.*)\n", sent) == [
        ("begin", f'"{log.run}"'),
        ("row", "2"),
        ("row", "3"),
        ("view", "30"),
    ]
    assert [event.split(b"data: ")[1] for event in log.since(f"{log.run}-7")] == [b"30\n\n"]
    assert log.since(f"{log.run}-8") == []
    for other in ("0000-7", f"{log.run}-", f"{log.run}-x", "-7", f"{log.run}-{10**30}"):
        assert b"begin" in log.since(other)[0], other


def test_a_browser_gets_what_is_kept_and_then_what_comes(page):
    """The clock is first; a browser that comes back gets only the events it missed."""
    reader = EventReader(page)
    assert [reader.next() for _ in range(3)] == [
        ("now", now_ns()),
        ("begin", page.events.run),
        ("view", {"number": 1}),
    ]
    page.publish("row", "first")
    assert reader.next() == ("row", "first")
    reader.socket.close()
    page.publish("row", "second")
    page.publish("view", {"number": 2})
    again = EventReader(page, reader.last)
    assert [again.next() for _ in range(3)] == [
        ("now", now_ns()),
        ("row", "second"),
        ("view", {"number": 2}),
    ]
    again.socket.close()


def test_numbers_without_json_and_taken_ports_are_errors(page):
    """ValueError where it is published; a ConfigError with port and remedy."""
    with pytest.raises(ValueError, match="JSON"):
        page.publish("view", float("nan"))
    reader = EventReader(page)
    assert reader.until("view") == {"number": 1}
    for taken in (port(page), 70_000):
        with pytest.raises(ConfigError, match=f"port {taken} .*--web PORT"):
            PageServer("watch.html", Access(taken), now_ns)


@pytest.mark.parametrize(
    "path", ["/", "/page.css", "/watch.js", "/events", "/sweep/7", "/sweep/8", "/nothing"]
)
def test_every_answer_says_what_a_browser_may_do(page, path):
    """No caching, frames, sources elsewhere or server version; in errors, too."""
    with connected(page) as one:
        one.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        head = b""
        while b"\r\n\r\n" not in head:
            head += one.recv(65536)
    lines = head.partition(b"\r\n\r\n")[0].decode()
    for line in (
        "Cache-Control: no-store",
        "X-Frame-Options: DENY",
        "X-Content-Type-Options: nosniff",
        "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self';"
        " connect-src 'self'",
        "frame-ancestors 'none'",
        "Server: palpate",
    ):
        assert line in lines
    assert ("X-Accel-Buffering: no" in lines) is (path == "/events")
    assert "unsafe" not in lines
    assert "ornado" not in lines


ANSWERS = {
    200: ["GET / 127.0.0.1:9000", "GET /watch.html", "GET /sweep/7"],
    404: [
        *("GET /sweep/8", "GET /sweep/-7", "GET /sweep/7777777777", "GET /other/7", "GET /enter"),
        *("GET /index.html", "GET /?x", "GET /../etc/passwd", "GET /..%2f..%2fetc/passwd"),
        *("GET /page.css/../../server.py", "GET /server.py", "GET //evil.example/", "GET /order"),
    ],
    405: [
        *("HEAD /", "POST /", "POST /order", "PUT /events", "DELETE /sweep/7", "OPTIONS /"),
    ],
    421: [
        *("GET / evil.example", "GET /events evil.example:80", "GET / [::2]", "GET / "),
        "GET /sweep/7 localhost.evil.example:80",
    ],
}
"""Method, path and host, localhost by default, by the status of the answer."""


@pytest.mark.parametrize(
    ("asked", "answer"), [(asked, code) for code, all_ in ANSWERS.items() for asked in all_]
)
def test_the_page_for_this_machine_and_no_more(page, asked, answer):
    """The page and its data under this machine's names; others get their HTTP status."""
    method, path, *host = asked.split(" ")
    told = ask(page, path, method, *host)
    assert status(told) == answer
    assert (b"watch.address" in told) is (answer == 421)
    assert status(ask(page)) == 200


def test_pages_run_in_browsers_of_2020_behind_any_path():
    """No younger script, and relative addresses."""
    absolute = re.compile(r"""(?:from|fetch\(|EventSource\(|href=|src=|replace\() ?["'`]/""")
    # Calls and signs that Chromium 83 and Safari 14 do not know
    young = re.compile(
        r"\w\.at\(|\?\?=|\|\|=|&&=|\.replaceChildren\(|replaceAll|AbortSignal\.timeout|findLast|hasOwn\b"
        r"|structuredClone|toSorted|toReversed|Promise\.any|checkVisibility"
    )
    found = {f.name: f.read_text() for f in server.FOLDER.iterdir()}
    assert len(found) > 15
    for name, text in found.items():
        assert not (name.endswith(".js") and young.search(text)), name
        assert not absolute.search(text), name


@pytest.mark.parametrize(
    "sent",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"y" * 10 * MOST_HEAD,
        b"\x00\x01\x02\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 999999999999\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nffffffff\r\n",
        b"GET /events?last=%ff%fe HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /%00%ff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello",
        "GET /ö HTTP/1.1\r\nHost: localhost\r\n\r\n".encode(),
    ],
)
def test_malformed_requests_are_refused(page, sent, capfd):
    """Each ends with an error or a closed connection, silently; the next is served."""
    with connected(page) as one:
        with suppress(OSError):
            one.sendall(sent)
            one.shutdown(socket.SHUT_WR)
        assert 400 <= status(received_by(one) or b"x 499") < 500
    assert status(ask(page)) == 200
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTTP/1.1\r\nHost: localhost\r\n", b"x" * (MOST_HEAD - 1)]
)
def test_half_a_request_ends_at_the_deadline(monkeypatch, sent):
    """A closed connection, even if its other side goes on sending; others are served."""
    monkeypatch.setattr(server, "HEAD_S", 0.3)
    with (
        PageServer("watch.html", Access(0), now_ns) as page,
        connected(page) as slow,
        connected(page) as dripping,
    ):
        slow.sendall(sent)
        dripping.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
        assert status(ask(page)) == 200
        dripping.settimeout(0.02)
        ended = False
        while not ended:
            try:
                dripping.sendall(b"X: y\r\n")
                ended = not dripping.recv(100)
            except TimeoutError:
                pass
            except OSError:
                ended = True
        assert received_by(slow) == b""


@pytest.mark.parametrize("body", [False, True])
def test_slow_requests_lock_nobody_out(page, body):
    """Slow heads and bodies hold all places: a new request is served, readers stay."""
    reader = EventReader(page)
    assert reader.until("view") == {"number": 1}
    sent = b"POST /order HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{" if body else b""
    with ExitStack() as stack:
        for number in range(4 * MOST_OPEN):
            slow = stack.enter_context(
                socket.create_connection(
                    ("127.0.0.1", port(page)), source_address=(f"127.0.0.{2 + number % 4}", 0)
                )
            )
            with suppress(OSError):
                slow.sendall(sent)
        assert status(ask(page)) == 200
        page.publish("view", {"number": 2})
        assert reader.until("view") == {"number": 2}


def test_of_served_connections_the_oldest_makes_room(page, monkeypatch):
    """A tablet that lost its network many times still gets a place."""
    monkeypatch.setattr(server, "MOST_OPEN", 3)
    readers = [EventReader(page) for _ in range(5)]
    for reader in readers[2:]:
        assert reader.until("view") == {"number": 1}
    until(lambda: len(page.queues) == 3)


@pytest.mark.slow
def test_one_who_reads_nothing_holds_nobody_up(page, monkeypatch):
    """It is disconnected when too many events wait; others get all events."""
    lazy = EventReader(page)
    busy = EventReader(page)
    until(lambda: len(page.queues) == 2)
    for i in range(40 * MOST_WAITING):
        page.publish("row", [i, "x" * 20_000])
        while (got := busy.until("row"))[0] != i:
            pass
    assert got[0] == 40 * MOST_WAITING - 1
    assert len(page.queues) == 1
    lazy.socket.close()


@pytest.mark.parametrize("rudely", [False, True])
def test_a_browser_that_goes_is_forgotten(page, rudely):
    """In the middle of the events, with or without a word: nothing waits for it any longer."""
    reader = EventReader(page)
    assert reader.until("view") == {"number": 1}
    assert page.watched
    if rudely:
        reader.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    reader.socket.close()
    until(lambda: not page.watched)


def test_without_tornado_it_says_what_to_install(tmp_path):
    """One line that names the extra; nothing else of the box needs it."""
    command = ["record", "--sim", "skin", "--virtual", "--out", str(tmp_path), "--web", "0"]
    code = (
        "import sys; sys.modules['tornado'] = None; from palpate.__main__ import main;"
        f"sys.exit(main({command}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == ConfigError.exit_code
    assert "palpate[page]" in done.stderr.splitlines()[-1]


def test_on_the_network_it_takes_a_token(tmp_path, monkeypatch):
    """Without the token the server answers with the page that asks for it. With the token, in a
    header or in the server's cookie, everything is served. A browser that trusts the certificate
    accepts it."""
    with guarded(tmp_path, monkeypatch) as (page, token, trusts):
        by_header = {"more": f"Authorization: Bearer {token}\r\n", "tls": trusts}
        answer = ask(page, tls=trusts)
        assert status(answer) == 401
        assert b'"enter.js"' in answer
        for path, code in {"/enter.js": 200, "/old.js": 200, "/logo.svg": 200}.items():
            assert status(ask(page, path, tls=trusts)) == code
        for path in ("/events", "/watch.js", "/watch.html", "/sweep/1", "/enter", "/nothing"):
            assert status(ask(page, path, tls=trusts)) == 401
        answer = ask(page, "/enter", **by_header)
        assert status(answer) == 204
        cookie = re.search(r"Set-Cookie: (.*)\r\n", answer.decode())[1]
        assert {"HttpOnly", "Secure", "SameSite=Strict", "Path=/"} <= set(cookie.split("; "))
        assert cookie.startswith("__Host-")
        answer = ask(page, more=f"Cookie: {cookie.split(';')[0]}\r\n", tls=trusts)
        assert status(answer) == 200
        assert b'"watch.js"' in answer
        assert status(ask(page, host="evil.example", **by_header)) == 421
        assert status(ask(page, host=f"{socket.gethostname()}:1", **by_header)) == 200


def test_each_token_gives_its_role(tmp_path, monkeypatch):
    """Also by the cookie that it brings; a browser of this machine has the last one."""
    with guarded(tmp_path, monkeypatch) as (page, _, trusts):
        for role in ROLES:
            token = (tmp_path / f"token-{role}").read_text().strip()
            answer = ask(page, "/enter", more=f"Authorization: Bearer {token}\r\n", tls=trusts)
            assert f"__Host-palpate={token};".encode() in answer
            assert page.access.role(token) == role
        assert page.access.role("x") == page.access.role("") == ""
    assert Access(0).role("") == ROLES[-1]


def test_plain_http_is_not_answered_on_the_network(tmp_path, monkeypatch):
    """It would reveal the token; a handshake that never ends is cut off."""
    monkeypatch.setattr(server, "HEAD_S", 0.3)
    with guarded(tmp_path, monkeypatch) as (page, token, trusts):
        assert status(ask(page, more=f"Authorization: Bearer {token}\r\n")) == 0
        with connected(page) as silent:
            assert received_by(silent) == b""
        assert status(ask(page, tls=trusts)) == 401


def test_wrong_tokens_are_slowed_and_logged_once(tmp_path, monkeypatch, logged):
    """Each waits for WRONG_S; the first is logged with its address."""
    waited = []

    async def sleep(seconds: float) -> None:
        if seconds == server.WRONG_S:
            waited.append(seconds)

    monkeypatch.setattr(server.asyncio, "sleep", sleep)
    with guarded(tmp_path, monkeypatch) as (page, token, trusts):

        def entered(path: str, more: str) -> int:
            return status(ask(page, path, more=f"{more}\r\n", tls=trusts))

        for wrong in ("x", token[:-1], token + "0", "ö", "x" * 4000):
            assert entered("/enter", f"Authorization: Bearer {wrong}") == 401
            assert entered("/events", f"Cookie: __Host-palpate={wrong}") == 401
        assert entered("/enter", f"Authorization: Bearer {token}") == 204
    assert len(waited) == 10
    (line,) = (line for line in logged if "token" in line)
    assert re.match("<4>page: .*127.0.0.1", line)


def test_it_listens_on_this_machine_alone(page):
    """On 127.0.0.1; the names of watch.address, and no others, are answered there."""
    access = Access.configured(WatchConfig(address="127.0.0.1 cell-7.plant.example"), 0)
    assert access.is_host("Cell-7.plant.example:443", "127.0.0.1")
    assert not access.is_host("evil.example", "127.0.0.1")
    assert page.address.startswith("http://127.0.0.1:")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port(page)), timeout=WAIT_S)


def test_beyond_this_machine_token_and_certificate_must_be_there(tmp_path, monkeypatch):
    """Missing, broken and unreadable files are named; an invalid address is refused."""
    network = WatchConfig(address="0.0.0.0", folder=str(tmp_path))
    for role in ROLES[1:]:
        (tmp_path / f"token-{role}").write_text(f"{role}0123456789abcdef")
    token = tmp_path / "token-look"
    with pytest.raises(ConfigError, match="cannot"):
        Access.configured(network, 0)
    for text in ("short", "x" * 300, "with spaces in the middle", "ö" * 20):
        token.write_text(text)
        with pytest.raises(ConfigError, match="install"):
            Access.configured(network, 0)
    token.write_text("0123456789abcdef0123456789abcdef\n")
    with pytest.raises(ConfigError, match=r"certificate\.pem"):
        PageServer("watch.html", Access.configured(network, 0), now_ns)
    with pytest.raises(ConfigError, match="'tablet'"):
        Access.configured(WatchConfig(address="tablet"), 0)
    assert Access.configured(WatchConfig(), 0) == Access(0)

    def denied(path: Path, *args: object) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_text", denied)
    with pytest.raises(ConfigError, match="token"):
        Access.configured(network, 0)
