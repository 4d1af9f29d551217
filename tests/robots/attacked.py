"""The load of bridges on the box, and bridges under attack: `python -m tests.robots.attacked
--minutes 2`, minutes for each case.

Prints a table and writes docs/data/robots-attacked.json; the exit code is 1 if a frame, a sentence
or an answer was lost.

One box (`palpate run --sim skin`, in real time) goes through all cases in turns of SLOT_S, so that
all run on the same machine: no bridge; Modbus and ROS 2 on its feed and TCP on its line; the same
with peers that flood the Modbus and TCP bridges with requests, noise and connections. Box and
listener run with real-time priority if `chrt` may be used.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from palpate.core.provenance import commit
from tests.campaigns.feed_load import REAL_TIME, SETTLE_S, SLOT_S, Kind, LatencyListener, result
from tests.factories import ros
from tests.factories.bridges import bridge
from tests.factories.paths import ROOT
from tests.rig.soak_boxes import Script
from tests.robots import page
from tests.robots.shared_line import SharedLine

CASES = {
    "0": "no bridge",
    "bridges": "Modbus and ROS 2 on the feed, TCP on the line",
    "attacked": "the same, Modbus and TCP attacked",
}


def attack(stack: ExitStack, kind: str, port: int) -> subprocess.Popen[bytes]:
    """Start hostile peers; they end with their input, and then report their counts."""
    command, pipe = (
        [sys.executable, "-m", "tests.robots.attackers", kind, str(port)],
        subprocess.PIPE,
    )
    return stack.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe, cwd=ROOT))


def said(attackers: subprocess.Popen[bytes]) -> dict[str, int]:
    """End the peers; returns their counts."""
    return dict(json.loads(attackers.communicate(b"\n", timeout=30)[0]))


def slot(name: str, feed: Path, box: SharedLine, listener: LatencyListener, kind: Kind) -> None:
    """One turn of a case: start bridges and peers, watch the box, end them."""
    with ExitStack() as stack:
        attackers = []
        if name != "0":
            ports = {
                "modbus": stack.enter_context(bridge("modbus", "--feed", feed))[1],
                "tcp": stack.enter_context(bridge("tcp", "--port", box.line))[1],
            }
            stack.enter_context(ros.bridge("-p", f"feed:={feed}", "-p", "frames_hz:=10.0"))
            if name == "attacked":
                attackers = [attack(stack, one, port) for one, port in ports.items()]
        listener.listen(SETTLE_S, Kind())
        before_s = box.process()[2]
        listener.listen(SLOT_S, kind)
        used_s = box.process()[2] - before_s
        kind.wall_s, kind.cpu_s = kind.wall_s + SLOT_S, kind.cpu_s + used_s
        kind.shares.append(used_s / SLOT_S)
        kind.rss_kib.append(box.process()[0])
        for one in attackers:
            kind.seen.update(said(one))
    listener.listen(SETTLE_S, Kind())


def measure(minutes: float, before: list[str]) -> dict[str, Any]:
    """Figures of each case, see `feed_load.result`."""
    kinds = {name: Kind() for name in CASES}
    with ExitStack() as stack:
        feed = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "feed.sock"
        box, sweeps = SharedLine(before, [f"store.runtime={feed.parent}"]), Script(1)
        stack.callback(box.close)
        box.start(1, sweeps)
        listener = LatencyListener(box, sweeps)
        listener.listen(30.0, Kind())  # until the box has started and answered the first sweeps
        rss_kib = box.process()[0]
        for turn in range(max(1, round(minutes * 60 / SLOT_S))):
            for name, kind in kinds.items():
                slot(name, feed, box, listener, kind)
                print(
                    f"{turn + 1}  {CASES[name]}: {100 * kind.shares[-1]:.2f} % of a core",
                    flush=True,
                )
        box.stop()
    return result(kinds, rss_kib)


def table(figures: dict[str, Any]) -> str:
    """The figures in Markdown."""
    rows = [
        "| | share of a core | sentence, after the quickest, p50 / p99 | in the box, p50 / p99 "
        "| answers | frames lost | the peers |"
    ]
    rows.append("|---|---|---|---|---|---|---|")
    for name, one in figures.items():
        late, within, peers = one["late_ms"], one["latency_ms"], one["lines"]
        bore = (
            f"{peers['attempts']} connections, "
            f"{peers['answers of the bridge']} answers to good ones"
            if peers
            else ""
        )
        rows.append(
            f"| {CASES[name]} | {100 * one['share']:.2f} % "
            f"| {late['p50']:.1f} / {late['p99']:.1f} ms | {within['p50']:.2f} / "
            f"{within['p99']:.2f} ms | {one['answers']} | {one['frames_lost']} | {bore} |"
        )
    return "\n".join(rows)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=2.0, help="for each case (%(default)s)")
    args = parser.parse_args()
    ros.required()
    real_time = (
        subprocess.run([*REAL_TIME, "true"], check=False, capture_output=True).returncode == 0
    )
    if real_time:  # only this process, which listens; bridges and peers have normal priority
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(10))
    figures = measure(args.minutes, [*REAL_TIME] if real_time else [])
    content = {"commit": commit(), "real_time": real_time, "cases": figures}
    (ROOT / "docs" / "data" / "robots-attacked.json").write_text(
        json.dumps(content, indent=1) + "\n"
    )
    page.write(ROOT / "docs" / "robots" / "README.md", "attacked", table(figures))
    print(table(figures))
    bad = [
        name
        for name, one in figures.items()
        if one["frames_lost"] or one["sentences_dropped"] or one["faults"]
    ]
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
