"""The numerical tests with the arithmetic of other processors, and tests of waiting under load.

`python -m tests.campaigns processors [OPTION ...]` runs pytest once for each kind of processor that
OpenBLAS knows and this one can imitate, with one thread or with eight in turn (`--all`: with both),
and once beside BUSY endless loops; options go to pytest. Takes some minutes on two cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path

from tests.factories.paths import ROOT

KINDS = {"Nehalem": "sse4_2", "Haswell": "avx2", "Zen": "avx2", "SkylakeX": "avx512f"}
"""Names of OPENBLAS_CORETYPE, each with the flag of /proc/cpuinfo that it needs."""
THREADS = ("1", "8")
BUSY = 8
NUMERICAL = ("tests/palpate/signal", "tests/palpate/inference", "tests/palpate_train/calibration")
WAITING = (
    "tests/palpate/io",
    "tests/palpate/runtime",
    "tests/palpate/service",
    "tests/palpate/sweeps",
)
FAST = ("-m", "pytest", "-q", "-n", str((os.cpu_count() or 1) + 1), "--dist", "worksteal")
FAST += ("-m", "not slow and not thorough")


def tested(paths: Sequence[str], **variables: str) -> bool:
    """Run the fast tests of these paths with these variables; whether they passed."""
    print(f"== {variables or f'beside {BUSY} busy loops'}", flush=True)
    command = [sys.executable, *FAST, *paths]
    return not subprocess.run(command, cwd=ROOT, env=os.environ | variables, check=False).returncode


def main(options: Sequence[str]) -> int:
    """Run all; 1 if a test failed."""
    flags = Path("/proc/cpuinfo").read_text().split()
    able = [kind for kind, flag in KINDS.items() if flag in flags]
    if left := KINDS.keys() - able:
        print(f"this processor cannot imitate {', '.join(sorted(left))}")
    pairs = product(able, THREADS) if "--all" in options else zip(able, cycle(THREADS))
    options = [option for option in options if option != "--all"]
    passed = [
        tested((*NUMERICAL, *options), OPENBLAS_CORETYPE=kind, OPENBLAS_NUM_THREADS=threads)
        for kind, threads in pairs
    ]
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(BUSY)]
    try:
        passed.append(tested((*WAITING, *options)))
    finally:
        for loop in loops:
            loop.kill()
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
