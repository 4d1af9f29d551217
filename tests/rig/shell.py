"""Shell commands in the guest, from outside through the port of its agent."""

import base64
import json
import select
import socket
from dataclasses import dataclass

from tests.rig.guest_clock import GuestClock

REPLY_S = 60
"""Longest delay of an answer, by the guest's clock, beyond the time that the command itself may
take."""


class GuestFailed(AssertionError):
    """The guest failed to carry out a request."""


@dataclass(frozen=True, slots=True)
class Done:
    """The end of a shell command: its exit code and its output. rc 124: it ran out of time."""

    rc: int
    out: str


class Shell:
    """One command at a time; an answer that comes too late is skipped."""

    def __init__(self, port: socket.socket, clock: GuestClock) -> None:
        self._port, self._clock = port, clock
        self._rest, self._unanswered = b"", 0

    def run(
        self, line: str, *, timeout_s: float = 30, check: bool = False, stdin: bytes = b""
    ) -> Done:
        """Run a command as root to its end. Raises GuestFailed, also if `check` fails."""
        request = {"run": line, "timeout_s": timeout_s, "stdin": base64.b64encode(stdin).decode()}
        try:
            self._port.sendall(json.dumps(request).encode() + b"\n")
        except OSError as e:
            raise GuestFailed(f"the guest has left before: {line}") from e
        self._unanswered += 1
        if not self._clock.until(lambda: self._heard_answer(line), timeout_s + REPLY_S):
            raise GuestFailed(f"the guest sent nothing for {timeout_s + REPLY_S:.0f} s to: {line}")
        reply = json.loads(self._next())
        done = Done(reply["rc"], base64.b64decode(reply["out"]).decode(errors="replace"))
        if check and done.rc:
            raise GuestFailed(f"rc {done.rc} of: {line}\n{done.out[-2000:]}")
        return done

    def _heard_answer(self, line: str) -> bool:
        """Whether the answer to the latest command is complete."""
        if b"\n" not in self._rest and select.select([self._port], [], [], 0)[0]:
            more = self._port.recv(1 << 20)
            if not more:
                raise GuestFailed(f"the guest has left during: {line}")
            self._rest += more
        while self._unanswered > 1 and b"\n" in self._rest:
            self._next()
        return b"\n" in self._rest

    def _next(self) -> bytes:
        answer, _, self._rest = self._rest.partition(b"\n")
        self._unanswered -= 1
        return answer
