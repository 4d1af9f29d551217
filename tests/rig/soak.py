"""`python -m tests.rig.soak --hours 1`: boxes sweep without pause, and each sentence is judged.

The results are a record of each box with its sums, and exit code 1 if a target was missed. A
process of its own records each box.
"""

import argparse
import json
import math
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from palpate.client.answers import Answer
from palpate.core import storage
from palpate.core.provenance import commit
from palpate.core.sentences import checksum
from palpate.sim import skin
from palpate_train.metrics import score
from tests.factories.paths import ROOT
from tests.rig import soak_judge
from tests.rig.soak_boxes import Gone, Script, ThisMachine
from tests.rig.soak_guest import VirtualBox
from tests.rig.soak_judge import SoakRun

BoxUnderTest = ThisMachine | VirtualBox
BOXES = {kind.name: kind for kind in (ThisMachine, VirtualBox)}
WORK = ROOT / "build" / "soak"
WAIT_S, SAMPLE_S, MINUTE_S = 0.2, 10.0, 60.0
SILENT_S = 60.0
"""A box that sends nothing for this long has ended; a working box sends its state each second."""
GRACE_S = 5.0
"""During a soak, an answer may come this long after its stop edge; at the end, all answers are
awaited."""
MARGIN_S = 0.5
"""A box is stopped this far inside a sweep, so that the sweep has certainly begun."""
NOTED = 200
"""Largest number of faults of a run that are recorded in full; a permanent fault would fill the
disk."""


class Recorder:
    """Writes a run's record from sentences and samples; times are the box's."""

    def __init__(self, box: BoxUnderTest, run: SoakRun, sweeps: Script) -> None:
        self.run = run
        self._box, self._sweeps, self._clock = box, sweeps, box.clock
        self._last, self._behind = 0, math.inf
        self._begun_s = self._heard_s = self._looked_s = box.clock()
        self._state: list[int] = []
        self._streaming = False

    def start(self) -> None:
        """Start the box; the run begins when it has started. Raises Gone."""
        self._box.start(self.run.seed, self._sweeps)
        self._begun_s = self._heard_s = self._looked_s = self._clock()

    def listen(self, seconds: float, stopped: Callable[[], bool]) -> None:
        """Judge sentences and take samples for this long or until `stopped()`. Raises Gone."""
        end_s = self._clock() + seconds
        while (now_s := self._clock()) < end_s and not stopped():
            for line in self._box.heard(WAIT_S):
                self.hear(*line)
            if now_s - self._heard_s > SILENT_S:
                raise Gone(f"the box has sent nothing for {now_s - self._heard_s:.0f} s")
            if now_s - self._looked_s >= SAMPLE_S:
                self._looked_s += SAMPLE_S
                self._look(now_s)
            self.run.length_s = round(self._clock() - self._begun_s, 1)

    def sweeping(self) -> bool:
        """Whether a sweep has certainly begun and not ended."""
        now_s = self._clock()
        return self._box.edges(now_s - MARGIN_S)[0] > self._box.edges(now_s + MARGIN_S)[1]

    def stop(self) -> None:
        """Make the box end; all sweeps that have begun must be answered. Raises Gone."""
        self.run.due = self._box.edges(self._clock())[0]
        for line in self._box.stop():
            self.hear(*line)

    def hear(self, at_s: float, line: str) -> None:
        """Judge a sentence."""
        self.run.silence_s = round(max(self.run.silence_s, at_s - self._heard_s), 2)
        self._heard_s = at_s
        body, _, end = line.removeprefix("$").rpartition("*")
        if not (line.startswith("$PPLP,") and body.isascii() and end == checksum(body)):
            self.fault(f"broken sentence {line[:80]!r}", at_s)
        elif answer := Answer.read(line):
            self._answer(at_s, answer)
        elif line.startswith("$PPLP,STA,"):
            self._note(at_s, body.split(",")[2:])

    def fault(self, what: str, at_s: float | None = None) -> None:
        """Record a fault."""
        if len(self.run.faults) < NOTED:
            self.run.faults.append([self._since(self._clock() if at_s is None else at_s), what])

    def _look(self, now_s: float) -> None:
        taken = self._box.process()
        if self._state:
            behind = 0.0 if math.isinf(self._behind) else round(self._behind, 1)
            self.run.samples.append([self._since(now_s), *taken, *self._state, behind])
            self._behind = math.inf
        self.run.due = self._box.edges(now_s - GRACE_S)[1]

    def _since(self, at_s: float) -> float:
        return round(self.run.began_s + at_s - self._begun_s, 2)

    def _answer(self, at_s: float, answer: Answer) -> None:
        # by time, not by number: if an emulator misses an edge, one sweep becomes two or two become
        # one
        fact = self._sweeps[max(self._box.edges(at_s)[1], 1)]
        if wrong := soak_judge.numbering(
            answer.sweep, self._last, self._box.edges(at_s + MARGIN_S)[0]
        ):
            self.fault(wrong, at_s)
        self._last = max(self._last, answer.sweep)
        row = [self._since(at_s), answer.sweep, fact.label, answer.status, answer.label]
        self.run.answers.append([*row, fact.alone, answer.latency_ms, answer.lost])

    def _note(self, at_s: float, state: list[str]) -> None:
        if state[1] == "streaming":
            self._streaming = True
        elif self._streaming:
            self.fault(f"the skin is {state[1]}", at_s)
        self._state = [int(n) for n in state[4:9]]  # received, lost, garbage, enumerations, dropped
        if self._state[0]:
            self._behind = min(self._behind, self._box.taken(at_s) - sum(self._state[:2]))


