"""Trigger and output lines on the simulated gpiod: edges, glitches, losses, storms, outputs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from itertools import accumulate, pairwise
from types import SimpleNamespace
from typing import Any
from unittest import mock

import gpiod
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core.config import OutputConfig, TriggerConfig
from palpate.core.errors import LineError
from palpate.core.types import EdgeKind
from palpate.io import gpio_lines
from palpate.io.gpio_lines import Lines, check_binding, find_lines
from palpate.io.trigger import GpioTrigger
from palpate.sim.gpio import SimGpio, SimRequest
from palpate.sim.rig import VirtualClock

US, MS = 1_000, 1_000_000
GLITCH = 500 * US
CHIP0, CHIP1 = "/dev/gpiochip0", "/dev/gpiochip1"
INPUTS = ("", "START", "STOP", "NEW")
OUTPUTS = ("READY", "BUSY", "VALID", "FAULT", "C0", "C1", "C2")
START, STOP, NEW_OBJECT, LOST = EdgeKind


def trigger_config(**changes: Any) -> TriggerConfig:
    """Start and stop on two lines, pulled down, 500 us; with changes."""
    return TriggerConfig(**{"start": "START", "stop": "STOP"} | changes)


def output_config(**changes: Any) -> OutputConfig:
    """All outputs wired, three class bits; with changes."""
    wired = {
        "ready": "READY",
        "busy": "BUSY",
        "result_valid": "VALID",
        "fault": "FAULT",
        "class_bits": ("C0", "C1", "C2"),
    }
    return OutputConfig(**wired | changes)


class TriggerSetup:
    """A trigger on a simulated gpiod; times count from `t0`, `high` is high from then on."""

    def __init__(
        self,
        chips: dict[str, tuple[str, ...]] | None = None,
        *,
        high: str = "",
        queue: int = 1024,
        **changes: Any,
    ) -> None:
        self.clock = VirtualClock()
        self.t0 = self.clock.now_ns()
        self.gpio = SimGpio(self.clock, chips or {CHIP0: INPUTS + OUTPUTS})
        if high:
            self.drive(high, 0)
        with mock.patch.object(gpio_lines, "QUEUE", queue):
            self.trigger = GpioTrigger(trigger_config(**changes), self.gpio)

    def drive(self, name: str, *times_ns: int, level: bool = True) -> None:
        """Toggle a line at these times, beginning with `level`."""
        for i, t_ns in enumerate(times_ns):
            self.gpio.drive(name, level ^ i % 2, self.t0 + t_ns)

    def poll(self, t_ns: int) -> list[tuple[EdgeKind, int]]:
        """The edges from one call at `t_ns`."""
        self.clock.sleep_until(self.t0 + t_ns)
        return [
            (edge.kind, edge.t_ns - self.t0) for edge in self.trigger.edges(self.clock.now_ns())
        ]

    def run(self, until_ns: int, step_ns: int = MS) -> list[tuple[EdgeKind, int]]:
        """The edges from calls at every step until `until_ns`."""
        now_ns = self.clock.now_ns() - self.t0
        return [
            edge for t_ns in range(now_ns, until_ns + step_ns, step_ns) for edge in self.poll(t_ns)
        ]


# ---------------------------------------------------------------- edges, bursts and losses
TWO_CHIPS = {CHIP0: ("START",), CHIP1: ("STOP",)}
THREE_CHIPS = TWO_CHIPS | {"/dev/gpiochip2": ("NEW",)}
ONE = {"mode": "one-line", "stop": ""}
KINDS = {"START": START, "STOP": STOP, "NEW": NEW_OBJECT, "LOST": LOST}


def ms(*times: float) -> list[int]:
    """Times in milliseconds as ns."""
    return [round(t * MS) for t in times]


def reported(text: str) -> list[tuple[EdgeKind, int]]:
    """Edges as `KIND milliseconds` one after the other."""
    words = text.split()
    return [(KINDS[k], *ms(float(t))) for k, t in zip(words[::2], words[1::2], strict=True)]


BURST = [10 + t / 1000 for t in (0, 20, 90, 300, 420, 900, 1300)]
BOUNCING = [10, 10.4, 10.8, 11.2, 11.6]
CASES: dict[
    str, tuple[dict[str, Any], dict[str, list[float]], dict[float, str], dict[str, int]]
] = {
    "two lines; a fall has no meaning": (
        {"new_object": "NEW"},
        {"NEW": [3.000001, 5], "START": [10.000007, 30], "STOP": [200.000013, 220]},
        {300: "NEW 3.000001 START 10.000007 STOP 200.000013"},
        {},
    ),
    "one line; its stop line is not requested": (
        {"mode": "one-line", "stop": "NOWHERE"},
        {"START": [10.000007, 200.000013]},
        {300: "START 10.000007 STOP 200.000013"},
        {},
    ),
    "reported once, exactly when settled": (
        *({}, {"START": [1]}, {1: "", 1.499999: "", 1.5: "START 1", 9: ""}, {}),
    ),
    "complete sweeps between two calls": (
        *(ONE, {"START": [10, 200, 300, 400]}, {500: "START 10 STOP 200 START 300 STOP 400"}, {}),
    ),
    "active low": (
        *(ONE | {"active_low": True}, {"-START": [10, 200]}, {300: "START 10 STOP 200"}, {}),
    ),
    "high at start-up": (
        *(ONE | {"high": "START"}, {"-START": [100, 200]}, {50: "", 300: "STOP 100 START 200"}, {}),
    ),
    "bounce keeps the first stamp": (
        *(ONE, {"START": [*BURST, 100]}, {200: "START 10 STOP 100"}, {"glitches": 0}),
    ),
    "a pulse of exactly glitch_us": (
        *(ONE, {"START": [10, 10.5]}, {20: "START 10 STOP 10.5"}, {}),
    ),
    **{
        f"a pulse of {width} ms, {'down' if high else 'up'}": (
            ONE | ({"high": "START"} if high else {}),
            {"-START" if high else "START": [10, 10 + width]},
            {20: ""},
            {"glitches": 1},
        )
        for width in (0.01, 0.1, 0.499999)
        for high in (False, True)
    },
    **{
        f"a clean STOP waits for an older START that bounces, {len(chips)} chips": (
            {"chips": chips},
            {"START": BOUNCING, "STOP": [10.1]},
            {11: "", 12: "", 13: "START 10 STOP 10.1"},
            {},
        )
        for chips in ({CHIP0: INPUTS}, {CHIP0: ("START",), CHIP1: ("NEW", "STOP")})
    },
    # it is low after the loss, though a START was reported last
    "dropped events are one LOST": (
        ONE | {"queue": 4},
        {"START": [5, *range(10, 17), 30, 40]},
        {6: "START 5", 20: "LOST 13", 50: "START 30 STOP 40"},
        {"lost_edges": 3, "glitches": 0, "storms": 0},
    ),
    "a loss upon a loss is only counted": (
        {"queue": 32},
        {"START": [10 + i / 1000 for i in range(100)]},
        {10.049: "LOST 10.018", 10.099: "", 20: ""},
        {"lost_edges": 50 - 32 + 50 - 32},
    ),
    "a loss discards open bursts, after a settled edge": (
        {"chips": TWO_CHIPS, "queue": 4},
        {"START": [5 + 0.4 * i for i in range(8)], "STOP": [5.1]},
        {5.9: "", 10: "STOP 5.1 LOST 6.6", 20: ""},
        {},
    ),
    "nothing counts between a loss and quiet": (
        {"chips": TWO_CHIPS, "queue": 4},
        {"STOP": [*range(10, 15)], "START": [15, 17]},
        {20: "LOST 11", 30: ""},
        {},
    ),
    "storm_edges edges are no storm": (
        {"storm_edges": 5},
        {"START": [10 + i / 1000 for i in range(5)]},
        {20: "", 21: "", 22: "START 10"},
        {"storms": 0},
    ),
    "of a storm between two calls the kernel keeps the last": (
        {},
        {"START": [*(10 + i / 1000 for i in range(10_000)), 60]},
        {50: "LOST 18.976", 51: "", 70: "START 60"},
        {"lost_edges": 8976},
    ),
    # one event of each chip a call
    "a burst with unread events is not settled": (
        {"chips": TWO_CHIPS, "storm_edges": 3},
        {"START": [10, 10.1, 10.2], "STOP": [11]},
        {50: "", 51: "", 52: "", 53: "START 10 STOP 11"},
        {"glitches": 0},
    ),
    "edges are reported while another chip is read": (
        {"chips": TWO_CHIPS, "storm_edges": 2},
        {"START": [10, 20], "STOP": [1, 2, 3, 4]},
        {50: "", 51: "STOP 1", 52: "", 53: "STOP 3", 54: "START 10", 55: ""},
        {},
    ),
    "each of three chips is read in each call": (
        {"chips": THREE_CHIPS, "new_object": "NEW", "storm_edges": 2},
        {"START": [1]},
        {1: "", 2: "START 1"},
        {},
    ),
}
"""Set-up, edges by line ("-": the first is a fall), the edges that a call at a time reports, and
counters at the end. Times are in milliseconds."""


@pytest.mark.parametrize(("how", "edges", "calls", "counters"), CASES.values(), ids=CASES)
def test_what_calls_report(how, edges, calls, counters):
    """Edges with the kernel's time stamps, in order; glitches, losses and storms are counted."""
    setup = TriggerSetup(**how)
    for name, times in edges.items():
        setup.drive(name.removeprefix("-"), *ms(*times), level=not name.startswith("-"))
    assert [setup.poll(t) for t in ms(*calls)] == [reported(text) for text in calls.values()]
    for name, count in counters.items():
        assert getattr(setup.trigger.edge_counters, name) == count
    assert setup.poll(ms(max(calls) + 10)[0]) == []


