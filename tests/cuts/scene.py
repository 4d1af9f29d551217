"""Plays a scene and cuts it short: commands change a folder one after another, and a judge examines
the folder after each cut.

The scene is first played to its end, and its calls are recorded. A moment lies before each call
that changes the folder or syncs a part of it, and after the last call of each command. At each
moment the command is killed, or the power is cut. The judge gets the folder that is found
afterwards, and each moment becomes a point with its findings.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.cuts import calls, tree
from tests.cuts.calls import NotFollowed, SystemCall, TracedRun
from tests.cuts.disk import Disk
from tests.factories.paths import SOURCES

MEMORY = Path("/dev/shm")
"""Folder in memory for scenes: the effect of a sync is modelled, and on a real disk it would take
time."""
BETWEEN = "\n"
"""Printed before each command, so that the last line is its own."""
SPARE_CALLS = 300
"""More calls than the wrapper of a command makes in its main thread."""
MAPPED = re.compile(r"-shm$")
"""SQLite's shared index, which it writes without calls and makes anew after a crash."""
ENVIRONMENT = {"PYTHONPATH": SOURCES}
LONGEST_S = 300.0
"""Longest time of a command that nothing kills."""


def stage() -> TemporaryDirectory[str]:
    """A folder to play in."""
    return TemporaryDirectory(prefix="cuts-", dir=MEMORY if MEMORY.is_dir() else None)


@dataclass(frozen=True, slots=True)
class Found:
    """The judge's input: the folder, the command that was cut, the output asked for."""

    folder: Path
    step: str
    heard: str


@dataclass(frozen=True, slots=True)
class SceneStep:
    """A command for a folder; its exit code; `killed` at a call, `ahead` such calls first."""

    name: str
    command: Callable[[Path], Sequence[str | Path]]
    code: int | None = 0
    killed: SystemCall | None = None
    ahead: int = 0

    def arguments(self, folder: Path) -> Sequence[str | Path]:
        """The whole command. It is `python -m MODULE ...` if calls are to be made ahead."""
        command = self.command(folder)
        if not (self.killed and self.ahead):
            return command
        words = (str(self.killed.thread), self.killed.name, str(self.ahead))
        return [*command[:2], "tests.cuts.counted", *words, *command[2:]]

    def cut(self, call: SystemCall | None, run: TracedRun) -> SceneStep:
        """The same command, killed at this call of a recorded run.

        strace counts the calls of each thread separately. Where another thread has as many calls of
        this name, the thread of the call begins with more.
        """
        others = Counter(
            c.thread for c in run.calls if call and c.name == call.name and c.thread != call.thread
        )
        most = max(others.values(), default=0)
        if not call or most < call.nth:
            return replace(self, killed=call)
        ahead = most + SPARE_CALLS
        return replace(self, killed=replace(call, nth=call.nth + ahead), ahead=ahead)


@dataclass(frozen=True, slots=True)
class CutScene:
    """prepare: makes the folder as it is before the first command. judge: returns the faults.
    apart: paths that the judge ignores. hears: extracts the part of the output that the judge
    needs."""

    name: str
    prepare: Callable[[Path], None]
    steps: tuple[SceneStep, ...]
    judge: Callable[[Found], list[str]]
    apart: re.Pattern[str] = tree.NOTHING
    hears: Callable[[str], str] = str


@dataclass(frozen=True, slots=True)
class CrashPoint:
    """A scene that was cut at one moment. how: a method of ScenePlay. call: the call that was not
    carried out. states: number of different folders that the cut may leave. wrong: the judge's
    findings."""

    scene: str
    step: str
    how: str
    moment: int
    call: str
    states: int
    wrong: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Moment:
    """The moment before a call that changes something; call None: after the last call."""

    step: int
    number: int
    call: SystemCall | None
    output: str
    disk: Disk


