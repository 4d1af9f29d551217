"""A command on a busy machine.

`python -m tests.campaigns busy [COMMAND ...]` runs the command, else the fast tests, beside LOOPS
endless loops.
"""

import subprocess
import sys
from collections.abc import Sequence

from tests.factories.paths import ROOT

LOOPS = 8
FAST = ("make", "test-fast", f"PYTEST_OPTIONS=-n {LOOPS}")


def main(command: Sequence[str]) -> int:
    """Run it; its exit code."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(LOOPS)]
    try:
        return subprocess.run(command or FAST, cwd=ROOT, check=False).returncode
    finally:
        for loop in loops:
            loop.kill()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
