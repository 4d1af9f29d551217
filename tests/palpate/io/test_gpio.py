"""Trigger and output lines on the simulated gpiod: edges, glitches, losses and storms of inputs;
outputs in their order."""

from __future__ import annotations

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


def test_lines_without_names_are_given_by_chip_and_offset() -> None:
    """Chip and offset stand for a line; a chip or line that is not there, and one line for two
    roles, are named. Without any name, the error says how."""
    chips = SimGpio(VirtualClock(), {CHIP0: ("", "", "A"), CHIP1: ("", "")})
    wanted = {"gpiochip0:1": (CHIP0, 1), "/dev/gpiochip1:0": (CHIP1, 0), "A": (CHIP0, 2)}
    assert find_lines(chips, list(wanted)) == wanted
    for names, why in (
        (["gpiochip7:0"], "/dev/gpiochip7 is not a gpio chip"),
        (["gpiochip0:3"], "/dev/gpiochip0 has no line 3; use 0 to 2"),
        (["A", "gpiochip0:2"], "A and gpiochip0:2 are the same gpio line"),
    ):
        with pytest.raises(LineError, match=why):
            find_lines(chips, names)
    nameless = SimGpio(VirtualClock(), {CHIP0: ("", "")})
    with pytest.raises(LineError, match="no line has a name here; give chip and offset"):
        find_lines(nameless, ["START"])


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
    """A simulated gpiod, a trigger on it and their clock. Times count from `t0`; line `high` is
    high from then on."""

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

    def queue(self, *events: tuple[bool, int, int]) -> None:
        """Put (rise, t_ns, number) into the kernel's queue for the first line of the first chip."""
        kinds = gpiod.EdgeEvent.Type
        for rise, t_ns, number in events:
            kind = kinds.RISING_EDGE if rise else kinds.FALLING_EDGE
            self.gpio.requests[0].queue.append(
                gpiod.EdgeEvent(kind.value, self.t0 + t_ns, 1, number, number)
            )


# ---------------------------------------------------------------- clean edges


def test_two_lines() -> None:
    """A rise of START is START, a rise of STOP is STOP, with the kernel's time stamps; a rise of
    NEW is NEW OBJECT, falls have no meaning."""
    setup = TriggerSetup(new_object="NEW")
    setup.drive("NEW", 3 * MS + 1, 5 * MS)
    setup.drive("START", 10 * MS + 7, 30 * MS)
    setup.drive("STOP", 200 * MS + 13, 220 * MS)
    assert setup.run(300 * MS) == [
        (NEW_OBJECT, 3 * MS + 1),
        (START, 10 * MS + 7),
        (STOP, 200 * MS + 13),
    ]


def test_one_line() -> None:
    """A rise is START and a fall is STOP; a configured stop line is not requested."""
    setup = TriggerSetup(mode="one-line", stop="NOWHERE")
    setup.drive("START", 10 * MS + 7, 200 * MS + 13)
    assert setup.run(300 * MS) == [(START, 10 * MS + 7), (STOP, 200 * MS + 13)]


def test_reported_when_settled() -> None:
    """A clean edge is reported exactly `glitch_us` after it, and once."""
    setup = TriggerSetup()
    setup.drive("START", MS)
    assert [setup.poll(t) for t in (MS, MS + GLITCH - 1, MS + GLITCH, 9 * MS)] == [
        [],
        [],
        [(START, MS)],
        [],
    ]


def test_start_and_stop_in_one_call() -> None:
    """Complete sweeps between two calls are reported by the second one, in order."""
    setup = TriggerSetup(mode="one-line", stop="")
    setup.drive("START", 10 * MS, 200 * MS, 300 * MS, 400 * MS)
    assert setup.poll(500 * MS) == [
        (START, 10 * MS),
        (STOP, 200 * MS),
        (START, 300 * MS),
        (STOP, 400 * MS),
    ]


def test_both_edges_undebounced() -> None:
    """The request is for both edges on the monotonic clock, without debouncing, and with a long
    queue."""
    for request in TriggerSetup().gpio.requests:
        (settings,) = request.settings.values()
        assert settings.direction is gpiod.line.Direction.INPUT
        assert settings.edge_detection is gpiod.line.Edge.BOTH
        assert settings.event_clock is gpiod.line.Clock.MONOTONIC
        assert not settings.debounce_period
        assert request.queue.maxlen == 1024


