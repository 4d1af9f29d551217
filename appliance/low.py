"""`python -m appliance.low`: takes the output lines low after a program that could not. In: its settings. Out: levels.

systemd runs it whenever `palpate run` has ended (ExecStopPost=). A program that was killed leaves its lines to the
chip's driver, and some drivers leave them as they were: READY high, with nobody there. It loads neither numpy nor
onnxruntime, so that it is done before a robot has noticed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import gpiod

from . import config
from .clock import SystemClock
from .errors import ApplianceError
from .lines import Lines


def main(argv: list[str] | None = None, gpio: Any = gpiod) -> int:
    """Drive all configured outputs low and let them go; the exit code, as `palpate` has them."""
    parser = argparse.ArgumentParser("python -m appliance.low", description="Takes all output lines low.")
    parser.add_argument("--board", help="as for palpate run")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="as for palpate run")
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="as for palpate run")
    args = parser.parse_args(argv)
    try:
        settings = config.load(args.board, args.set, folder=args.config_dir)
        Lines(settings.output, gpio, SystemClock()).close()  # requested low, then given back
    except ApplianceError as e:
        print(f"palpate: outputs may not be low: {e}", file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
