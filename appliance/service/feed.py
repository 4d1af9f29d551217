"""The feed: what the box does, for programs that watch it. In: health, verdicts, frames, readers'
requests. Out: JSON lines on a local socket (PROTOCOL.md, part 4).

Nothing here waits for a reader: what one does not take in time is dropped and counted. Every
PERIOD_NS a bounded part of the work is done, and after a costly one more time passes, so that
readers take no more than SHARE of a core whatever they do: many of them, or bad ones, get their
lines later, and the loop is none the slower.
"""

from __future__ import annotations

import json
import os
import select
import socket
import stat
import time
from binascii import b2a_base64
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any

from appliance import __version__
from appliance.core.clock import Clock
from appliance.core.config import FEED_SCHEMA
from appliance.core.errors import FormatError
from appliance.core.health import Health
from appliance.core.log import TroubleLog
from appliance.core.observer import Observer
from appliance.core.types import Frames, Sweep, SweepFormat, Verdict
from appliance.service.status import Report

MOST_READERS = 64
QUEUE_BYTES = 64 * 1024
"""What waits for one reader; lines that several readers wait for are held once."""
SWEEP_BYTES = 640 * 1024
"""Most of a line with a window. Of those that are larger than a queue there is one at a time, held
once for all readers."""
TAKE_NS = 5_000_000_000
"""When the next of these comes, a reader that has not taken the last one within this time is
closed."""
HEAD_BYTES = 512
"""At most what stands beside the data in a line with a window."""
MOST_REQUEST = 1024
"""Bytes of a request."""
MOST_HZ = 20.0
"""Frames a second that a reader may ask for."""
MOST_VALUES_S = 10_000
"""Raw counts a second that are written as text: of a large skin fewer frames a second are
offered."""
PERIOD_NS = 30_000_000
"""Time between two looks at the sockets; system calls in every turn of the loop would cost more
than all that is sent."""
SHARE = 0.004
"""Most of a core that the looks at the sockets may take; waking the caches for them costs about as
much again."""
MOST_PERIOD_NS = 250_000_000
"""One costly look, as when the machine is busy, holds up the next by no more than this."""
SOON_NS = 5_000_000
"""A verdict, or another state, is sent so soon after the look before it."""
SERVED, HEARD, HEARD_BYTES = 16, 2, 64
"""Readers that are written to, and sockets and bytes that are read, at one look."""
KERNEL_BYTES = 16 * 1024
"""What the kernel may hold for a reader; it doubles this. Its default would come to 13 MB with 64
readers."""
STATE = ("skin", "trouble", "sweeping", "ready")
HEALTH_NS = 1_000_000_000
RETRY_NS = 5_000_000_000
"""Time between two attempts to bind the socket."""
_PARTS = 64
"""Lines that are sent by one system call."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What a reader asks for. frames_hz: frames a second, 0 for none. sweeps: windows of cut
    sweeps. None: as before."""

    frames_hz: float | None = None
    sweeps: bool | None = None


def requests(data: bytes, rest: bytes = b"") -> tuple[list[Asked], bytes]:
    """The requests in `data`, which continues `rest`, and the new unfinished rest.

    Raises FormatError for a line that is no request, or longer than MOST_REQUEST.
    """
    *lines, rest = (rest + data).split(b"\n")
    for line in (*lines, rest):
        if len(line) > MOST_REQUEST:
            raise FormatError(f"a request of over {MOST_REQUEST} bytes; end each with a line feed")
    return [_request(line) for line in lines], rest


def _request(line: bytes) -> Asked:
    """Raises FormatError."""
    advice = 'send {"frames": HZ} or {"sweeps": true}, as in PROTOCOL.md, part 4'
    try:
        asked = json.loads(line)
    except (ValueError, RecursionError) as e:
        raise FormatError(f"{_shown(line)} is not json; {advice}") from e
    if not isinstance(asked, dict) or not asked or not asked.keys() <= {"frames", "sweeps"}:
        raise FormatError(f"{_shown(line)} is no request; {advice}")
    hz, sweeps = asked.get("frames", 0), asked.get("sweeps", False)
    if type(hz) not in (int, float) or not 0 <= hz <= MOST_HZ:
        raise FormatError(f"{_shown(line)}: frames a second are a number from 0 to {MOST_HZ:g}")
    if type(sweeps) is not bool:
        raise FormatError(f"{_shown(line)}: sweeps are asked for with true or false")
    return Asked(float(hz) if "frames" in asked else None, sweeps if "sweeps" in asked else None)


