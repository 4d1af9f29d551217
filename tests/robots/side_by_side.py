"""A box with everything attached and attacked, beside a box with nothing: `python -m
tests.robots.side_by_side --minutes 5`.

Writes docs/data/robots-side-by-side.json and the table of docs/robots/README.md; the exit code is 1
if the attacked box was worse off.

Both are `palpate run --sim skin` with the same sweeps, in real time, at the same time on this
machine. The page, the TCP bridge (on its serial line), the bridges of Modbus and OPC UA and readers
(on its feed) are attached to the first; each of these five has hostile peers. Only boxes and
listeners run with real-time priority, if that is allowed.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from palpate.client.answers import Answer
from palpate.core import storage
from palpate.core.provenance import commit
from palpate.sim import skin
from tests.campaigns.skins.load import BOX, hurry
from tests.factories.bridges import bridge
from tests.factories.paths import ROOT
from tests.rig.soak_boxes import Script, ThisMachine
from tests.robots import page
from tests.robots.shared_line import SharedLine

START_S, COME_S, LOOK_S = 20.0, 10.0, 10.0
"""Time for the boxes to start, for programs to attach, and between two samples of the processes."""
RESULTS = ROOT / "docs" / "data" / "robots-side-by-side.json"
SWEEP_S = 3.0
"""Shortest time between two sweeps of the robot."""
WAIT_S = 0.1
LISTENS = re.compile(r"127\.0\.0\.1:(\d+)")
LATE_MS = 1.0
"""Largest additional median of the times inside the box and to the robot's end."""
LOST, DROPPED = 7, 10
"""Fields of an STA sentence, counted from the talker."""
REAL_TIME = ("chrt", "-f", "10")
SHARE = 0.03
"""Largest additional share of a core: one percent for the feed's readers, two for fifty requests a
second over TCP, which the box answers."""
MIB = 2.0


@dataclass
class Measured:
    """Answers of a box: the time of each in seconds, and the frame of its stop edge; milliseconds
    inside the box, and from the verdict to the robot's end; frames lost and sentences dropped."""

    answers: list[tuple[float, int]] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    way_ms: list[float] = field(default_factory=list)
    lost: int = 0
    dropped: int = 0
    faults: Counter[str] = field(default_factory=Counter)


class LatencyListener:
    """The robot's end: the delay of each answer, and frames counted as lost."""

    def __init__(self, box: ThisMachine, sweeps: Script) -> None:
        self._box, self._sweeps = box, sweeps
        self._next, self._counts = 1, (0, 0)

    def listen(self, seconds: float, into: Measured) -> None:
        """Record the sentences of this many seconds for `into`."""
        end_s = time.monotonic() + seconds
        before = self._counts
        while (left_s := end_s - time.monotonic()) > 0:
            for at_s, line in self._box.heard(min(left_s, WAIT_S)):
                self._note(at_s, line, into)
        into.lost += self._counts[0] - before[0]
        into.dropped += self._counts[1] - before[1]

    def _note(self, at_s: float, line: str, into: Measured) -> None:
        fields = line.split("*")[0].split(",")
        if fields[:2] == ["$PPLP", "STA"]:
            self._counts = int(fields[LOST]), int(fields[DROPPED])
            into.faults["skin away"] += fields[3] != "streaming"
        if answer := Answer.read(line):
            fact = self._sweeps[answer.sweep]
            into.faults["sweeps without an answer"] += answer.sweep - self._next
            said = answer.label if answer.status == "ok" else answer.status
            into.faults["not as the network by itself"] += said != fact.alone
            self._next = answer.sweep + 1
            into.answers.append((at_s, fact.stop))
            into.latency_ms.append(answer.latency_ms)
            into.way_ms.append(1e3 * (at_s - float(fields[3])))


