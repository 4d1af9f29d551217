"""The command `palpate watch`."""

from __future__ import annotations

import argparse
import sys

from palpate.cli.common import load_settings
from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError
from palpate.core.interrupts import StopFlag
from palpate.core.log import TroubleLog, log
from palpate.core.retry import retried


def run(args: argparse.Namespace) -> int:
    """Show the running box until Ctrl-C or SIGTERM."""
    settings, clock = load_settings(args), SystemClock()
    socket, stopped = settings.store.feed, StopFlag()
    if not socket:
        raise ConfigError(
            'store.runtime = "" turns the feed off, so there is nothing to watch; set it to a'
            " folder"
        )
    path = str(socket)
    if args.web is not None:
        from palpate.web.access import Access
        from palpate.web.web import PageWatcher

        access = Access.configured(settings.watch, args.web)
        watcher = retried(lambda: PageWatcher(path, access, clock.now_ns), clock, stopped)
        log.info(f"page: {watcher.server.address}")
        watcher.run(stopped)
        return stopped.exit_code
    from palpate.web import lines

    if args.json:
        trouble = TroubleLog("feed", end="feed: it is read", known=False)
        lines.pass_on(path, sys.stdout, clock, stopped, trouble.update)
    else:
        lines.LineWatch(path, sys.stdout, clock).run(stopped)
    return stopped.exit_code
