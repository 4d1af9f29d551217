"""The command `palpate check --settings`."""

from __future__ import annotations

import argparse

from palpate.cli.common import load_settings
from palpate.core import config


def run(args: argparse.Namespace) -> int:
    """Print each value with its source."""
    print(config.describe(load_settings(args)))
    return 0
