"""`python -m palpate.cli.lower_outputs`: set the output lines low after a program that could not
do it.

systemd runs it after each end of `palpate run` (ExecStopPost=). If a program is killed, the driver
of the chip keeps its lines, and some drivers keep their levels: READY then stays high without a box
behind it. This command imports neither numpy nor onnxruntime, so that the lines are low before the
robot acts on them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import gpiod

from palpate.cli.options import NO_SETTINGS, add_settings
from palpate.core import config
from palpate.core.clock import Clock, SystemClock
from palpate.core.errors import EX_CONFIG, ApplianceError
from palpate.deployment import releases
from palpate.io.gpio_lines import Lines
from palpate.service import last_failure


def main(
    argv: list[str] | None = None,
    gpio: Any = gpiod,
    clock: Clock | None = None,
    environ: Mapping[str, str] = os.environ,
) -> int:
    """Drive all configured outputs low and release them. Exit codes as of `palpate`. If the program
    has failed several times in a row, wait before systemd starts it again."""
    about = "Sets all output lines low. Options as for palpate run."
    parser = argparse.ArgumentParser("python -m palpate.cli.lower_outputs", description=about)
    add_settings(parser)
    parser.set_defaults(**NO_SETTINGS)
    args = parser.parse_args(argv)
    with suppress(OSError):
        releases.note_fault(environ)
    try:
        loaded = config.load(args.board, args.set, folder=args.config_dir, unit=args.unit)
        clock = clock or SystemClock()
        Lines(loaded.output, gpio, clock).close()  # requested as low, then released
    except ApplianceError as e:
        print(f"palpate: outputs may not be low: {e}", file=sys.stderr)
        return e.exit_code
    last = last_failure.read(loaded.store.runtime_folder)
    # systemd sets EXIT_STATUS (systemd.exec(5)); a stop by hand is not delayed
    if last and environ.get("EXIT_STATUS") == str(last.code) and last.code != EX_CONFIG:
        clock.sleep_until(clock.now_ns() + round(last.pause_s * 1e9))
    return 0


if __name__ == "__main__":
    sys.exit(main())
