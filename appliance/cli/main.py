"""The command `palpate`: runs a command with the devices that it needs. In: arguments. Out: an exit
code.

Simulated devices are chosen by name, here and nowhere else, and every sentence they cause says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

from appliance.bridges import options as bridges
from appliance.bundle import bundle as bundles
from appliance.bundle.bundle import Bundle
from appliance.cli import bundle_commands, commands, skin_commands, watch_commands
from appliance.cli.commands import OpenDevices, load_bundle, load_settings, stop_flag
from appliance.cli.parser import parser
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ApplianceError, ConfigError
from appliance.core.interrupts import INTERRUPTED
from appliance.core.log import log, to_stderr
from appliance.core.observer import Observer
from appliance.core.types import SweepFormat
from appliance.io import skins
from appliance.io.robot_link import SerialSink
from appliance.runtime import assembly
from appliance.runtime.loop import Box

if TYPE_CHECKING:
    from appliance.sim.devices import RobotDevices, SimDevices


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; its exit code."""
    args = parser(RUNS).parse_args(argv)
    to_stderr()
    try:
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except ApplianceError as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        print("palpate: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # nobody reads standard output any more, so nothing must be written to it, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as e:
        print(
            f"palpate: {e.filename or 'a file'}: {e.strerror}; check its path and who may use it",
            file=sys.stderr,
        )
        return 1


def _with_devices(
    run: Callable[[argparse.Namespace, OpenDevices], int], args: argparse.Namespace
) -> int:
    return run(args, partial(_open_devices, args))


def _open_devices(args: argparse.Namespace, format: Callable[[], SweepFormat] | None) -> Devices:
    """The real devices, or simulated ones where `--sim` names them; `format` gives what the simulated
    skin has to send."""
    if args.sim:
        return _simulated(
            args.sim, format() if format else None, args, load_settings(args), remember=False
        )
    if args.virtual:
        raise ConfigError("--virtual needs --sim: real devices run in real time")
    return Devices(SystemClock())


def _simulated(
    name: str,
    format: SweepFormat | None,
    args: argparse.Namespace,
    settings: Config,
    *,
    remember: bool = True,
    spread: bool = False,
) -> RobotDevices:
    """A simulated robot with the skin that the settings name: a readout board on USB, or one on a
    terminal."""
    from appliance.sim import devices, rig, script

    clock = rig.VirtualClock() if args.virtual else SystemClock()
    profile = skins.profile(settings)
    if profile.codec == "palpate":
        acts, source, format = script.named(name, format, args.seed, spread=spread)
        return devices.build(format, islice(acts, args.sweeps), clock, source, remember=remember)
    from appliance.sim.skins import devices as terminal
    from appliance.sim.skins import sweeps

    seen = sweeps.view(settings.skin.profile, profile.format)
    acts, source, format = script.named(name, format, args.seed, spread=spread, seen=seen)
    acts = islice(acts, args.sweeps)
    return terminal.build(
        settings.skin.profile, profile, format, acts, clock, source, remember=remember
    )


def _played_bundle(settings: Config) -> Bundle:
    """The bundle for simulated sweeps: that of the settings, or the packaged one where only others
    may read what was deployed."""
    try:
        return load_bundle(settings, answers=False)
    except PermissionError as e:
        log.warning(
            f"{e.filename}: {e.strerror}, so the packaged bundle plays; the deployed one with sudo -u palpate"
        )
        return bundles.load(bundles.DEFAULT)


def run_demo(args: argparse.Namespace) -> int:
    """`palpate demo`: a dozen sweeps through a pseudo-terminal, seen from both ends."""
    from appliance.tools import demo, pseudo_terminal

    settings = load_settings(args)
    bundle = _played_bundle(settings)
    args.sweeps = args.sweeps or 12
    devices = _simulated(args.sim or "skin", bundle.format, args, settings, spread=True)
    stopped = stop_flag()
    with ExitStack() as stack:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), devices.clock, devices.source)
        show = demo.Demo(
            devices.robot.played,
            far_end,
            devices.clock,
            sys.stdout,
            bundle.manifest.labels,
            raw=args.raw,
        )
        box = assembly.box(_on_lines(settings), bundle, devices, port, stack)
        show.run(box, args.sweeps, lambda: stopped() or devices.finished(box.answered))
    return 0


def run_bench(args: argparse.Namespace) -> int:
    """`palpate bench`: see appliance/tools/bench.py."""
    from appliance.tools import bench_process, pseudo_terminal

    settings = load_settings(args)
    bundle = _played_bundle(settings)

    def build(
        devices: SimDevices, stack: ExitStack, observers: Iterable[Observer] = ()
    ) -> tuple[Box, int]:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), devices.clock, devices.source)
        return assembly.box(
            _on_lines(settings), bundle, devices, port, stack, observers=observers
        ), far_end

    if args.part:
        print(json.dumps(bench_process.measure(args.part, bundle.format, build, args.acts)))
        return 0
    from appliance.tools import bench

    figures = bench.run(
        bundle, build, args.references, args.seed, lambda line: print(line, flush=True)
    )
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _run_bridge(name: str, args: argparse.Namespace) -> int:
    """`palpate bridge NAME`: see appliance/bridges."""
    from appliance.bridges import command

    return command.RUNS[name](args)


def _on_lines(settings: Config) -> Config:
    """The settings with the trigger on lines, which the simulated robot drives."""
    return replace(settings, trigger=replace(settings.trigger, mode="two-lines"))


RUNS: dict[str, Callable[[argparse.Namespace], int]] = {
    "demo": run_demo,
    "bench": run_bench,
    **{f"bridge {name}": partial(_run_bridge, name) for name in bridges.TEXTS},
    **commands.RUNS,
    **bundle_commands.RUNS,
    **skin_commands.RUNS,
    **watch_commands.RUNS,
    **{
        name: partial(_with_devices, run)
        for name, run in {**commands.WITH_DEVICES, **skin_commands.WITH_DEVICES}.items()
    },
}
