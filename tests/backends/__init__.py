"""Backends: the devices, real or not, below the drivers of the box. PALPATE_BACKEND names one.

tests/appliance/io/test_backends.py is the contract of Sensor, Trigger, Lines and SerialSink; it
runs over any of them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from appliance.core.clock import Clock
from appliance.core.config import OutputConfig, SerialConfig, SkinConfig, TriggerConfig
from appliance.core.types import SweepFormat
from appliance.io import packets
from appliance.sim import skin

VARIABLE = "PALPATE_BACKEND"
NAMES = {
    "simulated": "the simulator, in virtual time",
    "mocked": "libusb and libgpiod over umockdev",
    "remote": "the kernel of the virtual box",
    "wired": "a real board with loops on its header",
}

ALL = frozenset(
    (
        "skin",
        "numbered",
        "plug",
        "unbind",
        "garble",
        "silence",
        "hold",
        "deny",
        "lines",
        "overrun",
        "serial",
        "stall",
        "pull",
    )
)
"""All that a backend may be able to do; `Backend` explains each."""


class BackendMissing(Exception):
    """A tool of a backend is not installed; the message says how to get it."""


@dataclass(frozen=True, slots=True)
class Skin:
    """A skin as it is plugged in: serial number, protocol version, and the format of its sweeps."""

    serial: str = "SIM0001"
    protocol: int = packets.VERSION
    rows: int = skin.FORMAT.rows
    cols: int = skin.FORMAT.cols
    rate_hz: float = skin.FORMAT.rate_hz
    dtype: str = skin.FORMAT.dtype
    axes: int = skin.FORMAT.axes


class Backend(Protocol):
    """The devices below the drivers, and the controls that a test has over them.

    can: "skin": one is there. "numbered": its raw counts are known (`skins.counts`). "plug": it is
    unplugged, plugged in and swapped. "unbind": its driver is taken away. "garble", "silence",
    "hold" (another program has it), "deny" (this user may not open it). "lines": inputs are driven,
    outputs seen. "overrun": a storm brings each edge to the kernel. "serial": the far end sends and
    receives. "stall": bytes that it does not read block the line. "pull": the port goes and comes
    back.

    slack_s: how much later than asked this machine may be before a wait counts as endless. pulse_s:
    how long a level is held so that the kernel sees it for certain. Controls act at once.
    """

    name: str
    can: frozenset[str]
    clock: Clock
    slack_s: float
    pulse_s: float
    gpio: Any
    backend: Any
    format: SweepFormat
    sensor: SkinConfig
    trigger: TriggerConfig
    output: OutputConfig
    serial: SerialConfig

    def reset(self) -> None:
        """A plain `Skin()` in its socket, inputs low, nothing on the serial line; nothing is in the
        way."""
        ...

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def after(self, seconds: float, control: Callable[[], None]) -> None:
        """Do `control` so much later, while the box works."""
        ...

    def plug(self, what: Skin) -> None:
        """Plug a skin in; unplug the previous skin."""
        ...

    def unplug(self) -> None:
        """Pull the skin's cable."""
        ...

    def unbind(self, on: bool) -> None:
        """Unbind the driver from the skin, or bind it again, without an event of plugging in."""
        ...

    def garble(self, on: bool) -> None:
        """Let every fifth transfer come as zeros."""
        ...

    def silence(self) -> None:
        """Let the skin stop sending until it is started again."""
        ...

    def hold(self, on: bool) -> None:
        """Another program claims the skin, or lets it go."""
        ...

    def deny(self, on: bool) -> None:
        """Take the permission to open the skin from this process, or give it back."""
        ...

    def drive(self, line: str, level: bool) -> None:
        """Set an input of the box."""
        ...

    def storm(self, line: str, edges: int) -> None:
        """Toggle an input so often, as quickly as can be; an even number ends where it began."""
        ...

    def level(self, line: str) -> bool:
        """An output of the box, as it is seen outside."""
        ...

    def say(self, data: bytes) -> None:
        """Send from the serial line's far end."""
        ...

    def hear(self) -> bytes:
        """Bytes at the far end since the last call."""
        ...

    def pull(self) -> None:
        """Take the serial port away, as an adapter is pulled out."""
        ...

    def put(self) -> None:
        """Bring the serial port back under its old name."""
        ...


def chosen() -> str:
    """The name in PALPATE_BACKEND; the simulator where it is not set. Raises BackendMissing for an
    unknown one."""
    name = os.environ.get(VARIABLE) or "simulated"
    if name not in NAMES:
        raise BackendMissing(f"{VARIABLE} = {name!r} is unknown; known are {', '.join(NAMES)}")
    return name


def opened(name: str) -> AbstractContextManager[Backend]:
    """The backend of that name, to be used in a `with`. Raises BackendMissing where this machine
    has not got it."""
    made: AbstractContextManager[Backend] = import_module(f"{__name__}.{name}").opened()
    return made
