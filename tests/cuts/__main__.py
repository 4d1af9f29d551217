"""Cuts every scene at every crash point: `python -m tests.cuts [SCENE ...]`.

Prints a line for each command, and writes to build/cuts.jsonl a line for each crash point, with the
machine and the commit. The exit code is 1 if anything is wrong.
"""

import argparse
import json
import os
import platform
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

from palpate.core.provenance import commit
from tests.cuts import black_box, calls, delivery, memory, recording, releases, teaching
from tests.cuts.scene import CrashPoint, CutScene, ScenePlay, stage
from tests.factories.paths import ROOT

SCENES: dict[str, Callable[[Path], CutScene]] = {
    "recording": lambda beside: recording.scene(),
    "recording-thread": lambda beside: recording.scene(recording.THREAD),
    "palpate-record": lambda beside: recording.palpate(),
    "black-box": lambda beside: black_box.scene(),
    "black-box-thread": lambda beside: black_box.scene("thread"),
    "memory": lambda beside: memory.scene(),
    "releases": lambda beside: releases.scene(),
    "delivery": lambda beside: delivery.Shop.opened(beside).scene(),
    "enrolment": lambda beside: delivery.Shop.opened(beside).enrolment(),
    "teaching": lambda beside: teaching.TeachingShop.opened(beside).teaching(),
}
"""Makes each scene; the argument is an empty folder for the files that it needs."""
HOWS = ("kill", "power", "kill_then_power", "timed")


def _given() -> argparse.Namespace:
    """The arguments; ends the program for a scene that does not exist."""
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
    parser.add_argument(
        "--times",
        type=int,
        metavar="N",
        help="instead kill each command and its processes at N random instants",
    )
    given = parser.parse_args()
    if wrong := set(given.scenes) - set(SCENES):
        parser.error(f"no scene {', '.join(sorted(wrong))}; there are {', '.join(SCENES)}")
    return given


def main() -> int:
    """Cut the named scenes, or all scenes."""
    given = _given()
    if lack := calls.lacking():
        sys.exit(f"cuts: needs {lack}")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    points = []
    with given.out.open("w") as out:
        print(json.dumps(_head()), file=out)
        for name in given.scenes or SCENES:
            with TemporaryDirectory(prefix="cuts-") as beside:
                scene = SCENES[name](Path(beside))
                hows = HOWS[:3] if given.twice else HOWS[:2]
                for point in timed(scene, given.times) if given.times else cut(scene, hows):
                    points.append(point)
                    print(json.dumps(asdict(point)), file=out, flush=True)
                    print(".", end="", flush=True)
                    for wrong in point.wrong:
                        where = f"{point.scene}: {point.step}: {point.how} before {point.call}"
                        print(f"\n{where}: {wrong}", flush=True)
    print("", *figures(points), sep="\n")
    return 1 if any(point.wrong for point in points) else 0


def _head() -> dict[str, str]:
    """The commit and the machine."""
    return {
        "commit": commit(),
        "kernel": platform.platform(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
    }


def timed(scene: CutScene, times: int) -> Iterator[CrashPoint]:
    """Kill each command of a scene at random instants."""
    rng = random.Random(scene.name)
    with stage() as work:
        play = ScenePlay(scene, Path(work))
        for number in range(len(scene.steps)):
            for _ in range(times):
                yield play.timed(number, rng.random())


def cut(scene: CutScene, hows: Sequence[str] = HOWS[:3]) -> Iterator[CrashPoint]:
    """Cut a scene in these ways at all its points."""
    with stage() as work:
        play = ScenePlay(scene, Path(work))
        for how in hows:
            for moment in play.moments():
                if how == "power" or moment.call:
                    yield getattr(play, how)(moment)


def figures(points: Iterable[CrashPoint]) -> Iterator[str]:
    """A line for each command, and a line for all."""
    steps: dict[str, list[CrashPoint]] = {}
    for point in points:
        for name in (f"{point.scene}: {point.step}", "all"):
            steps.setdefault(name, []).append(point)
    for name in sorted(steps, key="all".__eq__):
        reported = []
        for how in HOWS:
            if of_it := [point for point in steps[name] if point.how == how]:
                states = sum(point.states for point in of_it)
                wrong = f"wrong {sum(bool(point.wrong) for point in of_it)}"
                moments = f"{how.replace('_', ' ')} at {len(of_it)} moments"
                reported.append(f"{moments}, {states} folders, {wrong}")
        yield f"{name}: {'; '.join(reported)}"


if __name__ == "__main__":
    sys.exit(main())
