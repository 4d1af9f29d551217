"""The serial line to the robot controller: sends verdicts and other sentences, and reads commands.
And the verdict as a code on GPIO lines.

`core.sentences` defines sentences. Nothing here waits for the port: if the peer does not read,
sentences are dropped and counted, and no frame is lost.
"""

from __future__ import annotations

import errno
import io
import os
import select
import sys
import termios
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

from palpate.core import sentences
from palpate.core.clock import Clock
from palpate.core.config import SerialConfig
from palpate.core.errors import ConfigError
from palpate.core.observer import Observer
from palpate.core.sentences import TALKER, UNSAFE
from palpate.core.types import Status, Verdict
from palpate.io import serial_port
from palpate.io.gpio_lines import Lines

COMMANDS = (
    *("ID", "STATE", "TEST", "LABEL", "TARE", "NEW", "ABORT", "START", "STOP"),
    *("MATERIAL", "POSITION", "SESSION", "NEXT", "DISCARD", "MOVE", "RENAME", "UNDO"),
    *("TEACH", "USE", "FORGET"),
)
PAIRS = ("MOVE", "RENAME")
"""The commands with two texts: a sweep or a material, and the name of a material."""
TEXT_COMMANDS = (
    *("LABEL", "MATERIAL", "POSITION", "SESSION", "TEACH", "FORGET"),
    *PAIRS,
)
"""The commands that need a text after a comma. START may have one: speed and force of the slide."""
MOST_REFUSED, REFUSAL_NS = 8, 1_000_000_000
"""After so many bad lines without a command, one in this time is answered. A line that echoes with
changes would otherwise be answered without end."""
RETRY_NS = 1_000_000_000
"""Time between two attempts to open a port that is gone."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the robot: one of COMMANDS with its text, or `error` for another line."""

    name: str
    text: str = ""
    error: str = ""

    @property
    def line(self) -> str:
        """The command as it stands in a sentence or a capture."""
        with_text = self.name in TEXT_COMMANDS or (self.name == "START" and self.text)
        return f"{self.name},{self.text}" if with_text else self.name


def result(v: Verdict, source: str, *, loss_known: bool = True) -> bytes:
    """The RES sentence of a verdict. source: of the frames. loss_known: losses can be seen."""
    values = v.as_dict(arrays=False)
    return sentences.answer("RES", (v.sweep,), values, source, loss_known=loss_known)


def parse(data: bytes, rest: bytes = b"") -> tuple[list[Command], bytes]:
    """The commands in `data`, which continues `rest`, and the new unfinished rest (see
    `sentences.parse`). Sentences of the box itself, from a line that echoes, are left out."""
    found, rest = sentences.parse(data, rest)
    return [
        Command(s.kind, error=s.error) if s.error else command(s.kind, s.text)
        for s in found
        if s.kind not in sentences.OWN
    ], rest


def command(name: str, text: str | None = None) -> Command:
    """The command `name` with its text, or a Command with an `error`."""
    if name == "START":  # its trigger checks the values, and its error quotes the bad one
        return Command(name, text or "")
    field = (text or "").replace(",", "", name in PAIRS)  # of these the first comma parts two
    if name not in COMMANDS or UNSAFE.search(field):
        return Command(name, error=f"unknown command; known are {' '.join(COMMANDS)}")
    if (name in TEXT_COMMANDS) != (text is not None):
        form = f"{TALKER} {name}" + " TEXT" * (name in TEXT_COMMANDS)
        return Command(name, error=f"send it as {form}")
    return Command(name, text or "")


class StdoutPort:
    """Sentences on standard output, used if no serial port is configured. commands: another source
    of commands, since standard output has none. name: for messages. dropped: number of sentences
    that were not sent. trouble: the reason why the line does not work, "" if it does."""

    def __init__(self, commands: Callable[[], list[Command]] = list) -> None:
        self.name, self.dropped, self.trouble = "standard output", 0, ""
        self._commands = commands
        self._gone = False  # the reader of a pipe

    def say(self, line: bytes) -> None:
        """Print a sentence. It is dropped and counted if nobody reads the output, or the disk
        behind it is full. Raises BrokenPipeError once if the reader has gone, as for any program in
        a pipeline."""
        if self._gone:
            self.dropped += 1
            return
        try:
            if not _can_be_written(sys.stdout):
                raise BlockingIOError(errno.EAGAIN, "nobody reads it")
            sys.stdout.buffer.write(line)
            sys.stdout.buffer.flush()
            self.trouble = ""
        except BrokenPipeError:
            self._gone = True
            raise
        except (OSError, ValueError, AttributeError) as e:  # closed: no stream, or a closed one
            self.dropped += 1
            why = getattr(e, "strerror", None) or "it is closed"
            self.trouble = f"standard output cannot be written: {why}; sentences are dropped"

    def commands(self) -> list[Command]:
        return self._commands()

    def close(self) -> None:
        """Does nothing: standard output stays open."""