def test_a_request_for_each_line() -> None:
    """Each input has its own request, also on one chip: the kernel then numbers its events without
    gaps."""
    setup = TriggerSetup(new_object="NEW")
    assert [request.names for request in setup.gpio.requests] == [
        {1: "START"},
        {2: "STOP"},
        {3: "NEW"},
    ]


@pytest.mark.parametrize(("active_low", "wanted"), [(False, "PULL_DOWN"), (True, "PULL_UP")])
def test_bias(active_low: bool, wanted: str) -> None:
    """An open input is pulled to its inactive level."""
    setup = TriggerSetup(active_low=active_low)
    assert setup.gpio.requests[0].settings[1].bias is gpiod.line.Bias[wanted]


def test_active_low() -> None:
    """With active_low and a pull-up a fall is START; the high level at rest is not an edge."""
    setup = TriggerSetup(mode="one-line", stop="", active_low=True)
    setup.drive("START", 10 * MS, 200 * MS, level=False)
    assert setup.run(300 * MS) == [(START, 10 * MS), (STOP, 200 * MS)]


def test_high_at_start_up() -> None:
    """A line that is high when the box comes up makes no START; its fall is a STOP and its next
    rise a START."""
    setup = TriggerSetup(high="START", mode="one-line", stop="")
    assert setup.run(50 * MS) == []
    setup.drive("START", 100 * MS, 200 * MS, level=False)
    assert setup.run(300 * MS) == [(STOP, 100 * MS), (START, 200 * MS)]


# ---------------------------------------------------------------- bounce and glitches


def test_bounce_keeps_first_stamp() -> None:
    """A bouncing contact is one START with the stamp of its first edge."""
    setup = TriggerSetup(mode="one-line", stop="")
    bounce = [10 * MS + us * US for us in (0, 20, 90, 300, 420, 900, 1300)]
    setup.drive("START", *bounce, 100 * MS)
    assert setup.run(200 * MS) == [(START, 10 * MS), (STOP, 100 * MS)]
    assert setup.trigger.edge_counters.glitches == 0


@pytest.mark.parametrize("width_ns", [10 * US, 100 * US, GLITCH - 1])
@pytest.mark.parametrize("high", [False, True])
def test_glitch(width_ns: int, high: bool) -> None:
    """A pulse shorter than `glitch_us`, up or down, is only counted."""
    setup = TriggerSetup(high="START" if high else "", mode="one-line", stop="")
    setup.drive("START", 10 * MS, 10 * MS + width_ns, level=not high)
    assert setup.run(20 * MS) == []
    assert setup.trigger.edge_counters.glitches == 1


def test_pulse_of_glitch_us() -> None:
    """A pulse of exactly `glitch_us` is an edge."""
    setup = TriggerSetup(mode="one-line", stop="")
    setup.drive("START", 10 * MS, 10 * MS + GLITCH)
    assert setup.run(20 * MS) == [(START, 10 * MS), (STOP, 10 * MS + GLITCH)]


def test_level_seen_too_late() -> None:
    """The kernel may read the level too late: the same edge twice is one edge, and a return to the
    level is not an edge."""
    setup = TriggerSetup()
    setup.queue((False, MS, 1), (False, MS + US, 2))
    assert setup.poll(3 * MS) == []
    assert setup.trigger.edge_counters.glitches == 1
    setup.queue((True, 4 * MS, 3), (True, 4 * MS + US, 4))
    assert setup.poll(6 * MS) == [(START, 4 * MS)]


# ---------------------------------------------------------------- order


@pytest.mark.parametrize("chips", [{CHIP0: INPUTS}, {CHIP0: ("START",), CHIP1: ("NEW", "STOP")}])
def test_order_across_lines(chips: dict[str, tuple[str, ...]]) -> None:
    """A clean STOP waits for an older START that still bounces, on one chip and on two."""
    setup = TriggerSetup(chips)
    setup.drive("START", *(10 * MS + us * US for us in (0, 400, 800, 1200, 1600)))
    setup.drive("STOP", 10 * MS + 100 * US)
    assert setup.poll(11 * MS) == []
    assert setup.poll(12 * MS) == []
    assert setup.poll(13 * MS) == [(START, 10 * MS), (STOP, 10 * MS + 100 * US)]


