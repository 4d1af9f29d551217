"""The load of the feed's readers on the box: `python -m tests.campaigns.feed_load --minutes 5 --out
docs/data/feed.json`, minutes for each kind of readers.

Prints a table and writes JSON: share of a core, memory, latency and losses, with and without
readers. The exit code is 1 if a target was missed.

One box (`palpate run --sim skin`, in real time) goes through all kinds in turns of SLOT_S, so that
all run on the same machine. Box and listener run with real-time priority if `chrt` may be used, so
that other programs of the machine cause no latency. The time that the loop spends in the feed is
counted separately, too (feed_inside).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from palpate.client.answers import Answer
from palpate.core import storage
from palpate.core.provenance import commit
from palpate.sim import skin
from tests.campaigns.feed_inside import spent_ns
from tests.campaigns.feed_readers import KINDS
from tests.factories.paths import ROOT
from tests.rig.soak_boxes import Script, ThisMachine

SLOT_S, SETTLE_S = 20.0, 2.0
WAIT_S = 0.1
SHARE, MIB, LATE_MS = 0.01, 2.0, 1.0
"""Targets: additional share of a core, additional memory, additional median time to the
sentence."""
LOST, DROPPED = 7, 10
"""Fields of an STA sentence, counted from the talker."""
PACKET = 6
"""Frames of a packet, as rig.ReadoutBoard sends them."""
REAL_TIME = ("chrt", "-f", "10")


@dataclass
class Kind:
    """Measurements while there were readers of one kind."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    inside_s: float = 0.0
    """The part of cpu_s that is spent in the feed."""
    shares: list[float] = field(default_factory=list)
    rss_kib: list[int] = field(default_factory=list)
    answers: list[tuple[float, int]] = field(default_factory=list)
    """The time of each answer, in seconds, and the frame of its stop edge."""
    latency_ms: list[float] = field(default_factory=list)
    way_ms: list[float] = field(default_factory=list)
    """From the verdict, whose time has whole milliseconds, to the robot's end: the part outside the
    box."""
    lost: int = 0
    dropped: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    seen: Counter[str] = field(default_factory=Counter)


class LatencyListener:
    """The robot's end of the line: the delay of each answer, and the frames that the box counts as
    lost."""

    def __init__(self, box: ThisMachine, sweeps: Script) -> None:
        self._box, self._sweeps = box, sweeps
        self._next, self._counts = 1, (0, 0)

    def listen(self, seconds: float, kind: Kind) -> None:
        """Record the sentences of this many seconds for `kind`."""
        end_s = time.monotonic() + seconds
        before = self._counts
        while (left_s := end_s - time.monotonic()) > 0:
            for at_s, line in self._box.heard(min(left_s, WAIT_S)):
                self._note(at_s, line, kind)
        kind.lost += self._counts[0] - before[0]
        kind.dropped += self._counts[1] - before[1]

    def _note(self, at_s: float, line: str, kind: Kind) -> None:
        fields = line.split("*")[0].split(",")
        if fields[:2] == ["$PPLP", "STA"]:
            self._counts = int(fields[LOST]), int(fields[DROPPED])
            kind.faults["skin away"] += fields[3] != "streaming"
        if answer := Answer.read(line):
            fact = self._sweeps[answer.sweep]
            kind.faults["sweeps without an answer"] += answer.sweep - self._next
            said = answer.label if answer.status == "ok" else answer.status
            kind.faults["not as the network by itself"] += said != fact.alone
            self._next = answer.sweep + 1
            kind.answers.append((at_s, fact.stop))
            kind.latency_ms.append(answer.latency_ms)
            kind.way_ms.append(1e3 * (at_s - float(fields[3])))


def measure(
    names: Sequence[str], minutes: float, seed: int, before: Sequence[str], report: Any
) -> tuple[dict[str, Kind], int, dict[str, Any]]:
    """Measure all kinds in turns. Returns the measurements, the resident memory in KiB before the
    first reader, and a description of box and machine."""
    kinds = {name: Kind() for name in names}
    with ExitStack() as stack:
        path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "feed.sock"
        counted = [
            *before,
            sys.executable,
            "-m",
            "tests.campaigns.feed_inside",
            os.fspath(_inside(path)),
        ]
        box, sweeps = ThisMachine(counted, [f"store.runtime={path.parent}"]), Script(seed)
        stack.callback(box.close)
        box.start(seed, sweeps)
        listener = LatencyListener(box, sweeps)
        listener.listen(30.0, Kind())  # until the box has started and answered the first sweeps
        rss_kib = box.process()[0]
        for turn in range(max(1, round(minutes * 60 / SLOT_S))):
            for name, kind in kinds.items():
                _slot(name, path, box, listener, kind)
                report(
                    f"{turn + 1}  {name:<10} {100 * kind.shares[-1]:5.2f} % of a "
                    f"core, {kind.rss_kib[-1]} KiB"
                )
        box.stop()
    return kinds, rss_kib, dict(box.about())


