"""A skin whose readout board speaks PROTOCOL.md: bytes of a link become Frames. The skin may be
unplugged and plugged in again.

`read` does not raise for a failure of the link. It then returns no frames, `state` and `trouble`
give the reason, and it tries again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from palpate.core.clock import Clock, DeviceClock
from palpate.core.config import SkinConfig
from palpate.core.errors import (
    FormatError,
    SensorError,
    SensorLost,
    SensorMismatch,
    SensorOverflow,
    SensorSilent,
)
from palpate.core.types import EPOCH_BITS, EPOCHS, Frames, SweepFormat, shown
from palpate.io import packets
from palpate.io.sensor import (
    OPENED,
    FrameStream,
    Readable,
    SensorCounters,
    SkinLink,
    TransferObserver,
)

RATE_TOLERANCE = 0.01
"""Largest relative difference of the board's rate from the bundle's, for crystals and timers."""
STAMPS_NS = 5_000_000
"""Largest jitter of the time stamps. The readout board may count milliseconds, or be delayed by an
interrupt; windows do not move by that."""

PROOF_NS = 5_000_000_000
"""Time in which a skin that announces nothing can turn out to be the wrong skin. If it does, it
must then send frames for as long without a fault before it counts as streaming. Otherwise READY
would come and go with a wrong skin."""

MOST_SILENCE_MS = 8000
"""Longest wait for the first frame of an opened skin, unless `skin.silence_ms` is longer."""
LONGER = f"waiting longer each time, up to {MOST_SILENCE_MS / 1000:g} s (skin.silence_ms for more)"
MOST_RESTARTS, RESTARTS_NS = 8, 1_000_000_000
"""A readout board that begins its count anew so often within this time is faulty."""

_COUNT = np.arange(packets.MAX_FRAMES, dtype=np.int64)


class Stream:
    """Converts the bytes of a readout board to Frames with unwrapped numbers and host times. It
    does no I/O, and counts damaged data. unpack: finds the packets in bytes, as `packets.unpack`
    does."""

    loss_known = True
    misfit = ""

    def __init__(
        self,
        format: SweepFormat,
        counters: SensorCounters,
        unpack: Callable[[bytes], packets.Unpacked] = packets.unpack,
    ) -> None:
        self._format, self._counters, self._unpack = format, counters, unpack
        self._shape, self._dtype = format.shape, format.numpy_type
        # time of frame i of a packet after its first
        self._within_ns = np.rint(_COUNT * format.period_ns).astype(np.int64)
        self._position = packets.StreamPosition(-1)
        self._device = DeviceClock()
        self._leftover = b""
        # times at which the board restarted its count, the newest MOST_RESTARTS
        self._begun_ns: deque[int] = deque(maxlen=MOST_RESTARTS)
        # (number, device ns) of a frame at most a second ago
        self._mark: tuple[int, int] | None = None

    def restart(self) -> None:
        """Begin an enumeration: frame numbers get the next epoch, the clock starts again."""
        self._counters.enumerations += 1
        self._position = packets.StreamPosition((self._position.epoch + 1) % EPOCHS)
        self._begun_ns.clear()
        self._device, self._mark = DeviceClock(), None
        self._leftover = b""

    @property
    def clock(self) -> dict[str, float] | None:
        return self._device.quality()

    def feed(self, data: bytes, arrival_ns: int) -> Frames:
        """The frames of a transfer that ended at `arrival_ns`. Raises SensorMismatch if they have
        another format, or if the device clock disagrees with the frame count."""
        unpacked = self._unpack(self._leftover + data)
        self._leftover = unpacked.leftover
        self._counters.garbage_bytes += unpacked.garbage
        for p in unpacked.packets:
            if p.taxels.shape[1:] != self._shape or p.taxels.dtype != self._dtype:
                sent = f"{shown(p.taxels.shape[1:])} {p.taxels.dtype}"
                raise SensorMismatch(
                    f"the skin sent {sent}, but it had announced {self._format}; check its firmware"
                )
            self._counters.fifo_overflows += bool(p.flags & packets.Flag.OVERFLOW.value)
        fresh, position, lost, stale = packets.follow(unpacked.packets, self._position)
        restarts = (position.epoch - self._position.epoch) % EPOCHS
        self._position = position
        if restarts:
            self._device, self._mark = DeviceClock(), None
            self._check_restarts(restarts, arrival_ns)
        now = [item for item in fresh if item[0] >> EPOCH_BITS == position.epoch]
        # frames from before a restart within the same transfer have no host time and count as lost
        kept, all_frames = (sum(len(p.taxels) for _, p in of) for of in (now, fresh))
        self._counters.lost_frames += lost + all_frames - kept
        self._counters.stale_frames += stale
        return self._stamp(now, arrival_ns)

    def _check_restarts(self, restarts: int, now_ns: int) -> None:
        """Raises SensorMismatch if the count of frames begins anew again and again."""
        self._begun_ns.extend([now_ns] * min(restarts, MOST_RESTARTS))
        full = len(self._begun_ns) == MOST_RESTARTS
        if full and now_ns - self._begun_ns[0] < RESTARTS_NS:
            often = f"the skin began its count of frames anew {MOST_RESTARTS} times within a second"
            raise SensorMismatch(f"{often}; check its firmware")

    def _stamp(self, fresh: list[tuple[int, packets.Packet]], arrival_ns: int) -> Frames:
        """Give numbers and host times to packets [(first number, packet)] of one epoch."""
        if not fresh:
            return Frames.empty(self._format)
        starts = [self._device.unwrap(p.t_us) * 1000 for _, p in fresh]
        for start, (first, _) in zip(starts, fresh, strict=True):
            self._check_pace(first, start)
        last = int(self._within_ns[len(fresh[-1][1].taxels) - 1])
        self._device.update(starts[-1] + last, arrival_ns)
        runs = []
        for start, (first, p) in zip(starts, fresh, strict=True):
            n = len(p.taxels)
            self._counters.frames += n
            t_ns = self._device.to_host_ns(start) + self._within_ns[:n]
            runs.append(Frames(t_ns, first + _COUNT[:n], p.taxels))
        return runs[0] if len(runs) == 1 else Frames.joined(runs)

    def _check_pace(self, first: int, start_ns: int) -> None:
        """Compare the device clock with the frame count. If they disagree, host times and windows
        are wrong. The reference is a frame up to one second ago, so a jump of either is detected at
        once, and a wrong rate within that second. Raises SensorMismatch."""
        self._mark = self._mark or (first, start_ns)
        counted_ns = round((first - self._mark[0]) * self._format.period_ns)
        passed_ns = start_ns - self._mark[1]
        slack_ns = max(STAMPS_NS, self._format.period_ns) + RATE_TOLERANCE * counted_ns
        if abs(passed_ns - counted_ns) > slack_ns:
            wanted_hz = self._format.rate_hz
            hz = wanted_hz * counted_ns / max(passed_ns, 1)
            raise SensorMismatch(
                f"the skin's clock went on {passed_ns / 1e6:.1f} ms during frames of "
                f"{counted_ns / 1e6:.1f} ms: {hz:.4g} frames a second, not {wanted_hz:g}; "
                "starting it again, check its firmware or skin.rate_hz if this stays"
            )
        if counted_ns >= 1_000_000_000:
            self._mark = first, start_ns


class LinkSensor(ABC):
    """The part of a sensor that is common to all skins behind a link.

    States: `streaming`, from the first frame on; or `absent`, `busy`, `denied`, `mismatch`, `lost`,
    `silent`, with a remedy in `trouble`. A skin that is plugged in again begins a new enumeration:
    its frames get a new epoch in `seq` and a new clock. announced: the skin reports its format when
    it is opened.
    """

    announced = True

    def __init__(
        self,
        config: SkinConfig,
        format: SweepFormat,
        clock: Clock,
        stream: Callable[[SensorCounters], FrameStream],
        tap: TransferObserver | None = None,
    ) -> None:
        self.state = "absent"
        self.trouble: SensorError | None = None
        self.identity: packets.Identity | None = None
        self.counters = SensorCounters()
        self._config, self._format, self._clock, self._tap = config, format, clock, tap
        self._stream = stream(self.counters)
        self._link: Readable | None = None
        self._retry_ns = clock.now_ns()
        self._quiet_ns = 0  # time since the last frame, or since the skin was opened
        self._read_ns = 0  # end of the last read
        self._unheard = 0  # bytes since then
        self._framed = False  # a frame came since it was opened
        self._patience = 1  # a board that boots when it is opened is waited for longer each time
        self._opened_ns = 0
        self._proof_ns = 0  # frames must come for this long before the skin counts as streaming

    @property
    def clock(self) -> dict[str, float] | None:
        return self._stream.clock

    @property
    def loss_known(self) -> bool:
        return self._stream.loss_known

    def read(self) -> Frames:
        """The frames since the last call; waits at most `timeout_ms`."""
        if self._link is None and not self._connect():
            return Frames.empty(self._format)
        data = self._transfer()
        now = self._clock.now_ns()
        # since the last read: the examination of garbage takes time, too. A turn that took longer
        # than the timeout was not scheduled, and the skin may have been sending
        self._quiet_ns += min(now - self._read_ns, self._config.timeout_ms * 1_000_000)
        self._read_ns = now
        frames, before = Frames.empty(self._format), self.counters.frames
        wrong: SensorMismatch | None = None
        if data:
            self._unheard += len(data)
            try:
                frames = self._stream.feed(data, now)
            except SensorMismatch as e:
                wrong = e
            except Exception as e:  # bytes that nobody thought of
                wrong = SensorMismatch(f"the skin's bytes cannot be read ({_named(e)})")
        if self.counters.frames > before and not wrong:
            if not self._framed and self._quiet_ns <= self._config.silence_ms * 1_000_000:
                self._patience = 1
            self._framed = True
            self._quiet_ns = self._unheard = 0
            if self.state != "streaming" and self._proven(now):
                self._set_state("streaming", None)
        if data and self._tap:  # after the state, which a replay needs before these frames
            self._tap.transfer(now, data)
        if wrong:
            early = now - self._opened_ns < PROOF_NS
            self._drop(wrong, PROOF_NS if early and not self.announced else 0)
        self._check_silence()
        return frames if self.state == "streaming" else Frames.empty(self._format)

    def _proven(self, now_ns: int) -> bool:
        """Whether a skin that sends frames counts as streaming."""
        return now_ns - self._opened_ns >= self._proof_ns

    def close(self) -> None:
        if self._link:
            link, self._link = self._link, None
            link.close()

    @abstractmethod
    def _open(self) -> tuple[Readable, packets.Identity]:
        """Find, open, check and start the skin. Raises SensorError, with nothing left open."""

    def _no_frame(self, *, bytes_came: bool) -> SensorError:
        """The trouble of a skin that sent no frame for `silence_ms`. bytes_came: it sent other
        bytes. The message contains no measured figure, so that the log shows it once."""
        longer = "" if self._framed else f"; {LONGER}"
        return SensorSilent(
            f"the skin is there but sent no frame for {self._config.silence_ms} ms; "
            f"starting it again{longer}"
        )

    def _connect(self) -> bool:
        """Find, open, check and start the skin; False, with state and trouble, if it fails."""
        now = self._clock.now_ns()
        if now < self._retry_ns:
            timeout_ns = self._config.timeout_ms * 1_000_000
            self._clock.sleep_until(min(self._retry_ns, now + timeout_ns))
            return False
        try:
            self._link, self.identity = self._open()
        except SensorError as e:
            self._drop(e)
            return False
        except Exception as e:  # of libusb, pyserial or the system, which have many
            self._drop(SensorLost(f"the skin cannot be opened ({_named(e)}); trying again"))
            return False
        self._stream.restart()
        self._quiet_ns = self._unheard = 0
        self._framed = False
        self._opened_ns = self._read_ns = self._clock.now_ns()
        if self._tap:
            self._tap.state(self._opened_ns, OPENED)
        return True

    def _transfer(self) -> bytes:
        """The bytes of one read, b"" if none came. A link that has failed is dropped."""
        assert self._link
        try:
            return self._link.read(self._config.read_bytes, self._config.timeout_ms)
        except SensorOverflow:
            self.counters.overflows += 1  # sequence numbers show how many frames it held
        except SensorError as e:
            self._drop(e)
        except Exception as e:  # as in _connect
            self._drop(SensorLost(f"the skin cannot be read ({_named(e)}); trying again"))
        return b""

    def _check_silence(self) -> None:
        """Open a skin again that has sent no complete frame in `silence_ms` of reading. Before its
        first frame the time is longer at each attempt: a board may boot whenever it is opened."""
        silence_ms = self._config.silence_ms
        most_ms = silence_ms if self._framed else silence_ms * self._patience
        if self._link and self._quiet_ns > most_ms * 1_000_000:
            if not self._framed and 2 * most_ms <= max(silence_ms, MOST_SILENCE_MS):
                self._patience *= 2
            self._drop(self._no_frame(bytes_came=self._unheard > 0))

    def _drop(self, why: SensorError, proof_ns: int = 0) -> None:
        """Release the skin, keep the reason, and try again after `retry_ms`. proof_ns: the skin
        then counts as streaming only after it has sent frames for this long; 0: with its first
        frame."""
        with suppress(Exception):  # the device is gone, and with it what closing would tell it
            self.close()
        self._proof_ns = proof_ns
        self._retry_ns = self._clock.now_ns() + self._config.retry_ms * 1_000_000
        self._set_state(why.state, why)

    def _set_state(self, state: str, trouble: SensorError | None) -> None:
        if self._tap and state != self.state:
            self._tap.state(self._clock.now_ns(), state)
        self.state, self.trouble = state, trouble


def _named(e: Exception) -> str:
    return f"{type(e).__name__}: {e}"


def fits(skin: packets.SkinFormat | SweepFormat, wanted: SweepFormat) -> bool:
    """Whether the frames of a skin suit a bundle or a recording; windows are cut here."""
    same_rate = abs(skin.rate_hz / wanted.rate_hz - 1) <= RATE_TOLERANCE
    return (skin.shape, skin.dtype) == wanted.skin and same_rate


class UsbSensor(LinkSensor):
    """A skin whose readout board speaks PROTOCOL.md, part 1, on USB or on a serial port."""

    def __init__(
        self,
        config: SkinConfig,
        format: SweepFormat,
        clock: Clock,
        backend: Any = None,
        tap: TransferObserver | None = None,
    ) -> None:
        super().__init__(config, format, clock, lambda counters: Stream(format, counters), tap)
        self._backend = backend

    def _open(self) -> tuple[SkinLink, packets.Identity]:
        link = open_link(self._config, self._backend, self._clock)
        try:
            who, skin = ask(link)
            if not fits(skin, self._format):
                sends = f"{shown(skin.shape)} {skin.dtype} at {skin.rate_hz:g} Hz"
                raise SensorMismatch(
                    f"the skin sends {sends}, wanted is {self._format}; plug in the skin that it "
                    "was trained for, or deploy a bundle for this one"
                )
            link.request(packets.Request.START, 0)
        except Exception:
            link.close()
            raise
        return link, who


def ask(board: SkinLink) -> tuple[packets.Identity, packets.SkinFormat]:
    """Identity and format of a board. Raises SensorMismatch for other replies or versions."""
    try:
        who = packets.unpack_identity(board.request(packets.Request.IDENTITY, 64))
        if who.protocol != packets.VERSION:
            firmware = f"the skin's firmware {'.'.join(map(str, who.firmware))}"
            raise SensorMismatch(
                f"{firmware} speaks protocol {who.protocol}, this box speaks {packets.VERSION};"
                " update the older of them"
            )
        return who, packets.unpack_format(board.request(packets.Request.FORMAT, 64))
    except FormatError as e:
        raise SensorMismatch(
            f"the skin does not answer as PROTOCOL.md says: {e}; update its firmware"
        ) from e


def open_link(config: SkinConfig, backend: Any, clock: Clock) -> SkinLink:
    """Find and open the configured readout board. Raises SensorError."""
    # imported when it is used, since most boxes use one kind of link
    if config.link == "serial":
        from palpate.io import serial_link

        return serial_link.open_readout(config, clock)
    from palpate.io import usb_link

    return usb_link.open_readout(config, backend, clock)
