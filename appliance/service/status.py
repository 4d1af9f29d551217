"""The room of `palpate status`. In: how the box is each turn, and its verdicts. Out: these as one small JSON file, and the
file in words.

The file lies in memory (/run): it is written aside and renamed, so a reader has it whole, and never synced.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from appliance import __version__
from appliance.core import storage
from appliance.core.clock import Clock
from appliance.core.errors import ApplianceError, FormatError
from appliance.core.health import Health
from appliance.core.types import Status, Verdict
from appliance.service.journal import REASONS, WARNING

SCHEMA = 1
VERDICTS = 20
"""How many of the latest verdicts are told."""
PERIOD_NS = 1_000_000_000
SOON_NS = 100_000_000
"""A verdict, or another state of the skin, is told so soon after what was told before it."""
STALE_NS = 10_000_000_000
"""A file that has not changed for so long is of a program that hangs: it is the unit's watchdog time."""
MOST_BYTES = 1 << 20
_START = "systemctl start palpate, then journalctl -u palpate tells more"
WELL, NOT_RUNNING, SKIN_AWAY = os.EX_OK, 1, os.EX_UNAVAILABLE


class StatusFile:
    """Tells how the box is and what it has answered; gone when the program has ended in order.

    clock: the host's real one, which a reader in another process shares. more: further facts for JSON; a text among them
    is a line of its own in words, unless it is empty. log: told once where the file cannot be written; it is tried again.
    """

    def __init__(
        self, path: Path, clock: Clock, *, more: Callable[[], Mapping[str, Any]] = dict,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:  # fmt: skip
        self._path, self._clock, self._more, self._log = path, clock, more, log
        self._since_ns = self._next_ns = clock.now_ns()
        self._verdicts: deque[dict[str, Any]] = deque(maxlen=VERDICTS)
        self._fresh, self._skin, self._failed = False, "", False

    def send(self, verdict: Verdict) -> None:
        """Have a verdict told with the end of the turn."""
        self._verdicts.append(verdict.as_dict(arrays=False))
        self._fresh = True

    def turn(self, health: Health) -> None:
        """A turn is over: write what is due, once a second, and what is new soon."""
        now_ns = self._clock.now_ns()
        if health.skin != self._skin:
            self._skin, self._fresh = health.skin, True
        if now_ns < self._next_ns - (PERIOD_NS - SOON_NS if self._fresh else 0):
            return
        self._next_ns, self._fresh = now_ns + PERIOD_NS, False
        told = {
            **self._more(), **asdict(health), "time_ns": now_ns, "since_ns": self._since_ns, "pid": os.getpid(),
            "version": __version__, "schema": SCHEMA, "verdicts": list(self._verdicts),
        }  # fmt: skip
        # every user of the box may ask; the file lies in memory (/run), and on a card one sync a second would wear it
        self._try(lambda: storage.put(self._path, json.dumps(told).encode(), durable=False, mode=0o644))

    def stopping(self) -> None:
        """The loop has ended: what the file tells is no longer so."""
        self._try(lambda: self._path.unlink(missing_ok=True))

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except OSError as e:
            if not self._failed:
                self._log(f"{WARNING}status: {self._path} cannot be written: {e.strerror}; classifying goes on")
            self._failed = True
        else:
            self._failed = False


def read(path: Path, now_ns: int) -> dict[str, Any]:
    """What the file tells, with `running`, and `why` where it does not run. now_ns: of the clock that writes it.

    Raises FormatError where the file is none of this version's, ApplianceError where it may not be read.
    """
    try:
        with path.open("rb") as f:
            told = json.loads(f.read(MOST_BYTES))
        if not isinstance(told, dict) or told.get("schema") != SCHEMA:
            raise TypeError(f"no object of schema {SCHEMA}")
        pid, age_ns = int(told["pid"]), now_ns - int(told["time_ns"])
        told["verdicts"] = [v | {"status": Status(v["status"])} for v in told["verdicts"]]
        Health(**{name: told[name] for name in Health.__slots__})
    except FileNotFoundError:
        return {"running": False, "why": f"it does not run, or has begun just now (no {path}); {_START}"}
    except OSError as e:
        raise ApplianceError(f"{path} cannot be read: {e.strerror}; see store.status, or ask as root") from e
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
        raise FormatError(f"{path}: not a status of this version ({e}); restart the service") from e
    why = ""
    if not _alive(pid) or age_ns < 0:  # a file of before the last boot can be ahead of this boot's clock
        why = f"process {pid} has ended without a word; {_START}"
    elif age_ns > STALE_NS:
        why = f"process {pid} has told nothing for {_span(age_ns)}, it hangs; the service's watchdog starts it again"
    return told | {"running": not why, "why": why}


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:  # another user's
        return True
    except (OSError, OverflowError):
        return False
    return pid > 0


def exit_code(told: Mapping[str, Any]) -> int:
    """0 where all is well; 69 where the skin is away, 1 where it does not run."""
    if not told["running"]:
        return NOT_RUNNING
    return WELL if told["streams"] else SKIN_AWAY


def lines(told: Mapping[str, Any], now_ns: int) -> list[str]:
    """What `read` gave, in words: first how it is and what to do, then the last verdicts, the newest first."""
    if not told["running"]:
        return [f"not running: {told['why']}"]
    head = f"process {told['pid']}, palpate {told['version']}, source {told['source']}"
    said = [f"running for {_span(now_ns - told['since_ns'])} ({head})"]
    facts = {"skin": _skin(told), "bundle": told["bundle"], "sweeps": f"{told['answered']} answered"}
    if told["dropped"]:
        facts["serial"] = f"{told['dropped']} sentences dropped, since nobody read them; look at the robot's end"
    own = {"version", "why", *Health.__slots__}
    facts |= {name: text for name, text in told.items() if name not in own and isinstance(text, str) and text}
    said += [f"{name:<8} {text}" for name, text in facts.items()]
    said += [_line(v, now_ns) for v in reversed(told["verdicts"])]
    return ["".join(c if c.isprintable() else "?" for c in line) for line in said]


def _skin(told: Mapping[str, Any]) -> str:
    counted = f"{told['frames']:,} frames, {told['lost_frames']:,} lost"
    if told["garbage_bytes"]:
        counted += f", {told['garbage_bytes']:,} bytes in no packet"
    if told["enumerations"] > 1:
        counted += f", plugged in {told['enumerations']} times"
    return f"{told['skin']}{': ' if told['trouble'] else ''}{told['trouble']} ({counted})"


def _line(v: Mapping[str, Any], now_ns: int) -> str:
    """One verdict as a row."""
    what = REASONS.get(v["status"], "")
    if v["status"].classified:
        what = f"{v['label']:<24}  {100 * v['probability']:5.1f} %  {v['latency_ns'] / 1e6:6.1f} ms"
    what = "; ".join(filter(None, (what, v["detail"])))
    return f"sweep {v['sweep']:>6}  {_span(now_ns - v['time_ns']):>11} ago  {v['status']:<11}  {what}"


def _span(ns: int) -> str:
    """A time for a person: its two largest parts of days, hours, minutes, seconds."""
    s = max(0, ns) // 1_000_000_000
    parts = [(s // 86400, "d"), (s // 3600 % 24, "h"), (s // 60 % 60, "min"), (s % 60, "s")]
    first = next((i for i, (n, _) in enumerate(parts) if n), len(parts) - 1)
    return " ".join(f"{n} {unit}" for n, unit in parts[first : first + 2])
