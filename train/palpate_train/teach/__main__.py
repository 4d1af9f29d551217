"""`python -m palpate_train.teach`: assesses or fits the sweeps in a folder; the box starts it.

It prints one JSON object a line. `step`: a step begins, with the share done and the seconds left.
`assessed`: see Assessment.json. `taught`: the bundle is in --out. `error`: the reason, for a
person.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from palpate.core.errors import ApplianceError

LEAST_MB = 256
"""Private memory that a small lesson needs; numpy and scipy take most of it. Where they get less, a
BLAS may ask for memory for ever, so the limit is compared before they are loaded."""
LEAST_FREE_MB = 160
"""Free memory that a small lesson needs."""
LOAD_CPU_S = 60
"""Longest processor time in s of the imports; 2 on a desktop. Beyond it the kernel ends the
process."""
MEMINFO = Path("/proc/meminfo")


def main(argv: list[str] | None = None) -> int:
    """Run; the exit code."""
    parser = argparse.ArgumentParser("python -m palpate_train.teach")
    parser.add_argument("folder", type=Path, help="of recorded sweeps")
    parser.add_argument("--out", type=Path, help="write a bundle there; else only assess")
    parser.add_argument("--version", default="1", help="of the bundle")
    parser.add_argument("--by", default="", help="who teaches, for the manifest")
    parser.add_argument("--at", default="", help="when, for the manifest")
    parser.add_argument("--memory-mb", type=int, default=0, help="limit of private memory")
    parser.add_argument("--cpu-s", type=int, default=0, help="limit of processor time")
    args = parser.parse_args(argv)
    try:
        _check_memory(args.memory_mb)
        _restrict(args.memory_mb)
        _limit_cpu(LOAD_CPU_S)
        _run(args)
    except ApplianceError as e:
        _say("error", text=str(e))
        return e.exit_code
    except MemoryError:
        _say("error", text=_too_few(args.memory_mb))
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

    _limit_cpu(args.cpu_s)
    lesson = Lesson.read(args.folder)
    if args.out is None:
        _say("assessed", **assess(lesson).json())
        return

    def tell(step: str, done: float, left_s: float | None) -> None:
        _say("step", step=step, done=round(done, 2), left_s=left_s and round(left_s, 1))

    about = {"by": args.by, "at": args.at}
    manifest = teach(lesson, args.out, args.version, about, tell)
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


def _too_few(memory_mb: int) -> str:
    return f"{memory_mb} MB are too few for these sweeps; use a desktop"


def _check_memory(memory_mb: int) -> None:
    """Raises ApplianceError if the limit, or the free memory, is too little for any lesson."""
    if 0 < memory_mb < LEAST_MB:
        raise ApplianceError(_too_few(memory_mb))
    found = MEMINFO.read_text().partition("MemAvailable:")[2].split()
    if found and (free := int(found[0]) >> 10) < LEAST_FREE_MB:
        raise ApplianceError(
            f"{free} MB of memory are free, and teaching needs {LEAST_FREE_MB}; end other "
            "programs, or use a desktop"
        )


def _limit_cpu(seconds: int) -> None:
    """The kernel ends the process after this processor time, 0 for any; it may be called again."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (seconds or hard, hard))


def _restrict(memory_mb: int) -> None:
    """Take the limit of memory, and end first where memory is short."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if memory_mb:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_mb << 20, memory_mb << 20))


def _say(kind: str, **content: Any) -> None:
    print(json.dumps({"type": kind, **content}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