@dataclass(slots=True)
class ScenePlay:
    """A scene that was played to its end in `work`. said: the output before each command. before:
    the folder before each command. runs: the runs of the commands. Raises NotFollowed if the folder
    differs from the modelled effect of the calls."""

    scene: CutScene
    work: Path
    output: str = ""
    before: list[tree.Tree] = field(default_factory=list)
    runs: list[TracedRun] = field(default_factory=list)
    judged: dict[tuple[str, str, str], tuple[str, ...]] = field(default_factory=dict)
    took_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.work = self.work.resolve()
        self.folder.mkdir()
        self.scene.prepare(self.folder)
        for step in self.scene.steps:
            self.before.append(tree.read(self.folder))
            run = self._run(step)
            if not step.killed and step.code not in (None, run.code):
                raise NotFollowed(f"{step.name} ended with {run.code}: {run.output[-2000:]}")
            self.runs.append(run)

    @property
    def folder(self) -> Path:
        """The folder that the commands change."""
        return self.work / "folder"

    def moments(self) -> Iterator[Moment]:
        """All moments in order; the effects of the command before the previous are on the disk."""
        output = self.output
        for i, run in enumerate(self.runs):
            disk = Disk(self.folder, self.before[max(i - 1, 0)], self.scene.apart)
            disk.follow(self.runs[i - 1].calls if i else ())
            output += BETWEEN
            number = 0
            for call in run.calls:
                output += calls.output(call)
                if effect := disk.effect(call):
                    yield Moment(i, number, call, output, disk)
                    effect()
                    number += 1
            yield Moment(i, number, None, output, disk)

    def power(self, moment: Moment) -> CrashPoint:
        """The power fails: each folder that may be found is judged."""
        step, wrong, states = self.scene.steps[moment.step], [], 0
        for left in moment.disk.left():
            states += 1
            wrong += self._judged(left, step, moment.output)
        return self._point("power", moment, states, wrong)

    def kill(self, moment: Moment) -> CrashPoint:
        """The command is killed as it enters the moment's call. Raises NotFollowed."""
        step = self.scene.steps[moment.step]
        self._restore(self.before[moment.step])
        run = self._run(step.cut(moment.call, self.runs[moment.step]))
        output = "".join(BETWEEN + run.output for run in (*self.runs[: moment.step], run))
        return self._point("kill", moment, 1, self._judged(tree.read(self.folder), step, output))

    def timed(self, number: int, share: float) -> CrashPoint:
        """A command and all its processes are killed after a share of the time that it takes."""
        step = self.scene.steps[number]
        took_s, _ = self._timed(number, 0.0)
        _, heard = self._timed(number, share * took_s)
        output = "".join(
            BETWEEN + said for said in (*(r.output for r in self.runs[:number]), heard)
        )
        wrong = self._judged(tree.read(self.folder), step, output)
        at = f"{1000 * share * took_s:.0f} of {1000 * took_s:.0f} ms"
        return CrashPoint(self.scene.name, step.name, "timed", 0, at, 1, wrong)

    def _timed(self, number: int, after_s: float) -> tuple[float, str]:
        """Run a command, and kill its group after a time unless that is 0; the time that it takes
        whole, and its output."""
        if not after_s and number in self.took_s:
            return self.took_s[number], ""
        self._restore(self.before[number])
        begin = time.monotonic()
        with subprocess.Popen(
            [str(word) for word in self.scene.steps[number].command(self.folder)],
            env=os.environ | ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                heard, _ = process.communicate(timeout=after_s or LONGEST_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                heard, _ = process.communicate()
        return self.took_s.setdefault(number, time.monotonic() - begin), heard

    def kill_then_power(self, moment: Moment) -> CrashPoint:
        """Killed, started again, and without power at each moment. Raises NotFollowed."""
        step, before = self.scene.steps[moment.step], self.before[moment.step]
        steps = step.cut(moment.call, self.runs[moment.step]), replace(step, code=None)
        twice = replace(self.scene, prepare=lambda folder: tree.write(before, folder), steps=steps)
        wrong, states = [], 0
        output = "".join(BETWEEN + run.output for run in self.runs[: moment.step])
        with stage() as work:
            play = ScenePlay(twice, Path(work), output=output, judged=self.judged)
            for point in (play.power(later) for later in play.moments() if later.step):
                states += point.states
                again = f"(before its {point.call}, when it was started again)"
                wrong += [f"{text} {again}" for text in point.wrong]
        return self._point("kill_then_power", moment, states, wrong)

    def _run(self, step: SceneStep) -> TracedRun:
        """Run a command and compare the folder that it leaves with the model's."""
        disk = Disk(self.folder, tree.read(self.folder))
        run = calls.run(step.arguments(self.folder), self.work / "log", step.killed, ENVIRONMENT)
        disk.follow(run.calls)
        seen, there = disk.seen(), tree.read(self.folder)
        names = sorted(
            n for n in seen | there if seen.get(n, "") != there.get(n, "") and not MAPPED.search(n)
        )
        if names:
            raise NotFollowed(f"{step.name}: {', '.join(names)} not as its calls must have left it")
        return run

    def _restore(self, held: tree.Tree) -> None:
        shutil.rmtree(self.folder)
        self.folder.mkdir()
        tree.write(held, self.folder)

    def _judged(self, left: tree.Tree, step: SceneStep, output: str) -> tuple[str, ...]:
        """The judge's findings on a folder; each folder is judged once."""
        heard = self.scene.hears(output)
        key = tree.digest(left, self.scene.apart), step.name, heard
        if key not in self.judged:
            with TemporaryDirectory(dir=self.work) as aside:
                folder = Path(aside) / "folder"
                folder.mkdir()
                tree.write(left, folder)
                self.judged[key] = tuple(self.scene.judge(Found(folder, step.name, heard)))
        return self.judged[key]

    def _point(self, how: str, moment: Moment, states: int, wrong: Sequence[str]) -> CrashPoint:
        call = moment.call
        names = [str(Path(path).relative_to(self.folder)) for path in call.paths] if call else []
        reported = " ".join([call.name, *names]) if call else "the end"
        step = self.scene.steps[moment.step].name
        return CrashPoint(
            self.scene.name, step, how, moment.number, reported, states, tuple(dict.fromkeys(wrong))
        )
