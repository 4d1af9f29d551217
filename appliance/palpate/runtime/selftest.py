"""The self-test of `palpate check`: bundle, golden sweeps, skin, GPIO lines, port."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass

from palpate.answer.slide import SlideMeter
from palpate.bundle.bundle import Bundle, Manifest
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.errors import ApplianceError, PortError, SensorError, SensorMismatch
from palpate.core.types import SweepFormat, shown
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.io import skin_profile, skins
from palpate.io.gpio_lines import Lines
from palpate.io.robot_link import SerialSink
from palpate.io.sensor import Sensor
from palpate.io.trigger import GpioTrigger
from palpate.io.usb_sensor import fits
from palpate.runtime.assembly import UNSIGNED, gpio

UNPROVEN = "broken taxels are refused: export it again to measure how many can be bridged"
"""Text of a bundle without `bridging`."""
UNCHECKED = "early answers do not detect unknown materials: export it again"
"""Text of a bundle with early answers, but without limits for them."""
UNLIMITED = "unknown materials get the label of a known one, as classifier.strangers has no limits"
"""Text of a bundle that does not detect unknown materials."""
UNALLOWED = "noise, hum or another speed look like an unknown material: export it again"
"""Text of a bundle that detects unknown materials, but has no allowances for disturbances."""
LISTEN_S, LONGEST_S, LEAST_FRAMES = 1.0, 5.0, 50
"""Time for which frames of the skin are counted, and for a slow skin the longest time and the
number of frames that show its rate."""
BOOT_S = 8.0
"""Longest wait for the first frame of a skin that was opened; many boards boot then."""
MOST_READING = 0.5
"""Share of a core that reading a skin may take. The loop has one core; answers, recordings and
readers of the feed need the rest."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result for one component. detail: findings, or the problem and what to do."""

    component: str
    ok: bool
    detail: str


def check(
    settings: Config,
    load: Callable[[], Bundle],
    devices: Devices,
    spent_ns: Callable[[], int] = time.thread_time_ns,
) -> Iterator[CheckResult]:
    """Check all components in turn, also after a failure; the skin also without a bundle. spent_ns:
    processor time that this thread has taken so far."""
    loaded: list[Bundle] = []

    def bundle() -> str:
        loaded.append(load())
        return _described(loaded[0])

    yield _try("bundle", bundle)
    if settings.classifier.allow_unsigned:
        yield CheckResult("signatures", True, f"warning: unsigned {UNSIGNED}")
    if loaded:
        yield _try("golden sweeps", lambda: _golden(loaded[0], settings, devices, spent_ns))
        yield CheckResult("speed", True, _speed(loaded[0].manifest))
    wanted = loaded[0].format if loaded else None
    yield _try("skin", lambda: _skin(settings, wanted, devices, spent_ns))
    yield from _triggered(settings, devices)
    if settings.serial.port:
        yield _try("serial port", lambda: _port(settings, devices))


def _described(bundle: Bundle) -> str:
    m = bundle.manifest
    enrolled = "".join(f", {label} enrolled from {n}" for label, n in bundle.enrolled.items())
    return (
        f"{m.name} {m.version}, {bundle.id}, {m.format}, {len(m.labels)} labels{enrolled}; "
        + (f"{m.taught}; " if m.taught else "")
        + (f"{m.bridging.text} bridged" if m.bridging else UNPROVEN)
        + (f"; {UNCHECKED}" if m.early and not m.early.limits else "")
        + (f"; {UNALLOWED}" if m.known and not m.disturbances else "")
        + ("" if m.known else f"; {UNLIMITED}")
    )


def _golden(bundle: Bundle, settings: Config, devices: Devices, spent_ns: Callable[[], int]) -> str:
    classifier, begun_ns, n = Classifier(bundle, devices.clock), spent_ns(), len(bundle.golden)
    worst = classifier.self_test()
    each_ms = (spent_ns() - begun_ns) / 1e6 / n
    if settings.classifier.early:
        EarlyExit(classifier)
    worst_text = f"{n} sweeps, largest difference of a probability {worst:.2g}"
    return f"{worst_text}, {each_ms:.2g} ms of the processor for each"


def _try(component: str, look: Callable[[], str]) -> CheckResult:
    try:
        return CheckResult(component, True, look())
    except ApplianceError as e:
        return CheckResult(component, False, str(e))


def _speed(manifest: Manifest) -> str:
    """The speeds that can be measured, and the speeds of training."""
    place, trained = manifest.contact, manifest.speeds
    meter = SlideMeter(manifest.format, place.pitch_mm if place else None)
    if meter.why is not None:
        return f"not measured: {meter.why}"
    measured = f"measured from {meter.slowest_mm_s:.3g} to {meter.fastest_mm_s:.3g} mm/s"
    if trained is None:
        return f"{measured}; the bundle does not state the trained speeds: export it again"
    return f"{measured}, trained {trained}"


