"""The command `palpate`: which devices a command gets. In: arguments. Out: an exit code.

Simulated parts are chosen by name here and nowhere else, and every sentence they cause says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

from appliance.cli import commands, device_commands
from appliance.cli.device_commands import model, settings, stop_flag
from appliance.cli.parser import parser
from appliance.core.clock import SystemClock
from appliance.core.devices import Devices
from appliance.core.errors import ApplianceError, ConfigError
from appliance.core.types import SweepFormat
from appliance.io.robot_link import ResultSink, SerialSink
from appliance.runtime import assembly
from appliance.runtime.loop import Box, SweepObserver

if TYPE_CHECKING:
    from appliance.sim.devices import SimDevices


def main(argv: list[str] | None = None) -> int:
    """Run a command; its exit code."""
    args = parser(RUNS).parse_args(argv)
    try:
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except ApplianceError as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # whoever read our output has left; nothing more can be said there, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as e:
        print(f"palpate: {e.filename or 'a file'}: {e.strerror}; check its path and who may use it", file=sys.stderr)
        return 1


def _with_devices(
    run: Callable[[argparse.Namespace, device_commands.OpenDevices], int], args: argparse.Namespace
) -> int:
    return run(args, partial(_world, args))


def _world(args: argparse.Namespace, fmt: Callable[[], SweepFormat]) -> Devices:
    """The real devices, or the rig where `--sim` names it; `fmt` tells what the simulated skin has to send."""
    if args.sim:
        return _simulated(args.sim, fmt(), args, remember=False)
    if args.virtual:
        raise ConfigError("--virtual needs --sim: real devices run in real time")
    import gpiod

    return Devices(SystemClock(), gpiod)


def _simulated(name: str, fmt: SweepFormat, args: argparse.Namespace, *, remember: bool = True) -> SimDevices:
    from appliance.sim import devices, rig, script

    acts, source = script.named(name, fmt, args.seed)
    clock = rig.VirtualClock() if args.virtual else SystemClock()
    return devices.build(fmt, islice(acts, args.sweeps), clock, source, remember=remember)


def run_demo(args: argparse.Namespace) -> int:
    """`palpate demo`: a dozen sweeps through a pseudo-terminal, seen from both ends."""
    from appliance.tools import demo, pseudo_terminal

    how = settings(args)
    held = model(how)
    args.sweeps = args.sweeps or 12
    world = _simulated(args.sim or "skin", held.format, args)
    stopped = stop_flag()
    with ExitStack() as stack:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(how.serial, port=name), world.clock, world.source)
        show = demo.Demo(world.robot.played, far_end, world.clock, sys.stdout, raw=args.raw)
        box = assembly.box(how, held, world, port, stack)
        show.run(box, args.sweeps, stopped)
    return 0


def run_bench(args: argparse.Namespace) -> int:
    """`palpate bench`: see appliance/sim/bench.py."""
    from appliance.tools import bench_process, pseudo_terminal

    how = settings(args)
    held = model(how)

    def staged(
        world: SimDevices,
        stack: ExitStack,
        also: Iterable[ResultSink] = (),
        keepers: Iterable[SweepObserver] = (),
    ) -> tuple[Box, int]:
        far_end, name = stack.enter_context(pseudo_terminal.pair())
        port = SerialSink(replace(how.serial, port=name), world.clock, world.source)
        return assembly.box(how, held, world, port, stack, also=also, keepers=keepers), far_end

    if args.part:
        print(json.dumps(bench_process.measure(args.part, held.format, staged, args.acts)))
        return 0
    from appliance.tools import bench

    figures = bench.run(held, staged, args.references, args.seed, lambda line: print(line, flush=True))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    return 0


RUNS: dict[str, Callable[[argparse.Namespace], int]] = {
    "demo": run_demo, "bench": run_bench, **commands.RUNS,
    **{name: partial(_with_devices, run) for name, run in device_commands.RUNS.items()},
}  # fmt: skip
