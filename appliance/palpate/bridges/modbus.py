"""The box as a Modbus TCP server, with the registers, inputs and coils of docs/robots/modbus.md.

All registers of one request show the same moment. A coil is a command that is sent when the coil
rises: from a 0 that the same connection has written, so that a controller that writes its coils
cyclically does not send a command again after a broken connection.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from palpate.bridges import modbus_pdu as pdu
from palpate.bridges.modbus_pdu import (
    ExceptionCode,
    ModbusRequest,
    Reading,
    RequestRefused,
    Writing,
)
from palpate.bridges.server import TcpPeer
from palpate.bridges.source import BoxView, Source
from palpate.client.answers import Answer
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
PACE_S = 0.005
"""Pause after each request of a connection, so that a flood of requests leaves the other programs
of the computer their share."""
REQUEST_S = 5.0
"""Longest time for the rest of a request, and for a peer to accept a reply."""


@dataclass(frozen=True, slots=True)
class Register:
    """An entry of the map. words: number of its registers, the highest first. get: its value."""

    name: str
    get: Callable[[BoxView], int]
    words: int = 1


def _of_answer(get: Callable[[Answer], float]) -> Callable[[BoxView], int]:
    return lambda view: round(get(view.answer)) if view.answer else 0


def _of_state(name: str) -> Callable[[BoxView], int]:
    return lambda view: getattr(view.state, name) if view.state else 0


def _state_code(view: BoxView) -> int:
    skin = view.state.skin if view.state else ""
    return STATES.index(skin) + 1 if skin in STATES else 0


REGISTERS = (
    Register("map version", lambda view: VERSION),
    Register("heartbeat", lambda view: view.beats),
    Register("state of the skin", _state_code),
    Register("answers", lambda view: view.answers),
    Register("status", lambda view: STATUS_CODES[view.answer.status] if view.answer else 0),
    Register(
        "label code",
        lambda view: view.code(view.answer.label) if view.answer and view.answer.known else 0,
    ),
    Register(
        "likeliest label code", lambda view: view.code(view.answer.label) if view.answer else 0
    ),
    Register("probability", _of_answer(lambda answer: 1000 * answer.probability)),
    Register("margin", _of_answer(lambda answer: 1000 * answer.margin)),
    Register("latency", _of_answer(lambda answer: 100 * answer.latency_ms)),
    Register("early", _of_answer(lambda answer: answer.early)),
    Register("fused", _of_answer(lambda answer: answer.fused)),
    Register("lost in the window", _of_answer(lambda answer: answer.lost)),
    Register("sweep", _of_answer(lambda answer: answer.sweep), 2),
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


def _direction_code(answer: Answer) -> int:
    """1 + index in DIRECTIONS; 0: it was not measured."""
    return DIRECTIONS.index(answer.direction) + 1 if answer.direction in DIRECTIONS else 0


MEASURED = (
    Register("measured speed", _of_answer(lambda answer: 10 * (answer.measured_mm_s or 0))),
    Register("direction", _of_answer(_direction_code)),
)
"""The entries after the registers of SLIDE."""


def _of_finger(i: int, get: Callable[[BoxView, Answer], int]) -> Callable[[BoxView], int]:
    """An entry of the finger with this index; 0 if there is none."""

    def value(view: BoxView) -> int:
        there = view.answer and i < len(view.answer.fingers)
        return get(view, view.answer.fingers[i]) if view.answer and there else 0

    return value


def _name(view: BoxView, finger: Answer) -> int:
    return int.from_bytes(finger.finger.encode("ascii", "replace")[:8].ljust(8, b"\0"), "big")


FINGERS = (
    Register("fingers", lambda view: len(view.answer.fingers) if view.answer else 0),
    *(
        register
        for i in range(MOST_FINGERS)
        for register in (
            Register(f"finger {i + 1}", _of_finger(i, _name), 4),
            Register(f"status {i + 1}", _of_finger(i, lambda view, of: STATUS_CODES[of.status])),
            Register(
                f"label code {i + 1}",
                _of_finger(i, lambda view, of: view.code(of.label) if of.known else 0),
            ),
            Register(
                f"probability {i + 1}", _of_finger(i, lambda view, of: round(1000 * of.probability))
            ),
        )
    ),
)
"""The last entries of the map: the answers of the fingers."""
COUNTERS = (
    *("heartbeat", "answers", "sweep", "answered"),
    *("frames", "lost frames", "missed answers", "damaged sentences"),
)
"""Entries that wrap; all others stay at the largest number that fits."""


def _words(entries: Sequence[Register], view: BoxView) -> list[int]:
    """The words of some entries."""
    words: list[int] = []
    for register in entries:
        value, top = register.get(view), 1 << 16 * register.words
        value = value % top if register.name in COUNTERS else min(value, top - 1)
        words += [value >> 16 * i & 0xFFFF for i in reversed(range(register.words))]
    return words


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
        return (
            inputs(view, alive=alive)
            if function == pdu.READ_INPUTS
            else [*registers(view, alive=alive), *slide, *_words((*MEASURED, *FINGERS), view)]
        )

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
        async with self._commanding:  # no other peer's command comes between those of one write
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
