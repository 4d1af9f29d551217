"""Boxes under test: each sweeps by a script in real time, and returns its sentences, the edges that
it received, and the resources of its process.

ThisMachine is the installed command on this machine with the simulated skin and a pseudo-terminal
as its serial line. soak_guest.py has the virtual box, with its skin, lines and serial port on real
buses of the guest.
"""

import os
import platform
import re
import select
import subprocess
import sys
import tempfile
import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core.clock import SystemClock
from palpate.core.types import Frames, Status, Sweep
from palpate.inference.classifier import Classifier
from palpate.sim import rig, script, skin
from palpate.tools import pseudo_terminal
from tests.rig.soak_judge import short_answer

STOP_S = 30
"""Longest wait for a box to end after SIGTERM."""
HALF_FRAME_S = 0.5 / skin.FORMAT.rate_hz
SLOW_ANSWER_S = 0.5
"""The first answer may be this much slower than later answers."""
TICKS = os.sysconf("SC_CLK_TCK")
SMAPS = re.compile(r"^(Rss|Pss): +(\d+) kB", re.M)


class Gone(AssertionError):
    """The box ended by itself."""


@dataclass(frozen=True, slots=True)
class Fact:
    """A sweep of the script: material, frames at its edges, the bundle's own label."""

    label: str
    start: int
    stop: int
    alone: str


class Script:
    """The robot's sweeps in order, as facts, computed on demand, from number 1."""

    def __init__(self, seed: int) -> None:
        self._acts, self._facts, self._next = script.tubes(seed), list[Fact](), 0
        self._classifier = Classifier(bundle.load(bundle.DEFAULT), SystemClock())

    def __getitem__(self, number: int) -> Fact:
        """The sweep with this number."""
        while number > len(self._facts):
            self._add()
        return self._facts[number - 1]

    def edges(self, frame: float) -> tuple[int, int]:
        """Start and stop edges up to this frame."""
        while self._next <= frame:
            self._add()
        starts = bisect_right(self._facts, frame, key=lambda f: f.start)
        return starts, bisect_right(self._facts, frame, key=lambda f: f.stop)

    def _add(self) -> None:
        act = next(self._acts)
        self._facts.append(
            Fact(act.label, self._next + act.start, self._next + act.stop, self._alone(act))
        )
        self._next += len(act.frames)

    def _alone(self, act: rig.Act) -> str:
        first = (act.start + act.stop) // 2 - skin.FORMAT.window // 2
        window = act.frames[first : first + skin.FORMAT.window]
        seq = np.arange(len(window))
        verdict = self._classifier(Sweep(1, 0, 1, Status.OK, Frames(seq, seq, window)))
        return short_answer(verdict.status, verdict.label)


def process(smaps: str, stat: str, files: int) -> tuple[int, int, float, int, int]:
    """RSS, PSS in KiB, processor seconds, files, threads, from texts of /proc/PID."""
    kib = dict(SMAPS.findall(smaps))
    fields = stat.rpartition(")")[2].split()
    cpu_s = (int(fields[11]) + int(fields[12])) / TICKS
    return int(kib["Rss"]), int(kib["Pss"]), cpu_s, files, int(fields[17])


class Reckoned:
    """A robot and a board that cannot be observed: their sweeps and frames are computed from the
    clock and the known script.

    The quickest answer gives the start of the script, the first frames that were counted give the
    start of the board.
    """

    def __init__(self, sweeps: Script) -> None:
        self._sweeps = sweeps
        self._origin_s = self._board_s = 0.0

    def hear(self, at_s: float, line: str) -> None:
        """Take note of a sentence."""
        if answer := Answer.read(line):
            self._begin(at_s - self._sweeps[answer.sweep].stop / skin.FORMAT.rate_hz - HALF_FRAME_S)
        if not self._board_s and line.startswith("$PPLP,STA,"):
            frames = int(line.split(",")[6])
            self._board_s = at_s - frames / skin.FORMAT.rate_hz if frames else 0.0

    def _begin(self, origin_s: float) -> None:
        """The script began then or before; a wrong number in an answer must not shift it."""
        if not self._origin_s or 0 < self._origin_s - origin_s < SLOW_ANSWER_S:
            self._origin_s = origin_s

    def edges(self, at_s: float) -> tuple[int, int]:
        """Numbers of start and stop edges up to that time."""
        if not self._origin_s:
            return 0, 0
        return self._sweeps.edges((at_s - self._origin_s) * skin.FORMAT.rate_hz)

    def taken(self, at_s: float) -> float:
        """Number of frames that the board had taken up to that time, from any origin."""
        return (at_s - self._board_s) * skin.FORMAT.rate_hz if self._board_s else 0.0