def record(
    box: BoxUnderTest, run: SoakRun, length_s: float, save: Callable[[], None], stopped: list[int]
) -> None:
    """Sweep for this long or until `stopped`; `save` is called each minute."""
    recorder = Recorder(box, run, Script(run.seed))
    try:
        recorder.start()
        while run.length_s < length_s and not stopped:
            recorder.listen(min(MINUTE_S, length_s - run.length_s), lambda: bool(stopped))
            save()
            print(f"{box.name}: {progress(run)}", flush=True)
        recorder.listen(SILENT_S, recorder.sweeping)
        recorder.stop()
        run.ended = "time" if run.length_s >= length_s else "interrupted"
    except Gone as e:
        recorder.fault(str(e))
        run.ended = "gone"
    finally:
        box.close()
        save()


def progress(run: SoakRun) -> str:
    """The progress of a run as one line of text."""
    results = soak_judge.sums({"runs": [asdict(run)]})
    memory = f"{results['rss_kib'][-1] / 1024:.1f} MiB, " if results["rss_kib"] else ""
    names = ("unanswered", "wrong", "lost", "unaccounted", "faults")
    counts = (
        f"{name} {results[name]['n'] if name == 'wrong' else results[name]}" for name in names
    )
    return f"{run.length_s / 60:.0f} min, {memory}{results['answers']} sweeps: {', '.join(counts)}"


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON whole or not at all, each list of plain values on one line."""
    text = json.dumps(content, indent=1)
    text = re.sub(r"\[\n[^\[\]{}]*\]", lambda rows: json.dumps(json.loads(rows[0])), text)
    storage.put(path, (text + "\n").encode(), parents=True)


def soak(name: str, seed: int, hours: float, work: Path) -> None:
    """Record one box for `hours`, or until a signal comes."""
    box, run, got = BOXES[name](), SoakRun(seed), list[int]()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: got.append(n))
    about = {"box": name, "commit": commit(), "bundle": score.shipped(), "seed": seed}
    about |= {"format": str(skin.FORMAT), **box.about()}
    about |= {"started": datetime.now(UTC).isoformat(timespec="seconds"), "hours": hours}
    path = work / f"{name.replace(' ', '-')}.json"
    record(box, run, hours * 3600, lambda: write(path, about | {"runs": [asdict(run)]}), got)
    print(f"{name}: ended ({run.ended}); {progress(run)}", flush=True)


def summed(work: Path, out: Path) -> bool:
    """Check records, write results to `out`; False below a target. Old boxes keep theirs."""
    records = list(json.loads(out.read_text())["boxes"].values()) if out.exists() else []
    records += [json.loads(path.read_text()) for path in sorted(work.glob("*.json")) if path != out]
    boxes = {box["box"]: box | {"sums": soak_judge.sums(box)} for box in records}
    columns = {"answers": soak_judge.ANSWER, "samples": soak_judge.SAMPLE}
    left_out = {
        name: kind.missing() or "it was not recorded"
        for name, kind in BOXES.items()
        if name not in boxes
    }
    write(out, {"columns": columns, "left_out": left_out, "boxes": boxes})
    reached = bool(records)
    for name, box in boxes.items():
        for what, wanted, came, met in soak_judge.targets(box["sums"]):
            mark = {True: "ok", False: "FAIL", None: "too short to judge"}[met]
            print(f"{name}: {what}: {came} (wanted {wanted}): {mark}")
            reached &= met is not False
    return reached


def main() -> int:
    """Run the boxes, or one of them, and sum up; the exit code."""
    parser = argparse.ArgumentParser("python -m tests.rig.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0, help="how long in all (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="of the robot's sweeps (default 1)")
    parser.add_argument("--work", type=Path, default=WORK, help="where records are kept")
    parser.add_argument("--out", type=Path, default=WORK / "soak.json", help="file of results")
    parser.add_argument("--box", choices=BOXES, help="record this one alone, and sum up nothing")
    args = parser.parse_args()
    if args.box:
        soak(args.box, args.seed, args.hours, args.work)
        return 0
    arguments = ["--seed", str(args.seed), "--hours", repr(args.hours)]
    recorded = _together([*arguments, "--work", str(args.work.resolve())])
    return 0 if summed(args.work, args.out) and recorded else 1


def _together(arguments: list[str]) -> bool:
    """Each available box in a process of its own; False if one failed."""
    children = []
    for name, kind in BOXES.items():
        if missing := kind.missing():
            print(f"{name}: left out, {missing}", flush=True)
        else:
            command = [sys.executable, "-m", "tests.rig.soak", "--box", name, *arguments]
            children.append(subprocess.Popen(command, cwd=ROOT, start_new_session=True))

    def pass_on(number: int, frame: object) -> None:
        for child in children:
            child.terminate()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, pass_on)
    return not any([child.wait() for child in children])


if __name__ == "__main__":
    sys.exit(main())
