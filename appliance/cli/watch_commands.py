"""The command `palpate watch`: the running box for a person, over its feed. In: arguments. Out:
exit codes."""

from __future__ import annotations

import argparse
import sys

from appliance.cli.commands import load_settings, stop_flag
from appliance.core.clock import SystemClock
from appliance.core.errors import ConfigError
from appliance.core.log import TroubleLog, log


def run_watch(args: argparse.Namespace) -> int:
    """`palpate watch`: until Ctrl-C or SIGTERM."""
    settings, clock = load_settings(args), SystemClock()
    socket, stopped = settings.store.feed, stop_flag()
    if not socket:
        raise ConfigError(
            'store.runtime = "" turns the feed off, so there is nothing to watch; set it to a folder'
        )
    path = str(socket)
    if args.web is not None:
        from appliance.watch.access import Access
        from appliance.watch.web import PageWatcher

        watcher = PageWatcher(path, Access.configured(settings.watch, args.web), clock.now_ns)
        log.info(f"page: {watcher.server.address}")
        watcher.run(stopped)
        return 0
    from appliance.watch import terminal

    if args.json:
        trouble = TroubleLog("feed", end="feed: it is read", known=False)
        terminal.pass_on(path, sys.stdout, clock, stopped, trouble.update)
    else:
        terminal.TerminalWatch(path, sys.stdout, clock).run(stopped)
    return 0


RUNS = {"watch": run_watch}
