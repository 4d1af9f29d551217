"""The command `palpate watch`: the running box for a person, over its feed. In: arguments. Out: exit codes."""

from __future__ import annotations

import argparse
import sys

from appliance.cli.commands import load_settings, stop_flag
from appliance.core.clock import SystemClock
from appliance.core.errors import ConfigError
from appliance.core.log import TroubleLog


def run_watch(args: argparse.Namespace) -> int:
    """`palpate watch`: until Ctrl-C or SIGTERM."""
    from appliance.watch import terminal

    path, clock = load_settings(args).feed.socket, SystemClock()
    if not path:
        raise ConfigError('feed.socket = "" turns the feed off, so there is nothing to watch; set it to a path')
    stopped = stop_flag()
    if args.json:
        trouble = TroubleLog("feed", end="feed: it is read", known=False)
        terminal.pass_on(path, sys.stdout, clock, stopped, trouble.update)
    else:
        terminal.TerminalWatch(path, sys.stdout, clock).run(stopped)
    return 0


RUNS = {"watch": run_watch}
