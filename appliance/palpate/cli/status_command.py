"""The command `palpate status`. It imports little, since scripts call it often."""

from __future__ import annotations

import time

from palpate.core import runtime_folder
from palpate.core.errors import ConfigError
from palpate.service import status

TYPE_CHECKING = False
if TYPE_CHECKING:
    import argparse

PLAIN: tuple[list[str], ...] = ([], ["--json"])
"""The options that need no parser."""


def run(args: argparse.Namespace) -> int:
    """Print the state of the service; 69 if it waits for the skin, 1 if it does not run."""
    from palpate.core import settings_files

    if args.network:
        return show_network(as_json=args.json)
    if args.since is not None:
        return show_since(args)
    if args.unit:  # its folder has its name, and its settings a file of their own
        from palpate.cli.common import load_settings

        folder = load_settings(args).store.runtime_folder
    else:
        folder = settings_files.runtime(
            settings_files.read(args.board, args.set, folder=args.config_dir)
        )
    if folder is None:
        raise ConfigError(
            'store.runtime = "" turns the status file off; set it to a folder, and restart the'
            " service"
        )
    return show(str(folder), as_json=args.json)


def show_since(args: argparse.Namespace) -> int:
    """Print how often each status and label came since then, or all verdicts as JSON. Raises
    FeedError."""
    import json
    from pathlib import Path

    from palpate.cli.common import load_settings
    from palpate.client import verdicts
    from palpate.core import wall_clock

    path = Path(load_settings(args).bridge.memory)
    now_s = wall_clock.seconds()
    from_s, to_s = now_s - args.since, now_s + verdicts.AHEAD_S
    if args.json:
        print(json.dumps([*verdicts.since(path, from_s, to_s=to_s)], indent=1))
        return 0
    found = verdicts.counts(path, from_s, to_s)
    print(f"{sum(found.values())} sweeps since {wall_clock.of(from_s)}")
    for (word, label), n in found.items():
        print(f"{n:8}  {word:<12}  {label}".rstrip())
    return 0


def show_network(*, as_json: bool) -> int:
    """Print the open ports of the boxes of this network. Raises ConfigError without zeroconf."""
    import json
    from dataclasses import asdict

    from palpate.core.clock import SystemClock
    from palpate.service import network

    there = network.found(SystemClock())
    if as_json:
        print(json.dumps([asdict(each) for each in there], indent=1))
    for each in there if not as_json else ():
        print(f"{each.box:<24}  {each.kind:<8}  {each.host}:{each.port}")
    return 0


def show(folder: str = runtime_folder.RUNTIME, *, as_json: bool) -> int:
    """The same for a box with this runtime folder."""
    now_ns = time.monotonic_ns()
    report = status.read(f"{folder}/{runtime_folder.STATUS}", now_ns)
    if as_json:
        import json

        print(json.dumps(report, indent=1))
    else:
        print("\n".join(status.lines(report, now_ns)))
    return status.exit_code(report)