def _inside(feed: Path) -> Path:
    """The file of feed_inside beside the socket."""
    return feed.with_suffix(".ns")


def _slot(name: str, path: Path, box: ThisMachine, listener: LatencyListener, kind: Kind) -> None:
    """One turn of a kind: start its readers, watch the box, end them."""
    command = [sys.executable, "-m", "tests.campaigns.feed_readers", str(path), name]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT
    ) as readers:
        listener.listen(SETTLE_S, Kind())
        begin_s, cpu_s, inside_ns = time.monotonic(), box.process()[2], spent_ns(_inside(path))
        listener.listen(SLOT_S, kind)
        wall_s, cpu_s = time.monotonic() - begin_s, box.process()[2] - cpu_s
        kind.inside_s += (spent_ns(_inside(path)) - inside_ns) / 1e9
        kind.rss_kib.append(box.process()[0])
        kind.wall_s, kind.cpu_s = kind.wall_s + wall_s, kind.cpu_s + cpu_s
        kind.shares.append(cpu_s / wall_s)
        said, _ = readers.communicate(b"\n", timeout=30)
        kind.seen.update(json.loads(said))
    listener.listen(SETTLE_S, Kind())


def lateness(kinds: dict[str, Kind]) -> dict[str, Any]:
    """Milliseconds from the packet with the stop edge to each answer, minus those of the quickest
    answer.

    Packets begin at every sixth frame. The phase is not known outside the box, so it is chosen for
    the smallest spread of the answers.
    """

    def after(begin: int) -> dict[str, Any]:
        late = {}
        for name, kind in kinds.items():
            at_s, stop = np.array(kind.answers).T
            late[name] = (
                at_s - (np.ceil((stop - begin) / PACKET) * PACKET + begin) / skin.FORMAT.rate_hz
            )
        quickest = min(values.min() for values in late.values())
        return {name: 1e3 * (values - quickest) for name, values in late.items()}

    def spread(late: dict[str, Any]) -> float:
        low, high = np.percentile(np.concatenate([*late.values()]), [10, 90])
        return float(high - low)

    return min((after(begin) for begin in range(PACKET)), key=spread)


def result(kinds: dict[str, Kind], rss_kib: int) -> dict[str, Any]:
    """Figures of each kind. late_ms: see `lateness`. share_more: difference to the turns without
    readers, mean with a 95 % interval. inside: share of a core that the loop spends in the feed.
    memory_mib: largest increase of resident memory since before the first reader."""
    late, figures = lateness(kinds), {}
    for name, kind in kinds.items():
        more = np.array(kind.shares) - np.array(kinds["0"].shares)
        width = 1.96 * more.std(ddof=1) / np.sqrt(len(more)) if len(more) > 1 else float("nan")
        figures[name] = {
            "seconds": round(kind.wall_s),
            "answers": len(kind.answers),
            "share": round(kind.cpu_s / kind.wall_s, 5),
            "inside": round(kind.inside_s / kind.wall_s, 5),
            "share_more": [
                round(float(v), 5) for v in (more.mean(), more.mean() - width, more.mean() + width)
            ],
            "memory_mib": round((max(kind.rss_kib) - rss_kib) / 1024, 2),
            "late_ms": {f"p{q}": round(float(np.percentile(late[name], q)), 2) for q in (50, 99)},
            "way_ms": {f"p{q}": round(float(np.percentile(kind.way_ms, q)), 1) for q in (50, 99)},
            "slowest": [
                [round(float(v), 1), round(kind.way_ms[i], 1)] for i, v in slowest(late[name])
            ],
            "latency_ms": {
                f"p{q}": round(float(np.percentile(kind.latency_ms, q)), 2) for q in (50, 99)
            },
            "frames_lost": kind.lost,
            "sentences_dropped": kind.dropped,
            "faults": {k: n for k, n in kind.faults.items() if n},
            "lines": dict(kind.seen),
        }
    return figures