@pytest.mark.parametrize("step_ns", [US, 10 * US])
def test_storm(step_ns):
    """10,000 edges are one LOST at the first above the limit; a quiet line works again."""
    setup = TriggerSetup(**ONE)
    setup.drive("START", *(10 * MS + i * step_ns for i in range(10_000)))
    assert setup.run(200 * MS) == [(LOST, 10 * MS + 2000 * step_ns)]
    assert (setup.trigger.edge_counters.storms, setup.trigger.edge_counters.lost_edges) == (1, 0)
    setup.drive("START", 300 * MS, 400 * MS)
    assert setup.run(500 * MS) == [(START, 300 * MS), (STOP, 400 * MS)]


@pytest.mark.parametrize(("active_low", "bias"), [(False, "PULL_DOWN"), (True, "PULL_UP")])
def test_what_is_requested(active_low, bias):
    """Both edges on the monotonic clock, not debounced, with a long queue, pulled to the inactive
    level; a request for each line, so that the kernel numbers its events without gaps."""
    setup = TriggerSetup(new_object="NEW", active_low=active_low)
    requests = setup.gpio.requests
    assert [request.names for request in requests] == [{1: "START"}, {2: "STOP"}, {3: "NEW"}]
    for request in requests:
        (settings,) = request.settings.values()
        assert settings.bias is gpiod.line.Bias[bias]
        assert settings.direction is gpiod.line.Direction.INPUT
        assert settings.edge_detection is gpiod.line.Edge.BOTH
        assert settings.event_clock is gpiod.line.Clock.MONOTONIC
        assert not settings.debounce_period
        assert request.queue.maxlen == 1024


