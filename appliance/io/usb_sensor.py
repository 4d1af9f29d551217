"""UsbSensor: frames from pyusb, through unplug and replug. In: a pyusb backend, a clock. Out: Frames, state, trouble.

`read` never raises for what a bus can do: it gives no frames, says why in `state` and `trouble`, and tries again.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import usb.core

from appliance.core.clock import Clock, DeviceClock
from appliance.core.config import SensorConfig
from appliance.core.errors import FormatError, SensorError, SensorMismatch, SensorSilent
from appliance.core.types import EPOCH_BITS, Frames, SweepFormat
from appliance.io import packets, usb_link

RATE_TOLERANCE = 0.01
"""How far a board's rate may be from the bundle's: one per cent, as crystals and timers differ."""
STAMPS_NS = 5_000_000
"""How far a board's stamps may waver: it may stamp in milliseconds, or late under an interrupt. That moves no window."""

_COUNT = np.arange(packets.MAX_FRAMES, dtype=np.int64)


@dataclass(slots=True)
class SensorCounters:
    """What was counted since the program started, in the unit of each name."""

    frames: int = 0
    lost_frames: int = 0
    stale_frames: int = 0
    garbage_bytes: int = 0
    overflows: int = 0
    fifo_overflows: int = 0
    enumerations: int = 0


class Sensor(Protocol):
    """What the box asks of a skin."""

    @property
    def state(self) -> str:
        """`streaming`, or what keeps it from that (PROTOCOL.md, states of the skin)."""
        ...

    @property
    def trouble(self) -> SensorError | None:
        """Why it is not streaming, and what to do."""
        ...

    @property
    def identity(self) -> packets.Identity | None:
        """Who the board says it is, once it was asked."""
        ...

    @property
    def clock(self) -> dict[str, float] | None:
        """How well the board's time is known: DeviceClock.quality."""
        ...

    @property
    def tally(self) -> SensorCounters:
        """What was counted since the start."""
        ...

    def read(self) -> Frames:
        """The frames since the last call; none after a bounded wait."""
        ...


class TransferObserver(Protocol):
    """Takes note of what comes in, for captures."""

    def transfer(self, t_ns: int, data: bytes) -> None:
        """A bulk transfer has ended."""
        ...

    def state(self, t_ns: int, state: str) -> None:
        """The sensor's state has changed; `streaming` means a new enumeration."""
        ...


