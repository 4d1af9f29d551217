"""The command `sign`. It has a module of its own, since it does not need the imports of `bundles`,
which take seconds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.bundle import bundle
from palpate.core.outputs import add_rows
from palpate.core.text import say
from palpate_train.arguments import numbers
from palpate_train.export import sign

if TYPE_CHECKING:
    from palpate_train.arguments.program import Add


def register(add: Add) -> None:
    """sign."""
    # fmt: off
    add_rows(add("sign", run),
        ("bundle", "its folder", {"type": Path, "metavar": "BUNDLE"}),
        ("--key", "your private key (default: the key that `make install` has made,"
            " ~/.config/palpate/signing-key)", {"type": Path, "metavar": "KEY"}),
        ("--counter", "above that of every bundle delivered before (1 for the first)",
            {"type": numbers.whole("--counter", 1), "metavar": "N"}),
    )
    # fmt: on


def run(args: argparse.Namespace) -> None:
    """Sign the bundle; print its name, version, counter and identity."""
    signed = sign.sign(args.bundle, args.key or sign.own_key(), args.counter)
    say(
        f"signed: {signed.name} {signed.version}, counter {signed.counter}, "
        f"{bundle.identity(signed.json())} in {args.bundle}"
    )
