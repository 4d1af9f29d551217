"""Two releases on the box, and the trial of the new release. The box ends this trial by itself.

A release is a folder, /opt/palpate-VERSION; /opt/palpate leads to the present release, and
/opt/palpate.previous to the proven one. While a release is on trial, /opt/palpate.trial holds the
part of root (RootState). Before each start of the service, root runs `begin` with the program of
the proven release: it counts the start, or sends the new release back. The service records its
part (ReleaseReport) where user palpate may write. For each finger of a hand (palpate@NAME) root
counts in /opt/palpate.trial-NAME; any finger can send the release back, and the first that reaches
the goal proves it. /opt/palpate.rejected lists the releases that were sent back; they are refused
until somebody removes that file.

Each step is one rename, and the steps come in this order: `activate` writes the trial, then the
link; `send back` writes the rejection, then the link, then removes the trial. So after a loss of
power at any moment one of both releases runs, and the next start finishes the step.
"""

from __future__ import annotations

import argparse
import json
import os
import stat
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from palpate.core import storage
from palpate.core.errors import ApplianceError, ConfigError
from palpate.core.schema import typed
from palpate.core.text import printable
from palpate.deployment.state import MOST_STARTS, MOST_WHY, Standing, TrialProgress

FOLDER, NAME = Path("/opt"), "palpate"
"""Folder of the releases and of the link, and the name of the link."""
BOOT = Path("/proc/sys/kernel/random/boot_id")
REPORT = "release.json"
"""The file of a ReleaseReport, in the folder that systemd gives the service."""
MOST_BYTES = 1 << 14
FAULTS = ("SEGV", "ABRT", "BUS", "ILL", "FPE", "TRAP", "SYS")
"""Signals that a program gets for its own fault; ABRT also if it hangs, from the watchdog. KILL is
counted as a start: a person or a lack of memory sends it."""
SYSTEMD = Path("/run/systemd/system")
"""It is there where systemd runs (sd_booted(3))."""
RELOADED = (
    ("daemon-reload",),
    ("--no-block", "try-restart", "palpate@*", "palpate-watch", "palpate-bridge@*"),
)
"""What systemd does after the link was changed: it reads the units, and starts page and bridges of
the release that runs now."""


@dataclass(frozen=True, slots=True)
class RootState:
    """Root's part of a trial. release: the folder's name. back: the release to go back to. id: of
    this trial. start: the number of all starts. standing: with the last start, as of its begin."""

    release: str
    back: str
    id: str
    start: int = 0
    standing: Standing = field(default_factory=Standing)


@dataclass(frozen=True, slots=True)
class ReleaseReport:
    """The service's part of a trial. id, start: of RootState, at the last start. quiet: whether
    this start counts for nothing. sweeps, streamed_s: progress with this start. worked: as in
    Standing. passed: the goal was reached. why: the fault that sends the release back, "" without
    a fault."""

    id: str
    start: int = 0
    quiet: bool = False
    sweeps: int = 0
    streamed_s: float = 0.0
    worked: bool = False
    passed: bool = False
    why: str = ""


