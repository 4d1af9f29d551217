"""The trigger room: GPIO. In: the robot's edges, time-stamped. Out: READY, BUSY, FAULT, class bits and RESULT VALID.

Everything goes through libgpiod v2; the module itself (`import gpiod`, or the simulator's double) is passed in.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol, Self

from .errors import LineError

if TYPE_CHECKING:
    from gpiod import EdgeEvent, LineRequest

    from .clock import Clock
    from .config import OutputConfig, TriggerConfig

MAX_CHIPS = 256
"""The kernel makes no more GPIO devices (GPIO_DEV_MAX)."""
QUEUE = 1024
"""Events that the kernel may hold for one request; it grants no more. Then it drops the oldest."""
OVERTAKING = 16
"""No more events than this overtake one; with more of them here, the one before them was dropped."""

_ADVICE = {
    errno.EACCES: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EPERM: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EBUSY: "another program or driver holds one of them; gpioinfo tells which",
    errno.ENXIO: "one of them cannot raise interrupts; choose another line",
    errno.EINVAL: "the chip may not know this bias; try bias = 'as-is'",
    errno.ENODEV: "the chip is gone; plug it in and start again",
}


def check_binding(gpio: Any) -> None:
    """Raise LineError unless `gpio` is the libgpiod v2 binding or does as it does."""
    if not (hasattr(gpio, "request_lines") and hasattr(gpio, "LineSettings")):
        raise LineError(
            f"module gpiod {getattr(gpio, '__version__', 'of unknown version')} is not the libgpiod v2 binding; "
            "pip install 'gpiod>=2' (Debian's python3-libgpiod 1.6 shadows it: remove it or use a virtual environment)"
        )


def find_lines(gpio: Any, names: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Name -> (path of its chip, offset there), over all chips of this machine.

    Raises LineError for a name given twice, missing or ambiguous, for chips that may not be opened, and for no chip.
    """
    if len(set(names)) < len(names):
        raise LineError(f"a gpio line is given two roles in {', '.join(names)}; give each role its own line")
    places, denied = _catalogue(gpio) if names else ({}, [])
    found = {}
    for name in names:
        match places.get(name, []):
            case [place]:
                found[name] = place
            case []:
                if denied:
                    what, advice = f"may not open {', '.join(denied)} (errno 13)", _ADVICE[errno.EACCES]
                    raise LineError(f"{what}, where gpio line {name!r} might be; {advice}")
                near = get_close_matches(name, places, cutoff=0.5) or sorted(places)[:3]
                raise LineError(f"no gpio line is named {name!r}; nearest: {', '.join(near)}; gpioinfo lists them all")
            case several:
                where = " and ".join(f"{path} line {offset}" for path, offset in several)
                raise LineError(f"gpio line {name!r} is ambiguous: {where}; choose a line whose name is unique")
    return found


def _catalogue(gpio: Any) -> tuple[dict[str, list[tuple[str, int]]], list[str]]:
    """All named lines with their places, and the chips that may not be opened."""
    places: dict[str, list[tuple[str, int]]] = {}
    denied = []
    chips = set()
    for path in filter(gpio.is_gpiochip_device, (f"/dev/gpiochip{n}" for n in range(MAX_CHIPS))):
        try:
            with gpio.Chip(path) as chip:
                info = chip.get_info()
                if info.name in chips:  # a link to a chip that was seen already, as Raspberry Pi OS has
                    continue
                chips.add(info.name)
                for offset in range(info.num_lines):
                    if name := chip.get_line_info(offset).name:
                        places.setdefault(name, []).append((path, offset))
        except PermissionError:
            denied.append(path)
        except OSError as e:
            raise LineError(f"cannot list the gpio lines of {path}: {e}; see the kernel log (dmesg)") from e
    if not chips and not denied:
        raise LineError("this machine has no /dev/gpiochip*; load the driver of its gpio chip or plug in one on USB")
    return places, denied