def test_interrupts_overtake():
    """An edge that is delivered late, but within `glitch_us`, is in order and no loss."""
    setup = TriggerSetup()
    setup.drive("START", MS)
    setup.drive("STOP", MS + 5 * US)
    assert setup.poll(0) == []
    request = setup.gpio.requests[0]
    setup.clock.sleep_until(setup.t0 + MS + 5 * US)
    setup.gpio.now_ns()
    late = request.queue.popleft()
    assert setup.poll(MS + 10 * US) == []
    request.queue.append(late)
    assert setup.run(3 * MS, 100 * US) == [(START, MS), (STOP, MS + 5 * US)]
    assert setup.trigger.edge_counters.lost_edges == 0


FALL, RISE = gpiod.EdgeEvent.Type.FALLING_EDGE.value, gpiod.EdgeEvent.Type.RISING_EDGE.value
LAST = 2**32 - 1
QUEUES = {
    "the same edge twice is one": ([(FALL, 1, 1), (FALL, 1.001, 2)], "", 1),
    "a return to the level is none": ([(RISE, 4, 1), (RISE, 4.001, 2)], "START 4", 0),
    "two interrupts in one event are no loss": (
        [(FALL, 1.02, 1), (RISE, 5.02, 2)],
        "START 5.02",
        1,
    ),
    "event numbers wrap": (*([(RISE, 1, LAST), (FALL, 3, 0), (RISE, 5, 1)], "START 1 START 5", 0),),
}
"""Events of a line as (kind, milliseconds, number), what is reported, and glitches."""


