"""Cuts every scene at every crash point: `python -m tests.cuts [SCENE ...]`.

Prints a line for each command, and writes to build/cuts.jsonl a line for each crash point, with the
machine and the commit. An interrupted run is continued as long as neither the box nor the scenes
have changed. The exit code is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.cuts import black_box, calls, delivery, recording, teaching, tree
from tests.cuts.scene import ROOT, CrashPoint, CutScene, ScenePlay, stage

SCENES: dict[str, Callable[[Path], CutScene]] = {
    "recording": lambda beside: recording.scene(),
    "recording-thread": lambda beside: recording.scene(recording.THREAD),
    "palpate-record": lambda beside: recording.palpate(),
    "black-box": lambda beside: black_box.scene(),
    "black-box-thread": lambda beside: black_box.scene("thread"),
    "delivery": lambda beside: delivery.Shop.opened(beside).scene(),
    "enrolment": lambda beside: delivery.Shop.opened(beside).enrolment(),
    "teaching": lambda beside: teaching.TeachingShop.opened(beside).teaching(),
}
"""Makes each scene; the argument is an empty folder for the files that it needs."""
HOWS = ("kill", "power", "kill_then_power")


def main() -> int:
    """Cut the named scenes, or all scenes."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.cuts", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=f"from {', '.join(SCENES)}; all by default"
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "build" / "cuts.jsonl", help="points (%(default)s)"
    )
    parser.add_argument(
        "--twice",
        action="store_true",
        help="also kill each command and start it again, and then cut the power (hours)",
    )
    given = parser.parse_args()
    if wrong := set(given.scenes) - set(SCENES):
        parser.error(f"no scene {', '.join(sorted(wrong))}; there are {', '.join(SCENES)}")
    if lack := calls.lacking():
        sys.exit(f"cuts: needs {lack}")
    ledger = CrashPointLog(given.out)
    for name in given.scenes or SCENES:
        with TemporaryDirectory(prefix="cuts-") as beside:
            for point in cut(SCENES[name](Path(beside)), ledger, HOWS if given.twice else HOWS[:2]):
                print(".", end="", flush=True)
                for wrong in point.wrong:
                    print(
                        f"\n{point.scene}: {point.step}: {point.how} before {point.call}: {wrong}",
                        flush=True,
                    )
    print("", *figures(ledger.points()), sep="\n")
    return 1 if any(point.wrong for point in ledger.points()) else 0


class CrashPointLog:
    """Crash points by their moments: one line of a file each, under a head that names the code and
    the machine."""

    def __init__(self, path: Path) -> None:
        self._path, head = path, json.dumps(_head())
        path.parent.mkdir(parents=True, exist_ok=True)
        first, *lines = path.read_text().splitlines() if path.exists() else [""]
        lines = [
            line for line in lines if first == head and line.endswith("}")
        ]  # the last line may be incomplete
        path.write_text("".join(f"{line}\n" for line in (head, *lines)))
        self._points = [_point(json.loads(line)) for line in lines]

    def points(self, scene: str = "") -> list[CrashPoint]:
        """The points of a scene, or of all scenes."""
        return [point for point in self._points if scene in ("", point.scene)]

    def add(self, point: CrashPoint) -> None:
        """Append a point to the file."""
        self._points.append(point)
        with self._path.open("a") as file:
            file.write(json.dumps(asdict(point)) + "\n")


def _point(reported: dict[str, Any]) -> CrashPoint:
    return CrashPoint(**reported | {"wrong": tuple(reported["wrong"])})


def _head() -> dict[str, str]:
    """The head of a log: the commit, a digest of the code itself, and the machine."""
    git = ("git", "-C", str(ROOT), "describe", "--always", "--dirty")
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    sources = (tree.read(ROOT / folder) for folder in ("appliance/palpate", "tests/cuts"))
    digests = [
        tree.digest({name: held for name, held in s.items() if "__pycache__" not in name})
        for s in sources
    ]
    return {
        "commit": commit,
        "source": "".join(d[:16] for d in digests),
        "kernel": platform.platform(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
    }


def cut(scene: CutScene, ledger: CrashPointLog, hows: Sequence[str] = HOWS) -> Iterator[CrashPoint]:
    """Cut a scene in these ways at all points that are not in the log yet; each is appended to
    it."""
    done = {(point.step, point.how, point.moment) for point in ledger.points(scene.name)}
    with stage() as work:
        play = ScenePlay(scene, Path(work))
        for how in hows:
            for moment in play.moments():
                at = scene.steps[moment.step].name, how, moment.number
                if at not in done and (how == "power" or moment.call):
                    ledger.add(point := getattr(play, how)(moment))
                    yield point


def figures(points: Iterable[CrashPoint]) -> Iterator[str]:
    """A line for each command, and a line for all."""
    steps: dict[str, list[CrashPoint]] = {}
    for point in points:
        for name in (f"{point.scene}: {point.step}", "all"):
            steps.setdefault(name, []).append(point)
    for name in sorted(steps, key="all".__eq__):
        reported = []
        for how in HOWS:
            if not (of_it := [point for point in steps[name] if point.how == how]):
                continue
            states, wrong = (
                sum(point.states for point in of_it),
                sum(bool(point.wrong) for point in of_it),
            )
            reported.append(
                f"{how.replace('_', ' ')} at {len(of_it)} moments, {states} folders, wrong {wrong}"
            )
        yield f"{name}: {'; '.join(reported)}"


if __name__ == "__main__":
    sys.exit(main())
