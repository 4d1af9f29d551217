"""The commands that show and measure the box on simulated devices: demo, bench."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from palpate.bundle import bundle as bundles
from palpate.bundle.bundle import Bundle
from palpate.cli.common import check_output, load_bundle, load_settings
from palpate.cli.devices import simulated
from palpate.core import storage
from palpate.core.config import Config
from palpate.core.errors import BundleDenied
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.core.observer import Observer
from palpate.io import skins
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.runtime.loop import Box

if TYPE_CHECKING:
    from palpate.sim.devices import SimDevices


TOUR = 8
"""Sweeps of the tour."""
SEED = 2000
"""Seed of the sweeps of the benchmark by default."""
NEXT = """\
next: palpate demo --raw     the sentences that the robot reads
      make desktop           then docs/tutorials/first-model.md: your first model in 15 minutes"""


def _played_bundle(settings: Config) -> Bundle:
    """The bundle for simulated sweeps: the bundle of the settings, or the packaged bundle if this
    user may not read the deployed bundle."""
    try:
        return load_bundle(settings, answers=False)
    except BundleDenied as e:
        log.warning(f"{e}; the packaged bundle plays now")
        return bundles.load(bundles.DEFAULT)


def run_demo(args: argparse.Namespace) -> int:
    """Show a tour of good and faulty sweeps, or the sweeps of --sim, from both ends of a line."""
    from palpate.tools import demo, pseudo_terminal

    settings = load_settings(args)
    bundle = _played_bundle(settings)
    touring = not args.sim and skins.profile(settings).codec == "palpate"
    args.sweeps = args.sweeps or (TOUR if touring else 12)
    name = args.sim or "skin"
    devices = simulated(name, bundle.format, args, settings, spread=True, touring=touring)
    stopped = StopFlag()
    with ExitStack() as stack:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), devices.clock)
        labels = bundle.manifest.labels
        show = demo.Demo(devices.robot.played, far_end, sys.stdout, labels, raw=args.raw)
        box = assembly.box(_on_lines(settings), bundle, devices, port, stack)
        show.run(box, args.sweeps, lambda: stopped() or devices.finished(box.answered))
    if not args.raw and not stopped():
        print(f"\n{NEXT}")
    return stopped.exit_code


def run_bench(args: argparse.Namespace) -> int:
    """`palpate check --bench`: measure this machine (tools/bench.py)."""
    from palpate.tools import bench_process, pseudo_terminal

    if args.json:
        check_output(args.json)
    settings = load_settings(args)
    bundle = _played_bundle(settings)

    def build(
        devices: SimDevices, stack: ExitStack, observers: Iterable[Observer] = ()
    ) -> tuple[Box, int]:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), devices.clock)
        box = assembly.box(_on_lines(settings), bundle, devices, port, stack, observers=observers)
        return box, far_end

    if args.part:
        print(json.dumps(bench_process.measure(args.part, bundle.format, build, args.acts)))
        return 0
    from palpate.tools import bench

    figures = bench.run(
        bundle, build, args.references, args.seed or SEED, lambda line: print(line, flush=True)
    )
    if args.json:
        storage.put(args.json, (json.dumps(figures, indent=1) + "\n").encode())
    return 0


def _on_lines(settings: Config) -> Config:
    """The settings with the trigger on GPIO lines, which the simulated robot drives."""
    return replace(settings, trigger=replace(settings.trigger, mode="two-lines"))
