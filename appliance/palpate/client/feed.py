"""Reads the feed of the running box (PROTOCOL.md, part 4) from its socket, each line as a dict. It
connects again when the box restarts. numpy is not needed."""

from __future__ import annotations

import json
import os
import socket
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from palpate.core.clock import Clock, SystemClock, wait_readable
from palpate.core.errors import FeedError, FormatError
from palpate.core.runtime_folder import FEED, FEED_SCHEMA, RUNTIME

DEFAULT = f"{RUNTIME}/{FEED}"
MOST_LINE = 1 << 20
"""Longest line in bytes; the box sends far shorter lines."""
RETRY_NS = 500_000_000
"""Time between two attempts to connect."""
ENDED = "the box has closed the feed; it is read again when the box is back"


def parse(data: bytes, rest: bytes = b"") -> tuple[list[dict[str, Any]], bytes]:
    """The lines in `data`, which continues `rest`, and the new unfinished rest. Raises FormatError
    for a line that is not of a feed."""
    *lines, rest = (rest + data).split(b"\n")
    if len(rest) > MOST_LINE:
        raise FormatError(
            f"a line of over {MOST_LINE} bytes; is this socket the feed of a palpate?"
        )
    return [_line(line) for line in lines], rest


def _line(text: bytes) -> dict[str, Any]:
    """Raises FormatError."""
    try:
        line = json.loads(text)
        if not isinstance(line["type"], str):
            raise TypeError
    except (ValueError, TypeError, KeyError, RecursionError) as e:
        raise FormatError(
            f"{text[:40]!a} is not a line of a feed; is this socket the feed of a palpate?"
        ) from e
    if line["type"] == "hello" and line.get("schema") != FEED_SCHEMA:
        raise FormatError(
            f"the box speaks schema {line.get('schema')!r} of the feed, this reader "
            f"{FEED_SCHEMA}; update one of them"
        )
    return dict(line)


class Feed:
    """The feed at `path`. `read` connects if that is needed, so a missing box is not an error.

    frames_hz, sweeps: requested at each connection, see `ask`. trouble: the reason why nothing is
    read now, "" once a line has come: a socket that only takes connections is no feed. Only one
    thread may use it; `fileno` is for waiting elsewhere.
    """

    def __init__(
        self,
        path: str | Path = DEFAULT,
        *,
        frames_hz: float = 0,
        sweeps: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.path = Path(path)
        self.trouble = "nothing has come yet; see palpate status"
        self._reason = ""  # of the box, for closing this connection
        self._asked: dict[str, Any] = {"frames": frames_hz, "sweeps": sweeps}
        self._clock = clock or SystemClock()
        self._retry_ns = self._clock.now_ns()
        self._connection: socket.socket | None = None
        self._lines: deque[dict[str, Any]] = deque()
        self._rest = b""

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Every line, also after restarts of the box. Raises FeedError if none comes for ten
        seconds."""
        while True:
            line = self.read(10.0)
            if line is None:
                why = self.trouble or "nothing came for 10 s; see palpate status"
                raise FeedError(f"{self.path}: {why}")
            yield line

    @property
    def connected(self) -> bool:
        return self._connection is not None

    def fileno(self) -> int:
        """The connection's file descriptor, -1 without one."""
        return self._connection.fileno() if self._connection else -1

    def ask(self, *, frames_hz: float | None = None, sweeps: bool | None = None) -> None:
        """Request frames at this rate (0 to 20 a second), and the windows of sweeps; None: as
        before."""
        if frames_hz is not None:
            self._asked["frames"] = frames_hz
        if sweeps is not None:
            self._asked["sweeps"] = sweeps
        self._request()

    def read(self, timeout_s: float = 1.0) -> dict[str, Any] | None:
        """The next line; None if none has come in that time, with a reason in `trouble` if there is
        one."""
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not self._lines:
            left_ns = end_ns - self._clock.now_ns()
            if self._connection is None and not self._connect():
                if left_ns <= 0:
                    return None
                self._clock.sleep_until(min(end_ns, self._retry_ns))
            elif wait_readable(self.fileno(), max(0, left_ns) / 1e9):
                self._receive()
            elif left_ns <= 0:
                return None
        return self._lines.popleft()

    def close(self) -> None:
        """End the connection; the next `read` opens another."""
        if self._connection:
            self._connection.close()
            self._connection = None
        self._rest = b""

    def lose(self, why: str) -> None:
        """Close, and connect again after a while. why: `trouble` until then, unless the box has
        sent a reason."""
        self.close()
        self.trouble, self._reason = self._reason or why, ""
        self._retry_ns = self._clock.now_ns() + RETRY_NS

    def _connect(self) -> bool:
        """Connect when it is time to try, and repeat the requests."""
        now_ns = self._clock.now_ns()
        if now_ns < self._retry_ns:
            return False
        self._retry_ns = now_ns + RETRY_NS
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.settimeout(RETRY_NS / 1e9)
            connection.connect(os.fspath(self.path))
        except OSError as e:
            connection.close()
            self.trouble = _why(e)
            return False
        self._connection = connection
        self._request()
        return self._connection is not None

    def _request(self) -> None:
        if not self._connection:
            return
        try:
            self._connection.sendall(json.dumps(self._asked).encode() + b"\n")
        except OSError as e:
            self.lose(_why(e))

    def _receive(self) -> None:
        if not self._connection:
            return
        try:
            data = self._connection.recv(1 << 16)
            if not data:
                raise FeedError(ENDED)
            lines, self._rest = parse(data, self._rest)
        except OSError as e:
            self.lose(_why(e))
        except (FeedError, FormatError) as e:
            self.lose(str(e))
        else:
            for line in lines:
                # the box gives its reason before it closes
                self._reason = str(line.get("why")) if line["type"] == "closed" else ""
                self.trouble = self._reason
            self._lines += lines


def _why(e: OSError) -> str:
    """The reason why the feed cannot be read, for a person."""
    if isinstance(e, PermissionError):
        return (
            "you may not read the feed; join group palpate (sudo adduser NAME palpate), and log "
            "in again"
        )
    if isinstance(e, BlockingIOError):
        return "the box has no room for another connection now; it is tried again"
    if isinstance(e, (FileNotFoundError, ConnectionRefusedError)):
        return (
            "no palpate offers its feed there: the box is off or restarting; start it (systemctl "
            "start palpate), or see store.runtime"
        )
    return f"{str(e.strerror or e).lower()}; see palpate status"
