"""Converts the bytes of a skin of any profile to Frames with numbers and host times, and counts
lost frames. It does no I/O.

A skin with a clock and a frame count is handled as PROTOCOL.md defines (`usb_sensor.Stream`). For
all others, frames are numbered in the order of arrival, and their times are fitted to their
arrivals.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.clock import DeviceClock
from palpate.core.errors import SensorMismatch
from palpate.core.types import EPOCH_BITS, EPOCHS, Frames, SweepFormat
from palpate.io import packets, skin_codecs
from palpate.io.sensor import TTY_BYTES, FrameStream, SensorCounters
from palpate.io.skin_codecs import Codec, Decoded, Rest
from palpate.io.skin_profile import SkinProfile
from palpate.io.usb_sensor import Stream

RATE_WANDER = 0.05
"""Largest relative difference between the measured rate and the expected rate. Oscillators of
microcontrollers differ by 1 %, their loops by a little more. From 5 % on, a texture would be taken
for another that is finer or coarser by as much."""
_FIT = {"settle_s": 0.5, "span_s": 2.5, "step_s": 0.1, "max_ppm": 1.2e6 * RATE_WANDER}
"""Parameters of the fit of arrivals (DeviceClock). It looks back only a short time, so that a loop
that slows down by 2 % is followed once it is 20 ms late."""
SUSPECT_NS, SUSPECT_FRAMES = 60_000_000, 3
"""Frames later than this are held back until it is known whether frames before them are missing."""
_STEP_NS, _STEP_FRAMES = 250_000_000, 8
"""Length of the steps in which arrivals are judged."""
_STEPS = 8
_SLACK_NS = 5_000_000
"""Delays up to this come from USB and from the host, not from the skin."""
_SAME_NS = 2_000_000
"""Lateness counts as constant if it differs by less than this from one step to the next."""
_STEADY = 0.25
"""Largest relative difference between the paces of steps that are compared."""
_PARTLY = 0.75
"""Garbage counts as one more lost frame if a quarter of a frame is left over."""


def stream(profile: SkinProfile, format: SweepFormat, counters: SensorCounters) -> FrameStream:
    """The stream for a profile and the format of its sweeps."""
    if profile.codec == "palpate":
        return Stream(format, counters)
    codec = skin_codecs.codec(profile)
    if not profile.lacks:
        return Stream(format, counters, partial(_packets, codec, profile))
    return CountedStream(profile, format, counters)


def _packets(codec: Codec, profile: SkinProfile, data: bytes) -> packets.Unpacked:
    """Frames with count and clock as packets. Raises SensorMismatch for another grid."""
    found = codec(Rest(), data)
    if found.wrong:
        raise SensorMismatch(_of_another(found.wrong))
    made = []
    gaps = np.flatnonzero(found.counts[1:] - found.counts[:-1] != 1) + 1
    for begin, end in pairwise([0, *gaps.tolist(), len(found)]):
        for at in range(begin, end, packets.MAX_FRAMES):
            taxels = found.taxels[at : min(at + packets.MAX_FRAMES, end)]
            made.append(packets.Packet(int(found.counts[at]), int(found.times_us[at]), 0, taxels))
    return packets.Unpacked(made, [], found.garbage, found.rest.data)


def _of_another(why: str) -> str:
    return f"the skin is another one: {why}; correct skin.grid or skin.profile"


class CountedStream:
    """Frames of a skin without a clock, numbered in the order of arrival and timed by a fit of
    their arrivals.

    A frame must not get a time later than its true time. Frames that piled up while the host did
    not read keep the times that follow from their numbers. If the driver has thrown bytes away, all
    later frames stay late. They are held back until that is certain. Then numbering begins a new
    epoch, and the missing frames are counted as far as the lateness shows them.
    """

    def __init__(self, profile: SkinProfile, format: SweepFormat, counters: SensorCounters) -> None:
        self._profile, self._format, self._counters = profile, format, counters
        self._codec, self.misfit = skin_codecs.codec(profile), ""
        self._wrap = 1 << 8 * np.dtype(profile.sequence).itemsize if profile.sequence else 0
        self._epoch, self._count, self._skipped = -1, 0, 0
        self._rest, self._bytes = Rest(), 0
        self._arrivals: deque[tuple[int, int]] = deque()  # (bytes read so far, when)
        self._begin()

    def restart(self) -> None:
        self._counters.enumerations += 1
        self._counters.garbage_bytes += 0 if self._count else self._skipped
        self._begin()

    @property
    def loss_known(self) -> bool:
        return bool(self._wrap)

    @property
    def clock(self) -> dict[str, float] | None:
        return self._fit.quality()

    def feed(self, data: bytes, arrival_ns: int) -> Frames:
        """The frames that are completed by a read that ended at `arrival_ns`. Raises SensorMismatch
        if they have another grid or come at another rate."""
        begin = self._bytes - len(self._rest.data)
        self._bytes += len(data)
        self._arrivals.append((self._bytes, arrival_ns))
        found = self._codec(self._rest, data)
        self._rest = found.rest
        # the first reason stays until a frame comes, so that the log shows it once
        self.misfit = "" if len(found) else self.misfit or found.misfit
        self._counters.foreign_frames += found.foreign
        if found.wrong:
            raise SensorMismatch(_of_another(found.wrong))
        numbers = self._numbered(found)
        if not len(numbers):
            return Frames.empty(self._format)
        arrived_ns = self._arrival(begin + int(found.ends[-1]))
        return self._timed(numbers, found.taxels, arrived_ns, piled=len(data) >= TTY_BYTES)

    def _begin(self) -> None:
        """Begin a new enumeration with the next bytes."""
        self._rest, self._bytes = Rest(), 0
        self._arrivals.clear()
        self._count = self._skipped = 0  # frames so far, garbage after the last
        self._sent: int | None = None  # the last sequence number of the skin
        self._anew()

    def _anew(self) -> None:
        """Begin a new epoch: numbers and times start again."""
        self._epoch = (self._epoch + 1) % EPOCHS
        self._next, self._last_ns = 0, 0
        self._fit = DeviceClock(**_FIT)
        self._watch = ArrivalWatch(self._format.period_ns)
        self._held: list[Frames] = []
        self._fitted = False

    def _numbered(self, found: Decoded) -> NDArray[np.int64]:
        """The number of each frame in this epoch. Counts frames, garbage and missing frames."""
        n, first = len(found), not self._count
        # before the next frame
        before = self._skipped + (int(found.skipped[0]) if n else found.garbage)
        if not n:
            self._skipped = before
            self._counters.garbage_bytes += 0 if first else found.garbage
            return np.empty(0, np.int64)
        self._skipped = found.garbage - int(found.skipped.sum())
        # the rest of a frame that was being sent when the port was opened is not garbage
        uncounted = 0
        if first:
            uncounted = min(before, round(found.size)) - (before - int(found.skipped[0]))
        self._counters.garbage_bytes += found.garbage - uncounted
        if len(found.counts):
            missing = self._gaps(found.counts)
        else:
            skipped = np.array([0 if first else before, *found.skipped[1:]], np.int64)
            missing = (skipped / found.size + _PARTLY).astype(np.int64)
        numbers = self._next + np.cumsum(1 + missing) - 1
        self._next = int(numbers[-1]) + 1
        self._count += n
        self._counters.frames += n
        self._counters.lost_frames += int(missing.sum())
        return numbers

    def _gaps(self, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number of missing sequence numbers before each frame."""
        before = int(counts[0]) - 1 if self._sent is None else self._sent
        self._sent = int(counts[-1])
        return (np.diff(counts, prepend=before) - 1) % self._wrap

    def _arrival(self, end: int) -> int:
        """Time of the read that contains the byte before `end`. A codec may recognize a frame only
        when the next frame comes, so the read can be an earlier read."""
        while self._arrivals[0][0] < end:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def _timed(
        self, numbers: NDArray[np.int64], taxels: NDArray[Any], arrived_ns: int, *, piled: bool
    ) -> Frames:
        """Frames with times, after those held back; empty if these are held back."""
        last = int(numbers[-1])
        late_ns = self._late(last, arrived_ns)
        suspect = late_ns > max(SUSPECT_NS, SUSPECT_FRAMES * self._format.period_ns)
        frames = Frames(self._times(numbers), (self._epoch << EPOCH_BITS) + numbers, taxels)
        missing = self._watch.missing(last, arrived_ns, late_ns, piled=piled)
        if missing:
            self._counters.lost_frames += missing + sum(map(len, self._held)) + len(frames)
            self._anew()
            return Frames.empty(self._format)
        self._check_rate()
        if suspect:
            self._held.append(frames)
            return Frames.empty(self._format)
        held, self._held = self._held, []
        return Frames.joined([*held, frames]) if held else frames

    def _late(self, number: int, arrived_ns: int) -> int:
        """Lateness of a frame in ns. The fit learns from it unless it is far too large."""
        device_ns = round(number * self._format.period_ns)
        if self._fitted:
            late_ns = arrived_ns - self._fit.to_host_ns(device_ns)
            if late_ns > max(SUSPECT_NS, SUSPECT_FRAMES * self._format.period_ns):
                return late_ns
        self._fit.update(device_ns, arrived_ns)
        self._fitted = True
        return arrived_ns - self._fit.to_host_ns(device_ns)

    def _times(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Host times of frames [n], which never run backwards."""
        first, last = int(numbers[0]), int(numbers[-1])
        first_ns, last_ns = (
            self._fit.to_host_ns(number * self._format.period_ns) for number in (first, last)
        )
        within_ns = (numbers - first) * ((last_ns - first_ns) / max(1, last - first))
        t_ns: NDArray[np.int64] = np.maximum(
            first_ns + np.rint(within_ns).astype(np.int64),
            self._last_ns + 1 + np.arange(len(numbers)),
        )
        self._last_ns = int(t_ns[-1])
        return t_ns

    def _check_rate(self) -> None:
        """Compare the measured rate with the expected one. Raises SensorMismatch."""
        pace = self._watch.pace
        if pace and abs(pace - 1) > RATE_WANDER:
            measured_hz, wanted_hz = pace * self._format.rate_hz, self._format.rate_hz
            share = f"{100 * (pace - 1):+.0f} %, at most {100 * RATE_WANDER:g}"
            raise SensorMismatch(
                f"the skin sends {measured_hz:.1f} frames a second, {wanted_hz:g} are expected"
                f" ({share}); set skin.rate_hz for new recordings, or let it send {wanted_hz:g}"
            )


def proven_s(format: SweepFormat) -> float:
    """Time in which a CountedStream sees a wrong rate, in seconds."""
    return (_STEPS + 2) * max(_STEP_NS / 1e9, _STEP_FRAMES / format.rate_hz)


class ArrivalWatch:
    """Decides from arrivals whether uncounted frames are missing, and measures the rate.

    While the host reads a backlog, frames come faster than the skin takes them, and their lateness
    falls. If they come at an even pace and their lateness is constant, the backlog has been read,
    so frames are missing. pace: measured rate as a share of the expected rate, over several steps
    of an even pace; 0 while unknown.
    """

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._step_ns = max(_STEP_NS, round(_STEP_FRAMES * period_ns))
        self._suspect_ns = max(SUSPECT_NS, SUSPECT_FRAMES * period_ns)
        self._begun: tuple[int, int] | None = None  # (number, arrival) of the frame before the step
        self._last_ns = 0  # the arrival before
        self._least_ns = 0
        self._piled = False
        # (frames, time in ns, least lateness in ns)
        self._steps: deque[tuple[int, int, int]] = deque(maxlen=_STEPS)
        self.pace = 0.0

    def missing(self, number: int, arrival_ns: int, late_ns: int, *, piled: bool) -> int:
        """Number of missing frames as far as it is certain, else 0. late_ns: lateness of frame
        `number`. piled: more bytes were waiting when it was read."""
        self.pace = 0.0
        # if the host reads rarely, a frame may have come at any time since the last read
        if self._begun:
            late_ns -= max(0, round(arrival_ns - self._last_ns - 1.5 * self._period_ns))
        self._last_ns = arrival_ns
        if self._begun is None:
            self._begun, self._least_ns = (number, arrival_ns), late_ns
            return 0
        self._least_ns, self._piled = min(self._least_ns, late_ns), self._piled or piled
        passed_ns = arrival_ns - self._begun[1]
        if passed_ns < self._step_ns:
            return 0
        if self._piled:
            self._steps.clear()
        else:
            self._steps.append((number - self._begun[0], passed_ns, self._least_ns))
        self._begun, self._least_ns, self._piled = (number, arrival_ns), late_ns, False
        return self._judge()

    def _judge(self) -> int:
        """Set the pace if it is known; return the number of missing frames."""
        paces = [frames * self._period_ns / passed_ns for frames, passed_ns, _ in self._steps]
        even = max(paces, default=0) < (1 + _STEADY) * min(paces, default=0)
        if even and len(paces) == _STEPS:
            frames, passed_ns = (sum(step[i] for step in self._steps) for i in (0, 1))
            self.pace = frames * self._period_ns / passed_ns
        if len(paces) < 2 or not abs(paces[-1] - 1) < _STEADY or not abs(paces[-2] - 1) < _STEADY:
            return 0
        before_ns, now_ns = self._steps[-2][2], self._steps[-1][2]
        still = abs(now_ns - before_ns) < _SAME_NS
        stays = still and min(before_ns, now_ns) > max(_SLACK_NS, 0.75 * self._period_ns)
        # after several steps at the right pace, frames that are still late will stay late
        stuck = bool(self.pace) and abs(self.pace - 1) <= RATE_WANDER and now_ns > self._suspect_ns
        return max(1, round(now_ns / self._period_ns)) if stays or stuck else 0
