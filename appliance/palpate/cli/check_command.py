"""The command `palpate check`: tests each part of the box by itself."""

from __future__ import annotations

import argparse

from palpate.cli.common import load_bundle, load_settings
from palpate.cli.devices import open_any
from palpate.core.text import printable
from palpate.runtime.selftest import check


def run(args: argparse.Namespace) -> int:
    """Check each component by itself; 1 if any fails."""
    settings = load_settings(args)
    devices = open_any(args, settings)
    failed, answers = 0, not args.sim
    results = check(devices.wire(settings), lambda: load_bundle(settings, answers=answers), devices)
    for result in results:
        line = f"{'ok  ' if result.ok else 'FAIL'}  {result.component:<14} {result.detail}"
        print(printable(line), flush=True)
        failed += not result.ok
    return 1 if failed else 0
