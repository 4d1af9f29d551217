"""Serial line and class bits: sentences, a port that is never waited for, bits that settle."""

import fcntl
import io
import itertools
import os
import re
import struct
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pynmea2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core.config import OutputConfig, SerialConfig
from palpate.core.errors import ConfigError
from palpate.core.sentences import MAX_LINE, OWN, checksum, sentence
from palpate.core.types import Status, Verdict
from palpate.io import serial_port
from palpate.io.gpio_lines import Lines
from palpate.io.robot_link import Command, LineSink, SerialSink, StdoutPort, parse, result
from palpate.sim import gpio, rig
from palpate.tools import pseudo_terminal
from tests.factories.paths import ROOT

PROTOCOL = (ROOT / "firmware_config" / "PROTOCOL.md").read_text()


def verdict(label: str = "plastic rough", status: Status = Status.OK, detail: str = "") -> Verdict:
    """A verdict as the classifier makes it."""
    scores = np.array([0.987, 0.013])
    told = (status, label, 0.987, 0.981, scores, 1, 0, 410_000, "9f3c2a1b", detail)
    return Verdict(7, 5_021_384_000_000, *told)


def test_result_is_the_documents_example():
    """The code writes the RES sentence of PROTOCOL.md."""
    line = result(verdict(), "usb").decode().strip()
    assert f"`{line[:-2]}hh`" in PROTOCOL


def test_a_measured_slide_shortens_the_detail():
    """Fields 15 and 16 follow an empty field 14, and the detail keeps what room is left."""
    far = verdict(detail="moved 2.1 mm too far towards row 4; " * 3)
    line = result(replace(far, measured_mm_s=30.04, direction="rows+"), "usb")
    assert len(line) == MAX_LINE
    assert line.rpartition(b"*")[0].endswith(b",,30.0,rows+")
    assert b",1.00,moved 2.1 mm too far towards" in line
    assert result(verdict(), "usb").endswith(b",usb,1.00,*23\r\n")


def test_a_slide_without_room_is_left_out():
    """A sentence whose other fields fill the line: no number is cut, and field 14 remains."""
    full = replace(
        verdict("x" * 24, Status.UNDECIDED), sweep=10**9, time_ns=10**17, latency_ns=10**11
    )
    slid = replace(full, measured_mm_s=9999.9, direction="cols+")
    for known in (True, False):
        line = result(slid, "replay", loss_known=known)
        assert line == result(full, "replay", loss_known=known)
        assert len(line) <= MAX_LINE


@pytest.mark.slow
@given(st.text(max_size=200), st.text(max_size=40), st.sampled_from(list(Status)))
def test_pynmea2_parses_every_sentence(detail, label, status):
    """For any texts an independent parser accepts the checksum and finds all fields."""
    line = result(verdict(label, status, detail), "sim").decode("ascii")
    assert len(line) <= MAX_LINE
    parsed = pynmea2.parse(line.strip(), check=True)
    assert isinstance(parsed, pynmea2.ProprietarySentence)
    assert parsed.manufacturer == "PLP"
    assert parsed.data[1:3] == ["RES", "7"]
    assert parsed.data[4] == status


@pytest.mark.parametrize(
    ("line", "want"),
    [
        (b"$PPLP,ID*" + checksum("PPLP,ID").encode(), Command("ID")),
        (b"$PPLP,TARE", Command("TARE")),
        (b"PPLP,NEW", Command("NEW")),
        (b"PPLP ID", Command("ID")),
        (b"PPLP MATERIAL plastic rough", Command("MATERIAL", "plastic rough")),
        (b"$PPLP,START", Command("START")),
        (b"$PPLP,START,30,1.5", Command("START", "30,1.5")),
        (b"PPLP START ,1.5", Command("START", ",1.5")),
        (b"\0$PPLP,ID", Command("ID")),
        (b"$PPLP,TAR\xff$PPLP,ABORT", Command("ABORT")),
        (b"$PPLP,ABORT*" + checksum("PPLP,ABORT").lower().encode(), Command("ABORT")),
    ],
)
def test_commands_are_read(line, want):
    """With checksum or without, by program or person; noise before the $ is ignored."""
    assert parse(line + b"\r\n") == ([want], b"")