def read_report(folder: Path, trial: RootState) -> ReleaseReport:
    """The service's report on this trial; empty without one. Its user may put anything there."""
    try:
        at = os.open(folder / REPORT, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(at, "rb") as f:
            if not stat.S_ISREG(os.fstat(at).st_mode):
                return ReleaseReport(trial.id)
            found: ReleaseReport = typed(ReleaseReport, json.loads(f.read(MOST_BYTES)))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return ReleaseReport(trial.id)
    return found if found.id == trial.id else ReleaseReport(trial.id)


def write_report(folder: Path, report: ReleaseReport) -> None:
    """Raises OSError."""
    _put(folder / REPORT, report)


class Releases:
    """The releases in `folder`. report: folder of the service's report. boot: the file with the id
    of this boot. Methods that change something are for root, and raise OSError."""

    def __init__(
        self, folder: Path = FOLDER, report: Path | None = None, boot: Path = BOOT
    ) -> None:
        self.folder, self._report, self._boot = folder, report, boot
        unit = report.name.partition(f"{NAME}-")[2] if report else ""
        self._link, self._previous = folder / NAME, folder / f"{NAME}.previous"
        self._trial, self._rejected = folder / f"{NAME}.trial", folder / f"{NAME}.rejected"
        self._counts = folder / f"{NAME}.trial-{unit}" if unit else self._trial

    @property
    def current(self) -> str:
        """The release that the link leads to, "" without a link."""
        return _target(self._link)

    @property
    def trial(self) -> RootState | None:
        """The trial of the current release; None for a proven release."""
        held, counted = _state(self._trial), _state(self._counts)
        if not held or held.release != self.current:
            return None
        return counted if counted and counted.id == held.id else held

    @property
    def rejected(self) -> dict[str, list[str]]:
        """The releases that were sent back: for each why, and the release that runs since."""
        try:
            held = json.loads(self._rejected.read_bytes())
            return {str(name): [str(why), str(back)] for name, (why, back) in held.items()}
        except (OSError, ValueError, TypeError, AttributeError):
            return {}

    def activate(self, name: str) -> None:
        """Make a release current. It goes on trial if a proven release was there, unless it is
        that release. Raises ConfigError if this release was sent back."""
        if name in self.rejected:
            raise ConfigError(
                f"{name} was sent back here: {self.rejected[name][0]}; install another, or remove "
                f"{self._rejected} to try it again"
            )
        now, trial = self.current, self.trial
        if now == name:
            return
        proven = trial.back if trial else now
        if proven not in ("", name):
            storage.link(self._previous, proven)
            _put(self._trial, RootState(name, proven, os.urandom(8).hex()))
        storage.link(self._link, name)
        if proven == name:
            storage.link(self._previous, now)
            self._end_trial()

    def begin(self) -> str:
        """Count a start of the service, end a trial that was passed, or send the release back.
        Returns why it was sent back, else ""."""
        trial = self.trial
        if not trial:
            return ""
        report = read_report(self._report, trial) if self._report else ReleaseReport(trial.id)
        boot = self._boot.read_text().strip()
        held = self._judged(trial, report, boot)
        why = self.rejected.get(trial.release, [report.why])[0]
        if report.passed and not why:
            self._end_trial()
        elif why := why or held.spent(f"{MOST_STARTS} starts ended without an orderly end"):
            return self._send_back(trial, why)
        else:
            _put(self._counts, replace(trial, start=trial.start + 1, standing=held.begun(boot)))
        return ""

    def _judged(self, trial: RootState, report: ReleaseReport, boot: str) -> Standing:
        """The state before a start, once the last start has been judged by its report."""
        held = trial.standing
        if report.start == trial.start:
            quiet = report.quiet and trial.start > 0
            starts = max(0, held.starts - quiet)
            now = TrialProgress(starts, report.sweeps, report.streamed_s, report.worked)
            held = held.noted(now, "" if quiet else held.boot)
        return held.since(boot)

    def _send_back(self, trial: RootState, why: str) -> str:
        """Make the proven release current again, and refuse this release from now on."""
        if not (self.folder / trial.back).is_dir():
            return ""  # nothing better is there
        text = printable(why, " ")[:MOST_WHY]
        _put(self._rejected, self.rejected | {trial.release: [text, trial.back]})
        storage.link(self._link, trial.back)
        self._end_trial()
        return f"{trial.release} was sent back, and {trial.back} runs again: {text}"

    def _end_trial(self) -> None:
        for path in (self._trial, *self.folder.glob(f"{NAME}.trial-*")):
            path.unlink(missing_ok=True)
        storage.sync(self.folder)


def own(environ: Mapping[str, str] = os.environ) -> tuple[RootState, Path] | None:
    """The trial of the release that this program belongs to, and the folder for its report; None
    without a trial, and for a program that systemd has not started as the service."""
    release, report = Path(sys.prefix).resolve(), environ.get("STATE_DIRECTORY")
    trial = Releases(release.parent, Path(report)).trial if report else None
    return (trial, Path(report)) if report and trial and trial.release == release.name else None


def text() -> str:
    """For a person: the release that was sent back to this one, and why; else ""."""
    release = Path(sys.prefix).resolve()
    held = Releases(release.parent).rejected.items()
    sent = [f"{name} was sent back: {why}" for name, (why, back) in held if back == release.name]
    return sent[-1] if sent else ""


def note_fault(environ: Mapping[str, str]) -> None:
    """Report a signal that ended the service for its own fault. environ: as systemd sets it for
    ExecStopPost= (systemd.exec(5)). Raises OSError."""
    found, fault = own(environ), environ.get("EXIT_STATUS", "")
    if found and environ.get("EXIT_CODE") in ("killed", "dumped") and fault in FAULTS:
        trial, folder = found
        report, why = read_report(folder, trial), f"the program was ended by signal {fault}"
        if not (report.quiet and report.start == trial.start):  # else a bundle is on trial, too
            write_report(folder, replace(report, why=why))


def main(argv: list[str] | None = None, environ: Mapping[str, str] = os.environ) -> int:
    """`python -m palpate.deployment.releases begin`, or `activate NAME`; the exit code."""
    parser = argparse.ArgumentParser("python -m palpate.deployment.releases")
    parser.add_argument("command", choices=("begin", "activate"))
    parser.add_argument("name", nargs="?", default="", help="the release, palpate-VERSION")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--report", default=environ.get("STATE_DIRECTORY"))
    args = parser.parse_args(argv)
    releases = Releases(args.folder, Path(args.report) if args.report else None)
    try:
        if args.command == "activate":
            releases.activate(args.name)
        elif said := releases.begin():
            print(f"palpate: {said}", file=sys.stderr, flush=True)
            for command in RELOADED if SYSTEMD.is_dir() else ():
                subprocess.run(["systemctl", *command], check=False, timeout=30)
    except (ApplianceError, OSError) as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code if isinstance(e, ApplianceError) else 1
    return 0


def _state(path: Path) -> RootState | None:
    try:
        held: RootState = typed(RootState, json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError):
        return None
    return held


def _target(link: Path) -> str:
    try:
        return os.path.basename(os.readlink(link))
    except OSError:
        return ""


def _put(path: Path, held: RootState | ReleaseReport | dict[str, list[str]]) -> None:
    text = json.dumps(held if isinstance(held, dict) else asdict(held), indent=1)
    storage.put(path, f"{text}\n".encode(), mode=0o644)


if __name__ == "__main__":
    sys.exit(main())
