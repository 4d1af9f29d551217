"""The content of `palpate status`: reads the file with the state of the box (`status_file`), and
shows it in words. It needs neither numpy nor the settings' schema."""

from __future__ import annotations

import os

from palpate.core.errors import ApplianceError, FormatError
from palpate.core.runtime_folder import LAST_FAILURE
from palpate.core.text import printable

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from typing import Any

SCHEMA = 1
VERDICTS = 20
"""Number of the latest verdicts in the file."""
STALE_NS = 10_000_000_000
"""A file that has not changed for this long belongs to a program that hangs; it is the unit's
watchdog time."""
MOST_BYTES = 1 << 20
_START = "systemctl start palpate, then see journalctl -u palpate"
TROUBLES = {
    "garbage_bytes": "bytes in no packet",
    "stale_frames": "repeated or late",
    "overflows": "transfers too large",
    "fifo_overflows": "times the readout board's FIFO was full",
    "foreign_frames": "frames of other nodes on its bus",
}
"""Counts of the skin that are shown unless they are 0, in words."""
WELL, NOT_RUNNING, SKIN_AWAY = os.EX_OK, 1, os.EX_UNAVAILABLE


def read(path: Path | str, now_ns: int) -> dict[str, Any]:
    """The content of the file, with `running`, and `why` if the service does not run. now_ns: of
    the writer's clock.

    Raises FormatError for a file of another version, ApplianceError if it may not be read.
    """
    try:
        with open(path, "rb") as f:
            report = _report(f.read(MOST_BYTES))
        pid, age_ns = int(report["pid"]), now_ns - int(report["time_ns"])
    except FileNotFoundError:
        why = f"the service does not run, or has just started (no {path}); {_START}"
        return {"running": False, "why": _last_failure(path) or why}
    except OSError as e:
        raise ApplianceError(
            f"{path} cannot be read: {e.strerror}; see store.runtime, or ask as root"
        ) from e
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
        raise FormatError(f"{path}: not a status of this version ({e}); restart the service") from e
    why = ""
    # a file from before the last boot can be ahead of this boot's clock
    if not _alive(pid) or age_ns < 0:
        why = _last_failure(path) or f"process {pid} has ended without closing down; {_START}"
    elif age_ns > STALE_NS:
        why = (
            f"process {pid} has written nothing for {_span(age_ns)}, so it hangs; the service's "
            "watchdog restarts it"
        )
    return report | {"running": not why, "why": why}


def _report(data: bytes) -> dict[str, Any]:
    """The content of the file. Raises one of several errors if it is not as StatusFile writes."""
    import json

    from palpate.core.observer import Health
    from palpate.core.status import Status

    report: dict[str, Any] = json.loads(data)
    if not isinstance(report, dict) or report.get("schema") != SCHEMA:
        raise TypeError(f"not an object of schema {SCHEMA}")
    report["verdicts"] = [v | {"status": Status(v["status"])} for v in report["verdicts"]]
    if missing := set(Health._fields) - report.keys():
        raise KeyError(min(missing))
    return report


def _last_failure(path: Path | str) -> str:
    """Why the service has ended, "" if that is not known. path: of the status file."""
    folder = os.path.dirname(path)
    if not os.path.exists(os.path.join(folder, LAST_FAILURE)):
        return ""
    from pathlib import Path

    from palpate.service import last_failure

    last = last_failure.read(Path(folder))
    return last.text if last else ""


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:  # another user's process
        return True
    except (OSError, OverflowError):
        return False
    return pid > 0


def exit_code(report: Mapping[str, Any]) -> int:
    """0 if all is well, 69 if the skin is away, 1 if the service does not run."""
    if not report["running"]:
        return NOT_RUNNING
    return WELL if report["streams"] else SKIN_AWAY


def lines(report: Mapping[str, Any], now_ns: int) -> list[str]:
    """The result of `read` in words: first the state and the remedy, then the last verdicts, the
    newest first."""
    if not report["running"]:
        return [f"not running: {report['why']}"]
    head = f"process {report['pid']}, palpate {report['version']}, source {report['source']}"
    from palpate.core.observer import Health

    rows = [f"running for {_span(now_ns - report['since_ns'])} ({head})"]
    facts = {
        "skin": _skin(report),
        "bundle": report["bundle"] or "none",
        "sweeps": f"{report['answered']} answered",
    }
    if report.get("degraded"):
        facts["degraded"] = f"{report['degraded']}: bridged by its neighbours; check the skin"
    if edges := _trigger(report):
        facts["trigger"] = edges
    if report["dropped"]:
        facts["serial"] = (
            f"{report['dropped']} sentences dropped, since nobody read them; check the robot's end"
        )
    shown = {"version", "why", *Health._fields}
    facts |= {
        name: text
        for name, text in report.items()
        if name not in shown and isinstance(text, str) and text
    }
    rows += [f"{name:<8} {text}" for name, text in facts.items()]
    rows += [verdict_line(v, now_ns) for v in reversed(report["verdicts"])]
    return [*map(printable, rows)]


def _skin(report: Mapping[str, Any]) -> str:
    lost = f"{report['lost_frames']:,} lost"
    if not report.get("loss_known", True):
        lost = f"at least {lost}: this skin does not count its frames"
    counted = f"{report['frames']:,} frames, {lost}"
    for name, what in TROUBLES.items():
        if report[name]:
            counted += f", {report[name]:,} {what}"
    if report["enumerations"] > 1:
        counted += f", plugged in {report['enumerations']} times"
    return f"{report['skin']}{': ' if report['trouble'] else ''}{report['trouble']} ({counted})"


def _trigger(report: Mapping[str, Any]) -> str:
    """The troubles of the trigger's GPIO lines, "" for none."""
    counts = {"glitches": "glitches", "lost_edges": "edges lost", "storms": "storms of edges"}
    found = [f"{report[name]:,} {text}" for name, text in counts.items() if report[name]]
    return f"{', '.join(found)}; check the GPIO lines of the trigger" if found else ""


def verdict_line(v: Mapping[str, Any], now_ns: int) -> str:
    """One verdict as a row. v: as in the file, with its Status."""
    from palpate.core.status import REASONS

    what = REASONS.get(v["status"], "")
    if v["status"].classified:
        what = f"{v['label']:<24}  {100 * v['probability']:5.1f} %  {v['latency_ns'] / 1e6:6.1f} ms"
    what = "; ".join(filter(None, (what, v["detail"])))
    return (
        f"sweep {v['sweep']:>6}  {_span(now_ns - v['time_ns']):>11} ago  {v['status']:<11}  {what}"
    )


def _span(ns: int) -> str:
    """A time for a person: its two largest units of days, hours, minutes, seconds."""
    s = max(0, ns) // 1_000_000_000
    parts = [(s // 86400, "d"), (s // 3600 % 24, "h"), (s // 60 % 60, "min"), (s % 60, "s")]
    first = next((i for i, (n, _) in enumerate(parts) if n), len(parts) - 1)
    return " ".join(f"{n} {unit}" for n, unit in parts[first : first + 2])
