"""Backends below the drivers: PALPATE_BACKEND selects one; contract: io/test_backends.py."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from palpate.core.clock import Clock
from palpate.core.config import OutputConfig, SerialConfig, SkinConfig, TriggerConfig
from palpate.core.types import SweepFormat
from palpate.io import packets
from palpate.sim import skin

VARIABLE = "PALPATE_BACKEND"
NAMES = {
    "simulated": "the simulator, in virtual time",
    "mocked": "libusb and libgpiod over umockdev",
    "remote": "the kernel of the virtual box",
    "wired": "a real board with loops on its header",
}

ALL = frozenset(
    [
        *("skin", "numbered", "plug", "unbind", "garble", "silence", "hold", "deny"),
        *("lines", "overrun", "serial", "stall", "pull"),
    ]
)
"""All capabilities of backends. `Backend` explains each."""


class BackendMissing(Exception):
    """A requirement of a backend is not installed. The message says how to install it."""


@dataclass(frozen=True, slots=True)
class Skin:
    """A skin when it is plugged in: serial number, protocol version and sweep format."""

    serial: str = "SIM0001"
    protocol: int = packets.VERSION
    rows: int = skin.FORMAT.rows
    cols: int = skin.FORMAT.cols
    rate_hz: float = skin.FORMAT.rate_hz
    dtype: str = skin.FORMAT.dtype
    axes: int = skin.FORMAT.axes


class Backend(Protocol):
    """The layer below the drivers: the drivers' inputs, and the controls that a test has over them.

    `can` is a set of capabilities:

        "skin"      a skin is there
        "numbered"  its raw counts are known (`skins.counts`)
        "plug"      it can be unplugged, plugged in and swapped
        "unbind"    its kernel driver can be removed
        "garble"    its transfers can be damaged
        "silence"   it can stop sending
        "hold"      another program can claim it
        "deny"      this user can lose the permission to open it
        "lines"     a test can drive the inputs and see the outputs
        "overrun"   the kernel sees each edge of a storm
        "serial"    the far end sends and receives
        "stall"     the serial line blocks when the far end does not read
        "pull"      the serial port can disappear and come back

    slack_s: delay beyond the requested time after which a wait on this machine counts as endless.
    pulse_s: shortest time to hold a level so that the kernel certainly sees it. Controls act at
    once.
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

    def reset(self) -> None: ...  # a default `Skin()`, inputs low, the serial line empty, no faults
    def wait(self, seconds: float) -> None: ...
    def after(self, seconds: float, control: Callable[[], None]) -> None: ...  # the box goes on
    def plug(self, what: Skin) -> None: ...  # after unplugging the previous skin
    def unplug(self) -> None: ...
    def unbind(self, on: bool) -> None: ...  # or restore the driver, without an event for the box
    def garble(self, on: bool) -> None: ...  # every fifth transfer is replaced by zeros
    def silence(self) -> None: ...  # until it is started again
    def hold(self, on: bool) -> None: ...
    def deny(self, on: bool) -> None: ...
    def drive(self, line: str, level: bool) -> None: ...
    def storm(self, line: str, edges: int) -> None: ...  # as fast as possible; an even number
    def level(self, line: str) -> bool: ...  # of an output of the box, as seen from outside
    def say(self, data: bytes) -> None: ...  # from the far end of the serial line
    def hear(self) -> bytes: ...  # the bytes at the far end since the last call
    def pull(self) -> None: ...  # as if the USB adapter of the serial port was pulled out
    def put(self) -> None: ...  # the port is back under the same name


def chosen() -> str:
    """The name in PALPATE_BACKEND, by default the simulator. Raises BackendMissing."""
    name = os.environ.get(VARIABLE) or "simulated"
    if name not in NAMES:
        raise BackendMissing(f"{VARIABLE} = {name!r} is unknown; known are {', '.join(NAMES)}")
    return name


def opened(name: str) -> AbstractContextManager[Backend]:
    """Open the backend of that name. Raises BackendMissing if this machine does not have it."""
    made: AbstractContextManager[Backend] = import_module(f"{__name__}.{name}").opened()
    return made
