"""Captures: one file with all inputs of the box (transfers, sensor states, edges and commands, with
their times), and `Playback`, which feeds them to the same modules again.

The verdicts of a replayed capture are the same, bit for bit, since they depend on nothing else.
"""

from __future__ import annotations

import json
import math
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import IO

from palpate.core.errors import (
    ConfigError,
    FormatError,
    SensorError,
    SensorMismatch,
    TemporaryError,
    passes,
)
from palpate.core.log import TroubleLog, log
from palpate.core.observer import Observer
from palpate.core.schema import typed
from palpate.core.types import Edge, EdgeKind, Frames, SweepFormat
from palpate.io import skin_profile, skin_stream
from palpate.io.packets import Identity
from palpate.io.robot_link import Command, command
from palpate.io.sensor import OPENED, SensorCounters
from palpate.io.skin_profile import PALPATE, SkinProfile
from palpate.io.trigger import EdgeCounters

MAGIC = b"PPLPCAP1"
MOST_KEPT = 99
"""Largest number of captures of the same name from earlier starts."""
_RECORD = struct.Struct("<BQI")
_KINDS = tuple(EdgeKind)
_MOST_NS = 1 << 63
"""Times are int64."""


class RecordKind(IntEnum):
    """Kind of a record's content."""

    TRANSFER = 0
    STATE = 1
    EDGES = 2
    COMMAND = 3


_EDGE = struct.Struct("<QBdd")
"""Layout of an edge: time, kind, speed in mm/s and force in N, 0 if it has none."""


class CaptureWriter(Observer):
    """Writes a capture while the box runs. A power failure loses at most the records that the
    system had not written yet.

    After a failed write the capture ends, since a capture with a gap would replay differently;
    classifying goes on. A file of an earlier start is renamed to `path.1` or the next free number.
    profile: of the skin; it decides how its bytes are read. Raises ConfigError if the file cannot
    be opened.
    """

    def __init__(self, path: Path, format: SweepFormat, profile: SkinProfile = PALPATE) -> None:
        # the profile of PROTOCOL.md is left out
        skin = {} if profile.codec == PALPATE.codec else {"skin": profile.json()}
        head = json.dumps(format.json() | skin).encode()
        trouble, advice = f"capture: {path} cannot be written", "it ends here, the answers go on"
        self._ended, self._log = False, TroubleLog(trouble, advice)
        try:
            _set_aside(path)
            self._file: IO[bytes] = path.open("wb")
        except OSError as e:
            raise (TemporaryError if passes(e) else ConfigError)(
                f"--capture {path}: {e.strerror}; name a file that can be written"
            ) from e
        self._put(lambda: self._file.write(MAGIC + len(head).to_bytes(4, "little") + head))

    def transfer(self, t_ns: int, data: bytes) -> None:
        """Write a bulk transfer that ended at `t_ns`."""
        self._write(RecordKind.TRANSFER, t_ns, data)

    def state(self, t_ns: int, state: str) -> None:
        self._write(RecordKind.STATE, t_ns, state.encode())

    def triggered(self, t_ns: int, edges: Sequence[Edge]) -> None:
        """Write edges that the trigger returned at `t_ns`."""
        rows = [(e.t_ns, _KINDS.index(e.kind), e.speed_mm_s or 0, e.force_n or 0) for e in edges]
        self._write(RecordKind.EDGES, t_ns, b"".join(_EDGE.pack(*row) for row in rows))

    def command(self, t_ns: int, line: str) -> None:
        """Write a command that was executed, as a sentence."""
        self._write(RecordKind.COMMAND, t_ns, line.encode())

    def close(self) -> None:
        self._put(self._file.close)

    def _write(self, kind: RecordKind, t_ns: int, data: bytes) -> None:
        if not self._ended:
            self._put(lambda: self._file.write(_RECORD.pack(kind, t_ns, len(data)) + data))

    def _put(self, write: Callable[[], object]) -> None:
        self._ended = not self._log.attempt(write) or self._ended


def _set_aside(path: Path) -> None:
    """Rename the capture of an earlier start. Raises OSError, ConfigError for too many."""
    if not path.is_file() or not path.stat().st_size:  # /dev/full, a pipe
        return
    kept = (path.with_name(f"{path.name}.{i}") for i in range(1, MOST_KEPT + 1))
    free = next((name for name in kept if not name.exists()), None)
    if not free:
        raise ConfigError(f"--capture {path}: {MOST_KEPT} older captures are there; move some away")
    path.rename(free)
    log.info(f"capture: {path} of an earlier start was renamed to {free.name}")


