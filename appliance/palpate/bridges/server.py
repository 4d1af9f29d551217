"""A TCP server with limits, for the bridges: at most `most` connections at a time.

If it is full, a silent connection is closed for a new one, so that idle or dead peers never keep a
controller out. A browser is dropped at its first bytes: a page of anybody can send a request to any
port that its reader reaches, with lines that would be commands of the serial line.
"""

from __future__ import annotations

import asyncio
import re
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress

from palpate.core.errors import AddressError, ConfigError

QUIET_S = 5.0
"""If the server is full, a connection that has sent nothing for this long is closed for a new
one."""
BUFFER = 64 * 1024
"""Most bytes that wait for one peer; a peer that does not read them is dropped."""
PACE_S = 0.005
"""Pause after each request or piece that a client sends, so that a flood leaves the other programs
of the computer their share."""
CLOSE_S = 1.0
"""Longest wait until a peer has read the rest."""

KEEPALIVE = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4}
"""Two minutes after a silent peer has died its connection ends; a live peer may be silent for
hours."""
HEAD = 64
"""First bytes of a connection that are looked at."""
BROWSER = re.compile(rb"[A-Za-z]+ (?:[/*]|[\w.-]+:)|\x16\x03")
"""Begin of an HTTP request, or of TLS, whose first message can contain bytes of a page's server."""

Serve = Callable[["TcpPeer"], Awaitable[None]]


class TcpPeer:
    """One connection."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, now_s: Callable[[], float]
    ) -> None:
        self.heard_s = now_s()
        self._reader, self._writer, self._now_s = reader, writer, now_s
        self._head = b""

    async def read(self, timeout_s: float | None) -> bytes:
        """The bytes that have come, b"" at the end. Raises TimeoutError, ConnectionError (also for
        a browser)."""
        async with asyncio.timeout(timeout_s):
            data = await self._reader.read(4096)
        self.heard_s = self._now_s()
        if len(self._head) < HEAD:
            self._head += data[: HEAD - len(self._head)]
            if BROWSER.match(self._head):
                raise ConnectionAbortedError("a browser speaks; this port has another protocol")
        return data

    def write(self, data: bytes) -> None:
        """Send without waiting; a peer that does not read is dropped."""
        if self._writer.transport.get_write_buffer_size() + len(data) > BUFFER:
            self.drop()
        elif not self._writer.is_closing():
            self._writer.write(data)

    async def flush(self, timeout_s: float) -> None:
        """Wait until the peer has read everything. Raises TimeoutError, ConnectionError."""
        async with asyncio.timeout(timeout_s):
            await self._writer.drain()

    def drop(self) -> None:
        self._writer.transport.abort()

    async def close(self) -> None:
        """End the connection. Bytes that the peer does not read within CLOSE_S are dropped, so that
        the program can end."""
        with suppress(OSError, TimeoutError):
            self._writer.close()
            async with asyncio.timeout(CLOSE_S):
                await self._writer.wait_closed()
        self.drop()


class TcpServer:
    """Serves connections to `address`. peers: the open connections. tasks: none that can fail."""

    tasks: tuple[asyncio.Task[None], ...] = ()

    def __init__(self, serve: Serve, most: int) -> None:
        self.peers: set[TcpPeer] = set()
        self.address = ("", 0)
        self._serve, self._most = serve, most

    async def open(self, host: str, port: int) -> None:
        """Listen. Raises AddressError if the address is in use or not there yet, ConfigError if
        this program may not listen there or the address is impossible."""
        try:
            server = await asyncio.start_server(self._connected, host, port, limit=8192, backlog=64)
        except (OSError, OverflowError, ValueError) as e:
            raise not_listening(host, port, e) from e
        self.address = server.sockets[0].getsockname()[:2]

    def _make_room(self, now_s: float) -> bool:
        """Whether there is room for another connection. If it is full, the connection that has been
        silent longest is dropped."""
        if len(self.peers) < self._most:
            return True
        quietest = min(self.peers, key=lambda peer: peer.heard_s)
        if now_s - quietest.heard_s < QUIET_S:
            return False
        self.peers.discard(quietest)
        quietest.drop()
        return True

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        now_s = asyncio.get_running_loop().time
        if not self._make_room(now_s()):
            writer.transport.abort()
            return
        connection = writer.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in KEEPALIVE.items():
            if hasattr(socket, name):  # not on every desktop
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        # the default of the kernel is some megabytes
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        peer = TcpPeer(reader, writer, now_s)
        self.peers.add(peer)
        try:
            await self._serve(peer)
        except (OSError, TimeoutError):
            pass  # the peer is gone or hangs; the others are not affected
        except asyncio.CancelledError:
            pass  # the program ends; asyncio would print a traceback for a cancelled connection
        finally:
            self.peers.discard(peer)
            await peer.close()


def not_listening(host: str, port: int, e: Exception) -> ConfigError:
    """The error for an address where this program cannot listen."""
    why = str(getattr(e, "strerror", None) or e).lower()
    passing = isinstance(e, OSError) and not isinstance(e, PermissionError)
    return (AddressError if passing else ConfigError)(
        f"--listen {host}:{port}: {why}; name an address of this machine and a free port"
    )


def address(text: str) -> tuple[str, int]:
    """HOST:PORT. Raises ConfigError."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(
            f"--listen {text}: not an address; use HOST:PORT, for example 127.0.0.1:1502"
        )
    return host.strip("[]"), int(port)
