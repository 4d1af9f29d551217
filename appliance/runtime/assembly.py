"""The room where the parts of a box are put together. In: settings, a bundle, a world. Out: a Box; nothing of sim here."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress

from appliance.bundle.bundle import Bundle
from appliance.core.clock import Clock, SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ConfigError
from appliance.core.health import HealthObserver
from appliance.deployment.store import Store
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import Decider
from appliance.io.gpio_lines import Lines
from appliance.io.robot_link import Port, ResultSink, SerialSink, StdoutPort
from appliance.io.trigger import GpioTrigger
from appliance.io.usb_sensor import UsbSensor
from appliance.io.verdict_lines import LineSink, check_bits
from appliance.recording.capture import CaptureWriter
from appliance.recording.sweep_window import SweepCutter
from appliance.runtime.loop import Box, SweepObserver
from appliance.service import journal


def log(line: str) -> None:
    """One line for a person; a full disk costs the log, never the classifying."""
    with suppress(OSError):
        print(journal.spoken(line, journal.attached()), file=sys.stderr, flush=True)


def box(
    settings: Config, model: Bundle, world: Devices, port: Port | None, stack: ExitStack, *,
    capture: CaptureWriter | None = None, keepers: Iterable[SweepObserver] = (), pulses: Iterable[HealthObserver] = (),
    log: Callable[[str], None] = lambda line: None, also: Iterable[ResultSink] = (), labels: tuple[str, ...] = (),
    obey: Mapping[str, Callable[[str], list[object]]] | None = None,
) -> Box:  # fmt: skip
    """Put the parts together; `stack` takes them apart again. labels: what class bits must hold beside the bundle's."""
    settings = world.wire(settings)
    missing = next((k for k in ("start", "stop") if not getattr(settings.trigger, k)), None)
    if missing == "start" or (missing and settings.trigger.mode == "two-lines"):
        raise ConfigError(
            f"trigger.{missing} names no line, so no sweep can be cut; choose a board with --board, or use --sim"
        )
    run = classifier(settings, model, world.clock)
    run.self_test()
    trigger = stack.enter_context(GpioTrigger(settings.trigger, world.gpio))
    lines = stack.enter_context(Lines(settings.output, world.gpio, world.clock))
    sensor = UsbSensor(settings.sensor, model.format, world.clock, world.backend, capture)
    stack.callback(sensor.close)
    if port:
        stack.callback(port.close)
    sinks: list[ResultSink] = [*([port] if port else []), *also]
    if settings.output.class_bits:
        sinks.append(LineSink(lines, (*model.manifest.labels, *labels)))
    return Box(
        sensor, trigger, SweepCutter(model.format, settings.sweep), run, world.clock,
        early=early(settings, run), sinks=sinks,
        port=port, panel=lines, state_s=settings.serial.state_s, source=world.source, log=log,
        tap=capture, keepers=[*keepers], pulses=[*pulses], obey=obey or {},
    )  # fmt: skip


def classifier(settings: Config, model: Bundle, clock: Clock) -> Classifier:
    """The classifier as the settings want it."""
    how = settings.classifier
    return Classifier(model, clock, how.fuse, how.min_probability, how.max_sweeps)


def early(settings: Config, run: Classifier) -> Decider | None:
    """Who answers early, where the settings want it."""
    return Decider(run) if settings.classifier.early else None


def prove(settings: Config, model: Bundle) -> None:
    """Raises BundleError or ConfigError where this machine, set as it is, does not run a bundle as it should."""
    run = classifier(settings, model, SystemClock())
    run.self_test()
    early(settings, run)
    if settings.output.class_bits:
        check_bits(1 << len(settings.output.class_bits), model.manifest.labels)


def store(settings: Config) -> Store:
    """The box's store of bundles."""
    return Store(settings.store, lambda model: prove(settings, model))


def port(settings: Config, world: Devices) -> Port | None:
    """The serial line, or standard output where none is configured; not into the journal, which a person reads."""
    if settings.serial.port:
        return SerialSink(settings.serial, world.clock, world.source)
    return None if journal.attached() else StdoutPort(world.source)
