"""The command `palpate demo`: the box on simulated devices."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import replace

from palpate.bundle import bundle as bundles
from palpate.bundle.bundle import Bundle
from palpate.cli.common import load_bundle, load_settings
from palpate.cli.devices import simulated
from palpate.core.config import Config
from palpate.core.errors import BundleDenied
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.io import skins
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly

SCRIPTED = 8
"""Sweeps of the script of the demo."""
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
    """Show good and faulty sweeps in turn, or the sweeps of --sim, from both ends of a line."""
    from palpate.tools import demo, pseudo_terminal

    settings = load_settings(args)
    # the simulated robot drives GPIO lines
    settings = replace(settings, trigger=replace(settings.trigger, mode="two-lines"))
    bundle = _played_bundle(settings)
    scripted = not args.sim and skins.profile(settings).codec == "palpate"
    args.sweeps = args.sweeps or (SCRIPTED if scripted else 12)
    name = args.sim or "skin"
    devices = simulated(name, bundle.format, args, settings, spread=True, demo=scripted)
    stopped = StopFlag()
    with ExitStack() as stack:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), devices.clock)
        labels = bundle.manifest.labels
        show = demo.Demo(devices.robot.played, far_end, sys.stdout, labels, raw=args.raw)
        box = assembly.box(settings, bundle, devices, port, stack)
        show.run(box, args.sweeps, lambda: stopped() or devices.finished(box.answered))
    if not args.raw and not stopped():
        print(f"\n{NEXT}")
    return stopped.exit_code
