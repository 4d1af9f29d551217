"""Simulated GPIO: a double of the module gpiod (libgpiod v2) below the real trigger and output
drivers.

It gives edge events as the kernel queues and drops them, and lists the levels written to outputs.
Chips, lines and requests are simulated; enums, settings, events and errors are gpiod's own.
"""

from __future__ import annotations

import heapq
import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping, MutableSequence, Sequence
from contextlib import nullcontext
from itertools import count
from types import SimpleNamespace

import gpiod
from gpiod.line import Bias, Direction, Edge, Value

from palpate.core.clock import Clock

EventType = gpiod.EdgeEvent.Type
RequestConfig = Mapping[Iterable[int], gpiod.LineSettings]  # offsets on a chip -> their settings


class SimGpio:
    """Replaces the module gpiod. chips: path (/dev/gpiochip0 and so on) -> names of its lines, ''
    for an unnamed line.

    written: (t_ns, name, level) of each level that was written to an output, in order; empty
    without `remember`. requests: the present line requests. watchers: output line -> function that
    is called with the time when the box raises the line. refuse: path -> errno that a chip raises
    from now on: 13 permission denied, 19 unplugged.
    """

    __version__ = "sim"
    LineSettings = gpiod.LineSettings
    EdgeEvent = gpiod.EdgeEvent
    line = gpiod.line

    def __init__(
        self, clock: Clock, chips: Mapping[str, Sequence[str]], *, remember: bool = True
    ) -> None:
        self.written: MutableSequence[tuple[int, str, bool]] = [] if remember else deque(maxlen=0)
        self.requests: list[SimRequest] = []
        self.refuse: dict[str, int] = {}
        self.watchers: dict[str, Callable[[int], None]] = {}
        self._clock, self._chips = clock, chips
        self._driven: dict[str, bool] = {}
        self._plan, self._order = list[tuple[int, int, str, bool]](), count()

    def drive(self, name: str, level: bool, t_ns: int) -> None:
        """Schedule `level` of the input `name` for `t_ns`, also the edge's time stamp."""
        if not any(name in names for names in self._chips.values()):
            raise ValueError(f"no simulated gpio line is named {name!r}; add it to chips")
        heapq.heappush(self._plan, (t_ns, next(self._order), name, bool(level)))

    def forget(self, name: str, t_ns: int) -> None:
        """Cancel the levels scheduled for `name` at `t_ns` and later."""
        self._plan = [item for item in self._plan if item[2] != name or item[0] < t_ns]
        heapq.heapify(self._plan)

    def is_gpiochip_device(self, path: str) -> bool:
        return path in self._chips

    def Chip(self, path: str) -> nullcontext[SimpleNamespace]:
        """As in gpiod, with the methods that are needed to find lines by name."""
        self.check(path)
        names = self._chips[path]
        info = gpiod.ChipInfo(os.path.basename(path), "palpate-sim", len(names))
        lines = [SimpleNamespace(name=name) for name in names]
        return nullcontext(SimpleNamespace(get_info=lambda: info, get_line_info=lines.__getitem__))

    def request_lines(
        self, path: str, config: RequestConfig, consumer: str = "", event_buffer_size: int = 0
    ) -> SimRequest:
        self.now_ns()
        self.check(path)
        settings = {
            offset: line_settings for offsets, line_settings in config.items() for offset in offsets
        }
        names = {offset: self._chips[path][offset] for offset in settings}
        held = (r for r in self.requests if r.path == path)
        if any(request.names.keys() & names.keys() for request in held):
            raise OSError(16, os.strerror(16))
        levels = {
            o: self._driven.get(name, settings[o].bias is Bias.PULL_UP) for o, name in names.items()
        }
        self.requests.append(SimRequest(self, path, names, settings, levels, event_buffer_size))
        return self.requests[-1]

    def now_ns(self) -> int:
        """The present time, after all levels scheduled up to it were set."""
        now_ns = self._clock.now_ns()
        while self._plan and self._plan[0][0] <= now_ns:
            t_ns, _, name, level = heapq.heappop(self._plan)
            self._driven[name] = level
            for request in self.requests:
                request.notice(name, level, t_ns)
        return now_ns

    def check(self, path: str) -> None:
        """Raises OSError if the chip is set to refuse."""
        if path in self.refuse:
            raise OSError(self.refuse[path], os.strerror(self.refuse[path]), path)


class SimRequest:
    """As gpiod's LineRequest. queue: the kernel's; when full it drops its oldest event."""

    def __init__(
        self,
        gpio: SimGpio,
        path: str,
        names: dict[int, str],
        settings: dict[int, gpiod.LineSettings],
        levels: dict[int, bool],
        size: int,
    ) -> None:
        self.path, self.names, self.settings = path, names, settings
        # the kernel's limit; it rounds up to a power of two
        size = min(size or 16 * len(names), 1024)
        self.queue: deque[gpiod.EdgeEvent] = deque(maxlen=1 << (size - 1).bit_length())
        self._gpio, self._levels = gpio, levels
        self._seqno, self._line_seqno = count(1), {offset: count(1) for offset in names}

    def notice(self, name: str, level: bool, t_ns: int) -> None:
        """An input has a new level: queue an event if that is an edge of the requested kind."""
        for offset in (o for o, n in self.names.items() if n == name and self._levels[o] != level):
            self._levels[offset] = level
            rise = level != self.settings[offset].active_low
            wanted = Edge.RISING if rise else Edge.FALLING
            if self.settings[offset].edge_detection in (Edge.BOTH, wanted):
                event_type = EventType.RISING_EDGE if rise else EventType.FALLING_EDGE
                numbers = next(self._seqno), next(self._line_seqno[offset])
                self.queue.append(gpiod.EdgeEvent(event_type.value, t_ns, offset, *numbers))

    def wait_edge_events(self, timeout: float) -> bool:
        """As in gpiod with timeout 0: whether there is an event to read."""
        self._now_ns()
        return bool(self.queue)

    def read_edge_events(self, max_events: int) -> list[gpiod.EdgeEvent]:
        """As in gpiod, but raises RuntimeError instead of waiting for ever."""
        if not self.wait_edge_events(0):
            raise RuntimeError("reading from an empty queue blocks; ask wait_edge_events(0) before")
        return [self.queue.popleft() for _ in range(min(max_events, len(self.queue)))]

    def get_values(self, lines: Iterable[int]) -> list[Value]:
        self._now_ns()
        return [
            Value.ACTIVE if self._levels[o] != self.settings[o].active_low else Value.INACTIVE
            for o in lines
        ]

    def set_values(self, values: Mapping[int, Value]) -> None:
        now_ns = self._now_ns()
        for offset, value in values.items():
            self._levels[offset] = (value is Value.ACTIVE) != self.settings[offset].active_low
            self._gpio.written.append((now_ns, self.names[offset], self._levels[offset]))
            if self._levels[offset] and self.names[offset] in self._gpio.watchers:
                self._gpio.watchers[self.names[offset]](now_ns)

    def release(self) -> None:
        """As in gpiod; an output becomes an input, and its pull-down sets it low."""
        self._gpio.requests.remove(self)
        for offset, name in self.names.items():
            if self.settings[offset].direction is Direction.OUTPUT and self._levels[offset]:
                self._gpio.written.append((self._gpio.now_ns(), name, False))

    def _now_ns(self) -> int:
        if self not in self._gpio.requests:
            raise gpiod.RequestReleasedError
        self._gpio.check(self.path)
        return self._gpio.now_ns()