class Stream:
    """Bytes of one board -> Frames with unwrapped numbers and host times; no I/O. What is not intact is counted."""

    def __init__(self, fmt: SweepFormat, tally: SensorCounters) -> None:
        self._format, self._tally = fmt, tally
        self._grid, self._digits = (fmt.rows, fmt.cols), fmt.digits
        self._within_ns = np.rint(_COUNT * fmt.period_ns).astype(np.int64)
        self._place = packets.StreamPosition(-1)
        self._device = DeviceClock()
        self._leftover = b""
        self._mark: tuple[int, int] | None = None  # (number, device ns) of a frame at most a second ago

    def restart(self) -> None:
        """A new enumeration, the first one too: numbers get the next epoch, the device's clock starts anew."""
        self._tally.enumerations += 1
        self._place = packets.StreamPosition(self._place.epoch + 1)
        self._device, self._mark = DeviceClock(), None
        self._leftover = b""

    @property
    def clock(self) -> dict[str, float] | None:
        """How well the board's time is known: DeviceClock.quality."""
        return self._device.quality()

    def feed(self, data: bytes, arrival_ns: int) -> Frames:
        """Frames of a transfer that ended at `arrival_ns`.

        Raises SensorMismatch where they have another form, or where the board's clock does not go with its count.
        """
        got = packets.unpack(self._leftover + data)
        self._leftover = got.leftover
        self._tally.garbage_bytes += got.garbage
        for p in got.packets:
            if p.taxels.shape[1:] != self._grid or p.taxels.dtype != self._digits:
                form = f"{p.taxels.shape[1:]} {p.taxels.dtype}"
                raise SensorMismatch(f"the skin sent {form}, but it had announced {self._format}; check its firmware")
            self._tally.fifo_overflows += bool(p.flags & packets.Flag.OVERFLOW.value)
        fresh, place, lost, stale = packets.follow(got.packets, self._place)
        if place.epoch != self._place.epoch:
            self._device, self._mark = DeviceClock(), None
        self._place = place
        now = [item for item in fresh if item[0] >> EPOCH_BITS == place.epoch]
        # what came before the board started anew, in the same transfer, has no host time any more
        self._tally.lost_frames += lost + sum(len(p.taxels) for _, p in fresh) - sum(len(p.taxels) for _, p in now)
        self._tally.stale_frames += stale
        return self._stamp(now, arrival_ns)

    def _stamp(self, fresh: list[tuple[int, packets.Packet]], arrival_ns: int) -> Frames:
        """Put numbers and host times to packets [(first number, packet)] of one epoch."""
        if not fresh:
            return Frames.empty(self._format)
        starts = [self._device.unwrap(p.t_us) * 1000 for _, p in fresh]
        for start, (first, _) in zip(starts, fresh, strict=True):
            self._check_pace(first, start)
        self._device.update(starts[-1] + int(self._within_ns[len(fresh[-1][1].taxels) - 1]), arrival_ns)
        runs = []
        for start, (first, p) in zip(starts, fresh, strict=True):
            n = len(p.taxels)
            self._tally.frames += n
            runs.append(Frames(self._device.to_host_ns(start) + self._within_ns[:n], first + _COUNT[:n], p.taxels))
        return runs[0] if len(runs) == 1 else Frames.joined(runs)

    def _check_pace(self, first: int, start_ns: int) -> None:
        """Hold the board's clock against its count. Where they part, no host time is right, and a window cut by it is wrong.

        Compared with a frame up to a second ago: a jump of either is seen at once, another pace within that second.
        """
        self._mark = self._mark or (first, start_ns)
        counted_ns = round((first - self._mark[0]) * self._format.period_ns)
        passed_ns = start_ns - self._mark[1]
        slack_ns = max(STAMPS_NS, self._format.period_ns) + RATE_TOLERANCE * counted_ns
        if abs(passed_ns - counted_ns) > slack_ns:
            raise SensorMismatch(
                f"the skin's clock went on {passed_ns / 1e6:.1f} ms during frames of {counted_ns / 1e6:.1f} ms; "
                "starting it again, check its firmware if this stays"
            )
        if counted_ns >= 1_000_000_000:
            self._mark = first, start_ns