def test_interrupts_overtake() -> None:
    """An edge that the kernel's thread delivers late, but within `glitch_us`, is reported in order
    and is not a loss."""
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


def test_edges_that_the_kernel_joins() -> None:
    """Two interrupts before their thread has run are one event with the level after both. This is
    never a loss, whether it is a glitch or not."""
    setup = TriggerSetup()
    rise, fall = gpiod.EdgeEvent.Type.RISING_EDGE.value, gpiod.EdgeEvent.Type.FALLING_EDGE.value
    reported = (
        (fall, MS + 20 * US, 2, 1),
        (rise, 5 * MS + 20 * US, 5, 2),
    )  # kind, stamp, edges so far, events so far
    setup.gpio.requests[0].queue.extend(
        gpiod.EdgeEvent(k, setup.t0 + t, 1, edges, n) for k, t, edges, n in reported
    )
    assert setup.poll(9 * MS) == [(START, 5 * MS + 20 * US)]
    assert (setup.trigger.edge_counters.lost_edges, setup.trigger.edge_counters.glitches) == (0, 1)


def test_event_numbers_wrap() -> None:
    """The kernel's 32-bit event numbers wrap without a loss."""
    setup = TriggerSetup()
    setup.trigger._lines[0].seqno = 2**32 - 2
    setup.queue((True, MS, 2**32 - 1), (False, 3 * MS, 0), (True, 5 * MS, 1))
    assert setup.poll(9 * MS) == [(START, MS), (START, 5 * MS)]
    assert setup.trigger.edge_counters.lost_edges == 0


# ---------------------------------------------------------------- losses and storms


def test_overrun() -> None:
    """Dropped events are counted and reported as one LOST; no edge is derived from the rest or from
    the level."""
    setup = TriggerSetup(mode="one-line", stop="", queue=4)
    setup.drive("START", 5 * MS)
    assert setup.run(6 * MS) == [(START, 5 * MS)]
    setup.drive("START", *(t * MS for t in range(10, 17)), level=False)
    assert setup.poll(20 * MS) == [(LOST, 13 * MS)]  # the first that was left
    assert setup.trigger.edge_counters.lost_edges == 3
    setup.drive("START", 30 * MS, 40 * MS)  # it is low now, though a START was reported last
    assert setup.run(50 * MS) == [(START, 30 * MS), (STOP, 40 * MS)]
    assert setup.trigger.edge_counters.glitches == setup.trigger.edge_counters.storms == 0


def test_blind_until_quiet() -> None:
    """After a loss nothing counts until all lines have been quiet for `glitch_us`; then the levels
    are read again."""
    setup = TriggerSetup(mode="one-line", stop="", queue=4)
    setup.drive("START", *(t * 100 * US for t in (100, 110, 120, 130, 140, 144, 148)))
    assert (setup.poll(14_500 * US), setup.trigger.blind) == ([(LOST, 12 * MS)], True)
    assert (setup.poll(15_000 * US), setup.trigger.blind) == ([], True)
    assert (setup.poll(15_299 * US), setup.trigger.blind) == ([], True)
    assert (setup.poll(15_300 * US), setup.trigger.blind) == ([], False)
    setup.drive("START", 20 * MS, level=False)
    assert setup.poll(30 * MS) == [(STOP, 20 * MS)]


def test_loss_upon_loss() -> None:
    """A loss is reported as soon as it is certain; further losses before the lines are quiet are
    only counted."""
    setup = TriggerSetup(queue=32)
    setup.drive("START", *(10 * MS + i * US for i in range(100)))
    assert setup.poll(10 * MS + 49 * US) == [(LOST, 10 * MS + 18 * US)]
    assert setup.trigger.edge_counters.lost_edges == 50 - 32
    assert setup.run(20 * MS) == []
    assert setup.trigger.edge_counters.lost_edges == 100 - 32 - 32


