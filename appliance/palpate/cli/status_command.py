"""The command `palpate status`. It imports little, since scripts call it often."""

from __future__ import annotations

import argparse
import time

from palpate.core import settings_files
from palpate.core.errors import ConfigError
from palpate.core.runtime_folder import STATUS
from palpate.service import status


def run(args: argparse.Namespace) -> int:
    """Print the state of the service; 69 if it waits for the skin, 1 if it does not run."""
    layers = settings_files.read(args.board, args.set, folder=args.config_dir)
    folder = settings_files.runtime(layers)
    if folder is None:
        raise ConfigError(
            'store.runtime = "" turns the status file off; set it to a folder, and restart the'
            " service"
        )
    now_ns = time.monotonic_ns()
    report = status.read(folder / STATUS, now_ns)
    if args.json:
        import json

        print(json.dumps(report, indent=1))
    else:
        print("\n".join(status.lines(report, now_ns)))
    return status.exit_code(report)