@pytest.mark.parametrize("line", ["START", "START,30,1.5", "STOP", "MATERIAL,", "LABEL,3"])
def test_a_command_keeps_its_line(line):
    """The line that a capture has gives the same command again."""
    ((command,), _) = parse(f"$PPLP,{line}\r\n".encode())
    assert command.line == line


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        (b"$PPLP,ID*00", "checksum 00 should be"),
        (b"$PPLP,ID*FF", "checksum FF should be"),
        (b"$PPLP,JUMP", "known are ID"),
        (b"$GPGGA,1,2", "not a command"),
        (b"hello", "send for example"),
        (b"\xff\xfe\x00", "not a command"),
    ],
)
def test_bad_commands_are_answered(line, hint):
    """A wrong checksum, unknown command, other protocol, noise: an error with the remedy."""
    (command,), rest = parse(line + b"\n")
    assert hint in command.error
    assert rest == b""


@pytest.mark.parametrize("line", [b"ID", b"help", b"$PPLP,MATERIAL", b"$PPLP,ID,now", b"\xff"])
def test_the_example_of_an_error_can_be_copied(line):
    """It is understood when sent, whatever was typed, whole despite NMEA."""
    ((bad,), _) = parse(line + b"\r\n")
    heard = sentence("ANS", bad.name, "error", bad.error).decode("ascii")
    example = re.search(r"(?:send for example|send it as) ([^,*]+)", heard)[1]
    ((good,), _) = parse(example.encode() + b"\r\n")
    assert not good.error


def test_a_line_without_end_is_dropped():
    """Noise without a line end is reported once and does not accumulate."""
    (command,), rest = parse(b"x" * 1000)
    assert "without" in command.error
    assert len(rest) == MAX_LINE + 1
    assert parse(b"x" * 1000, rest) == ([], rest)
    # its end is not a line of its own
    assert parse(b"PPLP,ABORT\nPPLP,ID\n", rest) == ([Command("ID")], b"")


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=5))
def test_parse_never_raises_and_splits_anywhere(data, cuts):
    """Any bytes, split anywhere, give the same commands as in one piece."""
    edges = sorted({0, len(data), *(c % (len(data) + 1) for c in cuts)})
    rest, got = b"", []
    for a, b in itertools.pairwise(edges):
        found, rest = parse(data[a:b], rest)
        got += found
    assert (got, rest) == parse(data)


def sink_on(name: str, clock=None, **settings) -> SerialSink:
    """A sink on a port."""
    return SerialSink(SerialConfig(port=name, **settings), clock or rig.VirtualClock())


def test_a_port_that_is_not_there_and_comes(tmp_path):
    """It is named with what to do, sentences wait in the queue, and it is opened later."""
    clock = rig.VirtualClock()
    sink = sink_on(str(tmp_path / "ttyUSB0"), clock)
    sink.say(result(verdict(), "sim"))
    assert "ttyUSB0" in sink.trouble
    assert "dialout" in sink.trouble
    with pseudo_terminal.pair() as (far, name):
        (tmp_path / "ttyUSB0").symlink_to(name)
        assert sink.commands() == []
        assert sink.trouble
        clock.sleep_until(clock.now_ns() + 1_500_000_000)
        sink.commands()
        assert sink.trouble == ""
        assert os.read(far, 4096) == result(verdict(), "sim")
        sink.close()


@pytest.mark.parametrize("real", [True, False])
def test_a_port_is_kept_from_others(monkeypatch, real):
    """While the box has a port the kernel refuses it to others; after closing it is free, even if
    another had it open. A pseudo-terminal is not shut: it would stay so if the box is killed while
    the other end is open."""
    # Asks whether a terminal is shut to others (asm-generic/ioctls.h)
    tiocgexcl = 0x80045440

    def is_shut(port: int) -> bool:
        """Whether the kernel refuses a port to all but root."""
        return bool(struct.unpack("i", fcntl.ioctl(port, tiocgexcl, bytes(4)))[0])

    if real:
        monkeypatch.setattr(serial_port, "PSEUDO_TERMINALS", range(0))
    with pseudo_terminal.pair() as (_, name), open(name, "rb", buffering=0) as other:
        sink = sink_on(name)
        assert not is_shut(other.fileno())
        sink.commands()
        assert sink.trouble == ""
        assert is_shut(other.fileno()) == real
        sink.close()
        assert not is_shut(other.fileno())


LABELS = ("metal", "wood", "plastic rough")


def lines_on(bits: int) -> tuple[Lines, gpio.SimGpio]:
    """Output lines on a simulated chip."""
    names = tuple(f"C{i}" for i in range(bits))
    clock = rig.VirtualClock()
    chip = gpio.SimGpio(clock, {"/dev/gpiochip0": ["VALID", *names]})
    return Lines(OutputConfig(result_valid="VALID", class_bits=names), chip, clock), chip