def test_loss_ends_what_is_open() -> None:
    """A loss discards bursts that are still open; a settled edge that waited for them is reported
    before it."""
    setup = TriggerSetup({CHIP0: ("START",), CHIP1: ("STOP",)}, queue=4)
    setup.drive("START", *(t * 100 * US for t in (50, 54, 58, 62, 66, 70, 74, 78)))
    setup.drive("STOP", 5_100 * US)
    assert setup.poll(5_900 * US) == []
    assert setup.poll(10 * MS) == [(STOP, 5_100 * US), (LOST, 6_600 * US)]
    assert setup.poll(20 * MS) == []


def test_nothing_between_loss_and_quiet() -> None:
    """An edge of another chip that came after the loss is not reported: its STOP might be among the
    lost events."""
    setup = TriggerSetup({CHIP0: ("START",), CHIP1: ("STOP",)}, queue=4)
    setup.drive("STOP", *(t * MS for t in range(10, 15)))
    setup.drive("START", 15 * MS, 17 * MS)
    assert setup.poll(20 * MS) == [(LOST, 11 * MS)]
    assert setup.run(30 * MS) == []


@pytest.mark.parametrize("step_ns", [US, 10 * US])
def test_storm(step_ns: int) -> None:
    """10,000 edges in a burst are one LOST at the first one above the limit; the line works again
    when it is quiet."""
    setup = TriggerSetup(mode="one-line", stop="")
    setup.drive("START", *(10 * MS + i * step_ns for i in range(10_000)))
    assert setup.run(200 * MS) == [(LOST, 10 * MS + 2000 * step_ns)]
    assert (setup.trigger.edge_counters.storms, setup.trigger.edge_counters.lost_edges) == (1, 0)
    setup.drive("START", 300 * MS, 400 * MS)
    assert setup.run(500 * MS) == [(START, 300 * MS), (STOP, 400 * MS)]


def test_storm_of_just_storm_edges() -> None:
    """A burst of `storm_edges` edges and not more is an edge or a glitch like any other."""
    setup = TriggerSetup(storm_edges=5)
    setup.drive("START", *(10 * MS + i * US for i in range(5)))
    assert setup.run(20 * MS) == [(START, 10 * MS)]


def test_storm_between_two_calls() -> None:
    """Of 10,000 edges between two calls the kernel keeps the last 1024: one LOST, and all the
    others counted."""
    setup = TriggerSetup()
    setup.drive("START", *(10 * MS + i * US for i in range(10_000)))
    assert setup.poll(50 * MS) == [(LOST, 10 * MS + 8976 * US)]
    assert setup.trigger.edge_counters.lost_edges == 8976
    setup.drive("START", 60 * MS)
    assert setup.run(70 * MS) == [(START, 60 * MS)]


def test_reading_is_bounded() -> None:
    """A call reads no more than `storm_edges` events and leaves the rest to the next one."""
    setup = TriggerSetup(storm_edges=100)
    setup.drive("START", *(10 * MS + i * US for i in range(1000)))
    setup.poll(50 * MS)
    assert len(setup.gpio.requests[0].queue) == 1000 - 100 // 2  # of two lines
    assert [edge for _ in range(20) for edge in setup.poll(50 * MS)] == [(LOST, 10 * MS + 100 * US)]
    assert not setup.trigger.blind


def test_unread_rest_of_a_burst() -> None:
    """A burst with events still in the queue is not settled, though the call is long after it."""
    # one event of each chip a call
    setup = TriggerSetup({CHIP0: ("START",), CHIP1: ("STOP",)}, storm_edges=3)
    setup.drive("START", 10 * MS, 10 * MS + 100 * US, 10 * MS + 200 * US)
    setup.drive("STOP", 11 * MS)
    reported = [setup.poll((50 + i) * MS) for i in range(5)]
    assert [edge for edges in reported for edge in edges] == [(START, 10 * MS), (STOP, 11 * MS)]
    assert reported[0] == reported[1] == []
    assert setup.trigger.edge_counters.glitches == 0


def test_unread_edges_of_another_chip() -> None:
    """While one chip's queue is being read, edges are reported as they become certain, and later
    ones wait."""
    # one event of each chip a call
    setup = TriggerSetup({CHIP0: ("START",), CHIP1: ("STOP",)}, storm_edges=2)
    setup.drive("START", 10 * MS, 20 * MS)
    setup.drive("STOP", *(t * MS for t in (1, 2, 3, 4)))
    reported = [setup.poll((50 + i) * MS) for i in range(6)]
    assert reported == [[], [(STOP, 1 * MS)], [], [(STOP, 3 * MS)], [(START, 10 * MS)], []]


