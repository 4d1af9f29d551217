"""Turns edges of the robot's GPIO lines, time-stamped by the kernel, into START, STOP and NEW
OBJECT, debounced and in order of time.

Edges that the kernel dropped, or that came in a storm, are reported as LOST and not guessed.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from palpate.core.types import Edge, EdgeKind
from palpate.io.gpio_lines import check_binding, line_error, naming, request_lines

if TYPE_CHECKING:
    from gpiod import EdgeEvent, LineRequest

    from palpate.core.config import TriggerConfig


@dataclass(slots=True)
class EdgeCounters:
    """Counts since the program started. glitches: bursts that did not change the level. lost_edges:
    dropped by the kernel because its queue was full. storms: bursts of more than `storm_edges`
    edges."""

    glitches: int = 0
    lost_edges: int = 0
    storms: int = 0


class Trigger(Protocol):
    """The source of trigger edges."""

    def edges(self, now_ns: int) -> list[Edge]:
        """Edges that are settled at `now_ns`, in order of time; never waits."""

    @property
    def edge_counters(self) -> EdgeCounters: ...

    @property
    def about(self) -> dict[str, str]:
        """For sidecars. mode: `trigger.mode`. times: the origin of an edge's time."""

    @property
    def blind(self) -> bool:
        """True after LOST, until the levels are known again."""

    @property
    def due_ns(self) -> int:
        """Time at which a timed trigger starts or stops a sweep next; 0 if that is not planned."""


_Meaning = tuple[EdgeKind | None, EdgeKind | None]
"""The meaning of a falling and of a rising edge of a GPIO line; None: no meaning."""


@dataclass(slots=True)
class _Line:
    """An input: its request, its settled level, and the burst of edges that has not settled yet."""

    request: LineRequest
    offset: int
    name: str
    meaning: _Meaning
    seqno: int = 0  # of the newest event
    known_ns: int = 0  # all events up to this time were read
    level: bool = False
    count: int = 0  # edges in the burst
    first_ns: int = 0
    last_ns: int = 0
    after: bool = False  # level after the last edge of the burst


