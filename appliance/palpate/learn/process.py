"""A process of its own that learns next to the loop. It prints a line of JSON for each step.
Nothing here waits: the loop looks for news between two turns."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from palpate.client.feed import MOST_LINE
from palpate.core.clock import Clock
from palpate.core.config import TeachConfig
from palpate.core.errors import ConfigError

LEARNS = "palpate_train.teach"
"""The program that learns. The box itself does not import it, nor what it needs."""
NEEDED = ("palpate_train", "scipy", "onnx")
"""Modules of the extra palpate[teach]."""
NICE = 19
"""Priority of a process next to the loop: the lowest."""
ENDED_S = 5.0
"""Longest wait for a killed process."""
QUIET_S = 300.0
"""Longest time without a line of news; the longest step takes far less."""

FREE = "free some memory, teach fewer sweeps, or use a desktop"
"""The remedy where a process hangs: a library that gets no memory may ask for it for ever."""

News = dict[str, Any]


def check_installed() -> None:
    """Raises ConfigError if this box cannot learn."""
    if missing := [name for name in NEEDED if not find_spec(name)]:
        advice = "make install installs it unless TEACH=0 was given"
        raise ConfigError(f"teaching needs {missing[0]}, which is not installed; {advice}")


def learning(folder: Path, settings: TeachConfig, *more: str) -> list[str]:
    """The command that assesses the sweeps in `folder`, or with options fits a bundle."""
    limits = ("--memory-mb", str(settings.memory_mb), "--cpu-s", str(round(settings.limit_s)))
    return [sys.executable, "-P", "-m", LEARNS, str(folder), *limits, *more]


class TeachingProcess:
    """A running process. limit_s: it is killed after this time, and after quiet_s without a line.
    group: it gets a process group of its own, with which it is killed. Raises ConfigError if it
    cannot be started."""

    def __init__(
        self,
        command: Sequence[str],
        limit_s: float,
        clock: Clock,
        *,
        group: bool = False,
        quiet_s: float = QUIET_S,
    ) -> None:
        self._clock, self._limit_s, self._quiet_s, self._group = clock, limit_s, quiet_s, group
        self._end_ns = clock.now_ns() + round(limit_s * 1e9)
        self._heard_ns = clock.now_ns()
        self._rest, self._told, self.ended = b"", False, False
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL")}
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                env=os.environ | threads,
                process_group=0 if group else None,
            )
        except OSError as e:
            raise ConfigError(
                f"{command[0]} cannot be started: {e.strerror}; install palpate[teach]"
            ) from e
        with suppress(OSError):  # the loop comes first
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICE)
        assert self._process.stdout
        self._output = self._process.stdout.fileno()
        os.set_blocking(self._output, False)

    def news(self) -> list[News]:
        """The lines that have come. The last is `assessed`, `taught` or `error`."""
        if self.ended:
            return []
        found = self._read()
        if (code := self._process.poll()) is None:
            why = self._overdue(bool(found))
        else:
            found, why = [*found, *self._read()], _why(code)
        self._told = self._told or any(one["type"] != "step" for one in found)
        if why:
            self.close()
        return [*found, {"type": "error", "text": why}] if why and not self._told else found

    def _overdue(self, heard: bool) -> str:
        """Why the running process must end, "" if it may go on."""
        now_ns = self._clock.now_ns()
        self._heard_ns = now_ns if heard else self._heard_ns
        if now_ns > self._end_ns:
            return f"it was not done within {self._limit_s:g} s; teach fewer sweeps"
        if now_ns > self._heard_ns + self._quiet_s * 1e9:
            return f"it got no further for {self._quiet_s:g} s; {FREE}"
        return ""

    def close(self) -> None:
        if self.ended:
            return
        self.ended = True
        with suppress(ProcessLookupError):
            (os.killpg if self._group else os.kill)(self._process.pid, signal.SIGKILL)
        self._process.wait(ENDED_S)
        assert self._process.stdout
        self._process.stdout.close()

    def _read(self) -> list[News]:
        while len(self._rest) < MOST_LINE:
            try:
                data = os.read(self._output, 65536)
            except BlockingIOError:
                break
            if not data:
                break
            self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        return [found for line in lines if (found := _parsed(line))]


def _parsed(line: bytes) -> News | None:
    """The object in a line with its type; None for a line of something else, as of a library."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("type"), str) else None


def _why(code: int) -> str:
    """The reason for an end without a result."""
    if code == -signal.SIGKILL:
        return "the process that learns was killed: there was not enough memory; teach fewer sweeps"
    if code == -signal.SIGXCPU:
        return f"the process that learns took more processor time than it may; {FREE}"
    return f"the process that learns ended with {code}; the log says why (journalctl -u palpate)"