def test_three_chips() -> None:
    """Each chip is read in each call, however few edges make a storm."""
    setup = TriggerSetup(
        {CHIP0: ("START",), CHIP1: ("STOP",), "/dev/gpiochip2": ("NEW",)},
        new_object="NEW",
        storm_edges=2,
    )
    setup.drive("START", MS)
    assert setup.run(5 * MS) == [(START, MS)]


def test_chip_pulled_out() -> None:
    """A chip that is unplugged while it is read is a LineError that names its line and the
    errno."""
    setup = TriggerSetup()
    setup.gpio.refuse[CHIP0] = 19
    with pytest.raises(LineError, match=r"cannot read gpio lines START: .*errno 19.*plug it in"):
        setup.poll(MS)


# ---------------------------------------------------------------- any edges at all

gaps = st.lists(st.integers(1, 1500) | st.sampled_from([10, 499, 500, 501]), max_size=40)


def toggles(gaps_us: list[int]) -> list[int]:
    """Times in ns of edges with these gaps."""
    return [t * US for t in accumulate(gaps_us)]


def settled(times_ns: list[int]) -> list[tuple[int, bool]]:
    """Reference implementation: (first edge, level) of each burst that changes the level of a line
    that was low."""
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
def test_any_edges(lines: tuple[list[int], list[int], list[int]], step_us: int) -> None:
    """For any edges on three lines of two chips and any times of calls: the edges of the reference,
    in order of time."""
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
def test_any_losses(
    gaps_us: list[int], step_us: int, storm_edges: int, queue: int, high: bool
) -> None:
    """START and STOP alternate unless LOST is between them, times never go back, no short pulse
    makes an edge."""
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


def test_find_on_two_chips() -> None:
    """Lines are found by name on any chip; chip numbers may have gaps."""
    gpio = sim({"/dev/gpiochip4": ("", "STOP"), "/dev/gpiochip11": ("START",)})
    assert find_lines(gpio, ["START", "STOP"]) == {
        "START": ("/dev/gpiochip11", 0),
        "STOP": ("/dev/gpiochip4", 1),
    }


def test_find_through_link() -> None:
    """A second path to the same chip (Raspberry Pi OS links gpiochip4 to gpiochip0) makes no name
    ambiguous."""
    gpio = sim({CHIP0: ("START",)})
    chip = gpio.Chip
    with (
        mock.patch.object(
            gpio, "is_gpiochip_device", lambda path: path in (CHIP0, "/dev/gpiochip4")
        ),
        mock.patch.object(gpio, "Chip", side_effect=lambda _: chip(CHIP0)),
    ):
        assert find_lines(gpio, ["START"]) == {"START": (CHIP0, 0)}


def test_missing_line() -> None:
    """A missing line is named together with the most similar names."""
    with pytest.raises(LineError, match=r"no gpio line is named 'GPIO71'; nearest: GPIO17"):
        find_lines(sim({CHIP0: ("", "ID_SDA", "GPIO17")}), ["GPIO71"])


def test_nothing_like_it() -> None:
    """If no name is similar, some existing names are listed."""
    with pytest.raises(LineError, match=r"'START'; nearest: PA0, PA1, PA2;"):
        find_lines(sim({CHIP0: ("PA0", "PA1", "PA2", "PA3")}), ["START"])


def test_nameless_line() -> None:
    """An empty name finds no nameless line."""
    with pytest.raises(LineError, match="no gpio line is named ''"):
        GpioTrigger(trigger_config(start=""), sim({CHIP0: INPUTS}))


@pytest.mark.parametrize(
    ("chips", "where"),
    [
        ({CHIP0: ("A",), CHIP1: ("", "A")}, f"{CHIP0} line 0 and {CHIP1} line 1"),
        ({CHIP0: ("A", "A")}, f"{CHIP0} line 0 and {CHIP0} line 1"),
    ],
)
def test_ambiguous_line(chips: dict[str, tuple[str, ...]], where: str) -> None:
    """A name of two lines is refused, naming both."""
    with pytest.raises(LineError, match=f"'A' is ambiguous: {where}"):
        find_lines(sim(chips), ["A"])


