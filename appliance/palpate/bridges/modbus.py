"""The box as a Modbus TCP server, with the registers, inputs and coils of docs/robots/modbus.md.

All registers of one request show the same moment. A coil is a command that is sent when the coil
rises: from a 0 that the same connection has written, so that a controller that writes its coils
cyclically does not send a command again after a broken connection.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from palpate.bridges import modbus_pdu as pdu
from palpate.bridges.modbus_pdu import (
    ExceptionCode,
    ModbusRequest,
    Reading,
    RequestRefused,
    Writing,
)
from palpate.bridges.server import PACE_S, TcpPeer
from palpate.bridges.source import BoxView, Source
from palpate.core.clock import Clock
from palpate.core.errors import ApplianceError, FormatError
from palpate.core.log import SparseLog
from palpate.core.sentences import DIRECTIONS, MOST_FINGERS
from palpate.core.status import WORDS, Status

VERSION = 1
"""Version of the map of registers. It only grows at the end; the meaning of an entry never
changes."""
STATES = ("streaming", "absent", "busy", "denied", "mismatch", "silent", "lost")
"""States of the skin; the code is the index + 1. 0: the box is not heard."""
STATUS_CODES: Mapping[Status, int] = {status: words.code for status, words in WORDS.items()}
STALE = 99
"""Status code while the box is not heard."""
COILS = ("START", "STOP", "NEW", "TARE", "ABORT")
ORDER = ("ABORT", "NEW", "TARE", "START", "STOP")
"""Order in which the commands of one write are sent."""
INPUTS = ("alive", "ready", "sweeping", "fault", "known", "early")
LABEL_WORDS = 16
REQUEST_S = 5.0
"""Longest time for the rest of a request, and for a peer to accept a reply."""


@dataclass(frozen=True, slots=True)
class Register:
    """An entry of the map. words: number of its registers, the highest first. get: its value."""

    name: str
    get: Callable[[BoxView], int]
    words: int = 1


def _of_answer(name: str, steps: int = 1) -> Callable[[BoxView], int]:
    """An entry for a number of the answer, in steps of its unit; 0 without it."""
    return lambda view: round(steps * (getattr(view.answer, name, 0) or 0))


def _of_state(name: str) -> Callable[[BoxView], int]:
    return lambda view: getattr(view.state, name, 0)


def _state_code(view: BoxView) -> int:
    skin = view.state.skin if view.state else ""
    return STATES.index(skin) + 1 if skin in STATES else 0


def _name(view: BoxView) -> int:
    """The first eight letters of the finger's name."""
    name = view.answer.finger if view.answer else ""
    return int.from_bytes(name.encode("ascii", "replace")[:8].ljust(8, b"\0"), "big")


def _direction(view: BoxView) -> int:
    """1 + index in DIRECTIONS; 0: it was not measured."""
    direction = view.answer.direction if view.answer else ""
    return DIRECTIONS.index(direction) + 1 if direction in DIRECTIONS else 0


STATUS = Register("status", lambda view: STATUS_CODES[view.answer.status] if view.answer else 0)
LABEL_CODE = Register(
    "label code",
    lambda view: view.code(view.answer.label) if view.answer and view.answer.known else 0,
)
PROBABILITY = Register("probability", _of_answer("probability", 1000))
REGISTERS = (
    Register("map version", lambda view: VERSION),
    Register("heartbeat", lambda view: view.beats),
    Register("state of the skin", _state_code),
    Register("answers", lambda view: view.answers),
    STATUS,
    LABEL_CODE,
    Register(
        "likeliest label code", lambda view: view.code(view.answer.label) if view.answer else 0
    ),
    PROBABILITY,
    Register("margin", _of_answer("margin", 1000)),
    Register("latency", _of_answer("latency_ms", 100)),
    Register("early", _of_answer("early")),
    Register("fused", _of_answer("fused")),
    Register("lost in the window", _of_answer("lost")),
    Register("sweep", _of_answer("sweep"), 2),
    Register("answered", _of_state("answered"), 2),
    Register("frames", _of_state("frames"), 2),
    Register("lost frames", _of_state("lost_frames"), 2),
    Register("missed answers", lambda view: view.missed),
    Register("damaged sentences", lambda view: view.damaged),
    Register("labels", lambda view: len(view.labels)),
)
ADDRESSES: Mapping[str, int] = {
    register.name: sum(before.words for before in REGISTERS[:i])
    for i, register in enumerate(REGISTERS)
} | {"label": sum(register.words for register in REGISTERS)}
"""Address of the first word of each entry; the label's text comes last."""
SLIDE = {"speed_mm_s": 10, "force_n": 100}
"""The registers that a peer may write, after the label's text: speed and force of the slide as the
command START has them, and the steps of a register in one mm/s or N."""
SLIDE_AT = ADDRESSES["label"] + LABEL_WORDS


MEASURED = (
    Register("measured speed", _of_answer("measured_mm_s", 10)),
    Register("direction", _direction),
)
"""The entries after the registers of SLIDE."""
FINGER = Register("finger", _name, 4), STATUS, LABEL_CODE, PROBABILITY
"""The last entries of the map, for each finger; before them stands the number of fingers."""
COUNTERS = (
    *("heartbeat", "answers", "sweep", "answered"),
    *("frames", "lost frames", "missed answers", "damaged sentences"),
)
"""Entries that wrap; all others stay at the largest number that fits."""


def _words(entries: Sequence[Register], view: BoxView) -> list[int]:
    words: list[int] = []
    for register in entries:
        value, top = register.get(view), 1 << 16 * register.words
        value = value % top if register.name in COUNTERS else min(value, top - 1)
        words += [value >> 16 * i & 0xFFFF for i in reversed(range(register.words))]
    return words