def slowest(late_ms: Any) -> list[tuple[int, float]]:
    """The three latest answers: number in the list, milliseconds."""
    return [(int(i), float(late_ms[i])) for i in np.argsort(-late_ms)[:3]]


def missed(figures: dict[str, Any]) -> list[str]:
    """The targets that were missed, in words."""
    found = []
    for name, one in figures.items():
        more_ms = one["late_ms"]["p50"] - figures["0"]["late_ms"]["p50"]
        checks = {
            f"{100 * one['inside']:.2f} % of a core in the feed": one["inside"] > SHARE,
            f"{100 * one['share_more'][1]:.2f} % of a core at least": one["share_more"][1] > SHARE,
            f"{one['memory_mib']} MiB more": one["memory_mib"] > MIB,
            f"{more_ms:.2f} ms later in the median": more_ms > LATE_MS,
            f"{one['frames_lost']} frames lost": one["frames_lost"] > 0,
            f"{one['sentences_dropped']} sentences dropped": one["sentences_dropped"] > 0,
            f"{one['faults']}": bool(one["faults"]),
        }
        found += [f"{name}: {text}" for text, bad in checks.items() if bad]
    return found


NAMES = {
    "0": "none",
    "1": "1 reader",
    "8": "8, one never reads",
    "64": "64, one never reads",
    "attacked": "attacked",
    "bridge": "a bridge that is attacked",
}


def table(content: dict[str, Any]) -> str:
    """The measurements in Markdown."""
    figures = content["readers"]
    rows = [
        f"Measured by `python -m tests.campaigns.feed_load`, {figures['0']['seconds']} s of each "
        f"kind in turns of {SLOT_S:g} s, on "
        f"{content['machine']}{', with real-time priority' * content['real_time']}; "
        f"load average {content['load']:.1f} by other "
        f"work; commit {content['commit'][:12]}.",
        "",
        "| readers | share of a core | more than without | in the feed | memory, more | "
        "sentence, after the quickest, p50 / p99 | in the box, p50 / p99 | answers | frames lost |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, one in figures.items():
        more = (
            ""
            if name == "0"
            else "{:+.2f} % [{:+.2f}, {:+.2f}]".format(*(100 * v for v in one["share_more"]))
        )
        late, latency = one["late_ms"], one["latency_ms"]
        rows.append(
            f"| {NAMES[name]} | {100 * one['share']:.2f} % | {more} | {100 * one['inside']:.2f} "
            f"% | {one['memory_mib']:.2f} MiB | "
            f"{late['p50']:.1f} / {late['p99']:.1f} ms | {latency['p50']:.2f} "
            f"/ {latency['p99']:.2f} ms | "
            f"{one['answers']} | {one['frames_lost']} |"
        )
    return "\n".join(rows)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes", type=float, default=5.0, help="for each kind of readers (%(default)s)"
    )
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=KINDS, help="some of them, beside 0"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/feed.json"))
    parser.add_argument(
        "--draw", action="store_true", help="measure nothing: the table of --out as it is"
    )
    args = parser.parse_args()
    if not args.draw:
        _measured(args)
    content = json.loads(args.out.read_text())
    print(table(content))
    for text in (bad := missed(content["readers"])):
        print(f"FAIL {text}")
    return 1 if bad else 0


def _measured(args: argparse.Namespace) -> None:
    """Measure, and write the figures to --out."""
    real_time = (
        subprocess.run([*REAL_TIME, "true"], check=False, capture_output=True).returncode == 0
    )
    kinds, rss_kib, about = measure(
        ["0", *(name for name in args.kinds if name != "0")],
        args.minutes,
        args.seed,
        REAL_TIME if real_time else (),
        lambda line: print(line, flush=True),
    )
    figures = result(kinds, rss_kib)
    load = round(os.getloadavg()[2], 1)
    content = {
        "commit": commit(),
        "seed": args.seed,
        **about,
        "real_time": real_time,
        "load": load,
        "readers": figures,
    }
    storage.put(args.out, json.dumps(content, indent=1).encode() + b"\n", parents=True)


if __name__ == "__main__":
    sys.exit(main())
