"""How a box is put together. In: settings, a bundle, devices. Out: a Box; the simulator is not known here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from types import MappingProxyType

from appliance.bundle.bundle import Bundle
from appliance.core.clock import Clock, SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ConfigError
from appliance.core.log import in_journal
from appliance.core.observer import Observer
from appliance.deployment.store import Store
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import Decider
from appliance.io.gpio_lines import Lines
from appliance.io.robot_link import Port, SerialSink, StdoutPort
from appliance.io.trigger import GpioTrigger
from appliance.io.usb_sensor import UsbSensor
from appliance.io.verdict_lines import LineSink, check_bits
from appliance.recording.capture import CaptureWriter
from appliance.recording.sweep_window import SweepCutter
from appliance.runtime.loop import Box, CommandHandler, Pipeline


def box(
    settings: Config, bundle: Bundle, devices: Devices, port: Port | None, stack: ExitStack, *,
    capture: CaptureWriter | None = None, observers: Iterable[Observer] = (), labels: tuple[str, ...] = (),
    commands: Mapping[str, CommandHandler] = MappingProxyType({}),
) -> Box:  # fmt: skip
    """Put the components together; `stack` closes them again.

    capture: of all that comes in. labels: what the class bits must hold beside the bundle's labels.
    """
    settings = devices.wire(settings)
    missing = next((k for k in ("start", "stop") if not getattr(settings.trigger, k)), None)
    if missing == "start" or (missing and settings.trigger.mode == "two-lines"):
        raise ConfigError(
            f"trigger.{missing} names no line, so no sweep can be cut; choose a board with --board, or use --sim"
        )
    run = classifier(settings, bundle, devices.clock)
    run.self_test()
    trigger = stack.enter_context(GpioTrigger(settings.trigger, devices.gpio))
    lines = stack.enter_context(Lines(settings.output, devices.gpio, devices.clock))
    sensor = UsbSensor(settings.sensor, bundle.format, devices.clock, devices.backend, capture)
    stack.callback(sensor.close)
    if port:
        stack.callback(port.close)
    watching = [*observers, *([capture] if capture else [])]
    if settings.output.class_bits:  # last: it waits for output.settle_us
        watching.append(LineSink(lines, (*bundle.manifest.labels, *labels)))
    cutter = SweepCutter(bundle.format, settings.sweep)
    return Box(
        Pipeline(sensor, trigger, cutter, run, early_exit(settings, run)), devices.clock, port=port, panel=lines,
        observers=watching, commands=commands, source=devices.source, state_s=settings.serial.state_s,
    )  # fmt: skip


def classifier(settings: Config, bundle: Bundle, clock: Clock) -> Classifier:
    """The classifier, configured as the settings say."""
    chosen = settings.classifier
    return Classifier(bundle, clock, chosen.fuse, chosen.min_probability, chosen.max_sweeps)


def early_exit(settings: Config, run: Classifier) -> Decider | None:
    """What answers early, where the settings ask for it."""
    return Decider(run) if settings.classifier.early else None


def prove(settings: Config, bundle: Bundle) -> None:
    """Raises BundleError or ConfigError where this machine, set as it is, does not run a bundle as it should."""
    run = classifier(settings, bundle, SystemClock())
    run.self_test()
    early_exit(settings, run)
    if settings.output.class_bits:
        check_bits(1 << len(settings.output.class_bits), bundle.manifest.labels)


def store(settings: Config) -> Store:
    """The store of bundles that the settings name."""
    return Store(settings.store, lambda bundle: prove(settings, bundle))


def port(settings: Config, devices: Devices) -> Port | None:
    """The serial line, or standard output where none is configured; not into the journal, which a person reads."""
    if settings.serial.port:
        return SerialSink(settings.serial, devices.clock, devices.source)
    return None if in_journal() else StdoutPort(devices.source)