def _can_be_written(stream: TextIO) -> bool:
    """Whether a sentence can be written without waiting: a ready pipe takes more."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
    except io.UnsupportedOperation:  # a stream in memory
        return True
    return bool(poll.poll(0))


class SerialSink:
    """Sentences to and commands from a serial port, which may be unplugged and come back.
    dropped: number of sentences that the peer did not read."""

    def __init__(self, config: SerialConfig, clock: Clock) -> None:
        self.name, self.dropped, self.trouble = config.port, 0, ""
        self._config, self._clock = config, clock
        self._port: Any = None
        self._retry_ns = clock.now_ns()
        self._queue: deque[bytes] = deque()
        self._begun = 0  # sent bytes of the first sentence in the queue
        self._rest = b""
        self._refused = 0  # bad lines since the last command
        self._refusal_ns = clock.now_ns()

    def say(self, line: bytes) -> None:
        """Queue a sentence. Of a full queue the oldest that was not begun is dropped."""
        if len(self._queue) >= self._config.queue:
            del self._queue[1 if self._begun else 0]
            self.dropped += 1
        self._queue.append(line)
        self._flush()

    def commands(self) -> list[Command]:
        """Send queued sentences; return the commands that have come since the last call."""
        self._flush()
        if not self._port:
            return []
        try:
            data = os.read(self._port.fileno(), 4096)
        except BlockingIOError:
            return []
        except OSError as e:
            self._lose(e)
            return []
        found, self._rest = parse(data, self._rest)
        return [command for command in found if self._is_answered(command)]

    def close(self) -> None:
        if self._port:
            port, self._port = self._port, None
            serial_port.close(port)

    def _is_answered(self, command: Command) -> bool:
        """Whether a command, or a bad line, gets an answer."""
        if not command.error:
            self._refused = 0
            return True
        self._refused += 1
        now_ns = self._clock.now_ns()
        if self._refused > MOST_REFUSED and now_ns < self._refusal_ns:
            return False
        self._refusal_ns = now_ns + REFUSAL_NS
        return True

    def _flush(self) -> None:
        if not self._port and not self._open():
            return
        while self._queue:
            try:
                # not Serial.write: with write_timeout=0 pyserial 3.5 busy-waits while the peer does
                # not read
                self._begun += os.write(self._port.fileno(), self._queue[0][self._begun :])
            except BlockingIOError:
                return
            except OSError as e:
                self._lose(e)
                return
            if self._begun == len(self._queue[0]):
                self._queue.popleft()
                self._begun = 0

    def _open(self) -> bool:
        now = self._clock.now_ns()
        if now < self._retry_ns:
            return False
        self._retry_ns = now + RETRY_NS
        try:
            port = serial_port.open_alone(self._config.port, self._config.baud)
        except (OSError, ValueError, termios.error) as e:  # SerialException is an OSError
            advice = "check serial.port and group dialout"
            if serial_port.is_held(e):
                advice = "end the program that has it (fuser shows it)"
            self.trouble = f"serial port {self._config.port} cannot be opened: {e}; {advice}"
            return False
        self._port, self.trouble, self._rest = port, "", b""
        return True

    def _lose(self, e: OSError) -> None:
        why = f"serial port {self._config.port} failed: {e}"
        self.trouble = f"{why}; it is opened again when it is back"
        self.close()
        self._begun = 0
        self._retry_ns = self._clock.now_ns() + RETRY_NS


Port = SerialSink | StdoutPort
"""The line to the robot, for sentences and commands; neither waits."""


class LineSink(Observer):
    """Outputs the verdict as a code: 1 + the label's index in the manifest, or 0."""

    def __init__(self, lines: Lines, labels: Sequence[str]) -> None:
        check_bits(lines.capacity, labels)
        self._lines = lines
        self._code = {label: i + 1 for i, label in enumerate(labels)}

    def answered(self, verdict: Verdict) -> None:
        """Output the code and raise RESULT VALID."""
        self._lines.result(self._code[verdict.label] if verdict.status is Status.OK else 0)


def check_bits(codes: int, labels: Sequence[str]) -> None:
    """Raises ConfigError if `codes` are too few for the labels and the code 0."""
    if codes <= len(labels):
        needed = f"{len(labels)} labels and the code 0 do not fit output.class_bits"
        raise ConfigError(f"{needed}, which have {codes} codes; wire more GPIO lines, or none")