@contextmanager
def _naming(doing: str, names: Iterable[str]) -> Iterator[None]:
    """Make a LineError that names the lines of any OSError."""
    try:
        yield
    except OSError as e:
        advice = _ADVICE.get(e.errno or 0, "see the kernel log (dmesg)")
        raise LineError(
            f"cannot {doing} gpio lines {', '.join(names)}: {e.strerror} (errno {e.errno}); {advice}"
        ) from e


def _request(
    gpio: Any, names: Sequence[str], settings: Any, stack: ExitStack
) -> list[tuple[LineRequest, dict[int, str]]]:
    """One request per chip, each with {offset: name}; `stack` releases them."""
    chips: dict[str, dict[int, str]] = {}
    for name, (path, offset) in find_lines(gpio, names).items():
        chips.setdefault(path, {})[offset] = name
    requests = []
    for path, lines in chips.items():
        with _naming("request", lines.values()):
            request = gpio.request_lines(path, {tuple(lines): settings}, consumer="palpate", event_buffer_size=QUEUE)
        stack.callback(request.release)
        requests.append((request, lines))
    return requests


class Lines:
    """The box's answer on GPIO; all lines are low at first. An empty name is a line that is not wired.

    Raises LineError where lines cannot be found, requested or written.
    """

    def __init__(self, config: OutputConfig, gpio: Any, clock: Clock) -> None:
        check_binding(gpio)
        self._ready, self._busy, self._fault = config.ready, config.busy, config.fault
        self._valid, self._bits = config.result_valid, config.class_bits
        self._settle_ns = config.settle_us * 1000
        self._clock, self._value = clock, gpio.line.Value
        names = [name for name in (self._ready, self._busy, self._fault, self._valid, *self._bits) if name]
        self._levels = dict.fromkeys(names, False)
        settings = gpio.LineSettings(direction=gpio.line.Direction.OUTPUT, output_value=self._value.INACTIVE)
        with ExitStack() as stack:
            self._requests = _request(gpio, names, settings, stack)
            self._open = stack.pop_all()

    @property
    def capacity(self) -> int:
        """How many codes the class bits can tell apart: 2 to the number of bits."""
        return 1 << len(self._bits)

    def show(self, *, ready: bool, busy: bool, fault: bool) -> None:
        """Drive READY, BUSY and FAULT; writes only what has changed."""
        self._write({self._ready: ready, self._busy: busy, self._fault: fault})

    def result(self, code: int | None) -> None:
        """Show a class: RESULT VALID falls, the class bits change, and `settle_us` later RESULT VALID rises.

        None only lets it fall. A code outside 0..capacity-1 does the same and raises LineError.
        """
        self._write({self._valid: False})
        if code is None:
            return
        if not 0 <= code < self.capacity:
            raise LineError(
                f"code {code} does not fit {len(self._bits)} class bits; wire more lines in output.class_bits"
            )
        self._write({name: bool(code >> i & 1) for i, name in enumerate(self._bits)})
        self._clock.sleep_until(self._clock.now_ns() + self._settle_ns)
        self._write({self._valid: True})

    def close(self) -> None:
        """All low, then give the lines back: what a chip does with a line that nobody holds is its own affair."""
        try:
            self._write(dict.fromkeys(self._levels, False))
        finally:
            self._requests = []
            self._open.close()

    def _write(self, wanted: dict[str, bool]) -> None:
        new = {name: level for name, level in wanted.items() if self._levels.get(name, level) != level}
        for request, names in self._requests:
            mine = {offset: name for offset, name in names.items() if name in new}
            if mine:
                with _naming("write", mine.values()):
                    request.set_values(
                        {o: self._value.ACTIVE if new[n] else self._value.INACTIVE for o, n in mine.items()}
                    )
                self._levels.update({name: new[name] for name in mine.values()})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class EdgeKind(StrEnum):
    """What an edge says. LOST: edges were dropped or came in a storm; what happened in between is unknown."""

    START = "start"
    STOP = "stop"
    NEW_OBJECT = "new-object"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Edge:
    """One settled edge. t_ns: kernel time stamp, `CLOCK_MONOTONIC`, of the first edge of its burst.

    LOST is stamped with the edge at which the loss or the storm was found out. What was told before it is certain.
    Nothing comes after it until every line has been quiet for `glitch_us`; then the levels are read anew, which makes
    no edge.
    """

    kind: EdgeKind
    t_ns: int


