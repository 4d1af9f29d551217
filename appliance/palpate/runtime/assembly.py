"""Assembles a Box from settings, devices, and a bundle if there is one; and what every running box
reports."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from palpate.bundle import bundle as bundles
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.config import Config, TriggerConfig
from palpate.core.devices import Devices
from palpate.core.errors import ApplianceError, ConfigError, FormatError
from palpate.core.log import in_journal, log
from palpate.core.observer import Facts, Observer
from palpate.core.sentences import CommandHandler
from palpate.core.types import SweepFormat
from palpate.deployment.sandbox import run_limited
from palpate.deployment.signed import SignedBundle
from palpate.deployment.store import Store
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.inference.session import try_all
from palpate.io import skins
from palpate.io.gpio_lines import Lines
from palpate.io.lineless_triggers import (
    CommandTrigger,
    KeyTrigger,
    LinelessTrigger,
    TimedTrigger,
    standard_input,
)
from palpate.io.robot_link import LineSink, Port, SerialSink, StdoutPort, check_bits
from palpate.io.trigger import GpioTrigger, Trigger
from palpate.runtime.loop import Answerer, Box
from palpate.service.status_file import StatusFile
from palpate.sweeps.capture import CaptureWriter
from palpate.sweeps.sweep_window import SweepCutter

UNSIGNED = (
    "bundles are allowed: classifier.allow_unsigned = true; remove it from the settings once the "
    "bundle is signed"
)
"""Warning text, after the word "unsigned", shown while classifier.allow_unsigned is set."""
NO_COMMANDS: Mapping[str, CommandHandler] = MappingProxyType({})


def box(
    settings: Config,
    bundle: Bundle,
    devices: Devices,
    port: Port | None,
    stack: ExitStack,
    **more: Any,
) -> Box:
    """The box that classifies; `stack` closes it again. more: as for `assembled`."""
    run = Classifier(bundle, devices.clock, settings.classifier)
    run.self_test()
    early = EarlyExit(run) if settings.classifier.early else None
    more |= {"codes": bundle.manifest.labels, "early": early}
    return assembled(settings, run, devices, port, stack, **more)


def assembled(
    settings: Config,
    answerer: Answerer,
    devices: Devices,
    port: Port | None,
    stack: ExitStack,
    *,
    capture: CaptureWriter | None = None,
    observers: Iterable[Observer] = (),
    commands: Mapping[str, CommandHandler] = NO_COMMANDS,
    codes: tuple[str, ...] = (),
    early: EarlyExit | None = None,
    ordered: bool = False,
    serving: bool = True,
) -> Box:
    """The box with this answerer; `stack` closes it again. capture: records all inputs. codes:
    labels that the class bits hold. ordered: commands also come from another source than the port.
    serving: whether READY may rise."""
    settings = devices.wire(settings)
    trigger = _trigger(settings.trigger, answerer.format, devices, port, stack, ordered=ordered)
    watching = [answerer, *observers, *([capture] if capture else [])]
    if isinstance(trigger, LinelessTrigger):
        watching.append(trigger)
    commands = {**commands, "LABEL": partial(_label, codes)}
    if isinstance(trigger, CommandTrigger):
        commands = {**commands, **trigger.commands}
    lines = _outputs(settings, devices, stack)
    sensor = skins.sensor(settings, answerer.format, devices, capture)
    stack.callback(sensor.close)
    if port:
        stack.callback(port.close)
    if lines and settings.output.class_bits:  # last: it waits for output.settle_us
        watching.append(LineSink(lines, codes))
    cutter = SweepCutter(answerer.format, settings.sweep)
    return Box(
        *(sensor, trigger, cutter, answerer, devices.clock),
        early=early,
        port=port,
        lines=lines,
        serving=serving,
        observers=watching,
        commands=commands,
        source=devices.source,
        state_s=settings.serial.state_s,
    )


def _trigger(
    config: TriggerConfig,
    format: SweepFormat,
    devices: Devices,
    port: Port | None,
    stack: ExitStack,
    *,
    ordered: bool,
) -> Trigger:
    """The trigger of the settings. Raises ConfigError if nothing could start and stop sweeps."""
    if config.mode == "serial":
        if not ordered and (port is None or isinstance(port, StdoutPort)):
            raise ConfigError(
                'trigger.mode = "serial" takes START and STOP from the serial line, but '
                "serial.port is not set; set it, or trigger.mode to key, or use the page of "
                "palpate record --web"
            )
        return CommandTrigger(devices.clock, devices.commanded)
    if config.mode == "key":
        return stack.enter_context(closing(KeyTrigger(standard_input(), devices.clock, log.info)))
    if config.mode == "timed":
        window_s = format.window / format.rate_hz
        if config.sweep_s < window_s:
            raise ConfigError(
                f"a sweep of {config.sweep_s:g} s is shorter than the window of {window_s:g} s; "
                "use a longer --sweep"
            )
        return TimedTrigger(config, devices.clock, log.info)
    missing = next((k for k in ("start", "stop") if not getattr(config, k)), None)
    if missing == "start" or (missing and config.mode == "two-lines"):
        raise ConfigError(
            f"trigger.{missing} has no GPIO line, so no sweep can be cut; set trigger.mode "
            "to serial, key or timed, which need no lines (here --trigger serial), or choose a "
            "board with --board"
        )
    return stack.enter_context(closing(GpioTrigger(config, gpio(devices))))


def _label(labels: tuple[str, ...], code: str) -> list[object]:
    """The label with this code and the number of labels. Raises FormatError."""
    if not labels:
        raise FormatError(
            "sweeps are recorded without a bundle, so there are no labels; deliver or teach one"
        )
    if not (code.isdecimal() and 1 <= int(code) <= len(labels)):
        raise FormatError(f"label {code} is not there; use 1 to {len(labels)}")
    return [int(code), labels[int(code) - 1], len(labels)]


def _outputs(settings: Config, devices: Devices, stack: ExitStack) -> Lines | None:
    """The GPIO lines to the robot, None if none is wired."""
    out = settings.output
    if not any((out.ready, out.busy, out.result_valid, out.fault, out.decided, *out.class_bits)):
        return None
    return stack.enter_context(closing(Lines(out, gpio(devices), devices.clock)))


def gpio(devices: Devices) -> Any:
    """The module gpiod, or its simulated double; imported only if a GPIO line is wired."""
    if devices.gpio is not None:
        return devices.gpio
    import gpiod

    return gpiod


def prove(settings: Config, bundle: Bundle) -> None:
    """Raises BundleError or ConfigError if this machine does not run a bundle correctly."""
    run = Classifier(bundle, SystemClock(), settings.classifier)
    run.self_test()
    if settings.classifier.early:
        EarlyExit(run)
    if settings.output.class_bits:
        check_bits(1 << len(settings.output.class_bits), bundle.manifest.labels)


def store(settings: Config) -> Store:
    return Store(
        settings.store, lambda bundle: prove(settings, bundle), taught=settings.teach.allow
    )


def running(settings: Config, *, answers: bool = True) -> SignedBundle:
    """The bundle that the settings name, else the deployed bundle, else the packaged bundle.
    answers: whether a robot gets its answers. Then it must be signed, unless
    classifier.allow_unsigned is set. Raises BundleError or ConfigError."""
    name = settings.classifier.bundle
    return named(settings, Path(name), answers=answers) if name else store(settings).running()


def named(settings: Config, folder: Path, *, answers: bool) -> SignedBundle:
    """The bundle in `folder`, tried in a limited process; otherwise as `running`."""
    if settings.classifier.allow_unsigned or not answers:
        files = bundles.files(folder)
        found = SignedBundle(bundles.from_files(files, str(folder)), "", files)
    else:
        try:
            found = store(settings).bundles.read(folder)
        except ApplianceError as e:
            raise type(e)(
                f"{e}; a bench may allow unsigned bundles, by classifier.allow_unsigned = true"
            ) from e
    run_limited(partial(try_all, found.bundle))
    return found


def port(settings: Config, devices: Devices, *, terminal: bool = True) -> Port | None:
    """The serial line, or standard output; none in the journal, which people read. terminal: also
    if standard output is one; a person there reads the log."""
    if settings.serial.port:
        return SerialSink(settings.serial, devices.clock)
    read = in_journal() or not (terminal or not sys.stdout.isatty())
    return None if read else StdoutPort()


def capture(
    path: Path | None, settings: Config, format: SweepFormat, stack: ExitStack
) -> CaptureWriter | None:
    """The capture of `--capture`, which `stack` closes."""
    made = CaptureWriter(path, format, skins.profile(settings)) if path else None
    if made:
        stack.callback(made.close)
    return made


def done(
    wanted: int | None, box: Box, devices: Devices, stopped: Callable[[], bool]
) -> Callable[[], bool]:
    """True after a signal, after `wanted` answers, and at the end of a script."""
    most = float("inf") if wanted is None else wanted
    return lambda: box.answered >= most or stopped() or devices.finished(box.answered)


def reports(
    settings: Config, format: SweepFormat, source: str, model: Mapping[str, Any], facts: Facts
) -> list[Observer]:
    """The writer of the status file and the server of the feed, if the settings name them. The
    default folder exists in a service only. model: facts about the bundle for the first line of
    the feed."""
    status, feed, made = settings.store.status, settings.store.feed, list[Observer]()
    if status and os.access(status.parent, os.W_OK):
        made.append(StatusFile(status, SystemClock(), facts))
    default = settings.sources["store.runtime"] == "code"
    if feed and (not default or os.access(feed.parent, os.W_OK)):
        from palpate.service.feed import FeedServer

        known = {"source": source, "skin": settings.skin.profile, **model}
        known["unit"] = skins.profile(settings).unit
        made.append(FeedServer(feed, format, known, SystemClock(), facts))
    return made