class Playback:
    """Sensor, trigger, clock and source of commands of a replayed capture. Each record is returned
    at its time. Raises FormatError if the file cannot be read or is not a capture. An incomplete
    last record is left out."""

    def __init__(self, path: Path) -> None:
        try:
            data = path.read_bytes()
        except OSError as e:
            raise FormatError(f"{path}: cannot be read: {e.strerror}; name a capture") from e
        if not data.startswith(MAGIC):
            why = f"{path}: not a capture (it begins with {data[:8]!r})"
            raise FormatError(f"{why}; `palpate run --capture` writes captures")
        begin = len(MAGIC) + 4 + int.from_bytes(data[len(MAGIC) : len(MAGIC) + 4], "little")
        try:
            head = json.loads(data[len(MAGIC) + 4 : begin])
            skin = head.pop("skin", None) if isinstance(head, dict) else None
            self.format = typed(SweepFormat, head)
            profile = PALPATE if skin is None else skin_profile.from_json(skin, "skin")
        except (ValueError, TypeError, RecursionError, ConfigError) as e:
            raise FormatError(f"{path}: its head cannot be read: {e}; capture again") from e
        self.state = "absent"
        self._opened = False  # the last STATE record was OPENED
        self.trouble: SensorError | None = None
        self.identity: Identity | None = None
        self.counters = SensorCounters()
        self.about = {"mode": "capture", "times": "as captured"}
        self.edge_counters = EdgeCounters()  # a capture holds only the edges that were reported
        self._stream = skin_stream.stream(profile, self.format, self.counters)
        self._records = deque(_records(path, data, begin))
        self._now_ns = self._records[0][1] if self._records else 0

    @property
    def finished(self) -> bool:
        return not self._records

    @property
    def clock(self) -> dict[str, float] | None:
        return self._stream.clock

    @property
    def loss_known(self) -> bool:
        return self._stream.loss_known

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until(self, t_ns: int) -> None:
        """Clock: does nothing, since only records advance the time."""

    due_ns = 0  # the edges are in the capture

    @property
    def blind(self) -> bool:
        """Trigger: never, since a capture holds all edges that the box received."""
        return False

    def read(self) -> Frames:
        """Sensor: the next transfer's frames, or none if the next record is of another kind."""
        frames = Frames.empty(self.format)
        if self._records:
            kind, self._now_ns, data = self._records[0]
            if kind in (RecordKind.TRANSFER, RecordKind.STATE):
                self._records.popleft()
            if kind == RecordKind.TRANSFER:
                with suppress(SensorMismatch):  # the resulting state is the next record
                    frames = self._stream.feed(data, self._now_ns)
                if self._opened:  # the sensor was not streaming yet and did not return them
                    frames = Frames.empty(self.format)
            elif kind == RecordKind.STATE:
                self._enter(data.decode())
        return frames

    def _enter(self, state: str) -> None:
        self._opened = state == OPENED
        if self._opened:
            self._stream.restart()
        else:
            self.state = state

    def edges(self, now_ns: int) -> list[Edge]:
        """Trigger: the edges that the box received at this time."""
        return [
            Edge(_KINDS[k], t, *(value or None for value in slide))
            for body in self._due(RecordKind.EDGES, now_ns)
            for t, k, *slide in _EDGE.iter_unpack(body)
        ]

    def commands(self) -> list[Command]:
        """Port: the commands that were executed at this time."""
        return [_command(body) for body in self._due(RecordKind.COMMAND, self._now_ns)]

    def _due(self, kind: RecordKind, now_ns: int) -> Iterator[bytes]:
        """The contents of the next records, as far as they are of this kind and time."""
        while self._records and self._records[0][0] == kind and self._records[0][1] <= now_ns:
            yield self._records.popleft()[2]


def _records(path: Path, data: bytes, at: int) -> Iterator[tuple[RecordKind, int, bytes]]:
    """The records (kind, host ns, content) from byte `at` on. Raises FormatError."""
    while at + _RECORD.size <= len(data):
        kind, t_ns, size = _RECORD.unpack_from(data, at)
        body = data[at + _RECORD.size : at + _RECORD.size + size]
        whole = len(body) == size
        if kind >= len(RecordKind) or (whole and not _written(kind, t_ns, body)):
            record = f"record of kind {kind} with {size} bytes at byte {at}"
            raise FormatError(f"{path}: {record} is unknown; capture again")
        if whole:
            yield RecordKind(kind), t_ns, body
        at += _RECORD.size + size


def _written(kind: int, t_ns: int, body: bytes) -> bool:
    """Whether this record can come from CaptureWriter."""
    if kind == RecordKind.EDGES:
        return not len(body) % _EDGE.size and all(
            k < len(_KINDS) and t < _MOST_NS and all(0 <= value < math.inf for value in slide)
            for t, k, *slide in _EDGE.iter_unpack(body)
        )
    if kind == RecordKind.COMMAND:
        return not _command(body).error
    return t_ns < _MOST_NS and (kind == RecordKind.TRANSFER or body.isalpha())


def _command(line: bytes) -> Command:
    name, comma, text = line.decode("ascii", "replace").partition(",")
    return command(name, text if comma else None)
