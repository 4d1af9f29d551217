"""`python -m palpate_train.teach`: assesses or fits the sweeps in a folder; the box starts it.

It prints one JSON object a line. `step`: a step begins, with the share done and the seconds left.
`assessed`: see Assessment.json. `taught`: the bundle is in --out. `error`: the reason, for a
person.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from palpate.core.errors import ApplianceError

NICE = 19
"""Priority of the process: the lowest. The loop always comes first."""


def main(argv: list[str] | None = None) -> int:
    """Run; the exit code."""
    parser = argparse.ArgumentParser("python -m palpate_train.teach")
    parser.add_argument("folder", type=Path, help="of recorded sweeps")
    parser.add_argument("--out", type=Path, help="write a bundle there; else only assess")
    parser.add_argument("--version", default="1", help="of the bundle")
    parser.add_argument("--by", default="", help="who teaches, for the manifest")
    parser.add_argument("--at", default="", help="when, for the manifest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--forgotten", type=json.loads, default={}, help="JSON, see Lesson.read")
    parser.add_argument("--memory-mb", type=int, default=0, help="limit of private memory")
    args = parser.parse_args(argv)
    _restrict(args.memory_mb)
    try:
        _run(args)
    except ApplianceError as e:
        _say("error", text=str(e))
        return e.exit_code
    except MemoryError:
        _say("error", text=f"{args.memory_mb} MB are too few for these sweeps; use a desktop")
        return ApplianceError.exit_code
    except OSError as e:
        _say("error", text=f"{e.filename or args.folder}: {e.strerror}; nothing was changed")
        return ApplianceError.exit_code
    return 0


def _run(args: argparse.Namespace) -> None:
    # here: these imports take a second, and the limits hold for them too
    from palpate_train.teach.assessment import assess
    from palpate_train.teach.lesson import Lesson
    from palpate_train.teach.taught import teach

    lesson = Lesson.read(args.folder, args.forgotten)
    if args.out is None:
        _say("assessed", **assess(lesson, args.seed).json())
        return

    def tell(step: str, done: float, left_s: float | None) -> None:
        _say("step", step=step, done=round(done, 2), left_s=left_s and round(left_s, 1))

    about = {"by": args.by, "at": args.at}
    manifest = teach(lesson, args.out, args.version, about, args.seed, tell)
    # not ru_maxrss, which begins with the memory of the parent process
    status = Path("/proc/self/status").read_text()
    peak = int(status.partition("VmHWM:")[2].split()[0]) // 1024
    no_slides = [asdict(one) for one in lesson.no_slides]
    _say(
        "taught",
        no_slides=no_slides,
        labels=manifest.labels,
        figures=manifest.figures,
        peak_mb=peak,
    )


def _restrict(memory_mb: int) -> None:
    """Take the lowest priority and the limit of memory; a system that forbids it has its own."""
    with suppress(OSError):
        os.nice(NICE)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    if memory_mb:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_mb << 20, memory_mb << 20))


def _say(kind: str, **content: Any) -> None:
    print(json.dumps({"type": kind, **content}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