class GpioTrigger:
    """Debounces the robot's GPIO lines.

    A burst is a series of edges on one line with less than `glitch_us` between neighbours. It is
    settled `glitch_us` after its last edge. If the level then differs from the level before, the
    burst was one edge, with the time stamp of the first; otherwise it was a glitch. A clean edge is
    therefore reported `glitch_us` late but with its exact time (the kernel's own debouncing would
    shift the time stamp). An edge waits for older bursts on other lines, so that edges are always
    in order of time.

    A call reads at most `storm_edges` events. Raises LineError if lines cannot be found, requested
    or read.
    """

    due_ns = 0

    def __init__(self, config: TriggerConfig, gpio: Any) -> None:
        check_binding(gpio)
        self._glitch_ns = config.glitch_us * 1000
        self._storm_edges = config.storm_edges
        self.edge_counters = EdgeCounters()
        self.about = {"mode": config.mode, "times": "edge, stamped by the kernel"}
        self._pending: list[Edge] = []
        # newest edge since the levels became unknown; None: they are known
        self._blind_ns: int | None
        roles = _roles(config)
        with ExitStack() as stack:
            # separate requests: with several lines in a request, the interrupt handler counts an
            # edge and its thread delivers it. Of two edges before the thread has run, one count is
            # never delivered, so each bounce would look like a loss
            meaning, settings = dict(roles), _input_settings(config, gpio)
            names = [name for name, _ in roles]
            requests = request_lines(gpio, names, settings, stack, separate=True)
            self._lines = [
                _Line(r, o, name, meaning[name])
                for r, found in requests
                for o, name in found.items()
            ]
            self._active, self._rising = gpio.line.Value.ACTIVE, gpio.EdgeEvent.Type.RISING_EDGE
            self._read_levels()
            self._open = stack.pop_all()

    @property
    def blind(self) -> bool:
        """True from LOST until all lines have been quiet and their levels are known again."""
        return self._blind_ns is not None

    def edges(self, now_ns: int) -> list[Edge]:
        """Edges that are settled at `now_ns`, in order of time; never waits."""
        for line in self._lines:
            try:  # not `naming`: its generator costs more than reading an empty queue
                self._read(line, now_ns)
            except OSError as e:
                raise line_error("read", [line.name], e) from e
        waiting = self._pending or any(line.count for line in self._lines)
        if self._blind_ns is None and not waiting:
            return []
        horizon_ns = min(line.known_ns for line in self._lines)
        for line in self._lines:
            if line.count and horizon_ns - line.last_ns >= self._glitch_ns:
                self._settle(line)
        # the levels are read now, so all events that led to them must have been read before
        quiet_ns = 0 if self._blind_ns is None else self._blind_ns + self._glitch_ns
        if self._blind_ns is not None and horizon_ns >= max(now_ns, quiet_ns):
            self._read_levels()
        until_ns = min([horizon_ns, *(line.first_ns for line in self._lines if line.count)])
        self._pending.sort(key=lambda edge: edge.t_ns)
        due = [edge for edge in self._pending if edge.t_ns <= until_ns]
        del self._pending[: len(due)]
        return due

    def close(self) -> None:
        """Release the lines."""
        self._open.close()

    def _read(self, line: _Line, now_ns: int) -> None:
        """Read one line's share of the `storm_edges` events of a call."""
        left = max(1, self._storm_edges // len(self._lines))
        while left > 0 and line.request.wait_edge_events(0):
            events = line.request.read_edge_events(left)
            left -= len(events)
            for event in events:
                self._take(line, event)
        if left > 0:
            line.known_ns = max(line.known_ns, now_ns)

    def _take(self, line: _Line, event: EdgeEvent) -> None:
        t_ns = event.timestamp_ns
        dropped = (event.line_seqno - line.seqno - 1) % 2**32  # the kernel counts in 32 bits
        line.seqno, line.known_ns = event.line_seqno, max(line.known_ns, t_ns)
        if dropped:
            self.edge_counters.lost_edges += dropped
            self._lose(t_ns)
        if self._blind_ns is not None:
            self._blind_ns = max(self._blind_ns, t_ns)
            return
        if line.count and t_ns - line.last_ns >= self._glitch_ns:
            self._settle(line)
        if not line.count:
            line.first_ns = t_ns
        # a rise may follow a rise: the kernel reads the level only after the interrupt, so the
        # level of the newest event is right
        line.count, line.last_ns = line.count + 1, t_ns
        line.after = event.event_type is self._rising
        if line.count > self._storm_edges:
            self.edge_counters.storms += 1
            self._lose(t_ns)

    def _settle(self, line: _Line) -> None:
        """The burst has ended: report an edge if it changed the level."""
        line.count = 0
        if line.after == line.level:
            self.edge_counters.glitches += 1
            return
        line.level = line.after
        if kind := line.meaning[line.level]:
            self._pending.append(Edge(kind, line.first_ns))

    def _lose(self, t_ns: int) -> None:
        """Report LOST at `t_ns` and discard later edges on all lines."""
        if self._blind_ns is None:
            certain = [edge for edge in self._pending if edge.t_ns <= t_ns]
            self._pending, self._blind_ns = [*certain, Edge(EdgeKind.LOST, t_ns)], t_ns
        for line in self._lines:
            line.count = 0

    def _read_levels(self) -> None:
        """Start again from the lines' present levels."""
        for line in self._lines:
            with naming("read", [line.name]):
                line.level = line.request.get_values([line.offset]) == [self._active]
        self._blind_ns = None


def _roles(config: TriggerConfig) -> list[tuple[str, _Meaning]]:
    """Each wired line with the meaning of its falling and of its rising edge."""
    if config.mode == "one-line":
        roles: list[tuple[str, _Meaning]] = [(config.start, (EdgeKind.STOP, EdgeKind.START))]
    else:
        roles = [(config.start, (None, EdgeKind.START)), (config.stop, (None, EdgeKind.STOP))]
    if config.new_object:
        roles.append((config.new_object, (None, EdgeKind.NEW_OBJECT)))
    return roles


def _input_settings(config: TriggerConfig, gpio: Any) -> Any:
    """Both edges, time-stamped by the kernel with the monotonic clock, not debounced. An open input
    is pulled to its inactive level: a broken wire starts no sweep."""
    bias = gpio.line.Bias
    return gpio.LineSettings(
        direction=gpio.line.Direction.INPUT,
        edge_detection=gpio.line.Edge.BOTH,
        event_clock=gpio.line.Clock.MONOTONIC,
        bias=bias.PULL_UP if config.active_low else bias.PULL_DOWN,
        active_low=config.active_low,
    )
