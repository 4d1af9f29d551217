"""The command `palpate replay`."""

from __future__ import annotations

import argparse

from palpate.cli.common import load_bundle, load_settings
from palpate.runtime.replay import replay


def run(args: argparse.Namespace) -> int:
    """Print the sentences of a capture, a kept sweep or a folder of them; 1 if a verdict
    differs."""
    settings = load_settings(args)
    bundle = load_bundle(settings, answers=False)
    return replay(args.file, settings, bundle, lambda text: print(text, end="", flush=True))
