"""Writes and parses sentences of the serial line, a dialect of NMEA 0183 (PROTOCOL.md, part 2)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Any

TALKER = "PPLP"
OWN = ("RES", "FIN", "STA", "ANS", "REC", "TCH")
"""Kinds of sentences that the box sends; if one comes back, it is an echo and is not answered."""
MOST_FINGERS = 4
"""Largest number of fingers of a hand."""
MAX_LINE = 128
"""Longest sentence or command, in characters."""
SHORT_LINE = 80
"""Longest sentence in the short form, with its end: strings of RAPID hold 80 characters."""
Reply = list[object] | Future[list[object]]
"""The fields of the answer to a command. A future if the command is not done yet: it gets them, or
an exception, in the loop's thread."""
CommandHandler = Callable[[str], Reply]
"""Carries out a command: its text -> the reply. Raises ApplianceError with the reason for a
refusal."""
UNSAFE = re.compile(r"[^ -~]|[$*,!\\~^]")
"""Characters that no field may contain."""
DIRECTIONS = ("rows+", "rows-", "cols+", "cols-")
"""In which a finger slides: towards higher or lower rows or columns."""
_PATTERN = re.compile(
    rb"(?s:.*\$)?(?P<body>PPLP[, ](?P<kind>[A-Za-z]{0,16})(?:[, ](?P<text>[ "
    rb"-#%-)+-~]*))?)(?:\*(?P<sum>[0-9A-Fa-f]{2}))?"
)


def future_of(reply: Reply) -> Future[list[object]]:
    """The reply as a future; the fields of a command that is done are in it already."""
    if isinstance(reply, Future):
        return reply
    done: Future[list[object]] = Future()
    done.set_result(reply)
    return done


@dataclass(frozen=True, slots=True)
class Sentence:
    """A line that was received. kind: RES, STA, … or the name of a command. text: the text after
    it, None if there is none. summed: it had a checksum, which was right. error: the reason why it
    is not a sentence, "" if it is."""

    kind: str
    text: str | None = None
    summed: bool = False
    error: str = ""

    @property
    def fields(self) -> list[str]:
        return [] if self.text is None else self.text.split(",")


def checksum(body: str) -> str:
    """Checksum of NMEA 0183: the exclusive or of the characters, as two hexadecimal digits."""
    return f"{reduce(xor, body.encode('ascii'), 0):02X}"


def sentence(kind: str, *fields: object) -> bytes:
    """`$PPLP,KIND,field,…*hh` with CR and LF. Characters that NMEA reserves become spaces. A line
    that is too long is cut, but never within a number: whole numbers in the last fields, and texts
    behind them for which no room is left, are left out until the rest fits."""
    body = ",".join([TALKER, kind, *(UNSAFE.sub(" ", str(f)) for f in fields)])
    if len(body) > MAX_LINE - 6:
        no_room = len(body) - len(str(fields[-1])) > MAX_LINE - 6
        if isinstance(fields[-1], int) or (no_room and len(fields) > 1):
            return sentence(kind, *fields[:-1])
        body = body[: MAX_LINE - 6]
    return f"${body}*{checksum(body)}\r\n".encode("ascii")


def short(kind: str, *fields: object) -> bytes:
    """A sentence in the short form: without the last fields that do not fit SHORT_LINE. The first
    five of RES, up to the probability, always fit."""
    while len(line := sentence(kind, *fields)) > SHORT_LINE and fields:
        fields = fields[:-1]
    return line


def answer(
    kind: str, head: Sequence[object], v: Mapping[str, Any], source: str, *, loss_known: bool
) -> bytes:
    """RES or FIN for a verdict, as in the feed. head: its fields up to the number of the sweep.
    source: of the frames (usb, sim, replay). loss_known: whether lost frames of the skin can be
    seen.

    Optional fields follow the detail: that losses cannot be seen, and the measured slide. The
    detail is shortened to make room for them. If an empty detail does not suffice, the slide is
    left out.
    """
    first = (
        *head,
        f"{v['time_ns'] / 1e9:.3f}",
        *(v["status"], v["label"], f"{v['probability']:.3f}", f"{v['margin']:.3f}"),
        *(v["fused"], v["lost"], f"{v['latency_ns'] / 1e6:.2f}"),
        *(v["bundle"], source, f"{v['share']:.2f}"),
    )
    detail, measured = v["detail"], v.get("measured_mm_s")
    unseen: list[object] = [] if loss_known else [1]
    if measured is not None:
        slide = [*(unseen or [""]), f"{measured:.1f}", v.get("direction")]
        # a sentence of full length may have been cut
        if (room := MAX_LINE - len(sentence(kind, *first, "", *slide))) > 0:
            return sentence(kind, *first, detail[:room], *slide)
    if loss_known:
        return sentence(kind, *first, detail)
    room = MAX_LINE - len(sentence(kind, *first, "", 1))
    return sentence(kind, *first, detail[: max(0, room)], 1)


def parse(data: bytes, rest: bytes = b"") -> tuple[list[Sentence], bytes]:
    """The sentences in `data`, which continues `rest`, and the new unfinished rest. Each line gives
    one Sentence, however it is split. A line of over MAX_LINE characters is reported once. The rest
    then contains one character more, so that the end of the line is not taken for a sentence."""
    reported = len(rest) > MAX_LINE
    *lines, rest = re.split(rb"[\r\n]+", rest + data)
    found = [read(line) for line in lines[reported:] if line]
    if len(rest) > MAX_LINE and (lines or not reported):
        found.append(read(rest))
    return found, rest[: MAX_LINE + 1]


def read(line: bytes) -> Sentence:
    """One line, with or without its end. A checksum may be missing, and spaces may stand for
    commas, so that a person can type commands; a wrong checksum is always refused. A sentence
    begins at its $, since noise or a break may have left bytes before it."""
    if len(line) > MAX_LINE:
        return Sentence("", error=f"line of over {MAX_LINE} characters without an end")
    # the kind has only letters, since it is sent back in the answer to a command, and noise could
    # displace the fields of the answer
    match = _PATTERN.fullmatch(line.strip())
    if not match:  # the example has no characters that a sentence cannot contain
        return Sentence("", error=f"not a command; send for example {TALKER} ID")
    kind, body = match["kind"].decode(), match["body"].decode()
    text, given = (g if g is None else g.decode() for g in match.group("text", "sum"))
    if given and given.upper() != checksum(body):
        return Sentence(kind, error=f"checksum {given} should be {checksum(body)}")
    return Sentence(kind, text, bool(given))