def _skin(
    settings: Config, wanted: SweepFormat | None, devices: Devices, spent_ns: Callable[[], int]
) -> str:
    """The skin's name, format and processor time, in words. wanted: format of the bundle. Raises
    SensorError, also if the bundle is for another skin or this board is too slow for it."""
    format = skins.announced(settings, devices, wanted)
    sends = _listened(settings, format, devices, spent_ns)
    if wanted and not fits(format, wanted):
        raise SensorMismatch(
            f"{sends}; the bundle wants {wanted}: record sweeps of this skin and train a bundle "
            "(palpate record needs no bundle), or deploy a bundle for this skin"
        )
    slow = skin_profile.warning(format)
    return f"{sends}; warning: {slow}" if slow else sends


def _listened(
    settings: Config, format: SweepFormat, devices: Devices, spent_ns: Callable[[], int]
) -> str:
    """The frames of the skin and the share of a core for reading them, in words. Counting begins
    with the first frame, since the start takes more processor time."""
    sensor = skins.sensor(settings, format, devices)
    try:
        first_ns = _first_frame(sensor, devices.clock.now_ns)
        begun_ns, counters, first = spent_ns(), sensor.counters, sensor.counters.frames
        seconds = max(LISTEN_S, min(LONGEST_S, LEAST_FRAMES / format.rate_hz))
        if "time" in skins.profile(settings).lacks:  # the sensor needs longer to see a wrong rate
            from palpate.io import skin_stream  # boxes whose skin has a clock do without it

            seconds = max(seconds, skin_stream.proven_s(format))
        while (passed_s := (devices.clock.now_ns() - first_ns) / 1e9) < seconds:
            sensor.read()
        share = (spent_ns() - begun_ns) / max(round(passed_s * 1e9), 1)
        if sensor.trouble:
            raise sensor.trouble
        who = sensor.identity
        name = f"{who.board} {who.serial}" if who else ""
        sent = f"{shown(format.shape)} {format.dtype} at {format.rate_hz:g} Hz"
        lost = f"{counters.lost_frames} lost"
        lost = lost if sensor.loss_known else "whether frames were lost cannot be seen"
        foreign = f"{counters.foreign_frames} foreign, " if counters.foreign_frames else ""
        sends = (
            f"{name.strip()}, {sent}, {counters.frames - first} frames in {passed_s:.1f} s, "
            f"{lost}, {foreign}{100 * share:.1f} % of a core"
        )
        if share > MOST_READING:
            raise SensorError(
                f"{sends}: {100 * MOST_READING:.0f} % at most leave room for answers, recordings "
                "and readers; use a faster board, or a skin that sends fewer frames a second"
            )
        return sends
    finally:
        sensor.close()


def _first_frame(sensor: Sensor, now_ns: Callable[[], int]) -> int:
    """The time of the first frame. Raises SensorError if none comes within LISTEN_S, or within
    BOOT_S from a skin that was opened: its board may boot first."""
    begun_ns = now_ns()
    while not sensor.counters.frames:
        sensor.read()
        opened = sensor.counters.enumerations and (
            sensor.trouble is None or sensor.trouble.state in ("silent", "mismatch")
        )
        if now_ns() > begun_ns + (BOOT_S if opened else LISTEN_S) * 1e9:
            raise sensor.trouble or SensorError(
                f"the skin sent no frame within {BOOT_S} s; replug it"
            )
    return now_ns()


def _triggered(settings: Config, devices: Devices) -> Iterator[CheckResult]:
    if settings.trigger.mode == "serial" and not settings.serial.port:
        hint = "set serial.port, or trigger.mode to two-lines, key or timed"
        wrong = f"serial: START and STOP come over serial.port, which is not set; {hint}"
        yield CheckResult("trigger", False, wrong)
    elif not settings.trigger.by_lines:
        yield CheckResult("trigger", True, f"{settings.trigger.mode}, no lines")
    elif settings.trigger.start:
        yield _try("gpio lines", lambda: _lines(settings, devices))
    else:
        hint = "choose a board with --board, or set trigger.mode to serial, key or timed"
        yield CheckResult("gpio lines", False, f"trigger.start has no GPIO line; {hint}")


def _lines(settings: Config, devices: Devices) -> str:
    module = gpio(devices)
    with (
        closing(GpioTrigger(settings.trigger, module)),
        closing(Lines(settings.output, module, devices.clock)) as lines,
    ):
        codes = lines.capacity
    trigger = settings.trigger
    inputs = " ".join(filter(None, (trigger.start, trigger.stop, trigger.new_object)))
    return f"inputs {inputs}, outputs for {codes} codes"


def _port(settings: Config, devices: Devices) -> str:
    port = SerialSink(settings.serial, devices.clock)
    port.commands()
    trouble = port.trouble
    port.close()
    if trouble:
        raise PortError(trouble)
    return f"{settings.serial.port} opened at {settings.serial.baud} baud"
