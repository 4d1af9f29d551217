"""`palpate` on a simulated skin that a busy machine does not outrun: `python -m
tests.factories.paced_unit SITE WORD ...`, with its settings in SITE instead of /etc."""

import sys
import time
from pathlib import Path

from palpate.cli import devices
from palpate.cli.main import main
from palpate.core import config
from palpate.sim.rig import VirtualClock


class PacedClock(VirtualClock):
    """Passes in sleep alone: never ahead of real time, behind it on a busy machine."""

    def __init__(self) -> None:
        super().__init__(time.monotonic_ns())

    def sleep_until(self, t_ns: int) -> None:
        time.sleep(max(0, t_ns - time.monotonic_ns()) / 1e9)
        super().sleep_until(t_ns)


if __name__ == "__main__":
    config.SITE, devices.SystemClock = Path(sys.argv.pop(1)), PacedClock  # type: ignore[assignment, misc]
    sys.exit(main())
