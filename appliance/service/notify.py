"""The room of the service manager: sd_notify. In: how the box is, once a turn. Out: READY, STATUS, WATCHDOG, STOPPING.

Each is a datagram to the socket that systemd names in the environment; where it names none nothing is said.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING

from appliance.core.clock import Clock
from appliance.core.errors import ConfigError

if TYPE_CHECKING:
    from appliance.core.health import Health

FEEDS = 10
"""How often the watchdog is fed within its time: so nearly all of it is left for one turn of the loop."""


class Manager:
    """Tells systemd what `Box` tells a pulse. Never waits: what the socket does not take is said again next turn.

    environ: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID as systemd sets them. clock: a real one; systemd's watchdog
    does not wait for a simulated one. Raises ConfigError where WATCHDOG_USEC is no number.
    """

    def __init__(self, clock: Clock, environ: Mapping[str, str] = os.environ) -> None:
        self._clock = clock
        self._address = environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # abstract: it has no place in the file system
            self._address = "\0" + self._address[1:]
        self._watchdog_us = _watchdog_us(environ)
        self._next_ns = clock.now_ns()
        self._ready, self._status = False, ""

    def turn(self, health: Health) -> None:
        """A turn of the loop is over: feed the watchdog, and say what is new. Once READY, always READY."""
        ready, status = health.streams, health.text
        now_ns = self._clock.now_ns()
        due = self._watchdog_us > 0 and now_ns >= self._next_ns
        ready = ready or self._ready
        news = []
        if status != self._status:
            news.append("STATUS=" + " ".join(status.splitlines()))  # a line of its own would be another message
        if ready and not self._ready:
            news.append("READY=1")
        if due:
            news.append("WATCHDOG=1")
            if not ready:  # the watchdog sleeps until READY; a start that takes its turns may go on
                news.append(f"EXTEND_TIMEOUT_USEC={self._watchdog_us}")
        if news and self._send(news):
            self._ready, self._status = ready, status
            if due:
                self._next_ns = now_ns + self._watchdog_us * 1000 // FEEDS

    def stopping(self) -> None:
        """The loop has ended; what is open is being answered."""
        self._send(["STOPPING=1"])

    def _send(self, news: list[str]) -> bool:
        if not self._address:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as door:
                door.setblocking(False)
                door.sendto("\n".join(news).encode(errors="replace"), self._address)
        except OSError:  # gone, or full: the manager's trouble must not become the robot's
            return False
        return True


def _watchdog_us(environ: Mapping[str, str]) -> int:
    """Microseconds of this process's watchdog, 0 where there is none."""
    text, pid = environ.get("WATCHDOG_USEC", "0"), environ.get("WATCHDOG_PID")
    if not text.isdecimal():
        raise ConfigError(f"WATCHDOG_USEC={text} is no number of microseconds; leave it to systemd, or unset it")
    return int(text) if pid in (None, str(os.getpid())) else 0
