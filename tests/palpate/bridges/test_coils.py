"""Coils of the Modbus bridge: on only once the box has carried the command out."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from palpate.bridges.modbus import COILS, SLIDE, SLIDE_AT, ModbusBridge
from palpate.bridges.modbus_pdu import ModbusRequest
from palpate.bridges.source import BoxView
from palpate.core.clock import SystemClock
from palpate.core.errors import CommandRefused, NoAnswer

READ = bytes.fromhex("0100000005")
START, STOP, NEW = (1 << COILS.index(name) for name in ("START", "STOP", "NEW"))


class ScriptedSource:
    """Carries out commands except `refused`; `sent` lists those given, `slides` their values."""

    name = "scripted"

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.slides: list[dict[str, float]] = []
        self.refused: set[str] = set()
        self.error: Exception = CommandRefused("set trigger.mode to serial")

    def view(self) -> BoxView:
        return BoxView()

    def refresh(self) -> None: ...

    def close(self) -> None: ...

    def wait_ready(self, timeout_s: float) -> None: ...

    def send(self, command: str, **slide: float) -> str:
        self.sent.append(command)
        self.slides.append(slide)
        if command in self.refused:
            raise self.error
        return "done"


@pytest.fixture
def source() -> ScriptedSource:
    return ScriptedSource()


@pytest.fixture
def ask(source: ScriptedSource) -> Callable[[bytes], bytes]:
    """Ask a bridge that may write, over one connection."""
    return connected(ModbusBridge(source, SystemClock(), writes=True))


def connected(bridge: ModbusBridge) -> Callable[[bytes], bytes]:
    """Ask a bridge over another connection, on which all coils were written as 0."""
    return fresh(bridge, [False] * len(COILS))


def fresh(bridge: ModbusBridge, coils: list[bool | None]) -> Callable[[bytes], bytes]:
    """Ask a bridge over a connection with these coils."""
    slide = [0] * len(SLIDE)
    return lambda pdu: asyncio.run(bridge.answer(ModbusRequest(1, 1, pdu), coils, slide))


def one(coil: int, on: bool) -> bytes:
    """Function 5 for a coil, given as its bit."""
    return bytes([5, 0, coil.bit_length() - 1, 0xFF if on else 0, 0])


def several(bits: int) -> bytes:
    """Function 15 for all coils."""
    return bytes([15, 0, 0, 0, len(COILS), 1, bits])


def levels(ask: Callable[[bytes], bytes]) -> int:
    """The coils as they are read back."""
    return ask(READ)[2]


@pytest.mark.parametrize("error", [CommandRefused("no"), NoAnswer("no answer to START")])
@pytest.mark.parametrize("write", [one(START, True), several(START)])
def test_a_refused_command_is_carried_out_when_it_is_sent_again(source, ask, write, error):
    """Exception 4 twice, with the coil off; then the box obeys, and the coil is on."""
    source.refused, source.error = {"START"}, error
    for _ in range(2):
        assert ask(write) == bytes([write[0] | 0x80, 4])
        assert levels(ask) == 0
    source.refused = set()
    assert ask(write) == write[:5]
    assert levels(ask) == START
    assert source.sent == ["START"] * 3
    assert ask(write) == write[:5]  # still on: no second command
    assert source.sent == ["START"] * 3


BOTH = NEW | START
WRITES: dict[str, tuple[list[tuple[str, int, int]], list[str]]] = {
    "no START goes out without its NEW": (
        [("NEW", BOTH, 0), ("", BOTH, BOTH)],
        ["NEW", "NEW", "START"],
    ),
    "what was carried out is not repeated": (
        [("START", BOTH, NEW), ("", BOTH, BOTH)],
        ["NEW", "START", "START"],
    ),
    "a coil falls although another is refused": (
        [("", START, START), ("STOP", STOP, 0), ("", START, START)],
        ["START", "STOP", "START"],
    ),
    "the old sweep ends, then a new object, then its sweep": (
        [("", 0b11101, 0b11101)],
        ["ABORT", "NEW", "TARE", "START"],
    ),
}
"""Writes of all coils: the command that the box refuses, the coils wanted and those on afterwards;
and all commands that were sent."""


@pytest.mark.parametrize(("writes", "sent"), WRITES.values(), ids=WRITES)
def test_several_coils_in_one_write(source, ask, writes, sent):
    """Exception 4 if a command is refused; a coil is on only if its command was carried out."""
    for refused, wanted, on in writes:
        source.refused = {refused}
        assert ask(several(wanted))[:2] == (b"\x8f\x04" if refused else b"\x0f\x00")
        assert levels(ask) == on
    assert source.sent == sent


REFUSED = b"\x8f\x03"
DONE = b"\x0f\x00"
LEVELS: dict[str, tuple[list[tuple[int, bytes]], list[str]]] = {
    "connected again within a slide": (
        [(START, REFUSED), (START, REFUSED), (STOP, DONE), (0, DONE), (START, DONE)],
        ["STOP", "START"],
    ),
    "START still up beside STOP": ([(START, REFUSED), (START | STOP, REFUSED)], ["STOP"]),
    "all coils up": ([(31, REFUSED), (31, REFUSED)], []),
    "START and STOP at rest": (
        [
            (0, DONE),
            (START | STOP, REFUSED),
            (START | STOP, REFUSED),
            (START, REFUSED),
            (STOP, DONE),
        ],
        ["STOP"],
    ),
    "a new object, with START and STOP": ([(0, DONE), (START | STOP | NEW, REFUSED)], ["NEW"]),
}
"""Writes of all coils on a new connection with their replies, and all commands that were sent."""


@pytest.mark.parametrize(("writes", "sent"), LEVELS.values(), ids=LEVELS)
def test_a_coil_that_was_not_0_on_this_connection_does_not_rise(source, writes, sent):
    """Cyclic writers repeat nothing after a broken connection."""
    ask = fresh(ModbusBridge(source, SystemClock(), writes=True), [None] * len(COILS))
    assert [ask(several(bits))[:2] for bits, _ in writes] == [reply for _, reply in writes]
    assert source.sent == sent


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("0600000001", 2),
        ("0600270001", 2),
        ("06002a0001", 2),
        ("1000000001020001", 2),
        ("10002900020400010002", 2),
        ("10002800030600010002ffff", 2),
        ("060028", 3),
        ("060028000100", 3),
        ("100028000000", 3),
        ("1000280002020001", 3),
        ("10002800010400010002", 3),
        ("100028007cf8" + "0001" * 124, 3),
    ],
)
def test_other_registers_are_not_written(source, ask, pdu, code):
    """Other registers or wrong lengths in functions 6 and 16 are refused and change nothing."""
    data = bytes.fromhex(pdu)
    assert ask(data) == bytes([data[0] | 0x80, code])
    assert not source.sent
    assert levels(ask) == 0
    assert ask(bytes.fromhex("0300280002")) == bytes.fromhex("030400000000")


def test_start_has_the_registers_of_its_connection(source, ask):
    """Tenths of mm/s, hundredths of N; 0 is left out; other connections have none."""
    assert SLIDE_AT == 40
    assert ask(bytes.fromhex("10002800020401310096")) == bytes.fromhex("1000280002")
    assert ask(bytes.fromhex("0300280002")) == bytes.fromhex("030401310096")
    assert ask(bytes.fromhex("0400280002")) == bytes.fromhex("040401310096")
    for bits in (NEW, START, 0, START):
        ask(several(bits))
    assert ask(bytes.fromhex("0600280000")) == bytes.fromhex("0600280000")
    for bits in (0, START):
        ask(several(bits))
    both = {"speed_mm_s": 30.5, "force_n": 1.5}
    assert source.sent == ["NEW", "START", "START", "START"]
    assert source.slides == [{}, both, both, {"force_n": 1.5}]
    other = connected(ModbusBridge(source, SystemClock(), writes=True))
    other(several(START))
    assert source.slides[-1] == {}