def test_one_line_two_roles() -> None:
    """A line that is given two roles is refused before it is requested."""
    with pytest.raises(LineError, match="two roles in START, START"):
        GpioTrigger(trigger_config(stop="START"), sim({CHIP0: INPUTS}))


@pytest.mark.parametrize("number", [1, 13])
def test_permission_denied(number: int) -> None:
    """A chip that may not be opened is named with advice, if the line is on no other chip."""
    gpio = sim({CHIP0: ("START",), CHIP1: ("STOP",)})
    gpio.refuse[CHIP1] = number
    assert find_lines(gpio, ["START"]) == {"START": (CHIP0, 0)}
    with pytest.raises(LineError, match=f"may not open {CHIP1}.*'STOP'.*group gpio"):
        find_lines(gpio, ["START", "STOP"])


def test_unreadable_chip() -> None:
    """Any other failure of a chip names it."""
    gpio = sim({CHIP0: INPUTS})
    gpio.refuse[CHIP0] = 5
    with pytest.raises(LineError, match=f"cannot list the gpio lines of {CHIP0}"):
        find_lines(gpio, ["START"])


def test_no_chip() -> None:
    """A machine without GPIO is an error, unless no line is wanted."""
    with pytest.raises(
        LineError,
        match=r"no /dev/gpiochip.*; without lines leave `board` out and set trigger\.mode",
    ):
        find_lines(sim({}), ["START"])
    assert find_lines(sim({}), []) == {}


@pytest.mark.parametrize(
    "module", [SimpleNamespace(__version__="1.6.3", Chip=object), SimpleNamespace()]
)
def test_binding_of_libgpiod_1(module: Any) -> None:
    """The old binding, or another module of that name, is refused with its version and advice."""
    version = getattr(module, "__version__", "of unknown version")
    with pytest.raises(LineError, match=f"module gpiod {version} is not.*pip install 'gpiod>=2'"):
        GpioTrigger(trigger_config(), module)
    with pytest.raises(LineError, match="is not the libgpiod v2 binding"):
        Lines(output_config(), module, VirtualClock())


def test_real_binding() -> None:
    """The installed gpiod is accepted, and so is the double."""
    check_binding(gpiod)
    check_binding(sim({}))


def test_busy_line() -> None:
    """A line that is in use is a LineError with errno 16, and the free lines are released."""
    gpio = sim({CHIP0: ("START",), CHIP1: ("STOP",)})
    with GpioTrigger(trigger_config(stop="", start="STOP", mode="one-line"), gpio):
        with pytest.raises(
            LineError, match=r"cannot request gpio lines STOP: .*errno 16.*gpioinfo"
        ):
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


