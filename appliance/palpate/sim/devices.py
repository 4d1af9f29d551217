"""Simulated devices for the real drivers, built from the acts of the robot: the robot, its GPIO
lines (a double of gpiod) and the readout board (a pyusb backend)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from palpate.core.clock import Clock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.types import SweepFormat
from palpate.sim import gpio, rig, usb
from palpate.sim.rig import NEW_OBJECT, START, STOP

READY, BUSY, RESULT_VALID, FAULT, DECIDED = "READY", "BUSY", "RESULT-VALID", "FAULT", "DECIDED"
BITS = tuple(f"CLASS-{i}" for i in range(8))


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDevices(Devices):
    """Simulated GPIO lines and the robot that drives them and keeps its played acts."""

    gpio: gpio.SimGpio
    robot: rig.Robot

    def wire(self, settings: Config) -> Config:
        """The settings with the simulated GPIO lines; a trigger without lines stays."""
        wires = {"start": START, "stop": STOP, "new_object": NEW_OBJECT}
        trigger = replace(settings.trigger, **wires, active_low=False)  # type: ignore[arg-type]
        if trigger.by_lines:
            trigger = replace(trigger, mode="two-lines")
        bits = {"class_bits": BITS, "result_valid": RESULT_VALID}
        state = {"ready": READY, "busy": BUSY, "fault": FAULT, "decided": DECIDED}
        output = replace(settings.output, **bits, **state)  # type: ignore[arg-type]
        return replace(settings, trigger=trigger, output=output)

    def commanded(self, t_ns: int, *, start: bool) -> None:
        self.robot.obey(t_ns, start=start)

    def finished(self, answered: int) -> bool:
        return self.robot.finished and answered >= self.robot.acts


@dataclass(frozen=True, slots=True, kw_only=True)
class SimDevices(RobotDevices):
    """The robot's cell with a readout board on a simulated USB bus."""

    backend: usb.RigBackend

    def wire(self, settings: Config) -> Config:
        ids = {"usb": f"{usb.VENDOR_ID:04x}:{usb.PRODUCT_ID:04x}", "profile": "palpate", "grid": ""}
        link = "acm" if self.backend.acm else "vendor"
        skin_config = replace(settings.skin, **ids, rate_hz=0.0, link=link)  # type: ignore[arg-type]
        return replace(RobotDevices.wire(self, settings), skin=skin_config)


def robot_on_lines(
    acts: Iterable[rig.Act],
    clock: Clock,
    *,
    stops: bool = True,
    remember: bool = True,
    follows: bool = False,
) -> tuple[rig.Robot, gpio.SimGpio]:
    """A robot that plays `acts`, and the GPIO lines that it drives. See `build`."""
    outputs = READY, BUSY, RESULT_VALID, FAULT, DECIDED, *BITS
    chips = {"/dev/gpiochip0": [START, STOP, NEW_OBJECT, *outputs]}
    lines = gpio.SimGpio(clock, chips, remember=remember)
    robot = rig.Robot(iter(acts), lines, remember=remember, follows=follows)
    if stops:
        lines.watchers[DECIDED] = robot.react
    return robot, lines


def build(
    format: SweepFormat,
    acts: Iterable[rig.Act],
    clock: Clock,
    source: str,
    *,
    acm: bool = False,
    stops: bool = True,
    remember: bool = True,
    follows: bool = False,
) -> SimDevices:
    """Devices on which a robot plays `acts`. source: name of the source in sentences. acm: the
    readout board is a CDC-ACM device. stops: the robot ends its slide after DECIDED. follows: the
    finger slides from the command START to STOP, instead of in its own time.

    remember: keep all acts and all output levels, to examine them later; without it memory does not
    grow.
    """
    robot, lines = robot_on_lines(acts, clock, stops=stops, remember=remember, follows=follows)
    backend = usb.RigBackend(rig.ReadoutBoard(format, robot, clock), clock, acm=acm)

    def cable(out_ns: int, in_ns: int) -> None:
        backend.at(out_ns, backend.unplug)
        backend.at(in_ns, backend.plug)

    robot.cable = cable
    more = {"backend": backend, "source": source, "robot": robot, "format": format}
    return SimDevices(clock=clock, gpio=lines, **more)  # type: ignore[arg-type]