@pytest.mark.parametrize(
    ("status", "on"),
    [
        (Status.OK, {"VALID", "C0", "C1"}),
        *((status, {"VALID"}) for status in (Status.UNSURE, Status.CONFLICT, Status.NO_CONTACT)),
    ],
)
def test_the_code_of_an_answer(status, on):
    """The label's code if it is ok, else code 0; RESULT VALID rises with either."""

    def levels(chip: gpio.SimGpio) -> dict[str, bool]:
        """The present levels of the lines."""
        return {name: level for _, name, level in chip.written}

    lines, chip = lines_on(2)
    sink = LineSink(lines, LABELS)
    sink.answered(verdict())
    sink.answered(verdict("plastic rough" if status.classified else "", status))
    assert {name for name, level in levels(chip).items() if level} == on


def test_too_few_class_bits():
    """Labels that do not fit the bits are refused at start, with the numbers."""
    lines, _ = lines_on(1)
    with pytest.raises(ConfigError, match="3 labels"):
        LineSink(lines, LABELS)


def test_a_line_that_echoes_gets_no_answers():
    """Own sentences, whole or in part; a command among them counts."""
    own = [sentence(kind, 1, "ok") for kind in OWN]
    found, rest = parse(b"".join(own) + b"$PPLP,ID\r\n" + own[0][:7])
    assert [c.name for c in found] == ["ID"]
    found, _ = parse(own[0][7:], rest)
    assert found == []
    damaged = own[2].replace(b"ok", b"oj")
    assert parse(damaged)[0] == []


@pytest.mark.parametrize(
    "change",
    [
        bytes.lower,
        lambda line: line[3:],
        lambda line: b'"' + line.strip() + b'"\r\n',
        lambda line: line.replace(b"ANS", b"AMS"),
        lambda line: bytes(c for each in line for c in (each, each)),
    ],
    ids=["lower case", "cut", "quoted", "damaged", "doubled"],
)
def test_an_echo_with_changes_is_not_answered_without_end(change):
    """Eight answers, then one a second; commands still count."""
    clock = rig.VirtualClock()
    with pseudo_terminal.pair() as (robot, name):
        sink = sink_on(name, clock)
        sink.commands()
        os.write(robot, change(sentence("ANS", "ID", "ok")))
        answers = 0
        for _ in range(600):
            for bad in sink.commands():
                answers += 1
                os.write(robot, change(sentence("ANS", bad.name, "error", bad.error)))
            os.write(robot, change(sentence("STA", 1, "lost")))
            clock.sleep_until(clock.now_ns() + 10**8)
        assert 8 <= answers <= 8 + 60 + 1
        os.write(robot, b"PPLP ID\r\nPPLP NO\r\n")
        # a read returns as much as the terminal has passed on
        found = [one for _ in range(10) for one in sink.commands() if one.name in ("ID", "NO")]
        assert [(command.name, bool(command.error)) for command in found] == [
            ("ID", False),
            ("NO", True),
        ]
        sink.close()


@pytest.mark.parametrize(
    "error",
    [OSError(28, "No space left"), OSError(27, "File too large"), ValueError("closed file")],
)
def test_standard_output_that_takes_nothing(monkeypatch, error):
    """Sentences are dropped and counted, with the reason; they go on once it works again."""

    class StandardOutput:
        """Stands for sys.stdout; writing raises an error."""

        def __init__(self, error: Exception | None) -> None:
            self.error, self.buffer, self.written = error, self, b""

        def fileno(self) -> int:
            raise io.UnsupportedOperation

        def write(self, data: bytes) -> None:
            if self.error:
                raise self.error
            self.written += data

        def flush(self) -> None:
            """Nothing is kept back."""

    output = StandardOutput(error)
    monkeypatch.setattr(sys, "stdout", output)
    port = StdoutPort()
    port.say(b"1")
    port.say(b"2")
    assert port.dropped == 2
    assert "sentences" in port.trouble
    output.error = None
    port.say(b"3")
    assert (output.written, port.trouble) == (b"3", "")
    monkeypatch.setattr(sys, "stdout", None)
    port.say(b"4")
    assert port.dropped == 3


def test_a_pipe_that_nobody_reads_does_not_hold_the_loop(monkeypatch):
    """When the pipe is full, sentences are dropped at once; a reader that goes ends the command."""
    reader, writer = os.pipe()
    with suppress(BrokenPipeError), os.fdopen(writer, "w") as stream:  # closing writes the rest
        monkeypatch.setattr(sys, "stdout", stream)
        port = StdoutPort()
        for _ in range(2000):
            port.say(b"x" * 100)
        assert port.dropped > 0
        os.close(reader)
        with pytest.raises(BrokenPipeError):
            port.say(b"x")
        port.say(b"x")
        monkeypatch.undo()
