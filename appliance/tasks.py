"""What the box does with its devices: run, check, enrol. In: arguments, a way to the devices. Out: exit codes.

`__main__` says which devices these are.
"""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from . import build, bundle, config
from .box import Keeper, World
from .build import log
from .capture import CaptureWriter, keeper
from .check import check
from .clock import SystemClock
from .config import Config
from .notify import Manager
from .sweep import SweepFormat

Devices = Callable[[Callable[[], SweepFormat]], World]
"""Gives the world; asked with what tells the format that a simulated skin has to send."""


def settings(args: argparse.Namespace) -> Config:
    """The settings that a command's options ask for."""
    return config.load(args.board, args.set, folder=args.config_dir)


def model(settings: Config) -> bundle.Bundle:
    """The bundle that the settings ask for."""
    return bundle.load(Path(settings.classifier.bundle) if settings.classifier.bundle else bundle.DEFAULT)


def stop_flag() -> Callable[[], bool]:
    """True once SIGTERM or SIGINT has come: the loop then ends within one turn."""
    got: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: got.append(n))
    return lambda: bool(got)


def run(args: argparse.Namespace, devices: Devices) -> int:
    """`palpate run`: until SIGTERM, or with --sim until the script has ended and everything was answered."""
    how = settings(args)
    held = model(how)
    world = devices(lambda: held.format)
    stopped = stop_flag()
    with ExitStack() as stack:
        capture = CaptureWriter(args.capture, held.format, log) if args.capture else None
        if capture:
            stack.callback(capture.close)
        keepers: list[Keeper] = [keeper(args.keep, held.format, log)] if args.keep else []
        box = build.box(
            how, held, world, build.port(how, world), stack, capture=capture, keepers=keepers, log=log,
            pulses=[Manager(SystemClock())],
        )  # fmt: skip

        def done() -> bool:
            enough = args.sweeps is not None and box.answered >= args.sweeps
            return enough or stopped() or world.finished(box.answered)

        box.run(done)
    return 0


def run_check(args: argparse.Namespace, devices: Devices) -> int:
    """`palpate check`: each part by itself, one line each; 1 where any fails."""
    how = settings(args)
    world = devices(lambda: model(how).format)
    failed = 0
    for f in check(world.wire(how), lambda: model(how), world):
        print(f"{'ok  ' if f.ok else 'FAIL'}  {f.part:<14} {f.detail}", flush=True)
        failed += not f.ok
    return 1 if failed else 0


def run_enrol(args: argparse.Namespace, devices: Devices) -> int:
    """`palpate enrol`: the box takes sweeps as always; of the good ones it makes a bundle with one label more."""
    from . import enrol

    how = settings(args)
    how = replace(how, classifier=replace(how.classifier, early=False))  # whole windows are wanted
    held = model(how)
    enrol.admit(held, args.label)
    enrol.check_place(args.out, args.replace)
    world = devices(lambda: held.format)
    stopped = stop_flag()
    with ExitStack() as stack:
        taken = enrol.Taken(args.good, log)
        port = build.port(how, world)
        box = build.box(how, held, world, port, stack, keepers=[taken.keep], log=log, labels=(args.label,))
        box.run(lambda: taken.enough or stopped() or world.finished(box.answered))
    new = enrol.enrol(held, args.label, taken.windows())
    for warning in new.warnings:
        log(f"warning: {warning}")
    enrol.write(new.files, args.out, args.replace)
    m = new.bundle.manifest
    log(f"{args.out}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)} labels; use it with classifier.bundle")
    return 0


RUNS = {"run": run, "check": run_check, "enrol": run_enrol}
