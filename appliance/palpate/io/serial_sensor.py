"""A skin on a serial port that does not speak PROTOCOL.md: the bytes of the port become Frames as
the skin's profile describes.

Only the commands of the profile are sent, and nothing else, since the skin may be another device.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from functools import partial

from palpate.core.clock import Clock, wait_readable
from palpate.core.config import SkinConfig
from palpate.core.errors import SensorError, SensorMismatch
from palpate.core.types import SweepFormat, shown
from palpate.io import packets, serial_port, skin_stream
from palpate.io.sensor import BytePort, Readable, TransferObserver
from palpate.io.serial_link import COLLECT_NS, SerialLink, find
from palpate.io.serial_port import PortInfo
from palpate.io.skin_profile import SkinProfile
from palpate.io.skin_stream import RATE_WANDER
from palpate.io.usb_sensor import LinkSensor

ANSWER_NS = 100_000_000
"""A request that was not answered for so long is lost."""
QUIET_NS = 2_000_000
"""An answer has ended once nothing has come for so long. A request before its end would disturb it
on a line that both sides share."""


class ProfileLink:
    """A port whose skin gets the stop commands of its profile before the port is released."""

    def __init__(self, port: BytePort, stop: Iterable[bytes]) -> None:
        self._port, self._stop = port, list(stop)
        self.read: Callable[[int, int], bytes] = port.read

    def close(self) -> None:
        """Send the stop commands, unless the skin is gone, and release the port."""
        with contextlib.suppress(SensorError):
            for command in self._stop:
                self._port.write(command)
        self._port.close()


class PollingLink(ProfileLink):
    """A port whose skin sends a frame when it is asked. polls: the requests of a frame, evenly
    spaced within `period_ns`. The next waits for the end of the last answer."""

    def __init__(
        self,
        port: BytePort,
        stop: Iterable[bytes],
        polls: list[bytes],
        period_ns: int,
        clock: Clock,
    ) -> None:
        super().__init__(port, stop)
        self.read = self._read
        self._polls, self._slot_ns, self._clock = polls, period_ns // len(polls), clock
        self._next, self._next_ns, self._waits_until_ns = 0, clock.now_ns(), 0

    def _read(self, size: int, timeout_ms: int) -> bytes:
        """As `Readable.read`, asking in between."""
        until_ns = self._clock.now_ns() + timeout_ms * 1_000_000
        while (now_ns := self._clock.now_ns()) < until_ns:
            due_ns = max(self._next_ns, self._waits_until_ns)
            if now_ns >= due_ns:
                self._port.write(self._polls[self._next])
                self._next = (self._next + 1) % len(self._polls)
                self._next_ns = max(self._next_ns + self._slot_ns, now_ns)
                self._waits_until_ns = now_ns + ANSWER_NS
                continue
            if data := self._port.read(size, max(1, (min(due_ns, until_ns) - now_ns) // 1_000_000)):
                self._waits_until_ns = self._clock.now_ns() + QUIET_NS
                return data
        return b""


def started(port: BytePort, profile: SkinProfile, rate_hz: float, clock: Clock) -> ProfileLink:
    """An open port whose skin got its start commands, and is asked for frames if its profile says
    so. Raises SensorError."""
    for command in profile.commands(profile.start, rate_hz):
        port.write(command)
    stop = profile.commands(profile.stop, rate_hz)
    if polls := requests(profile):
        return PollingLink(port, stop, polls, round(1e9 / rate_hz), clock)
    return ProfileLink(port, stop)


def requests(profile: SkinProfile) -> list[bytes]:
    """The requests of a frame; none for a skin that sends by itself."""
    if profile.codec == "modbus":
        from palpate.io.skin_codecs import modbus

        return modbus.requests(profile)
    return profile.commands(profile.poll, profile.rate_hz)


def opener(
    clock: Clock,
    wait: Callable[[int, float], bool] = wait_readable,
    profile: SkinProfile | None = None,
) -> Callable[[str, int], SerialLink]:
    """Opens a port, given its path and baud rate, and does not collect the bytes of a skin that
    waits for the next request. wait: see `Devices`."""
    pause_ns = 0 if profile and requests(profile) else COLLECT_NS
    return lambda path, baud: SerialLink(path, baud, clock, wait=wait, collect_ns=pause_ns)


class SerialSensor(LinkSensor):
    """A skin on a serial port, read as its profile describes. open_port: opens a port, given path
    and baud rate. ports: lists the serial ports of the machine."""

    announced = False

    def __init__(
        self,
        config: SkinConfig,
        profile: SkinProfile,
        format: SweepFormat,
        clock: Clock,
        tap: TransferObserver | None = None,
        *,
        open_port: Callable[[str, int], BytePort],
        ports: Callable[[], list[PortInfo]] = serial_port.ports,
    ) -> None:
        made = partial(skin_stream.stream, profile, format)
        super().__init__(config, format, clock, made, tap)
        self._profile, self._ports = profile, ports
        self._open_port = open_port
        self._on_usb = False  # the port is of USB itself, which has no speed
        self._tared_ns = 0  # until then the skin tares itself, and its frames are not used

    def _proven(self, now_ns: int) -> bool:
        return now_ns >= self._tared_ns and super()._proven(now_ns)

    def _open(self) -> tuple[Readable, packets.Identity]:
        self._check_format()
        there = self._ports()
        path = self._config.port or find(self._profile.ids, self._config.serial, there)
        node = os.path.realpath(path)  # a path in /dev/serial/by-id is a link
        self._on_usb = os.path.basename(node).startswith("ttyACM")
        info = next((port for port in there if port.path in (path, node)), PortInfo(path))
        port = self._open_port(path, self._profile.baud)
        try:
            link = started(port, self._profile, self._format.rate_hz, self._clock)
            if self._config.tare:
                for command in self._profile.commands(self._profile.tare, self._format.rate_hz):
                    port.write(command)
                self._tared_ns = self._clock.now_ns() + round(self._profile.tare_s * 1e9)
        except Exception:
            port.close()
            raise
        return link, packets.Identity(0, (0, 0, 0), self._config.profile, info.serial)

    def _check_format(self) -> None:
        """Raises SensorMismatch if the skin cannot send the bundle's format."""
        sent, wanted = self._profile.format, self._format
        near = abs(sent.rate_hz / wanted.rate_hz - 1) <= RATE_WANDER
        if sent.skin != wanted.skin or not (near or wanted.rate_hz in self._profile.rates_hz):
            rates = " or ".join(f"{rate:g}" for rate in self._profile.rates_hz or (sent.rate_hz,))
            raise SensorMismatch(
                f"the profile {self._config.profile} sends {shown(sent.shape)} {sent.dtype} at "
                f"{rates} Hz, wanted is {wanted}; correct skin.profile, skin.grid or skin.rate_hz, "
                "or deploy a bundle for this skin"
            )

    def _no_frame(self, *, bytes_came: bool) -> SensorError:
        if not bytes_came:
            return super()._no_frame(bytes_came=False)
        baud = "" if self._on_usb else " or the profile's baud"
        remedy = self._stream.misfit or (
            f"correct skin.profile, skin.grid{baud} (`palpate skin detect` listens);"
            " a board that boots when it is opened needs a longer skin.silence_ms"
        )
        return SensorMismatch(
            f"the skin sent bytes for {self._config.silence_ms} ms, but no frame of profile"
            f" {self._config.profile} ({shown(self._profile.format.shape)} {self._profile.number});"
            f" {remedy}"
        )
