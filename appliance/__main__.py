"""The command `palpate`: the only place where parts are put together. In: arguments, configuration. Out: an exit code.

Simulated parts are chosen by name here and nowhere else, and every sentence they cause says so.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from . import bundle, config
from .arguments import parser
from .box import Box, Pulse, World
from .capture import CaptureWriter, Playback, keeper
from .check import check
from .classifier import Classifier
from .clock import Clock, SystemClock
from .config import Config
from .early import Decider
from .errors import ApplianceError, ConfigError, FormatError
from .lines import Lines
from .notify import Manager
from .recorder import Recorder
from .sensor import UsbSensor
from .sink import LineSink, Port, ResultSink, SerialSink, StdoutPort, result
from .sweep import Sweep, SweepFormat, load
from .trigger import GpioTrigger

if TYPE_CHECKING:
    from .sim.stage import SimWorld


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


def _settings(args: argparse.Namespace) -> tuple[Config, bundle.Bundle]:
    settings = config.load(args.board, args.set, folder=args.config_dir)
    return settings, _bundle(settings)


def _bundle(settings: Config) -> bundle.Bundle:
    return bundle.load(Path(settings.classifier.bundle) if settings.classifier.bundle else bundle.DEFAULT)


def _world(args: argparse.Namespace, fmt: Callable[[], SweepFormat]) -> World:
    """The real devices, or the rig where `--sim` names it; `fmt` tells what the simulated skin has to send."""
    if args.sim:
        return _simulated(args.sim, fmt(), args, remember=False)
    if args.virtual:
        raise ConfigError("--virtual needs --sim: real devices run in real time")
    import gpiod

    return World(SystemClock(), gpiod)


def _simulated(name: str, fmt: SweepFormat, args: argparse.Namespace, *, remember: bool = True) -> SimWorld:
    from .sim import rig, script, stage

    acts, source = script.named(name, fmt, args.seed)
    clock = rig.VirtualClock() if args.virtual else SystemClock()
    return stage.build(fmt, islice(acts, args.sweeps), clock, source, remember=remember)


def _log(line: str) -> None:
    with suppress(OSError):  # a full disk costs the log, never the classifying
        print(f"palpate: {line}", file=sys.stderr, flush=True)


def build(
    settings: Config, model: bundle.Bundle, world: World, port: Port, stack: ExitStack, *,
    capture: CaptureWriter | None = None, keep: Callable[[Sweep], None] | None = None,
    log: Callable[[str], None] = lambda line: None, also: Iterable[ResultSink] = (), labels: tuple[str, ...] = (),
    pulse: Pulse | None = None,
) -> Box:  # fmt: skip
    """Put the parts together; `stack` takes them apart again. labels: what class bits must hold beside the bundle's."""
    settings = world.wire(settings)
    missing = next((k for k in ("start", "stop") if not getattr(settings.trigger, k)), None)
    if missing == "start" or (missing and settings.trigger.mode == "two-lines"):
        raise ConfigError(
            f"trigger.{missing} names no line, so no sweep can be cut; choose a board with --board, or use --sim"
        )
    classifier = _classifier(settings, model, world.clock)
    classifier.self_test()
    trigger = stack.enter_context(GpioTrigger(settings.trigger, world.gpio))
    lines = stack.enter_context(Lines(settings.output, world.gpio, world.clock))
    sensor = UsbSensor(settings.sensor, model.format, world.clock, world.backend, capture)
    stack.callback(sensor.close)
    stack.callback(port.close)
    sinks: list[ResultSink] = [port, *also]
    if settings.output.class_bits:
        sinks.append(LineSink(lines, (*model.manifest.labels, *labels)))
    return Box(
        sensor, trigger, Recorder(model.format, settings.sweep), classifier, world.clock,
        early=_early(settings, classifier), sinks=sinks,
        port=port, panel=lines, state_s=settings.serial.state_s, source=world.source, log=log,
        tap=capture, keep=keep, pulse=pulse,
    )  # fmt: skip


def _classifier(settings: Config, model: bundle.Bundle, clock: Clock) -> Classifier:
    how = settings.classifier
    return Classifier(model, clock, how.fuse, how.sure, how.most_sweeps)


def _early(settings: Config, classifier: Classifier) -> Decider | None:
    return Decider(classifier) if settings.classifier.early else None


def _port(settings: Config, world: World) -> Port:
    if settings.serial.port:
        return SerialSink(settings.serial, world.clock, world.source)
    return StdoutPort(world.source)


def _stop_flag() -> Callable[[], bool]:
    """True once SIGTERM or SIGINT has come: the loop then ends within one turn."""
    got: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: got.append(n))
    return lambda: bool(got)


def run_box(args: argparse.Namespace) -> int:
    """`palpate run`: until SIGTERM, or with --sim until the script has ended and everything was answered."""
    settings, model = _settings(args)
    world = _world(args, lambda: model.format)
    stopped = _stop_flag()
    with ExitStack() as stack:
        capture = CaptureWriter(args.capture, model.format, _log) if args.capture else None
        if capture:
            stack.callback(capture.close)
        keep = keeper(args.keep, model.format, _log) if args.keep else None
        box = build(
            settings, model, world, _port(settings, world), stack, capture=capture, keep=keep, log=_log,
            pulse=Manager(SystemClock()),
        )  # fmt: skip

        def done() -> bool:
            enough = args.sweeps is not None and box.answered >= args.sweeps
            return enough or stopped() or world.finished(box.answered)

        box.run(done)
    return 0