def test_outputs_begin_low(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """All outputs are requested low, with one request per chip, and nothing is written."""
    gpio, _, _ = panel
    settings = [s for request in gpio.requests for s in request.settings.values()]
    assert [request.path for request in gpio.requests] == [CHIP0, CHIP1]
    assert {(s.direction, s.output_value) for s in settings} == {
        (gpiod.line.Direction.OUTPUT, gpiod.line.Value.INACTIVE)
    }
    assert gpio.written == []


def test_only_changes_are_written(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """READY, BUSY and FAULT are written only when they change."""
    gpio, clock, lines = panel
    lines.show(ready=True, busy=False, fault=False)
    clock.sleep_until(MS)
    lines.show(ready=True, busy=False, fault=False)
    lines.show(ready=False, busy=True, fault=False)
    clock.sleep_until(2 * MS)
    lines.show(ready=False, busy=False, fault=True)
    assert gpio.written == [
        (0, "READY", True),
        (MS, "READY", False),
        (MS, "BUSY", True),
        (2 * MS, "BUSY", False),
        (2 * MS, "FAULT", True),
    ]


def test_class_bits_settle_first(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """RESULT VALID falls, the bits change (lowest first in the list), and `settle_us` later RESULT
    VALID rises."""
    gpio, _, lines = panel
    lines.result(5)
    assert gpio.written == [(0, "C0", True), (0, "C2", True), (200 * US, "VALID", True)]
    gpio.written.clear()
    lines.result(2)
    assert gpio.written == [
        (200 * US, "VALID", False),
        (200 * US, "C0", False),
        (200 * US, "C1", True),
        (200 * US, "C2", False),
        (400 * US, "VALID", True),
    ]


def test_same_code_again(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """The same code again also gives a new RESULT VALID."""
    gpio, _, lines = panel
    lines.result(0)
    lines.result(0)
    assert gpio.written == [
        (200 * US, "VALID", True),
        (200 * US, "VALID", False),
        (400 * US, "VALID", True),
    ]


def test_no_result(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """With None RESULT VALID falls at once and no bit changes."""
    gpio, clock, lines = panel
    lines.result(1)
    gpio.written.clear()
    lines.result(None)
    assert gpio.written == [(200 * US, "VALID", False)]
    assert clock.now_ns() == 200 * US


@pytest.mark.parametrize("code", [-1, 8])
def test_code_that_does_not_fit(panel: tuple[SimGpio, VirtualClock, Lines], code: int) -> None:
    """A code that is too large for the bits is a LineError and leaves RESULT VALID low."""
    gpio, _, lines = panel
    assert lines.capacity == 8
    lines.result(7)
    gpio.written.clear()
    with pytest.raises(LineError, match=f"code {code} does not fit 3 class bits"):
        lines.result(code)
    assert gpio.written == [(200 * US, "VALID", False)]


def test_not_wired() -> None:
    """Lines without a name are neither searched nor written; a box without outputs needs no
    chip."""
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


def test_close_drops_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing drives READY and all others low, as on a chip that keeps driven levels; closing twice
    does no harm."""
    clock = VirtualClock(0)
    gpio = SimGpio(clock, {CHIP0: OUTPUTS})
    monkeypatch.setattr(SimRequest, "release", lambda request: gpio.requests.remove(request))
    with Lines(output_config(), gpio, clock) as lines:
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


def test_close_of_a_dead_chip(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """A chip that is gone cannot be driven low: LineError, and the other lines are still
    released."""
    gpio, _, lines = panel
    lines.show(ready=True, busy=False, fault=False)
    gpio.refuse[CHIP0] = 19
    with pytest.raises(LineError, match=r"cannot write gpio lines READY: .*errno 19"):
        lines.close()
    assert gpio.requests == []
    lines.close()


# ---------------------------------------------------------------- the double itself


def test_double_releases_low(panel: tuple[SimGpio, VirtualClock, Lines]) -> None:
    """An output that is released while it is high falls, by its pull-down."""
    gpio, clock, lines = panel
    lines.show(ready=True, busy=False, fault=False)
    clock.sleep_until(MS)
    for request in list(gpio.requests):
        request.release()
    assert gpio.written == [(0, "READY", True), (MS, "READY", False)]
    with pytest.raises(gpiod.RequestReleasedError):
        lines.show(ready=False, busy=False, fault=False)


@pytest.mark.parametrize(("asked", "granted"), [(0, 32), (5, 8), (64, 64), (5000, 1024)])
def test_double_queues_as_the_kernel(asked: int, granted: int) -> None:
    """16 events a line unless asked otherwise, rounded up to a power of two, at most 1024; the
    oldest is dropped."""
    clock = VirtualClock(0)
    gpio = SimGpio(clock, {CHIP0: INPUTS})
    request = gpio.request_lines(
        CHIP0, {(1, 2): gpiod.LineSettings(edge_detection=gpiod.line.Edge.RISING)}, "", asked
    )
    for t_ns in range(2 * granted + 2):
        gpio.drive("START", t_ns % 2 == 0, t_ns)
    clock.sleep_until(MS)
    events = request.read_edge_events(5000)
    assert [(e.timestamp_ns, e.global_seqno, e.line_seqno) for e in events] == [
        (2 * i, i + 1, i + 1) for i in range(1, granted + 1)
    ]


def test_double_never_waits() -> None:
    """Reading from an empty queue, where gpiod would wait for ever, and driving an unknown line are
    mistakes."""
    gpio = SimGpio(VirtualClock(), {CHIP0: INPUTS})
    with pytest.raises(RuntimeError, match="empty queue"):
        gpio.request_lines(CHIP0, {(1,): gpiod.LineSettings()}).read_edge_events(1)
    with pytest.raises(ValueError, match="no simulated gpio line is named 'START1'"):
        gpio.drive("START1", True, 0)