@dataclass
class BoxSide:
    """One of the two boxes. looks: (seconds, processor seconds, KiB resident)."""

    box: ThisMachine
    listener: LatencyListener
    found: Measured = field(default_factory=Measured)
    looks: list[tuple[float, float, int]] = field(default_factory=list)
    before_kib: int = 0

    def look(self) -> None:
        """Record the resources that the process has used."""
        used = self.box.process()
        self.looks.append((time.monotonic(), used[2], used[0]))

    def figures(self) -> dict[str, Any]:
        """latency_ms: inside the box. way_ms: from the verdict to the robot's end of the line.
        edge_ms: from the stop edge to the robot's end, minus the median, because the start of the
        script is not known outside the box; both boxes have the same sweeps."""
        found = self.found
        at_s, stop = np.array(found.answers).T
        edge_s = at_s - stop / skin.FORMAT.rate_hz
        seconds, cpu_s, kib = (np.array(values) for values in zip(*self.looks, strict=True))
        shares = np.diff(cpu_s) / np.diff(seconds)
        return {
            "seconds": round(float(seconds[-1] - seconds[0])),
            "answers": len(found.answers),
            "share": round(float((cpu_s[-1] - cpu_s[0]) / (seconds[-1] - seconds[0])), 5),
            "shares": [round(float(share), 4) for share in shares],
            "before_mib": round(self.before_kib / 1024, 1),
            "most_mib": round(int(kib.max()) / 1024, 1),
            **{
                f"{name}_ms": spread(values)
                for name, values in (
                    ("edge", 1e3 * (edge_s - np.median(edge_s))),
                    ("latency", found.latency_ms),
                    ("way", found.way_ms),
                )
            },
            "frames_lost": found.lost,
            "sentences_dropped": found.dropped,
            "faults": {name: n for name, n in found.faults.items() if n},
        }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 99th percentile and maximum."""
    return {
        name: round(float(np.percentile(values, q)), 2)
        for name, q in (("p50", 50), ("p99", 99), ("max", 100))
    }


def sides(
    stack: ExitStack, feed: Path, seed: int, sweeps_n: int, before: Sequence[str]
) -> dict[str, BoxSide]:
    """Start both boxes."""
    found = {}
    for name, box in (
        ("alone", ThisMachine(before, ["store.runtime="])),
        ("attacked", SharedLine(before, [f"store.runtime={feed.parent}"])),
    ):
        sweeps = Script(seed)
        sweeps[sweeps_n]  # computed now: later it would delay a listener
        stack.callback(box.close)
        box.start(seed, sweeps)
        found[name] = BoxSide(box, LatencyListener(box, sweeps))
    return found


def listen(both: dict[str, BoxSide], seconds: float, *, measured: bool) -> None:
    """Read both boxes in threads of high priority, and sample their processes."""
    failed: list[BaseException] = []

    def one(side: BoxSide) -> None:
        hurry(BOX)
        try:
            side.listener.listen(seconds, side.found if measured else Measured())
        except BaseException as e:  # raised by the thread that joins
            failed.append(e)

    threads = [threading.Thread(target=one, args=(side,), daemon=True) for side in both.values()]
    for thread in threads:
        thread.start()
    while measured and any(thread.is_alive() for thread in threads) and not failed:
        for side in both.values():
            side.look()
        threads[0].join(LOOK_S)
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]
    for side in both.values() if measured else ():
        side.look()


def attack(stack: ExitStack, kind: str, where: object) -> subprocess.Popen[bytes]:
    """Start hostile peers; they end with their input, and then report their counts."""
    command, pipe = (
        [sys.executable, "-m", "tests.robots.attackers", kind, str(where)],
        subprocess.PIPE,
    )
    return stack.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe, cwd=ROOT))


def said(attackers: subprocess.Popen[bytes]) -> dict[str, int]:
    """End the peers; returns their counts."""
    return dict(json.loads(attackers.communicate(b"\n", timeout=30)[0]))


@contextmanager
def listening(*words: str) -> Iterator[int]:
    """Run a module of Python as a process of its own; yields its port on loopback, from its log.
    Nothing waits for it without a limit."""
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        late = threading.Timer(START_S, process.kill)
        late.start()
        try:
            log = iter(process.stderr.readline, "")  # type: ignore[union-attr]
            port = next(int(at[1]) for line in log if (at := LISTENS.search(line)))
            late.cancel()
            # a log that nobody reads would fill its pipe, and then stop the program
            threading.Thread(target=deque, args=(log, 0), daemon=True).start()
            yield port
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(COME_S)
            process.kill()


def measure(minutes: float, seed: int, before: Sequence[str]) -> dict[str, Any]:
    """Figures of both boxes, counts of the peers, and the names of box and machine."""
    with ExitStack() as stack:
        feed = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "feed.sock"
        both = sides(stack, feed, seed, round((START_S + COME_S + 60 * minutes) / SWEEP_S), before)
        listen(both, START_S, measured=False)
        for side in both.values():
            side.before_kib = side.box.process()[0]
        attached = stack.enter_context(ExitStack())
        line = both["attacked"].box
        assert isinstance(line, SharedLine)
        there = {
            "feed": feed,
            "tcp": attached.enter_context(bridge("tcp", "--port", line.line))[1],
            "modbus": attached.enter_context(bridge("modbus", "--feed", feed))[1],
            "opcua": attached.enter_context(
                listening(
                    *("palpate.bridges", "opcua", "--feed", str(feed), "--anonymous"),
                    *("--listen", "127.0.0.1:0", "--folder", str(feed.parent / "opcua")),
                )
            ),
            "page": attached.enter_context(
                listening("palpate", "watch", "--web", "0", "--set", f"store.runtime={feed.parent}")
            ),
        }
        peers = {kind: attack(attached, kind, where) for kind, where in there.items()}
        print(f"attached: {', '.join(peers)}", flush=True)
        listen(both, COME_S, measured=False)
        listen(both, 60 * minutes, measured=True)
        seen = {kind: said(process) for kind, process in peers.items()}
        return {
            **line.about(),
            "peers": seen,
            "boxes": {name: side.figures() for name, side in both.items()},
        }


def worse(boxes: dict[str, Any]) -> list[str]:
    """The targets that the attacked box missed, in words."""
    alone, one = boxes["alone"], boxes["attacked"]
    checks = {
        f"{one['frames_lost']} frames lost, alone {alone['frames_lost']}": one["frames_lost"]
        > alone["frames_lost"],
        f"{one['sentences_dropped']} sentences dropped": one["sentences_dropped"]
        > alone["sentences_dropped"],
        f"{one['faults']}, alone {alone['faults']}": bool(
            one["faults"].keys() - alone["faults"].keys()
        ),
        f"{100 * one['share']:.2f} % of a core, alone {100 * alone['share']:.2f} %": one["share"]
        > alone["share"] + SHARE,
        f"{one['most_mib']} MiB, before {one['before_mib']}": one["most_mib"] - one["before_mib"]
        > MIB,
    } | {
        f"{name} {one[name]['p50']} ms, alone {alone[name]['p50']}": one[name]["p50"]
        > alone[name]["p50"] + LATE_MS
        for name in ("latency_ms", "way_ms")
    }
    return [text for text, bad in checks.items() if bad]


NAMES = {
    "alone": "nothing attached",
    "attacked": "page, TCP, Modbus, OPC UA and feed, all attacked",
}


def table(content: dict[str, Any]) -> str:
    """The measurements in Markdown."""
    boxes, peers = content["boxes"], content["peers"]
    rows = [
        "Measured by `python -m tests.robots.side_by_side`, both boxes at the same time "
        f"for {boxes['alone']['seconds']} s, on "
        f"{content['machine']}{', with real-time priority' * content['real_time']};",
        f"load average {content['load']:.1f}; commit {content['commit'][:12]}.",
        "",
        "| box | frames lost | answers | verdict to line, p50 / p99 / most "
        "| share of a core | memory: before, most |",
        "|---|---|---|---|---|---|",
    ]
    for name, one in boxes.items():
        way = "{p50:.1f} / {p99:.1f} / {max:.1f} ms".format(**one["way_ms"])
        rows.append(
            f"| {NAMES[name]} | {one['frames_lost']} | {one['answers']} | {way} "
            f"| {100 * one['share']:.2f} % | {one['before_mib']}, {one['most_mib']} MiB |"
        )
    bore = [f"{kind} {seen['attempts']:,}" for kind, seen in peers.items()]
    good = [
        f"{kind} {seen['answers of the bridge']:,}"
        for kind, seen in peers.items()
        if "answers of the bridge" in seen
    ]
    rows += [
        "",
        f"Hostile connections: {', '.join(bore)}; answers to one good peer: {', '.join(good)}.",
    ]
    return "\n".join(rows)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes", type=float, default=5.0, help="for both boxes at once (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--out",
        type=Path,
        default=RESULTS,
        help="the table of the usual file goes into docs/robots/README.md",
    )
    args = parser.parse_args()
    real_time = (
        subprocess.run([*REAL_TIME, "true"], check=False, capture_output=True).returncode == 0
    )
    load = round(os.getloadavg()[2], 1)
    found = measure(args.minutes, args.seed, REAL_TIME if real_time else ())
    content = {"commit": commit(), "seed": args.seed, "real_time": real_time, "load": load, **found}
    storage.put(args.out, json.dumps(content, indent=1).encode() + b"\n", parents=True)
    if args.out == RESULTS:
        page.write(ROOT / "docs" / "robots" / "README.md", "side-by-side", table(content))
    print(table(content))
    for text in (bad := worse(content["boxes"])):
        print(f"FAIL {text}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