def run_demo(args: argparse.Namespace) -> int:
    """`palpate demo`: a dozen sweeps through a pseudo-terminal, seen from both ends."""
    from .sim import demo, terminal

    settings, model = _settings(args)
    args.sweeps = args.sweeps or 12
    world = _simulated(args.sim or "skin", model.format, args)
    stopped = _stop_flag()
    with ExitStack() as stack:
        far_end, name = stack.enter_context(terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), world.clock, world.source)
        show = demo.Demo(world.robot.played, far_end, world.clock, sys.stdout, raw=args.raw)
        box = build(settings, model, world, port, stack)
        show.run(box, args.sweeps, stopped)
    return 0


def run_check(args: argparse.Namespace) -> int:
    """`palpate check`: each part by itself, one line each; 1 where any fails."""
    settings = config.load(args.board, args.set, folder=args.config_dir)
    world = _world(args, lambda: _bundle(settings).format)
    failed = 0
    for f in check(world.wire(settings), lambda: _bundle(settings), world):
        print(f"{'ok  ' if f.ok else 'FAIL'}  {f.part:<14} {f.detail}", flush=True)
        failed += not f.ok
    return 1 if failed else 0


def run_enrol(args: argparse.Namespace) -> int:
    """`palpate enrol`: the box takes sweeps as always; of the good ones it makes a bundle with one label more."""
    from . import enrol

    settings, model = _settings(args)
    settings = replace(settings, classifier=replace(settings.classifier, early=False))  # whole windows are wanted
    enrol.admit(model, args.label)
    enrol.check_place(args.out, args.replace)
    world = _world(args, lambda: model.format)
    stopped = _stop_flag()
    with ExitStack() as stack:
        taken = enrol.Taken(args.good, _log)
        port = _port(settings, world)
        box = build(
            settings, model, world, port, stack, keep=taken.keep, log=_log, also=[taken], labels=(args.label,)
        )  # fmt: skip
        box.run(lambda: taken.enough or stopped() or world.finished(box.answered))
    new = enrol.enrol(model, args.label, taken.windows())
    for warning in new.warnings:
        _log(f"warning: {warning}")
    enrol.write(new.files, args.out, args.replace)
    m = new.bundle.manifest
    _log(f"{args.out}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)} labels; use it with classifier.bundle")
    return 0


def run_replay(args: argparse.Namespace) -> int:
    """`palpate replay`: all sentences of a capture, or that of one saved sweep."""
    settings, model = _settings(args)
    if args.file.suffix == ".npy":
        sweep, fmt = load(args.file)
        _same(args.file, fmt, model)
        classifier = _classifier(settings, model, SystemClock())
        verdict = classifier(sweep) if sweep.share == 1 else Decider(classifier)(sweep)
        if verdict is None:
            raise FormatError(
                f"{args.file} was answered early, which this bundle does not do; name the one it was kept with"
            )
        sys.stdout.buffer.write(result(verdict, "replay"))
        return 0
    play = Playback(args.file)
    _same(args.file, play.format, model)
    classifier = _classifier(settings, model, play)
    port = StdoutPort("replay", play.commands)
    recorder = Recorder(model.format, settings.sweep)
    early = _early(settings, classifier)
    box = Box(play, play, recorder, classifier, play, early=early, sinks=[port], port=port, source="replay")
    box.run(lambda: play.finished)
    return 0


def _same(file: Path, fmt: SweepFormat, model: bundle.Bundle) -> None:
    if fmt != model.format:
        raise FormatError(
            f"{file} holds {fmt}, the bundle wants {model.format}; name its bundle with --set classifier.bundle=DIR"
        )


def run_config(args: argparse.Namespace) -> int:
    """`palpate config`: each value with its source."""
    print(config.describe(config.load(args.board, args.set, folder=args.config_dir)))
    return 0


def run_bench(args: argparse.Namespace) -> int:
    """`palpate bench`: see appliance/sim/bench.py."""
    from .sim import parts, terminal

    settings, model = _settings(args)

    def staged(
        world: SimWorld,
        stack: ExitStack,
        also: Iterable[ResultSink] = (),
        keep: Callable[[Sweep], None] | None = None,
    ) -> tuple[Box, int]:
        far_end, name = stack.enter_context(terminal.pair())
        port = SerialSink(replace(settings.serial, port=name), world.clock, world.source)
        return build(settings, model, world, port, stack, also=also, keep=keep), far_end

    if args.part:
        print(json.dumps(parts.measure(args.part, model.format, staged, args.acts)))
        return 0
    from .sim import bench

    figures = bench.run(model, staged, args.yardsticks, args.seed, lambda line: print(line, flush=True))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    return 0


RUNS = {
    "run": run_box, "demo": run_demo, "check": run_check, "enrol": run_enrol,
    "replay": run_replay, "config": run_config, "bench": run_bench,
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
