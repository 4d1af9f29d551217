"""`python -m tests.rig build|show|ground|lacking`: builds or shows the virtual box."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.rig.cell import Cell
from tests.rig.emulated_machines import Missing
from tests.rig.image import ground, image, lacking
from tests.rig.machine import Guest


def show(cell: Cell, sweeps: int) -> None:
    """Let the robot sweep; print material, answer, and levels of its lines."""
    begun = time.monotonic()
    cell.plug()
    cell.until_ready()
    print(f"READY {time.monotonic() - begun:.1f} s after the skin was plugged in", flush=True)
    for _ in range(sweeps):
        touch, answer = cell.sweep()
        cell.lines.wait("RESULT-VALID", True, 5)
        heard_ns = next(t for t, line in reversed(cell.serial.heard) if ",RES," in line)
        print(
            f"{touch.act.label:<15} "
            f"-> {answer.status} {answer.label:<15} {answer.probability:.3f}  class bits "
            f"{cell.lines.code()}  {(heard_ns - touch.stop_ns) / 1e6:.1f} ms from edge to sentence",
            flush=True,
        )


def main() -> int:
    """Run the command of the arguments; its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.rig", description=__doc__)
    parser.add_argument("what", choices=["build", "show", "ground", "lacking"])
    parser.add_argument("--sweeps", type=int, default=6)
    args = parser.parse_args()
    if args.what == "lacking":
        print(*lacking())
        return 0

    def say(line: str) -> None:
        print(line, flush=True)

    try:
        if args.what == "ground":
            print(ground(say))
            return 0
        made = image(say)
    except Missing as e:
        print(e, file=sys.stderr)
        return 1
    if args.what == "build":
        print(made.disk)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        begun = time.monotonic()
        with Guest(made, Path(folder), snapshot=True) as machine:
            machine.ready(60)
            print(
                f"the virtual box goes on from its snapshot: {time.monotonic() - begun:.1f} s",
                flush=True,
            )
            cell = Cell(machine)
            show(cell, args.sweeps)
    return 0


if __name__ == "__main__":
    sys.exit(main())