@pytest.mark.parametrize("name", QUEUES)
def test_events_in_the_queue_of_a_line(name):
    """The level is that after an event, and the kernel numbers events without gaps."""
    setup, (events, wanted, glitches) = TriggerSetup(), QUEUES[name]
    setup.trigger._lines[0].seqno = (events[0][2] - 1) % 2**32
    for kind, t_ms, number in events:
        edges = number + (name[:3] == "two")  # edges so far
        setup.gpio.requests[0].queue.append(
            gpiod.EdgeEvent(kind, setup.t0 + round(t_ms * MS), 1, edges, number)
        )
    assert setup.poll(9 * MS) == reported(wanted)
    counted = setup.trigger.edge_counters
    assert (counted.lost_edges, counted.glitches) == (0, glitches)


def test_blind_until_quiet():
    """After a loss nothing counts until all lines were quiet; then levels are read again."""
    setup = TriggerSetup(mode="one-line", stop="", queue=4)
    setup.drive("START", *(t * 100 * US for t in (100, 110, 120, 130, 140, 144, 148)))
    assert (setup.poll(14_500 * US), setup.trigger.blind) == ([(LOST, 12 * MS)], True)
    assert (setup.poll(15_000 * US), setup.trigger.blind) == ([], True)
    assert (setup.poll(15_299 * US), setup.trigger.blind) == ([], True)
    assert (setup.poll(15_300 * US), setup.trigger.blind) == ([], False)
    setup.drive("START", 20 * MS, level=False)
    assert setup.poll(30 * MS) == [(STOP, 20 * MS)]


def test_reading_is_bounded():
    """A call reads no more than `storm_edges` events and leaves the rest to the next one."""
    setup = TriggerSetup(storm_edges=100)
    setup.drive("START", *(10 * MS + i * US for i in range(1000)))
    setup.poll(50 * MS)
    assert len(setup.gpio.requests[0].queue) == 1000 - 100 // 2  # of two lines
    assert [edge for _ in range(20) for edge in setup.poll(50 * MS)] == [(LOST, 10 * MS + 100 * US)]
    assert not setup.trigger.blind


def test_chip_pulled_out():
    """A chip that is unplugged is a LineError that names its line and the errno."""
    setup = TriggerSetup()
    setup.gpio.refuse[CHIP0] = 19
    with pytest.raises(LineError, match=r"START.*19"):
        setup.poll(MS)


# ---------------------------------------------------------------- any edges at all

gaps = st.lists(st.integers(1, 1500) | st.sampled_from([10, 499, 500, 501]), max_size=40)


def toggles(gaps_us: list[int]) -> list[int]:
    """Times in ns of edges with these gaps."""
    return [t * US for t in accumulate(gaps_us)]


