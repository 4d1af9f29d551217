"""The feed: a local socket that sends health, verdicts, frames and sweeps as JSON lines to programs
that watch the box (PROTOCOL.md, part 4).

Nothing here waits for a reader. The sockets are served at most every PERIOD_NS, each time a bounded
part of them, and less often if that was costly. So all readers together take no more than SHARE of
a core. With hostile readers the lines come later, but the loop does not slow down.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate import __version__
from palpate.core.clock import Clock
from palpate.core.errors import FormatError
from palpate.core.log import TroubleLog
from palpate.core.observer import Facts, Health, Observer
from palpate.core.runtime_folder import FEED_SCHEMA
from palpate.core.types import Frames, Sweep, SweepFormat, Verdict
from palpate.service.feed_reader import MOST_HZ, QUEUE_BYTES, Reader, encode, sweep_line
from palpate.service.status_file import Report

MOST_READERS = 64
MOST_VALUES_S = 10_000
"""Most raw counts a second that are written as text; a large skin offers fewer frames a second."""
PERIOD_NS = 30_000_000
"""Least time between two rounds. System calls in every turn of the loop would cost more than
everything that is sent."""
SHARE = 0.004
"""Largest share of a core for the rounds. Refilling the caches afterwards costs about as much
again."""
MOST_PERIOD_NS = 250_000_000
"""Longest pause after a round, however costly it was (the machine may just have been busy)."""
SOON_NS = 5_000_000
"""Least time between a round and the next if there is a new verdict or state to send."""
HEARD = 2
"""Sockets that are read in one round."""
KERNEL_BYTES = 16 * 1024
"""Send buffer of a reader in the kernel, which doubles it. The default would come to 13 MB with 64
readers."""
STATE = ("skin", "trouble", "sweeping", "ready")
HEALTH_NS = 1_000_000_000
RETRY_NS = 5_000_000_000
"""Time between two attempts to bind the socket."""


class FeedServer(Observer):
    """Offers the feed at `path` to at most MOST_READERS programs of the socket's group.

    A *round* takes up a connection, requests of some readers, and sends to all.

    format: of the sweeps. known: source, bundle, labels and skin for the first line (PROTOCOL.md).
    clock, facts: as for Report. spent_ns: processor time that this thread has used so far.
    """

    def __init__(
        self,
        path: Path,
        format: SweepFormat,
        known: Mapping[str, Any],
        clock: Clock,
        facts: Facts,
        spent_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self._path, self._clock, self._spent_ns = path, clock, spent_ns
        self._report = Report(clock, facts)
        self._most_hz = min(MOST_HZ, MOST_VALUES_S / format.channels)
        self._hello = _hello(format, known, self._most_hz)
        self._listener: socket.socket | None = None
        self._poll = select.epoll()
        self._readers: dict[int, Reader] = {}
        self._newest: Frames | None = None
        self._retry_ns = self._health_ns = self._next_ns = clock.now_ns()
        self._health = b""  # the line of this second
        self._tick, self._fresh = 0, False
        self._state: tuple[object, ...] = ()
        self._log = TroubleLog(
            f"feed: {path} cannot be offered",
            "classifying goes on; see store.runtime",
            end=f"feed: offered at {path}",
        )

    def frames(self, frames: Frames) -> None:
        self._newest = frames

    def answered(self, verdict: Verdict) -> None:
        """Queue a verdict; it is sent at the end of the turn."""
        if self._readers:
            self._to_all(encode("verdict", verdict.as_dict()))
            self._fresh = True

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Queue the window of a sweep for the readers that requested windows. A reader without room
        for it loses it."""
        asked = [reader for reader in self._readers.values() if reader.sweeps]
        if not (asked and len(sweep.frames)):
            return
        # a window that no reader gets is not written as text
        small = sweep.frames.taxels.nbytes * 4 // 3 < QUEUE_BYTES
        line = sweep_line(sweep) if small else None
        for reader in asked:
            reader.put_window(line)

    def turn(self, health: Health) -> None:
        """Queue a new state; begin the next round when it is time."""
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
                self._receive(
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

    def _offer(self, now_ns: int) -> socket.socket | None:
        """The bound socket, None if it is not bound; tries again every RETRY_NS."""
        if now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            self._log.attempt(self._bind)
        return self._listener

    def _bind(self) -> None:
        """Raises OSError."""
        _clear(self._path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            os.fchmod(listener.fileno(), 0o600)  # whatever the umask, nobody comes in before chmod
            listener.bind(os.fspath(self._path))
            self._path.chmod(0o660)
            listener.listen(MOST_READERS)
        except OSError:
            listener.close()
            raise
        self._poll.register(listener, select.EPOLLIN)
        self._listener = listener

    def _put_frame(self, now_ns: int) -> None:
        """Queue the newest frame for the readers whose next frame is due. Its line is made once for
        all of them."""
        tick = int(now_ns * self._most_hz) // 1_000_000_000
        before, self._tick = self._tick, tick
        if tick == before or self._newest is None:
            return
        due = [r for r in self._readers.values() if _due(r.frames_hz / self._most_hz, before, tick)]
        if not due:
            return
        frames, self._newest = self._newest, None  # so it is not sent again
        frame = {"time_ns": int(frames.t_ns[-1]), "taxels": frames.taxels[-1].tolist()}
        line = encode("frame", frame)
        for reader in due:
            reader.put(line)

    def _take_up(self, listener: socket.socket, health: Health) -> None:
        """Accept one connection; its first lines are `hello` and `health`."""
        try:
            connection, _ = listener.accept()
        except OSError:  # the peer is gone, or there are no file descriptors left
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

    def _health_line(self, health: Health) -> bytes:
        """The health line, made at most once a second: readers that connect again and again would
        make it the largest cost."""
        self._health = self._health or encode("health", self._report(health))
        return self._health

    def _receive(self, reader: Reader, *, gone: bool) -> None:
        """Take up a reader's requests. gone: the reader has closed the connection, perhaps after
        sending some."""
        try:
            asked = reader.receive()
        except FormatError as e:
            self._close(reader, str(e))
            return
        except (OSError, EOFError) as e:
            if gone or isinstance(e, OSError):
                self._close(reader)
            else:  # it will request nothing more, but goes on reading
                self._poll.modify(reader.connection, 0)
            return
        for request in asked:
            if request.frames is not None:
                reader.frames_hz = min(request.frames, self._most_hz)
            if request.sweeps is not None:
                reader.sweeps = request.sweeps

    def _send(self) -> None:
        for reader in [reader for reader in self._readers.values() if reader.waits]:
            try:
                reader.send()
            except OSError:
                self._close(reader)

    def _to_all(self, line: bytes) -> None:
        for reader in self._readers.values():
            reader.put(line)

    def _close(self, reader: Reader, why: str = "") -> None:
        number = reader.connection.fileno()
        del self._readers[number]
        self._poll.unregister(number)
        reader.close(why)


def _hello(format: SweepFormat, known: Mapping[str, Any], most_hz: float) -> bytes:
    program = {"schema": FEED_SCHEMA, "version": __version__, "pid": os.getpid()}
    sweeps = {"format": format.json(), "window_s": format.window / format.rate_hz}
    return encode("hello", {**program, **known, **sweeps, "frames_hz": most_hz})


def _due(share: float, before: int, tick: int) -> bool:
    """Whether a reader that gets this share of the ticks gets a tick after `before` and up to
    `tick`."""
    return int(before * share) != int(tick * share)


def _clear(path: Path) -> None:
    """Remove the socket of a process that has died. Raises OSError if the path holds anything
    else."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError("the file there is not a socket; move it away")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:  # a program listens there, and is busy
            pass
    raise OSError(
        "another program offers its feed there; end it, or give this one a path of its own"
    )
