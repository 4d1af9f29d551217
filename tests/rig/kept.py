"""Finds sweeps that a killed box lost: compares the sentences that a robot received with the files
on the disk.

A kept sweep is written after its answer, beside the loop, and its REC sentence follows once it is
on the disk. So if the robot received an answer and its REC with the outcome `stored`, the sweep
must be stored whole. Each run may lack the sweeps that were still being written.

The module also holds the log of a campaign of kills, which a later run continues.
"""

import json
import shutil
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core.sentences import checksum
from palpate.core.sweep_file import load
from palpate.core.types import Status, Sweep
from tests.rig.cell import Cell
from tests.rig.emulated_machines import ROOT
from tests.rig.machine import Guest

KEPT = "/var/lib/palpate/kept"
DROP_IN = "/etc/systemd/system/palpate.service.d/arguments.conf"
PALPATE = "/opt/palpate/bin/palpate"
ANSWERED = {str(status) for status in Status if status.classified} | {"unknown", "recorded"}
"""Statuses of answers that follow a window; a box that records answers `recorded`."""


@dataclass(frozen=True, slots=True)
class Heard:
    """An answer: its number, and when the box had all that it needed, in s of its clock."""

    sweep: int
    complete_s: float

    def fits(self, kept: Sweep) -> bool:
        """Whether `kept` is the sweep that was answered."""
        return kept.id == self.sweep and abs(kept.complete_ns / 1e9 - self.complete_s) < 0.005


def runs_with(machine: Guest, arguments: str, more: str = "") -> None:
    """Start the service with these arguments from now on. more: further lines of its drop-in."""
    folder = DROP_IN.rpartition("/")[0]
    machine.run(f"mkdir -p {folder}", check=True)
    machine.put(
        DROP_IN, f"[Service]\nExecStart=\nExecStart={PALPATE} {arguments}\n{more}\n".encode()
    )
    machine.run("systemctl daemon-reload", check=True, timeout_s=60)


def checked(cell: Cell) -> str:
    """The output of `palpate check`, which must succeed in the place of the service."""
    as_palpate = f"runuser -u palpate -G dialout -G gpio -G plugdev -- {PALPATE}"
    cell.machine.run("systemctl stop palpate", check=True)
    try:
        return cell.machine.run(f"{as_palpate} check", timeout_s=90, check=True).out
    finally:
        cell.machine.run("systemctl start --no-block palpate", check=True)
        cell.until_ready()


def found(disk: Path, folder: Path) -> tuple[int, list[Path]]:
    """Of a copy of a disk: e2fsck's exit code after the journal, and the kept sweeps."""
    raw, out = folder / "disk.raw", folder / "found"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()

    def run(*command: str | Path) -> int:
        return subprocess.run(command, check=False, capture_output=True, timeout=120).returncode

    assert run("qemu-img", "convert", "-O", "raw", disk, raw) == 0
    run("e2fsck", "-y", "-E", "journal_only", raw)
    code = run("e2fsck", "-f", "-n", raw)
    run("debugfs", "-R", f"rdump {KEPT} {out}", raw)
    raw.unlink()
    return code, sorted((out / "kept").glob("*"))


def sweeps(files: Iterable[Path]) -> list[Sweep]:
    """All kept sweeps among `files`. Raises FormatError if a sweep is not whole."""
    return [load(path)[0] for path in files if path.suffix == ".npy"]


def whole(line: str) -> list[str]:
    """The fields of a sentence; none if the sentence is damaged."""
    body, star, given = line.removeprefix("$").partition("*")
    return body.split(",") if star and body.isascii() and checksum(body) == given else []


def owed(heard: Iterable[tuple[int, str]]) -> tuple[list[Heard], list[Heard]]:
    """Answers whose sweep must be stored, and may be missing. heard: of one boot."""
    must: list[Heard] = []
    may: list[Heard] = []
    waiting: dict[int, Heard] = {}
    for _, line in heard:
        match whole(line):
            case ["PPLP", "RES", number, t_s, status, *rest] if status in ANSWERED:
                sweep = int(number)
                if waiting and sweep <= max(waiting):  # another run, which counts anew
                    may += waiting.values()
                    waiting = {}
                waiting[sweep] = Heard(sweep, float(t_s) - float(rest[5]) / 1000)
            case ["PPLP", "REC", number, "stored", *_] if int(number) in waiting:
                must.append(waiting.pop(int(number)))
    return must, [*may, *waiting.values()]


def lost(heard: Iterable[tuple[int, str]], kept: list[Sweep]) -> dict[str, int]:
    """Counts: answers with a window, sweeps owed, those missing, other missing ones."""
    must, may = owed(heard)
    gone = [h for h in must if not any(h.fits(k) for k in kept)]
    unfinished = [h for h in may if not any(h.fits(k) for k in kept)]
    return {
        "answered": len(must) + len(may),
        "owed": len(must),
        "lost": len(gone),
        "unfinished": len(unfinished),
    }


class CampaignLog:
    """build/rig/NAME.jsonl: one line for each event of a campaign on this box."""

    def __init__(self, name: str, box: Path) -> None:
        self._path, self._box = ROOT / "build" / "rig" / f"{name}.jsonl", box.parent.name
        self.lines: list[dict[str, Any]] = []
        with suppress(FileNotFoundError):
            events = [json.loads(line) for line in self._path.read_text().splitlines()]
            self.lines = [line for line in events if line["box"] == self._box]

    def add(self, **what: Any) -> None:
        """Append an event."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self.lines.append({"box": self._box} | what)
        with self._path.open("a") as f:
            f.write(json.dumps(self.lines[-1]) + "\n")

    def sum(self, name: str) -> int:
        """Sum over all events."""
        return sum(line.get(name, 0) for line in self.lines)