def settled(times_ns: list[int]) -> list[tuple[int, bool]]:
    """Reference: (first edge, level) of each burst that changes a line that was low."""
    bursts: list[list[int]] = []
    for t_ns in times_ns:
        if bursts and t_ns - bursts[-1][-1] < GLITCH:
            bursts[-1].append(t_ns)
        else:
            bursts.append([t_ns])
    level, out = False, []
    for burst in bursts:
        if len(burst) % 2:
            level = not level
            out.append((burst[0], level))
    return out


@pytest.mark.slow
@given(st.tuples(gaps, gaps, gaps), st.integers(20, 5000))
def test_any_edges(lines, step_us):
    """Any edges on three lines of two chips, read at any times, are the reference's, in order."""
    setup = TriggerSetup({CHIP0: ("NEW", "STOP"), CHIP1: ("START",)}, new_object="NEW")
    wanted = []
    for name, kind, gaps_us in zip(
        ("START", "STOP", "NEW"), (START, STOP, NEW_OBJECT), lines, strict=True
    ):
        setup.drive(name, *toggles(gaps_us))
        wanted += [(kind, t_ns) for t_ns, level in settled(toggles(gaps_us)) if level]
    reported = setup.run(max(sum(gaps_us) for gaps_us in lines) * US + MS, step_us * US)
    assert sorted(reported) == sorted(wanted)
    assert [t_ns for _, t_ns in reported] == sorted(t_ns for _, t_ns in wanted)


@given(gaps, st.integers(20, 5000), st.integers(2, 30), st.sampled_from([2, 8, 64]), st.booleans())
def test_any_losses(gaps_us, step_us, storm_edges, queue, high):
    """Without LOST between them START and STOP alternate, in time, and skip short pulses."""
    setup = TriggerSetup(
        high="START" if high else "", mode="one-line", stop="", storm_edges=storm_edges, queue=queue
    )
    times = toggles(gaps_us)
    setup.drive("START", *times, level=not high)
    reported = setup.run((sum(gaps_us) + 1500 + 50 * step_us) * US, step_us * US)
    assert all(a != b or a is LOST for (a, _), (b, _) in pairwise(reported))
    assert all(a <= b for (_, a), (_, b) in pairwise(reported))
    by_the_book = {(START if level != high else STOP, t_ns) for t_ns, level in settled(times)}
    assert {edge for edge in reported if edge[0] is not LOST} <= by_the_book
    lost = setup.trigger.edge_counters.lost_edges + setup.trigger.edge_counters.storms
    assert bool(lost) == any(kind is LOST for kind, _ in reported)
    assert not setup.trigger.blind


# ---------------------------------------------------------------- finding and requesting lines


def sim(chips: dict[str, tuple[str, ...]]) -> SimGpio:
    """A simulated gpiod with these chips."""
    return SimGpio(VirtualClock(), chips)


NAMELESS = {CHIP0: ("", "", "A"), CHIP1: ("", "")}


@pytest.mark.parametrize(
    ("chips", "wanted"),
    [
        (NAMELESS, {"gpiochip0:1": (CHIP0, 1), "/dev/gpiochip1:0": (CHIP1, 0), "A": (CHIP0, 2)}),
        (
            {"/dev/gpiochip4": ("", "STOP"), "/dev/gpiochip11": ("START",)},
            {"START": ("/dev/gpiochip11", 0), "STOP": ("/dev/gpiochip4", 1)},
        ),
        ({}, {}),
    ],
)
def test_lines_are_found(chips, wanted):
    """By name on any chip, or by chip and offset; a box without lines needs no chip."""
    assert find_lines(sim(chips), list(wanted)) == wanted


