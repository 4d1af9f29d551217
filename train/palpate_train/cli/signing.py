"""The command `sign`. It has a module of its own, since it does not need the imports of `bundles`,
which take seconds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.bundle import bundle
from palpate.core.text import say
from palpate_train.arguments import numbers
from palpate_train.export import sign

if TYPE_CHECKING:
    from palpate_train.arguments.program import Add


def register(add: Add) -> None:
    """sign."""
    command = add("sign", run)
    command.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    command.add_argument(
        "--key",
        type=Path,
        metavar="KEY",
        help="your private key (default: the key that `make install` has made, "
        "~/.config/palpate/signing-key)",
    )
    command.add_argument(
        "--counter",
        type=numbers.whole("--counter", 1),
        metavar="N",
        help="above that of every bundle delivered before (1 for the first)",
    )


def run(args: argparse.Namespace) -> None:
    """Sign the bundle; print its name, version, counter and identity."""
    signed = sign.sign(args.bundle, args.key or sign.own_key(), args.counter)
    say(
        f"signed: {signed.name} {signed.version}, counter {signed.counter}, "
        f"{bundle.identity(signed.json())} in {args.bundle}"
    )
