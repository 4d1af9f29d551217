"""The box as a service of systemd: sends READY, STATUS, WATCHDOG and STOPPING as datagrams
(sd_notify) to the socket named in the environment, and logs a line for each verdict."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from logging import INFO, WARNING

from palpate.core.clock import Clock
from palpate.core.log import log
from palpate.core.observer import Health, Observer
from palpate.core.status import REASONS, Status
from palpate.core.types import Verdict

FEEDS = 10
"""How often the watchdog is fed within its time, so that nearly all of it is left for one turn of
the loop."""
MOST_DIGITS = 18
"""Digits of the longest watchdog time in us, some 30,000 years."""


class Notifier(Observer):
    """Sends systemd the state of the box. Never waits: a message that the socket does not accept is
    sent again in the next turn.

    environ: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID, set by systemd. clock: a real clock, as
    systemd's watchdog does not follow a simulated clock. note: stands after each state.
    """

    def __init__(
        self, clock: Clock, environ: Mapping[str, str] = os.environ, note: str = ""
    ) -> None:
        self._clock, self._note = clock, note
        self._address = environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # abstract, without a place in the file system
            self._address = "\0" + self._address[1:]
        self._watchdog_us = _watchdog_us(environ)
        self._next_ns = clock.now_ns()
        self._ready, self._status = False, ""

    def turn(self, health: Health) -> None:
        """Feed the watchdog, and send changes. Once READY, always READY."""
        ready, status = health.streams, health.text + self._note
        now_ns = self._clock.now_ns()
        due = self._watchdog_us > 0 and now_ns >= self._next_ns
        ready = ready or self._ready
        messages = []
        if status != self._status:
            # a line break would begin another message
            messages.append("STATUS=" + " ".join(status.splitlines()))
        if ready and not self._ready:
            messages.append("READY=1")
        if due:
            messages.append("WATCHDOG=1")
            # the watchdog begins with READY; until then each turn extends the time for the start
            if not ready:
                messages.append(f"EXTEND_TIMEOUT_USEC={self._watchdog_us}")
        if messages and self._send(messages):
            self._ready, self._status = ready, status
            if due:
                self._next_ns = now_ns + self._watchdog_us * 1000 // FEEDS

    def stopping(self) -> None:
        self._send(["STOPPING=1"])

    def _send(self, messages: list[str]) -> bool:
        if not self._address:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
                manager.setblocking(False)
                manager.sendto("\n".join(messages).encode(errors="replace"), self._address)
        except OSError:  # gone, or full: not a fault of the robot
            return False
        return True


def _watchdog_us(environ: Mapping[str, str]) -> int:
    """Microseconds of this process's watchdog, 0 if it has none, or if the value is unusable."""
    text, pid = environ.get("WATCHDOG_USEC") or "0", environ.get("WATCHDOG_PID")
    if not (text.isdecimal() and text.isascii() and len(text) <= MOST_DIGITS):
        log.warning(
            f"WATCHDOG_USEC={text[:40]!a} is not a number of microseconds, so no watchdog is fed;"
            " leave it to systemd, or unset it"
        )
        return 0
    return int(text) if pid in (None, "", str(os.getpid())) else 0


def words(v: Verdict) -> str:
    """A verdict in words: "sweep 7: plastic rough, 98.7 % (1.2 ms)"."""
    if v.status is Status.RECORDED:
        filled = f"{v.lost} lost frames filled in" if v.lost else ""
        return "; ".join(filter(None, (f"sweep {v.sweep}: recorded", filled, v.detail)))
    if not v.status.classified:
        why = "; ".join(filter(None, (REASONS[v.status], v.detail)))
        return f"sweep {v.sweep}: no answer, {v.status}: {why}"
    what = v.label if v.status is Status.OK else f"{v.status}, perhaps {v.label}"
    fused = f" after {v.fused} sweeps" if v.fused > 1 else ""
    early = f", early at {v.share:.0%} of the window".replace("%", " %") if v.share < 1 else ""
    detail = f"; {v.detail}" if v.detail else ""
    return (
        f"sweep {v.sweep}: {what}, {100 * v.probability:.1f} %{fused}{early} "
        f"({v.latency_ns / 1e6:.1f} ms){detail}"
    )


class VerdictLog(Observer):
    """Logs each verdict as one line."""

    def answered(self, verdict: Verdict) -> None:
        """Log a verdict; as a warning if it has no answer, or shows a displacement of the
        contact."""
        fine = (
            verdict.status.classified or verdict.status is Status.ABORTED
        ) and verdict.displacement is None
        log.log(INFO if fine else WARNING, words(verdict))
