"""The connection of one feed reader: its requests and its queue (PROTOCOL.md, part 4).

Nothing here waits for the reader. Lines that it does not take in time are dropped and counted.
"""

from __future__ import annotations

import json
import socket
from binascii import b2a_base64
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from typing import Annotated, Any

from palpate.core.errors import FormatError
from palpate.core.schema import Within, typed
from palpate.core.types import Sweep

QUEUE_BYTES = 768 * 1024
"""Most bytes that wait for one reader: a window of 640 kB as text, and other lines. Readers that
stand still hold the same lines."""
LINE_BYTES = 200
"""What a line counts next to its bytes: some 60 for the object, and a place in each queue. Without
it frames of minutes would wait, whose places in twenty queues take more than the frames."""
HEARD_BYTES = 64
"""Bytes of requests that are read at once."""
MOST_REQUEST = 1024
"""Longest request, in bytes."""
MOST_HZ = 20.0
"""Highest frame rate that a reader may request."""
_PARTS = 64
"""Most lines that one system call sends."""


@dataclass(frozen=True, slots=True)
class FeedRequest:
    """A request of a reader. frames: frames a second, 0 for none. sweeps: whether the reader gets
    the windows of sweeps. None leaves the earlier request as it is."""

    frames: Annotated[float, Within(0, MOST_HZ)] | None = None
    sweeps: bool | None = None


def requests(data: bytes, rest: bytes = b"") -> tuple[list[FeedRequest], bytes]:
    """The requests in `data`, which continues `rest`, and the new unfinished rest.

    Raises FormatError for a line that is not a request or is longer than MOST_REQUEST.
    """
    *lines, rest = (rest + data).split(b"\n")
    for line in (*lines, rest):
        if len(line) > MOST_REQUEST:
            raise FormatError(f"a request of over {MOST_REQUEST} bytes; end each with a line feed")
    return [_request(line) for line in lines], rest


def _request(line: bytes) -> FeedRequest:
    try:
        asked = json.loads(line)
        if asked == {} or None in asked.values():
            raise TypeError("it holds nothing")
        return typed(FeedRequest, asked)
    except (ValueError, TypeError, AttributeError, RecursionError) as e:
        raise FormatError(
            f'{_shown(line)} is not a request; send json: {{"frames": HZ}}, from 0 to '
            f'{MOST_HZ:g} a second, or {{"sweeps": true or false}}'
        ) from e


def _shown(line: bytes) -> str:
    """The beginning of a line, in ASCII that is safe on every terminal."""
    text = ascii(line[:40])[2:-1]
    return f"{text}..." if len(line) > 40 else text


def encode(kind: str, content: Mapping[str, Any]) -> bytes:
    """One line of the feed. NaN and infinity, which a float skin may send, become null."""
    values = {"type": kind, **content}
    try:
        text = json.dumps(values, allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(values), allow_nan=False)
    return text.encode() + b"\n"


def sweep_line(sweep: Sweep) -> bytes:
    """The line with a sweep's window. It can be large, so its data are copied as rarely as
    possible."""
    taxels = sweep.frames.taxels
    about = {
        "sweep": sweep.id,
        "start_ns": sweep.start_ns,
        "shape": taxels.shape,
        "dtype": str(taxels.dtype),
    }
    data = b2a_base64(
        taxels.astype(taxels.dtype.newbyteorder("<"), order="C", copy=False).data, newline=False
    )
    return b"".join((encode("sweep", about)[:-2], b', "data": "', data, b'"}\n'))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(v) for name, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not isfinite(value) else value


class Reader:
    """One connection with its queue of lines and its requests."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.frames_hz, self.sweeps = 0.0, False
        self._queue: deque[bytes] = deque()
        self._size = 0  # bytes in the queue, with LINE_BYTES each
        self._begun = 0  # bytes of the first line that were sent
        self._lost = 0  # lines that were dropped
        self._rest = b""

    @property
    def waits(self) -> bool:
        return bool(self._queue or self._lost)

    def put(self, line: bytes) -> None:
        """Queue a line. Where there is no room, the oldest lines are dropped, except a line that
        was sent in part."""
        self._queue.append(line)
        self._size += len(line) + LINE_BYTES
        first = 1 if self._begun else 0
        while self._size > QUEUE_BYTES and len(self._queue) > first:
            self._drop(first)
            self._lost += 1

    def put_window(self, line: bytes | None) -> None:
        """Queue a line if there is room, else count it as lost. None: it is too large for all."""
        if line is None or self._size + len(line) + LINE_BYTES > QUEUE_BYTES:
            self._lost += 1
        else:
            self.put(line)

    def send(self) -> None:
        """Send as much as the reader takes now. Between two lines it first gets the number of
        lines that it has lost.

        Raises OSError if the reader is gone.
        """
        lost = 0 if self._begun else self._lost
        if lost:
            self._queue.appendleft(encode("lost", {"lines": lost}))
            self._size += len(self._queue[0]) + LINE_BYTES
        try:
            parts = islice(self._queue, 1, _PARTS)
            sent = self.connection.sendmsg([memoryview(self._queue[0])[self._begun :], *parts])
        except BlockingIOError:
            if lost:
                self._drop(0)
            return
        self._lost -= lost
        self._begun += sent
        while self._queue and self._begun >= len(self._queue[0]):
            self._begun -= len(self._queue[0])
            self._drop(0)

    def receive(self) -> list[FeedRequest]:
        """The requests that have come since the last call.

        Raises FormatError for a line that is not a request, EOFError or OSError if the reader is
        gone.
        """
        try:
            data = self.connection.recv(HEARD_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise EOFError
        found, self._rest = requests(data, self._rest)
        return found

    def close(self, why: str = "") -> None:
        """Send as much as the reader takes at once, then the reason, and close. The reason is left
        out if a line was sent in part, since it would stand in the middle of that line."""
        with suppress(OSError):
            while self.waits:
                before = len(self._queue)
                self.send()
                if len(self._queue) == before:
                    break
            if why and not self.waits:
                self.connection.send(encode("closed", {"why": why}))
        self.connection.close()

    def _drop(self, at: int) -> None:
        self._size -= len(self._queue[at]) + LINE_BYTES
        del self._queue[at]