class ThisMachine:
    """`palpate run --sim skin` beside this Python. before: a prefix. sets: settings."""

    name = "this machine"

    def __init__(self, before: Sequence[str] = (), sets: Sequence[str] = ()) -> None:
        self._stack, self._rest = ExitStack(), b""
        self._before, self._sets = before, [f"--set={text}" for text in sets]
        self.clock = time.monotonic

    @staticmethod
    def missing() -> str:
        """Why this box is not available here; "" if it is."""
        return ""

    def start(self, seed: int, sweeps: Script) -> None:
        """Start the box and its robot."""
        self._robot = Reckoned(sweeps)
        self.launch("--sim", "skin", "--seed", str(seed))

    def launch(self, *options: str) -> None:
        """Start `palpate run` with these options."""
        self._far, port = self._stack.enter_context(pseudo_terminal.pair())
        palpate = Path(sys.executable).with_name("palpate")
        command = [*self._before, str(palpate), "run", *options, *self._sets]
        self._log = Path(self._stack.enter_context(tempfile.TemporaryDirectory())) / "log"
        self._box = subprocess.Popen(
            [*command, "--set", f"serial.port={port}"], stderr=self._log.open("wb")
        )
        self._stack.callback(self._end)

    def _end(self) -> None:
        self._box.kill()
        self._box.wait()

    def heard(self, wait_s: float) -> list[tuple[float, str]]:
        """Lines since the last call with their times, after `wait_s` at most. Raises Gone."""
        if self._box.poll() is not None:
            raise Gone(f"the box ended with {self._box.returncode}: {self._log_text()}")
        return self._read(wait_s)

    def _read(self, wait_s: float) -> list[tuple[float, str]]:
        if not select.select([self._far], [], [], wait_s)[0]:
            return []
        *lines, self._rest = (self._rest + self._said()).split(b"\r\n")
        found = [(time.monotonic(), line.decode("ascii", "replace")) for line in lines]
        for at_s, line in found:
            self._note(at_s, line)
        return found

    def _note(self, at_s: float, line: str) -> None:
        """A hook for each line before it is returned."""
        self._robot.hear(at_s, line)

    def _said(self) -> bytes:
        """Sentences that the box has sent."""
        return os.read(self._far, 65536)

    def _log_text(self) -> str:
        return self._log.read_text(errors="replace").strip()[-300:]

    def edges(self, at_s: float) -> tuple[int, int]:
        """Numbers of start and stop edges up to that time."""
        return self._robot.edges(at_s)

    def taken(self, at_s: float) -> float:
        """Number of frames that the board had taken up to that time, from any origin."""
        return self._robot.taken(at_s)

    def process(self) -> tuple[int, int, float, int, int]:
        """See `process`. Raises Gone."""
        place = Path("/proc", str(self._box.pid))
        try:
            smaps, stat = ((place / name).read_text() for name in ("smaps_rollup", "stat"))
            return process(smaps, stat, len(os.listdir(place / "fd")))
        except (OSError, KeyError) as e:
            raise Gone(
                f"the process of the box cannot be read: {e}; its log ends {self._log_text()!r}"
            ) from e

    def about(self) -> Mapping[str, Any]:
        """What kind of box this is, for the record."""
        versions = {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "onnxruntime": ort.__version__,
        }
        return {
            "what": "palpate run --sim skin, the serial line a pseudo-terminal; "
            "its memory holds the simulated skin too",
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, Linux {platform.release()}",
            "versions": versions,
        }

    def stop(self) -> list[tuple[float, str]]:
        """End the box; returns its last lines. Raises Gone unless its exit code is 0."""
        self._box.terminate()
        lines = list(self._until_ended())
        if self._box.poll() != 0:
            raise Gone(f"the box ended after SIGTERM with {self._box.poll()}: {self._log_text()}")
        return lines

    def close(self) -> None:
        """Clean up, whatever has happened."""
        self._stack.close()

    def _until_ended(self) -> Iterator[tuple[float, str]]:
        end_s = time.monotonic() + STOP_S
        ended = False
        while not ended and time.monotonic() < end_s:
            ended = (
                self._box.poll() is not None
            )  # closed before the last read, so that no data remain in the line
            with suppress(BlockingIOError):
                yield from self._read(0.2)