@pytest.mark.parametrize(
    ("chips", "names", "why"),
    [
        (NAMELESS, ["gpiochip7:0"], "gpiochip7 is not"),
        (NAMELESS, ["gpiochip0:3"], "no line 3; use 0 to 2"),
        (NAMELESS, ["A", "gpiochip0:2"], "A and gpiochip0:2"),
        (NAMELESS, [""], "''"),
        ({CHIP0: ("", "")}, ["START"], "gpiochip0:17"),
        ({CHIP0: ("", "ID_SDA", "GPIO17")}, ["GPIO71"], r"GPIO71.*GPIO17"),
        ({CHIP0: ("PA0", "PA1", "PA2", "PA3")}, ["START"], "nearest: PA0"),
        ({CHIP0: ("A",), CHIP1: ("", "A")}, ["A"], r"0 line 0 and .*1 line 1"),
        ({CHIP0: ("A", "A")}, ["A"], r"0 line 0 and .*0 line 1"),
        ({}, ["START"], "no /dev/gpiochip"),
    ],
)
def test_lines_that_are_not_found(chips, names, why):
    """A missing, nameless, ambiguous or doubled line is named, with what there is instead."""
    with pytest.raises(LineError, match=why):
        find_lines(sim(chips), names)


def test_find_through_link():
    """A second path to a chip (Raspberry Pi OS has one) makes no name ambiguous."""
    gpio = sim({CHIP0: ("START",)})
    chip = gpio.Chip
    with (
        mock.patch.object(
            gpio, "is_gpiochip_device", lambda path: path in (CHIP0, "/dev/gpiochip4")
        ),
        mock.patch.object(gpio, "Chip", side_effect=lambda _: chip(CHIP0)),
    ):
        assert find_lines(gpio, ["START"]) == {"START": (CHIP0, 0)}


@pytest.mark.parametrize(
    ("number", "why"),
    [(1, r"may not open.*'STOP'"), (13, r"may not open.*'STOP'"), (5, f"of {CHIP1}")],
)
def test_a_chip_that_cannot_be_opened(number, why):
    """It is named, if a line is on no other chip."""
    gpio = sim({CHIP0: ("START",), CHIP1: ("STOP",)})
    gpio.refuse[CHIP1] = number
    if number != 5:
        assert find_lines(gpio, ["START"]) == {"START": (CHIP0, 0)}
    with pytest.raises(LineError, match=why) as refused:
        find_lines(gpio, ["START", "STOP"])
    assert CHIP1 in str(refused.value)


@pytest.mark.parametrize(
    "module", [SimpleNamespace(__version__="1.6.3", Chip=object), SimpleNamespace()]
)
def test_binding_of_libgpiod_1(module):
    """It is refused with its version; the installed one and the double are not."""
    version = getattr(module, "__version__", "of unknown version")
    with pytest.raises(LineError, match=version):
        GpioTrigger(trigger_config(), module)
    with pytest.raises(LineError, match="libgpiod v2"):
        Lines(output_config(), module, VirtualClock())
    check_binding(gpiod)
    check_binding(sim({}))


def test_busy_line():
    """A line that is in use is a LineError with errno 16, and the free lines are released."""
    gpio = sim({CHIP0: ("START",), CHIP1: ("STOP",)})
    with closing(GpioTrigger(trigger_config(stop="", start="STOP", mode="one-line"), gpio)):
        with pytest.raises(LineError, match=r"STOP.*16"):
            GpioTrigger(trigger_config(), gpio)
        assert [request.names for request in gpio.requests] == [{0: "STOP"}]
    assert gpio.requests == []


# ---------------------------------------------------------------- outputs


@pytest.fixture
def panel() -> tuple[SimGpio, VirtualClock, Lines]:
    """A simulated gpiod with two chips, its clock, and all outputs requested."""
    clock = VirtualClock(0)
    gpio = SimGpio(clock, {CHIP0: ("READY", "BUSY", "FAULT", "C0"), CHIP1: ("VALID", "C1", "C2")})
    return gpio, clock, Lines(output_config(), gpio, clock)


def test_outputs_begin_low(panel):
    """All outputs are requested low, with one request per chip, and nothing is written."""
    gpio, _, _ = panel
    settings = [s for request in gpio.requests for s in request.settings.values()]
    assert [request.path for request in gpio.requests] == [CHIP0, CHIP1]
    assert {(s.direction, s.output_value) for s in settings} == {
        (gpiod.line.Direction.OUTPUT, gpiod.line.Value.INACTIVE)
    }
    assert gpio.written == []


