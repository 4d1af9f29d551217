"""The commands that look at the box: check, its settings, replay and watch. Each imports
its modules when it runs."""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from palpate.cli.common import load_bundle, load_settings
from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError
from palpate.core.interrupts import StopFlag, during_imports
from palpate.core.log import TroubleLog, log
from palpate.core.retry import retried
from palpate.core.text import printable


def run_check(args: argparse.Namespace) -> int:
    """Check each component by itself; 1 if any fails."""
    with during_imports("palpate"):
        from palpate.cli.devices import open_any
        from palpate.runtime.selftest import check

    settings = load_settings(args)
    devices = open_any(args, settings)
    failed, answers = 0, not args.sim
    results = check(devices.wire(settings), lambda: load_bundle(settings, answers=answers), devices)
    for result in results:
        line = f"{'ok  ' if result.ok else 'FAIL'}  {result.component:<14} {result.detail}"
        print(printable(line), flush=True)
        failed += not result.ok
    return 1 if failed else 0


def run_settings(args: argparse.Namespace) -> int:
    print(config.describe(load_settings(args)))
    return 0


def run_replay(args: argparse.Namespace) -> int:
    """Print the sentences of a capture, sweep or folder; 1 if a verdict differs. With --mcap the
    sweeps are written by palpate-train, which the box does not import."""
    if args.mcap:
        if not find_spec("palpate_train"):
            raise ConfigError("--mcap needs palpate-train, which is not installed; use a desktop")
        write = (sys.executable, "-P", "-m", "palpate_train", "sets", "mcap", args.file, args.mcap)
        return subprocess.run(write, check=False).returncode
    with during_imports("palpate"):
        from palpate.runtime.replay import replay

    settings = load_settings(args)
    bundle = load_bundle(settings, answers=False)
    return replay(args.file, settings, bundle, lambda text: print(text, end="", flush=True))


def run_watch(args: argparse.Namespace) -> int:
    """Show the running box until Ctrl-C or SIGTERM."""
    settings, clock = load_settings(args), SystemClock()
    socket, stopped = settings.store.needed_feed(), StopFlag()
    if args.web is not None:
        from palpate.web.access import Access
        from palpate.web.history import History
        from palpate.web.web import OtherBoxes, PageWatcher

        access = Access.configured(settings.watch, args.web)
        history = History(Path(settings.bridge.memory), settings.watch.shifts)
        others = OtherBoxes(clock) if access.tokens else tuple  # on this machine alone: none
        given = str(socket), access, clock.now_ns, history, args.unit or "", others
        watcher = retried(lambda: PageWatcher(*given), clock, stopped)
        log.info(f"page: {watcher.server.address}")
        watcher.run(stopped)
        return stopped.exit_code
    from palpate.web import lines

    if args.json:
        trouble = TroubleLog("feed", end="feed: it is read", known=False)
        lines.pass_on(str(socket), sys.stdout, clock, stopped, trouble.update)
    else:
        lines.LineWatch(str(socket), sys.stdout, clock).run(stopped)
    return stopped.exit_code
