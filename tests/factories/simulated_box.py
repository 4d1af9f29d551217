"""A box on simulated devices: numbered frames, an idle robot, the robot's port."""

import os
import select
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from palpate.core.observer import Observer
from palpate.core.types import Sweep, SweepFormat, Verdict
from palpate.io.robot_link import SerialSink
from palpate.runtime.loop import Box
from palpate.sim import devices, rig, script, skin

SECOND = 1_000_000_000
SETTLE_S = 0.02


def numbered(n: int, format: SweepFormat = skin.FORMAT, first: int = 0) -> np.ndarray:
    """Frames [n, R, C] or [n, R, C, A] whose counts tell frame, taxel and axis."""
    grid = np.arange(format.channels).reshape(1, *format.shape)
    return (
        (np.arange(first, first + n) % 97).reshape(-1, *(1,) * len(format.shape)) + grid
    ).astype(format.numpy_type)


def idle_devices(
    seconds: float = 3600, format: SweepFormat = skin.FORMAT, **board
) -> devices.SimDevices:
    """Simulated devices: a skin that sends numbered frames, and an idle robot."""
    n = min(round(seconds * format.rate_hz), 60_000)
    acts = [rig.Act(numbered(n, format), 10**9, 10**9 + 1, "")]
    simulated = devices.build(format, acts, rig.VirtualClock(), "sim", acm=board.pop("acm", False))
    simulated.backend.board = rig.ReadoutBoard(
        format, simulated.robot, simulated.clock, **{"packet_frames": 4} | board
    )
    return simulated


def played(acts: Iterable[rig.Act], format: SweepFormat = skin.FORMAT) -> devices.SimDevices:
    """Simulated devices on which a robot plays these acts."""
    return devices.build(format, acts, rig.VirtualClock(), "sim")


def tubes(seed: int, n: int | None = None, **more: str) -> devices.SimDevices:
    """Simulated devices whose robot sweeps over `n` tubes."""
    return played(script.tubes(seed, n, **more))


class OnSweep(Observer):
    """Calls a function with each sweep and its verdict."""

    def __init__(self, act: Callable[[Sweep, Verdict], object]) -> None:
        self._act = act

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        self._act(sweep, verdict)


@dataclass
class Rigged:
    """A box on the rig, and the robot's end of its serial line."""

    box: Box
    simulated: devices.SimDevices
    far_end: int
    port: SerialSink
    heard: list[str] = field(default_factory=list)
    kept: list[Sweep] = field(default_factory=list)
    rest: bytes = b""

    def until(self, done: Callable[[], bool], *, limit_s: float = 60) -> list[Verdict]:
        """Step until `done()`; fails after `limit_s` of simulated time."""
        verdicts = []
        end_ns = self.simulated.clock.now_ns() + limit_s * SECOND
        while not done():
            late = f"the condition did not hold within {limit_s} s of simulated time"
            assert self.simulated.clock.now_ns() < end_ns, late
            verdicts += self.box.step()
            self.listen()
        self.listen(SETTLE_S)
        return verdicts

    def seconds(self, s: float) -> list[Verdict]:
        """Step for `s` seconds of simulated time."""
        end_ns = self.simulated.clock.now_ns() + round(s * SECOND)
        return self.until(lambda: self.simulated.clock.now_ns() >= end_ns)

    def listen(self, wait_s: float = 0) -> None:
        """Read the robot's end. wait_s: real time in which the kernel delivers the bytes."""
        while select.select([self.far_end], [], [], wait_s)[0]:
            *lines, self.rest = (self.rest + os.read(self.far_end, 65536)).split(b"\r\n")
            self.heard += [line.decode("ascii") for line in lines]

    def ask(self, line: str) -> str:
        """Send a command; returns the sentence that answers it."""
        before = len(self.heard)
        os.write(self.far_end, line.encode() + b"\r\n")
        self.until(lambda: any(",ANS," in h for h in self.heard[before:]), limit_s=5)
        return next(h for h in self.heard[before:] if ",ANS," in h)

    def edge(self, name: str, after_s: float, level: bool = True) -> None:
        """Drive an input `after_s` from now."""
        self.simulated.gpio.drive(
            name, level, self.simulated.clock.now_ns() + round(after_s * SECOND)
        )

    def pulse(self, name: str, after_s: float) -> None:
        """Drive an input high for 20 ms."""
        self.edge(name, after_s)
        self.edge(name, after_s + 0.02, False)
