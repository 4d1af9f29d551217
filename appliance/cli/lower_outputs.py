"""`python -m appliance.cli.lower_outputs`: set the output lines low after a program that could not
do it.

systemd runs it after each end of `palpate run` (ExecStopPost=). If a program is killed, the driver
of the chip keeps its lines, and some drivers keep their levels: READY then stays high without a box
behind it. This command imports neither numpy nor onnxruntime, so that the lines are low before the
robot acts on them.
"""

from __future__ import annotations

import sys
from typing import Any

import gpiod

from appliance.cli.parser import add_settings
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.core.errors import ApplianceError
from appliance.core.menu import CommandParser
from appliance.io.gpio_lines import Lines


def main(argv: list[str] | None = None, gpio: Any = gpiod) -> int:
    """Drive all configured outputs low and release them. Exit codes as of `palpate`."""
    about = "Sets all output lines low. Options as for palpate run."
    parser = CommandParser("python -m appliance.cli.lower_outputs", description=about)
    add_settings(parser)
    args = parser.parse_args(argv)
    try:
        loaded = config.load(args.board, args.set, folder=args.config_dir)
        Lines(loaded.output, gpio, SystemClock()).close()  # requested as low, then released
    except ApplianceError as e:
        print(f"palpate: outputs may not be low: {e}", file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