class Trigger(Protocol):
    """Where the recorder gets its edges from."""

    def edges(self, now_ns: int) -> list[Edge]:
        """Edges that have settled by `now_ns`, in order of time; never waits."""
        ...


_Meaning = tuple[EdgeKind | None, EdgeKind | None]
"""What a line's fall and its rise say; None: nothing."""


@dataclass(slots=True)
class _Line:
    """An input line: its settled level, and the burst of edges that has not settled yet."""

    meaning: _Meaning
    level: bool = False
    count: int = 0  # edges in the burst
    first_ns: int = 0
    last_ns: int = 0
    after: bool = False  # level after the last of them


@dataclass(slots=True)
class _Bank:
    """The input lines of one chip, which share a kernel queue."""

    request: LineRequest
    names: dict[int, str]
    lines: dict[int, _Line]
    early: list[EdgeEvent] = field(default_factory=list)  # read, but an event before them is missing
    seqno: int = 0  # of the newest event that was taken
    known_ns: int = 0  # all events up to here were taken

    def step(self, event: EdgeEvent) -> int:
        """1 for the event that comes next; the kernel counts in 32 bits."""
        return (event.global_seqno - self.seqno + 2**31) % 2**32 - 2**31


class GpioTrigger:
    """The robot's lines as clean edges.

    A burst is a run of edges on one line with less than `glitch_us` between neighbours. It has settled `glitch_us`
    after its last edge. If the level is another one then, it was one edge, stamped with the burst's first; if not, a
    glitch. So a clean edge is told `glitch_us` late, with its exact stamp (the kernel's own debouncing would move the
    stamp). An edge waits for older bursts on other lines, so that order never inverts.

    A call reads at most `storm_edges` events. Raises LineError where lines cannot be found, requested or read.
    """

    def __init__(self, config: TriggerConfig, gpio: Any) -> None:
        check_binding(gpio)
        self._glitch_ns = config.glitch_us * 1000
        self._storm_edges = config.storm_edges
        self._glitches = self._lost_events = self._storms = 0
        self._pending: list[Edge] = []
        self._blind_ns: int | None  # newest edge since the levels became unknown; None: they are known
        roles = _roles(config)
        with ExitStack() as stack:
            requests = _request(gpio, [name for name, _ in roles], _input_settings(config, gpio), stack)
            meaning = dict(roles)
            self._banks = [_Bank(r, names, {o: _Line(meaning[n]) for o, n in names.items()}) for r, names in requests]
            self._lines = [line for bank in self._banks for line in bank.lines.values()]
            self._active, self._rising = gpio.line.Value.ACTIVE, gpio.EdgeEvent.Type.RISING_EDGE
            self._read_levels()
            self._open = stack.pop_all()

    @property
    def glitches(self) -> int:
        """Bursts that changed nothing."""
        return self._glitches

    @property
    def lost_events(self) -> int:
        """Events that the kernel dropped because its queue was full."""
        return self._lost_events

    @property
    def storms(self) -> int:
        """Bursts of more than `storm_edges` edges."""
        return self._storms

    @property
    def blind(self) -> bool:
        """True from LOST until all lines were quiet and their levels are known again."""
        return self._blind_ns is not None

    def edges(self, now_ns: int) -> list[Edge]:
        """Edges that have settled by `now_ns` (read before the call), in order of time; never waits."""
        for bank in self._banks:
            with _naming("read", bank.names.values()):
                self._read(bank, now_ns)
        horizon_ns = min(bank.known_ns for bank in self._banks)
        for line in self._lines:
            if line.count and horizon_ns - line.last_ns >= self._glitch_ns:
                self._settle(line)
        # the levels are those of now: first read everything that led to them
        if self._blind_ns is not None and horizon_ns >= max(now_ns, self._blind_ns + self._glitch_ns):
            self._read_levels()
        until_ns = min([horizon_ns, *(line.first_ns for line in self._lines if line.count)])
        self._pending.sort(key=lambda edge: edge.t_ns)
        due = [edge for edge in self._pending if edge.t_ns <= until_ns]
        del self._pending[: len(due)]
        return due

    def close(self) -> None:
        """Give the lines back."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self, bank: _Bank, now_ns: int) -> None:
        """Take the chip's share of events, in the order of their numbers."""
        left = max(1, self._storm_edges // len(self._banks))
        while left > 0 and bank.request.wait_edge_events(0):
            events = bank.request.read_edge_events(left)
            bank.early += events
            left -= len(events)
        bank.early.sort(key=bank.step)
        while bank.early:
            event = bank.early[0]
            # interrupt threads of two lines may overtake each other: wait a little before calling an event dropped
            young = now_ns - event.timestamp_ns < self._glitch_ns and len(bank.early) <= OVERTAKING
            if bank.step(event) > 1 and young:
                break
            self._take(bank, bank.early.pop(0))
        if left > 0 and not bank.early:
            bank.known_ns = max(bank.known_ns, now_ns)

    def _take(self, bank: _Bank, event: EdgeEvent) -> None:
        step, t_ns = bank.step(event), event.timestamp_ns
        if step < 1:
            return  # so late that it counts as dropped already
        if step > 1:
            self._lost_events += step - 1
            self._lose(t_ns)
        bank.seqno = event.global_seqno
        bank.known_ns = max(bank.known_ns, t_ns)
        if self._blind_ns is not None:
            self._blind_ns = max(self._blind_ns, t_ns)
            return
        line = bank.lines[event.line_offset]
        if line.count and t_ns - line.last_ns >= self._glitch_ns:
            self._settle(line)
        if not line.count:
            line.first_ns = t_ns
        # a rise may follow a rise: the kernel looks at the level only after the interrupt, so the newest word is right
        line.count, line.last_ns, line.after = line.count + 1, t_ns, event.event_type is self._rising
        if line.count > self._storm_edges:
            self._storms += 1
            self._lose(t_ns)

    def _settle(self, line: _Line) -> None:
        """The burst is over: an edge, if it changed the level."""
        line.count = 0
        if line.after == line.level:
            self._glitches += 1
            return
        line.level = line.after
        if kind := line.meaning[line.level]:
            self._pending.append(Edge(kind, line.first_ns))

    def _lose(self, t_ns: int) -> None:
        """Tell LOST at `t_ns` and believe nothing later, on any line: a STOP may be missing as well as a START."""
        if self._blind_ns is None:
            self._pending = [edge for edge in self._pending if edge.t_ns <= t_ns] + [Edge(EdgeKind.LOST, t_ns)]
            self._blind_ns = t_ns
        for line in self._lines:
            line.count = 0

    def _read_levels(self) -> None:
        """Begin anew from the lines' levels."""
        for bank in self._banks:
            with _naming("read", bank.names.values()):
                values = bank.request.get_values(list(bank.lines))
            for line, value in zip(bank.lines.values(), values, strict=True):
                line.level = value is self._active
        self._blind_ns = None


def _roles(config: TriggerConfig) -> list[tuple[str, _Meaning]]:
    """Each wired line with the meaning of its fall and of its rise."""
    if config.mode == "one-line":
        roles: list[tuple[str, _Meaning]] = [(config.start, (EdgeKind.STOP, EdgeKind.START))]
    else:
        roles = [(config.start, (None, EdgeKind.START)), (config.stop, (None, EdgeKind.STOP))]
    if config.new_object:
        roles.append((config.new_object, (None, EdgeKind.NEW_OBJECT)))
    return roles


def _input_settings(config: TriggerConfig, gpio: Any) -> Any:
    """Both edges, stamped by the kernel on the host's monotonic clock, not debounced."""
    return gpio.LineSettings(
        direction=gpio.line.Direction.INPUT,
        edge_detection=gpio.line.Edge.BOTH,
        event_clock=gpio.line.Clock.MONOTONIC,
        bias=gpio.line.Bias[config.bias.upper().replace("-", "_")],
        active_low=config.active_low,
    )