def shown(**on: bool) -> Callable[[Lines], None]:
    """A call of `show`."""
    return lambda lines: lines.show(**{"ready": False, "busy": False, "fault": False} | on)


def coded(code: int | None) -> Callable[[Lines], None]:
    """A call of `result`."""
    return lambda lines: lines.result(code)


@pytest.mark.parametrize(
    ("calls", "written"),
    [
        pytest.param(
            [shown(ready=True), shown(ready=True), shown(busy=True), shown(fault=True)],
            [["READY+"], [], ["READY-", "BUSY+"], ["BUSY-", "FAULT+"]],
            id="only changes are written",
        ),
        pytest.param(
            [coded(5), coded(2)],
            [["C0+", "C2+", "200 VALID+"], ["VALID-", "C0-", "C1+", "C2-", "200 VALID+"]],
            id="the bits, lowest first, settle before RESULT VALID",
        ),
        pytest.param(
            [coded(0), coded(0)],
            [["200 VALID+"], ["VALID-", "200 VALID+"]],
            id="the same code again is a new RESULT VALID",
        ),
        pytest.param(
            [coded(1), coded(None)],
            [["C0+", "200 VALID+"], ["VALID-"]],
            id="None lets RESULT VALID fall at once",
        ),
    ],
)
def test_what_is_written(panel, calls, written):
    """The changes of each call: microseconds since its begin, line and level."""
    gpio, clock, lines = panel
    for call, wanted in zip(calls, written, strict=True):
        begun_ns = clock.now_ns()
        call(lines)
        after = [((t_ns - begun_ns) // US, f"{name}{'-+'[on]}") for t_ns, name, on in gpio.written]
        assert [f"{t} {change}" if t else change for t, change in after] == wanted
        gpio.written.clear()


@pytest.mark.parametrize("code", [-1, 8])
def test_code_that_does_not_fit(panel, code):
    """A code that is too large for the bits is a LineError and leaves RESULT VALID low."""
    gpio, _, lines = panel
    assert lines.capacity == 8
    lines.result(7)
    gpio.written.clear()
    with pytest.raises(LineError, match=f"code {code} .* 3 class"):
        lines.result(code)
    assert gpio.written == [(200 * US, "VALID", False)]


def test_not_wired():
    """Lines without a name are not searched or written; without outputs no chip is needed."""
    gpio = SimGpio(VirtualClock(0), {CHIP0: ("READY",)})
    lines = Lines(
        output_config(busy="", result_valid="", fault="", class_bits=()), gpio, VirtualClock(0)
    )
    lines.show(ready=True, busy=True, fault=True)
    lines.result(0)
    assert gpio.written == [(0, "READY", True)]
    assert lines.capacity == 1
    nothing = output_config(ready="", busy="", result_valid="", fault="", class_bits=())
    Lines(nothing, SimGpio(VirtualClock(0), {}), VirtualClock(0)).show(
        ready=True, busy=False, fault=False
    )


def test_close_drops_all(monkeypatch):
    """Closing drives all lines low, also on a chip that keeps levels; twice does no harm."""
    clock = VirtualClock(0)
    gpio = SimGpio(clock, {CHIP0: OUTPUTS})
    monkeypatch.setattr(SimRequest, "release", lambda request: gpio.requests.remove(request))
    with closing(Lines(output_config(), gpio, clock)) as lines:
        lines.show(ready=True, busy=False, fault=False)
        lines.result(4)
        gpio.written.clear()
    assert sorted(gpio.written) == [
        (200 * US, "C2", False),
        (200 * US, "READY", False),
        (200 * US, "VALID", False),
    ]
    assert gpio.requests == []
    lines.close()
    assert len(gpio.written) == 3


def test_close_of_a_dead_chip(panel):
    """A chip that is gone is a LineError, and the other lines are still released."""
    gpio, _, lines = panel
    lines.show(ready=True, busy=False, fault=False)
    gpio.refuse[CHIP0] = 19
    with pytest.raises(LineError, match=r"READY.*19"):
        lines.close()
    assert gpio.requests == []
    lines.close()
