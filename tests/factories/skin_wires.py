"""Skins on a serial line in virtual time, by the name of a profile.

For each skin: the expected content of its frames, their bytes, and a port that delivers them with a
driver's buffer and every fault. Where a skin allows several bytes (width of offsets, separators,
commands), these are not the same as those of the emulated skins.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from palpate.core.config import SkinConfig
from palpate.core.errors import SensorBusy, SensorLost
from palpate.core.types import Frames, SweepFormat
from palpate.io import skin_profile
from palpate.io.sensor import TransferObserver
from palpate.io.serial_port import PortInfo
from palpate.io.serial_sensor import SerialSensor
from palpate.io.skin_profile import SkinProfile
from palpate.sim.rig import VirtualClock
from tests.factories.paths import ROOT
from tests.factories.skins import wires
from tests.factories.skins.devices import on_wire

FOLDER = ROOT / "firmware_config" / "skins"
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml") if path.stem != "palpate")
PATH = "/dev/serial/by-id/skin"
SECOND = 1_000_000_000
TTY_BYTES = 4095
"""Most bytes of one read from a tty."""


@cache
def profile(name: str) -> SkinProfile:
    """A packaged profile."""
    return skin_profile.load(name, [FOLDER])


def taxels(p: SkinProfile, i: int) -> NDArray[np.generic]:
    """Raw counts of frame `i`: [R, C] or [R, C, A], different in every frame and taxel."""
    format = p.format
    shift = (np.arange(format.channels).reshape(format.shape) * 7 + i * 13) % 199
    if "int8" in p.number.split():
        shift %= 128
    return (shift / 4 if format.dtype == "float32" else shift).astype(format.numpy_type)


def numbers(p: SkinProfile, i: int) -> NDArray[np.generic]:
    """All values of frame `i` on the wire: [R, C, values]. Unused values are 99."""
    grid = np.full((p.rows, p.cols, p.values), 99, np.dtype(p.number))
    grid[..., list(p.take)] = taxels(p, i).reshape(p.rows, p.cols, len(p.take))
    return grid


VARIANTS: dict[str, Callable[[bytes], bytes]] = {
    "reskin": lambda data: data.replace(b"\t", b" "),
    "3d-vitac": lambda data: data.replace(b"\r\n", b"\n"),
    "xela-can": bytes.lower,
    "robotiq-tsf": lambda data: data[:2] + bytes([wires.Robotiq.READ]) + data[3:],
}
"""Other choices of the bytes, where a skin allows several."""


@lru_cache(20_000)
def wire(name: str, i: int, period_ns: float = 1e6) -> bytes:
    """Frame `i` of a packaged profile as bytes. period_ns: of its clock."""
    if name == "papillarray":
        return papillarray(numbers(profile(name), i), i, period_ns=period_ns)
    skin = wires.wire(name, 1e9 / period_ns)
    frame = on_wire(taxels(profile(name), i), profile(name))
    data = skin.encode(frame) if isinstance(skin, wires.Polled) else skin.frame(frame, 0)
    return VARIANTS.get(name, bytes)(data)


def papillarray(
    grid: NDArray[np.generic], i: int, sensors: int = 1, period_ns: float = 1e6
) -> bytes:
    """A PTS packet with blocks of types 1 and 3.

    Offsets are one byte wide and count from the byte that holds their width.
    """
    pillars = grid.reshape(-1, 6)
    each = len(pillars) // sensors
    clock = struct.pack("<IQ", (1000 + i) % (1 << 32), 5_000_000 + round(i * period_ns / 1000))
    body = struct.pack("<H", sensors) + bytes(sensors)
    for k in range(sensors):
        body += struct.pack("<H", each) + bytes(each)
        rows = pillars[k * each : (k + 1) * each].tolist()
        body += b"".join(struct.pack("<H6f", 2, *row) for row in rows)
    table = 1 + 2 * 3
    content = bytes([1]) + struct.pack("<HBHB", 1, table, 3, table + len(clock)) + clock + body
    check = struct.pack("<H", sum(content) & 0xFFFF)
    return wires.PapillArray.START + content + check + wires.PapillArray.END


@dataclass
class WirePort:
    """A serial port with a skin behind it and the kernel's buffer between them.

    frames: the bytes of frame i. period_ns: time between two frames. latency: time from the end of
    a frame to the driver. capacity: size of the driver's buffer in bytes; bytes beyond it are lost.
    mangle: changes the bytes of a frame on the cable. chunk: most bytes of one read. sent: bytes
    from the box.
    """

    clock: VirtualClock
    frames: Callable[[int], bytes]
    period_ns: float
    capacity: int = 1 << 30
    latency: Callable[[], int] = lambda: 200_000
    mangle: Callable[[bytes], bytes] = lambda data: data
    chunk: Callable[[], int] = lambda: TTY_BYTES
    silent: bool = False
    gone: bool = False
    busy: bool = False
    sent: list[bytes] = field(default_factory=list)
    is_open: bool = False
    thrown_away: int = 0

    def __post_init__(self) -> None:
        self.begun_ns = self.clock.now_ns()
        self._next, self._due_ns, self._buffer = 0, 0, b""
        self._plan()

    def taken_ns(self, i: int) -> int:
        """Host time of frame `i`."""
        return self.begun_ns + round((i + 1) * self.period_ns)

    def open(self, path: str, baud: int) -> WirePort:
        """Open it in the middle of a frame. Earlier bytes are lost."""
        if self.busy:
            raise SensorBusy("port held by another program")
        if self.gone:
            raise SensorLost("it is gone (errno 19)")
        self.is_open = True
        self._fill()
        self._buffer = self._buffer[-5:]
        return self

    def write(self, data: bytes) -> None:
        if self.gone:
            raise SensorLost("it is gone (errno 19)")
        self.sent.append(data)

    def close(self) -> None:
        """Stop reading."""
        self.is_open = False

    def read(self, size: int, timeout_ms: int) -> bytes:
        """The bytes so far, or b"" after the timeout."""
        until_ns = self.clock.now_ns() + timeout_ms * 1_000_000
        while True:
            if self.gone:
                raise SensorLost("the skin was unplugged (errno 19)")
            self._fill()
            if self._buffer:
                n = min(size, self.chunk(), TTY_BYTES)
                data, self._buffer = self._buffer[:n], self._buffer[n:]
                return data
            if self.clock.now_ns() >= until_ns:
                return b""
            self.clock.sleep_until(until_ns if self.silent else min(until_ns, self._due_ns))

    def ports(self) -> list[PortInfo]:
        """The port while it is plugged in."""
        return [] if self.gone else [PortInfo(PATH, 0x1A86, 0x7523, "S1")]

    def _plan(self) -> None:
        self._due_ns = self.taken_ns(self._next) + self.latency()

    def _fill(self) -> None:
        while self._due_ns <= self.clock.now_ns():
            data = b"" if self.silent else self.mangle(self.frames(self._next))
            kept = data[: max(0, self.capacity - len(self._buffer))]
            self.thrown_away += len(data) - len(kept)
            self._buffer += kept
            self._next += 1
            self._plan()


class WiredSkin:
    """A sensor on a skin of a packaged profile, in virtual time."""

    def __init__(
        self,
        name: str,
        format: SweepFormat | None = None,
        *,
        rate: float = 1.0,
        clock: VirtualClock | None = None,
        tap: TransferObserver | None = None,
        **settings: object,
    ) -> None:
        self.name, self.profile, self.clock = name, profile(name), clock or VirtualClock()
        self.format = format or self.profile.format
        period_ns = self.profile.format.period_ns / rate
        self.port = WirePort(self.clock, lambda i: wire(name, i, period_ns), period_ns)
        options = {"port": PATH, "retry_ms": 50} | settings
        config = SkinConfig(profile=name, **options)  # type: ignore[arg-type]
        adapted = skin_profile.adapted(self.profile, config)
        self.sensor = SerialSensor(
            config,
            adapted,
            self.format,
            self.clock,
            tap,
            open_port=self.port.open,
            ports=self.port.ports,
        )
        self.states: list[str] = []
        self.troubles: list[str] = []

    def seconds(self, seconds: float) -> Frames:
        """All frames of this time. `states` gets the new states after the first frame or fault."""
        end_ns, parts = self.clock.now_ns() + round(seconds * SECOND), [self.sensor.read()]
        while self.clock.now_ns() < end_ns:
            before = self.clock.now_ns()
            parts.append(self.sensor.read())
            opening = self.sensor.state == "absent" and not self.sensor.trouble
            if not opening and self.sensor.state not in self.states[-1:]:
                self.states.append(self.sensor.state)
                self.troubles.append(str(self.sensor.trouble or ""))
            if self.clock.now_ns() == before:  # each turn takes some time
                self.clock.sleep_until(before + 1_000_000)
        return Frames.joined(parts)

    def which(self, frames: Frames) -> NDArray[np.int64]:
        """Number [n] of each frame by its content. Fails for one that was never sent."""
        sent = {taxels(self.profile, i).tobytes(): i for i in range(199)}
        low = np.array([sent[one.tobytes()] for one in frames.taxels], np.int64)
        # The content repeats after 199 frames. The time decides between equal frames.
        about = (frames.t_ns - self.port.begun_ns) / self.port.period_ns
        return low + 199 * np.rint((about - low) / 199).astype(np.int64)

    def late_ms(self, frames: Frames) -> NDArray[np.float64]:
        """Delay [n] of each frame's time behind its true time, ms."""
        taken = np.array([self.port.taken_ns(int(i)) for i in self.which(frames)])
        return (frames.t_ns - taken) / 1e6
