"""The numerical tests with the arithmetic of other processors.

`python -m tests.campaigns processors [OPTION ...]` runs the fast tests of NUMERICAL once for each
kind of processor that OpenBLAS knows and this one can imitate, with one thread or with eight in
turn (`--all`: with both); options go to pytest.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path

from tests.factories.paths import ROOT

KINDS = {"Nehalem": "sse4_2", "Haswell": "avx2", "Zen": "avx2", "SkylakeX": "avx512f"}
"""Names of OPENBLAS_CORETYPE, each with the flag of /proc/cpuinfo that it needs."""
THREADS = ("1", "8")
NUMERICAL = (
    *(f"tests/palpate/{name}" for name in ("answer", "inference", "learn")),
    *(
        f"tests/palpate_train/{name}"
        for name in ("answer", "evaluate", "export", "metrics", "models")
    ),
)
"""The packages that compute with matrices; the others read, write, wait and show."""
FAST = ("-m", "pytest", "-q", "-n", str((os.cpu_count() or 1) + 1), "--dist", "worksteal")
FAST += ("-m", "not slow and not thorough")


def tested(kind: str, threads: str, options: Sequence[str]) -> str:
    """Run the tests with the arithmetic of a processor; the line that says what came of it."""
    begin = time.monotonic()
    name = f"{kind}, threads: {threads}"
    print(f"== {name}", flush=True)
    env = os.environ | {"OPENBLAS_CORETYPE": kind, "OPENBLAS_NUM_THREADS": threads}
    command = [sys.executable, *FAST, *NUMERICAL, *options]
    code = subprocess.run(command, cwd=ROOT, env=env, check=False).returncode
    return f"{'FAILED' if code else 'passed'} in {time.monotonic() - begin:.0f} s: {name}"


def main(options: Sequence[str]) -> int:
    """Run all; 1 if a test failed."""
    flags = Path("/proc/cpuinfo").read_text().split()
    able = [kind for kind, flag in KINDS.items() if flag in flags]
    pairs = product(able, THREADS) if "--all" in options else zip(able, cycle(THREADS))
    options = [option for option in options if option != "--all"]
    lines = [tested(kind, threads, options) for kind, threads in pairs]
    lines += [f"this processor cannot imitate {kind}" for kind in KINDS if kind not in able]
    print(*lines, sep="\n")
    return int(any(line.startswith("FAILED") for line in lines))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
