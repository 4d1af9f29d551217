"""Coils of the Modbus bridge: a coil is on only after the box has carried its command out, so a
refused command that is sent again is carried out."""

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
    """Carries out commands, except those in `refused`; `sent` lists the commands it was given,
    `slides` their values."""

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
    """Ask a bridge over another connection."""
    coils, slide = [False] * len(COILS), [0] * len(SLIDE)
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
def test_a_refused_command_is_carried_out_when_it_is_sent_again(
    source: ScriptedSource, ask: Callable[[bytes], bytes], write: bytes, error: Exception
):
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


@pytest.mark.parametrize("write", [one(START, True), several(START)])
def test_a_command_that_met_a_busy_bridge_is_carried_out_when_it_is_sent_again(write: bytes):
    """Exception 6 while another peer's command runs, with the coil off; afterwards the same write
    sends the command."""
    source = ScriptedSource()
    bridge = ModbusBridge(source, SystemClock(), writes=True)
    mine, slide = [False] * len(COILS), [0] * len(SLIDE)

    async def both() -> None:
        running, go_on = asyncio.Event(), asyncio.Event()
        to_thread = asyncio.to_thread

        async def slow(send: Callable[[str], str], command: str) -> str:
            running.set()
            await go_on.wait()
            return await to_thread(send, command)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(asyncio, "to_thread", slow)
            tare = asyncio.create_task(
                bridge.answer(ModbusRequest(1, 1, one(8, True)), [False] * len(COILS), slide)
            )
            await running.wait()
            assert await bridge.answer(ModbusRequest(1, 1, write), mine, slide) == bytes(
                [write[0] | 0x80, 6]
            )
            assert not any(mine)
            go_on.set()
            await tare
        assert await bridge.answer(ModbusRequest(2, 1, write), mine, slide) == write[:5]

    asyncio.run(both())
    assert source.sent == ["TARE", "START"]


def test_no_stop_goes_out_without_its_start(source: ScriptedSource, ask: Callable[[bytes], bytes]):
    """Both in one write: after a refused START no STOP is sent; sent again, both are, in order."""
    source.refused = {"START"}
    assert ask(several(START | STOP)) == b"\x8f\x04"
    assert levels(ask) == 0
    assert source.sent == ["START"]
    source.refused = set()
    assert ask(several(START | STOP))[0] == 15
    assert source.sent == ["START", "START", "STOP"]
    assert levels(ask) == START | STOP


def test_a_command_that_was_carried_out_is_not_repeated(
    source: ScriptedSource, ask: Callable[[bytes], bytes]
):
    """START was carried out, STOP was refused: sent again, the write sends STOP alone."""
    source.refused = {"STOP"}
    assert ask(several(START | STOP)) == b"\x8f\x04"
    assert levels(ask) == START
    source.refused = set()
    assert ask(several(START | STOP))[0] == 15
    assert source.sent == ["START", "STOP", "STOP"]


def test_a_coil_falls_although_another_is_refused(
    source: ScriptedSource, ask: Callable[[bytes], bytes]
):
    """START falls with the write whose STOP is refused, so the next START is a command again."""
    ask(several(START))
    source.refused = {"STOP"}
    assert ask(several(STOP)) == b"\x8f\x04"
    assert levels(ask) == 0
    assert ask(several(START))[0] == 15
    assert source.sent == ["START", "STOP", "START"]


def test_the_commands_of_one_write_have_an_order(
    source: ScriptedSource, ask: Callable[[bytes], bytes]
):
    """The old sweep ends first, then the new object is announced, then its sweep begins."""
    assert ask(several(0b11111))[0] == 15
    assert source.sent == ["ABORT", "NEW", "TARE", "START", "STOP"]


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
def test_other_registers_are_not_written(
    source: ScriptedSource, ask: Callable[[bytes], bytes], pdu: str, code: int
):
    """Functions 6 and 16 are refused beside the two registers, or with a wrong length, and change
    nothing."""
    data = bytes.fromhex(pdu)
    assert ask(data) == bytes([data[0] | 0x80, code])
    assert not source.sent
    assert levels(ask) == 0
    assert ask(bytes.fromhex("0300280002")) == bytes.fromhex("030400000000")


def test_start_has_the_registers_of_its_connection(
    source: ScriptedSource, ask: Callable[[bytes], bytes]
):
    """Tenths of mm/s and hundredths of N, written in one request or in two, and read back; 0 is
    left out. Other commands and other connections have none."""
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