def _shown(line: bytes) -> str:
    """The beginning of a line, in characters that every terminal may get."""
    text = ascii(line[:40])[2:-1]
    return f"{text}..." if len(line) > 40 else text


def encode(kind: str, content: Mapping[str, Any]) -> bytes:
    """One line of the feed. Numbers that JSON lacks, as a float skin may send them, become null."""
    values = {"type": kind, **content}
    try:
        text = json.dumps(values, allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(values), allow_nan=False)
    return text.encode() + b"\n"


def _sweep_line(sweep: Sweep) -> bytes:
    """The line with a sweep's window; its data are copied as few times as possible."""
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


def _weight(line: bytes) -> int:
    """What a line takes of a reader's queue: one that is larger than it is not the reader's own."""
    return len(line) if len(line) <= QUEUE_BYTES else 0


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(v) for name, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not isfinite(value) else value


class Reader:
    """One connection: what waits for it, and what it has asked for."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.frames_hz, self.sweeps = 0.0, False
        self.due = False
        """It stands in the line of those that are written to."""
        self._queue: deque[bytes] = deque()
        self._size = self._begun = self._lost = (
            0  # bytes that wait, bytes sent of the first line, lines dropped
        )
        self._rest = b""

    @property
    def waits(self) -> bool:
        """Whether there is something to send."""
        return bool(self._queue or self._lost)

    def put(self, line: bytes) -> None:
        """Queue a line; the oldest that were not begun give way to it."""
        self._queue.append(line)
        self._size += _weight(line)
        first = 1 if self._begun else 0
        while self._size > QUEUE_BYTES and len(self._queue) > first:
            self._size -= _weight(self._queue[first])
            del self._queue[first]
            self._lost += 1

    def put_or_miss(self, line: bytes | None) -> None:
        """Queue a line where there is room, else count it as lost. None: there is no room for it
        with anybody."""
        if line is None or self._size + _weight(line) > QUEUE_BYTES:
            self._lost += 1
        else:
            self.put(line)

    def takes(self, line: bytes) -> bool:
        """Whether this line waits, or was begun."""
        return any(one is line for one in self._queue)

    def send(self) -> None:
        """Send what the reader takes now; between two lines it first gets to know how many it has
        lost.

        Raises OSError where it is gone.
        """
        lost = 0 if self._begun else self._lost
        if lost:
            self._prepend(encode("lost", {"lines": lost}))
        try:
            parts = islice(self._queue, 1, _PARTS)
            sent = self.connection.sendmsg([memoryview(self._queue[0])[self._begun :], *parts])
        except BlockingIOError:
            if lost:
                self._drop_first()
            return
        self._lost -= lost
        self._begun += sent
        while self._queue and self._begun >= len(self._queue[0]):
            self._begun -= len(self._queue[0])
            self._drop_first()

    def hear(self) -> list[Asked]:
        """What it asks for now. Raises FormatError for what is no request, EOFError and OSError
        where it is gone."""
        try:
            data = self.connection.recv(HEARD_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise EOFError
        found, self._rest = requests(data, self._rest)
        return found

    def close(self, why: str = "") -> None:
        """Send what it takes at once, and why it is closed; a line that was begun is not cut by
        another."""
        with suppress(OSError):
            while self.waits:
                before = len(self._queue)
                self.send()
                if len(self._queue) == before:
                    break
            if why and not self.waits:
                self.connection.send(encode("closed", {"why": why}))
        self.connection.close()

    def _prepend(self, line: bytes) -> None:
        self._queue.appendleft(line)
        self._size += _weight(line)

    def _drop_first(self) -> None:
        self._size -= _weight(self._queue.popleft())


class FeedServer(Observer):
    """Offers the feed at `path` to at most MOST_READERS programs of the socket's group.

    format: of the sweeps. facts: what the first line says beside the format (PROTOCOL.md: source,
    bundle, labels, skin). clock, more: as for Report. spent_ns: processor time that this thread has
    taken so far.
    """

    def __init__(
        self,
        path: Path,
        format: SweepFormat,
        facts: Mapping[str, Any],
        clock: Clock,
        more: Callable[[], Mapping[str, Any]] = dict,
        spent_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self._path, self._clock, self._report, self._spent_ns = (
            path,
            clock,
            Report(clock, more),
            spent_ns,
        )
        self._most_hz = min(MOST_HZ, MOST_VALUES_S / format.channels)
        self._hello = encode(
            "hello",
            {
                "schema": FEED_SCHEMA,
                "version": __version__,
                "pid": os.getpid(),
                **facts,
                "format": format.json(),
                "window_s": format.window / format.rate_hz,
                "frames_hz": self._most_hz,
            },
        )
        self._listener: socket.socket | None = None
        self._poll = select.epoll()
        self._readers: dict[int, Reader] = {}
        self._due: deque[Reader] = (
            deque()
        )  # those with something to send, in the order in which they get their turn
        self._newest: Frames | None = None
        self._large, self._large_ns = (
            b"",
            0,
        )  # the last line that was larger than a queue, and when it came
        self._retry_ns = self._health_ns = self._next_ns = clock.now_ns()
        self._health = b""  # the line of this second
        self._tick, self._fresh = 0, False
        self._state: tuple[object, ...] = ()
        self._log = TroubleLog(
            f"feed: {path} cannot be offered",
            "classifying goes on; see feed.socket",
            end=f"feed: offered at {path}",
        )

    def frames(self, frames: Frames) -> None:
        """Keep the newest."""
        self._newest = frames

    def answered(self, verdict: Verdict) -> None:
        """Have a verdict sent at the end of the turn."""
        if self._readers:
            self._to_all(encode("verdict", verdict.as_dict()))
            self._fresh = True

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Have the window of a sweep sent to those who asked for it; one for which there is no room
        is lost to them."""
        asked = [reader for reader in self._readers.values() if reader.sweeps]
        if not (asked and len(sweep.frames)):
            return
        size = sweep.frames.taxels.nbytes * 4 // 3 + HEAD_BYTES
        small, now_ns = size <= QUEUE_BYTES, self._clock.now_ns()
        line = (
            _sweep_line(sweep)
            if small or (size <= SWEEP_BYTES and self._last_is_taken(now_ns))
            else None
        )
        if line and not small:
            self._large, self._large_ns = line, now_ns
        for reader in asked:
            if reader.connection.fileno() < 0:  # closed for the sake of this one
                continue
            reader.put_or_miss(line)
            self._let_wait(reader)

    def turn(self, health: Health) -> None:
        """Queue what is new; when it is time, take up connections and requests, and send to the
        next few readers."""
        state = health.skin, health.trouble, health.sweeping, health.ready
        if state != self._state:
            self._state, self._fresh = state, True
            if self._readers:
                self._to_all(encode("state", dict(zip(STATE, state, strict=True))))
        now_ns = self._clock.now_ns()
        if now_ns < self._next_ns - (PERIOD_NS - SOON_NS if self._fresh else 0):
            return
        begun_ns, self._fresh = self._spent_ns(), False
        listener = self._listener or self._offer(now_ns)
        if listener:
            self._work(listener, health, now_ns)
        pause_ns = round((self._spent_ns() - begun_ns) / SHARE)
        self._next_ns = now_ns + min(max(pause_ns, PERIOD_NS), MOST_PERIOD_NS)

    def _work(self, listener: socket.socket, health: Health, now_ns: int) -> None:
        if now_ns >= self._health_ns:
            self._health_ns, self._health = now_ns + HEALTH_NS, b""
            if self._readers:
                self._to_all(self._health_line(health))
        self._put_frame(now_ns)
        for number, events in self._poll.poll(0, HEARD):
            if number in self._readers:
                self._hear(
                    self._readers[number], gone=bool(events & (select.EPOLLHUP | select.EPOLLERR))
                )
            else:
                self._take_up(listener, health)
        self._send()

    def stopping(self) -> None:
        """Close all connections and remove the socket."""
        for reader in [*self._readers.values()]:
            self._close(reader, "the box is stopping")
        self._poll.close()
        if self._listener:
            self._listener.close()
            self._listener = None
            with suppress(OSError):
                self._path.unlink()

    def _last_is_taken(self, now_ns: int) -> bool:
        """Whether no reader takes the last large line any more; who has had its time for that is
        closed."""
        taking = [reader for reader in self._readers.values() if reader.takes(self._large)]
        if taking and now_ns < self._large_ns + TAKE_NS:
            return False
        for reader in taking:
            self._close(
                reader, f"it has not taken a sweep within {TAKE_NS / 1e9:g} s; read without pause"
            )
        self._large = b""
        return True

    def _offer(self, now_ns: int) -> socket.socket | None:
        """Bind the socket where it is time to try; None where it is not bound."""
        if now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            self._log.attempt(self._bind)
        return self._listener

    def _bind(self) -> None:
        """Raises OSError."""
        _clear(self._path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            with _umask(0o117):
                listener.bind(os.fspath(self._path))
            listener.listen(MOST_READERS)
        except OSError:
            listener.close()
            raise
        self._poll.register(listener, select.EPOLLIN)
        self._listener = listener

    def _put_frame(self, now_ns: int) -> None:
        """Queue the newest frame for those whose next one is due; made once, however many want
        it."""
        tick = int(now_ns * self._most_hz) // 1_000_000_000
        before, self._tick = self._tick, tick
        if tick == before or self._newest is None:
            return
        due = [r for r in self._readers.values() if _due(r.frames_hz / self._most_hz, before, tick)]
        if not due:
            return
        frames, self._newest = self._newest, None  # one that has been sent is not sent again
        line = encode(
            "frame", {"time_ns": int(frames.t_ns[-1]), "taxels": frames.taxels[-1].tolist()}
        )
        for reader in due:
            reader.put(line)
            self._let_wait(reader)

    def _take_up(self, listener: socket.socket, health: Health) -> None:
        """Accept one connection, which first hears what the box is and how it is."""
        try:
            connection, _ = listener.accept()
        except OSError:  # it has gone again, or there are no file descriptors left
            return
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
        reader = Reader(connection)
        if len(self._readers) >= MOST_READERS:
            reader.close(f"{MOST_READERS} readers are connected already; close one")
            return
        self._readers[connection.fileno()] = reader
        self._poll.register(connection, select.EPOLLIN)
        reader.put(self._hello)
        reader.put(self._health_line(health))
        self._let_wait(reader)

    def _health_line(self, health: Health) -> bytes:
        """Made once a second at most: those who connect again and again would make it the costliest
        of all."""
        self._health = self._health or encode("health", self._report(health))
        return self._health

    def _hear(self, reader: Reader, *, gone: bool) -> None:
        """Take up its requests. gone: it has closed the connection, perhaps after them."""
        try:
            asked = reader.hear()
        except FormatError as e:
            self._close(reader, str(e))
            return
        except (OSError, EOFError) as e:
            if gone or isinstance(e, OSError):
                self._close(reader)
            else:  # it asks for nothing more, and goes on reading
                self._poll.modify(reader.connection, 0)
            return
        for request in asked:
            if request.frames_hz is not None:
                reader.frames_hz = min(request.frames_hz, self._most_hz)
            if request.sweeps is not None:
                reader.sweeps = request.sweeps

    def _send(self) -> None:
        """Write to the next few; who has more to get stands at the end again."""
        for _ in range(min(SERVED, len(self._due))):
            reader = self._due.popleft()
            reader.due = False
            if reader.connection.fileno() < 0:  # closed meanwhile
                continue
            try:
                reader.send()
            except OSError:
                self._close(reader)
                continue
            if reader.waits:
                self._let_wait(reader)

    def _to_all(self, line: bytes) -> None:
        for reader in self._readers.values():
            reader.put(line)
            self._let_wait(reader)

    def _let_wait(self, reader: Reader) -> None:
        if not reader.due:
            reader.due = True
            self._due.append(reader)

    def _close(self, reader: Reader, why: str = "") -> None:
        number = reader.connection.fileno()
        del self._readers[number]
        self._poll.unregister(number)
        reader.close(why)


def _due(share: float, before: int, tick: int) -> bool:
    """Whether a reader that wants this share of the ticks wants the one of those after `before` up
    to `tick`."""
    return int(before * share) != int(tick * share)


def _clear(path: Path) -> None:
    """Remove the socket of a process that has died. Raises OSError where something else is
    there."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError("what is there is not a socket; move it away")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:  # somebody is there, and busy
            pass
    raise OSError(
        "another program offers its feed there; end it, or give this one a path of its own"
    )


@contextmanager
def _umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)