class UsbSensor:
    """The skin's readout board on USB (PROTOCOL.md, part 1).

    States: `absent`, `busy`, `denied`, `mismatch`, `lost`, `silent` with `trouble` saying what to do, or `streaming`.
    A board that comes back is a new enumeration: its frames get a new epoch in `seq` and a new device clock.
    """

    def __init__(
        self,
        config: SensorConfig,
        fmt: SweepFormat,
        clock: Clock,
        backend: Any = None,
        tap: TransferObserver | None = None,
    ) -> None:
        self.state = "absent"
        self.trouble: SensorError | None = None
        self.identity: packets.Identity | None = None
        self.tally = SensorCounters()
        self._config, self._format, self._clock, self._backend, self._tap = config, fmt, clock, backend, tap
        self._stream = Stream(fmt, self.tally)
        self._link: usb_link.VendorLink | None = None
        self._retry_ns = clock.now_ns()
        self._quiet_ns = 0  # spent listening since the last frame

    @property
    def clock(self) -> dict[str, float] | None:
        """How well the board's time is known: DeviceClock.quality."""
        return self._stream.clock

    def read(self) -> Frames:
        """Frames that came since the last call; waits `timeout_ms` at most for them."""
        if self._link is None and not self._connect():
            return Frames.empty(self._format)
        begun = self._clock.now_ns()
        data = self._transfer()
        now = self._clock.now_ns()
        # a read that took longer than it was told to had no processor: the skin may have sent all the while
        self._quiet_ns += min(now - begun, self._config.timeout_ms * 1_000_000)
        frames = Frames.empty(self._format)
        if data:
            if self._tap:
                self._tap.transfer(now, data)
            frames = self._frames(data, now)
        if len(frames):
            self._quiet_ns = 0
        self._check_silence()
        return frames

    def close(self) -> None:
        """Stop the board and let it go."""
        if self._link:
            board, self._link = self._link, None
            board.close()

    def _connect(self) -> bool:
        """Find, open, check and start the board; False and a state where that fails."""
        now = self._clock.now_ns()
        if now < self._retry_ns:
            self._clock.sleep_until(min(self._retry_ns, now + self._config.timeout_ms * 1_000_000))
            return False
        try:
            self._link = usb_link.open_board(self._config, self._backend, self._clock)
            self.identity = self._check(self._link)
            self._link.request(packets.Request.START, 0)
        except SensorError as e:
            self._drop(e)
            return False
        except usb.core.USBError as e:
            self._drop(usb_link.explain(e))
            return False
        self._stream.restart()
        self._quiet_ns = 0
        self._set_state("streaming", None)
        return True

    def _check(self, board: usb_link.VendorLink) -> packets.Identity:
        """Compare the board's identity and format with what this box and its bundle can use."""
        try:
            who = packets.unpack_identity(board.request(packets.Request.IDENTITY, 64))
            if who.protocol != packets.VERSION:
                raise SensorMismatch(
                    f"the skin's firmware {'.'.join(map(str, who.firmware))} speaks protocol {who.protocol}, "
                    f"this box speaks {packets.VERSION}; update the older of them"
                )
            skin = packets.unpack_format(board.request(packets.Request.FORMAT, 64))
        except FormatError as e:
            raise SensorMismatch(f"the skin does not answer as PROTOCOL.md says: {e}") from e
        f = self._format
        if (skin.rows, skin.cols, skin.dtype) != f.skin or abs(skin.rate_hz / f.rate_hz - 1) > RATE_TOLERANCE:
            raise SensorMismatch(
                f"the skin sends {skin.rows}x{skin.cols} {skin.dtype} at {skin.rate_hz:g} Hz, the bundle wants {f}; "
                "plug in the skin that it was trained for, or deploy a bundle for this one"
            )
        return who

    def _transfer(self) -> bytes:
        """One bulk transfer; b"" where nothing came, and a dropped link where the board has failed."""
        assert self._link
        try:
            return self._link.read(self._config.read_bytes, self._config.timeout_ms)
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as e:
            if e.errno == errno.EOVERFLOW:
                # more bytes than were asked for: this transfer is gone, the sequence numbers will say what was in it
                self.tally.overflows += 1
            else:
                self._drop(usb_link.explain(e))
            return b""

    def _frames(self, data: bytes, now_ns: int) -> Frames:
        try:
            return self._stream.feed(data, now_ns)
        except SensorMismatch as e:
            self._drop(e)
            return Frames.empty(self._format)

    def _check_silence(self) -> None:
        """Start a board anew that is there but has sent no whole packet in `silence_ms` of listening."""
        quiet_ms = self._quiet_ns // 1_000_000
        if self._link and quiet_ms > self._config.silence_ms:
            self._drop(SensorSilent(f"the skin is there but sent no frame for {quiet_ms} ms; starting it again"))

    def _drop(self, why: SensorError) -> None:
        """Let the board go, remember why, and try again after `retry_ms`."""
        self.close()
        self._retry_ns = self._clock.now_ns() + self._config.retry_ms * 1_000_000
        self._set_state(why.state, why)

    def _set_state(self, state: str, trouble: SensorError | None) -> None:
        if self._tap and state != self.state:
            self._tap.state(self._clock.now_ns(), state)
        self.state, self.trouble = state, trouble