def _finger_words(view: BoxView) -> list[int]:
    """The number of fingers, and the words of MOST_FINGERS; 0 for a finger that is not there."""
    fingers = view.answer.fingers if view.answer else ()
    each = (*fingers, *[None] * (MOST_FINGERS - len(fingers)))
    words = [_words(FINGER, replace(view, answer=one)) for one in each[:MOST_FINGERS]]
    return [len(fingers), *chain.from_iterable(words)]


def registers(view: BoxView, *, alive: bool) -> list[int]:
    """The words of REGISTERS and of the label's text. alive: the box was heard lately."""
    words = _words(REGISTERS, view)
    if not alive:
        words[ADDRESSES["state of the skin"]] = 0
        words[ADDRESSES["status"]] = STALE
        words[ADDRESSES["label code"]] = 0
    text = (view.answer.label if view.answer else "").encode("ascii", "replace")[: 2 * LABEL_WORDS]
    text = text.ljust(2 * LABEL_WORDS, b"\0")
    return words + [text[i] << 8 | text[i + 1] for i in range(0, len(text), 2)]


def inputs(view: BoxView, *, alive: bool) -> list[bool]:
    """The discrete inputs, in the order of INPUTS."""
    state, answer = view.state, view.answer
    if not (alive and state):
        return [False, False, False, True, False, False]
    known, early = (answer.known, answer.early) if answer else (False, False)
    return [True, state.ready, state.sweeping, state.skin != "streaming", known, early]


class ModbusBridge:
    """Serves connections. writes: whether coils and registers may be written. Only one command is
    sent at a time."""

    def __init__(self, source: Source, clock: Clock, *, writes: bool) -> None:
        self._log = SparseLog(clock.now_ns)
        self._source, self._clock, self._writes = source, clock, writes
        self._commanding = asyncio.Lock()

    async def serve(self, peer: TcpPeer) -> None:
        """Answer the requests of one connection until it ends, hangs, or sends invalid bytes."""
        coils: list[bool | None] = [None] * len(COILS)
        slide, rest = [0] * len(SLIDE), b""
        while data := await peer.read(REQUEST_S if rest else None):
            try:
                found, rest = pdu.requests(data, rest)
            except FormatError:
                return
            for request in found:
                peer.write(pdu.reply(request, await self.answer(request, coils, slide)))
            await peer.flush(REQUEST_S)
            await asyncio.sleep(PACE_S * len(found))

    async def answer(
        self, request: ModbusRequest, coils: list[bool | None], slide: list[int]
    ) -> bytes:
        """The reply's function and data. coils, slide: the coils (None: not yet written as 0) and
        the registers of SLIDE of this connection; they change with its writes."""
        try:
            wanted = pdu.parse(request.pdu)
            if isinstance(wanted, Reading):
                return pdu.read(wanted, self._values(wanted.function, coils, slide))
            await self._write(wanted, coils, slide)
            return pdu.written(request.pdu)
        except RequestRefused as e:
            return pdu.refusal(request.pdu, e.fault)

    def _values(
        self, function: int, coils: Sequence[bool | None], slide: Sequence[int]
    ) -> Sequence[int]:
        if function == pdu.READ_COILS:
            return [bool(coil) for coil in coils]
        view = self._source.view()
        alive = view.alive(self._clock.now_ns())
        if function == pdu.READ_INPUTS:
            return inputs(view, alive=alive)
        last = *_words(MEASURED, view), *_finger_words(view)
        return [*registers(view, alive=alive), *slide, *last]

    async def _write(self, wanted: Writing, coils: list[bool | None], slide: list[int]) -> None:
        if not self._writes:
            raise RequestRefused(ExceptionCode.FUNCTION)
        if wanted.function in (pdu.WRITE_REGISTER, pdu.WRITE_REGISTERS):
            first = wanted.address - SLIDE_AT
            if not 0 <= first <= len(slide) - len(wanted.values):
                raise RequestRefused(ExceptionCode.ADDRESS)
            slide[first : first + len(wanted.values)] = wanted.values
            return
        if wanted.address + len(wanted.values) > len(coils):
            raise RequestRefused(ExceptionCode.ADDRESS)
        on = [at for at, value in enumerate(wanted.values, wanted.address) if value]
        rising = {COILS[at]: at for at in on if coils[at] is False}
        for at, value in enumerate(wanted.values, wanted.address):
            if not value:
                coils[at] = False
        if {"START", "STOP"} <= rising.keys():  # a sweep of 0 ms is nobody's wish
            for name in ("START", "STOP"):
                coils[rising.pop(name)] = None
        await self._command_all(rising, coils, slide)
        if any(coils[at] is None for at in on):
            raise RequestRefused(ExceptionCode.VALUE)

    async def _command_all(
        self, rising: Mapping[str, int], coils: list[bool | None], slide: Sequence[int]
    ) -> None:
        """Send the commands of rising coils. Raises RequestRefused."""
        if not rising:
            return
        if self._commanding.locked():
            raise RequestRefused(ExceptionCode.BUSY)
        async with self._commanding:  # no other peer commands within one write
            for name in sorted(rising, key=ORDER.index):
                await self._command(name, slide if name == "START" else ())
                coils[rising[name]] = True  # only now: a refused command is sent again

    async def _command(self, name: str, slide: Sequence[int]) -> None:
        # 0: the peer does not know it
        values = {
            value: word / SLIDE[value] for value, word in zip(SLIDE, slide, strict=False) if word
        }
        try:
            await asyncio.to_thread(self._source.send, name, **values)
        except ApplianceError as e:
            self._log.warning(f"modbus: {name}: {e}")
            raise RequestRefused(ExceptionCode.DEVICE) from e
