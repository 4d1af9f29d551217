"""Sentences of the serial line, in the form of NMEA 0183 (PROTOCOL.md, part 2). In: fields, or
bytes of the line. Out: sentences, on the box and on the robot's side.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import reduce
from operator import xor

TALKER = "PPLP"
MAX_LINE = 128
"""Characters of a sentence or command."""
UNSAFE = re.compile(r"[^ -~]|[$*,!\\~^]")
"""What no field may hold."""
_PATTERN = re.compile(
    rb"(?s:.*\$)?(?P<body>PPLP[, ](?P<kind>[A-Za-z]{0,16})(?:[, ](?P<text>[ -#%-)+-~]*))?)(?:\*(?P<sum>[0-9A-Fa-f]{2}))?"
)


@dataclass(frozen=True, slots=True)
class Sentence:
    """A line that was received.

    kind: RES, STA, … or the name of a command. text: what follows it, None for nothing. summed: it
    had its checksum, and this was right. error: why it is no sentence, "" if it is one.
    """

    kind: str
    text: str | None = None
    summed: bool = False
    error: str = ""

    @property
    def fields(self) -> list[str]:
        """The fields of the text."""
        return [] if self.text is None else self.text.split(",")


def checksum(body: str) -> str:
    """Checksum of NMEA 0183: exclusive or of the characters between $ and *, as two hexadecimal
    digits."""
    return f"{reduce(xor, body.encode('ascii'), 0):02X}"


def sentence(kind: str, *fields: object) -> bytes:
    """`$PPLP,KIND,field,…*hh` with CR and LF. Characters that NMEA reserves become spaces; a line
    that is too long is cut, but never within a number: last fields that are whole numbers are left
    out until the rest fits."""
    body = ",".join([TALKER, kind, *(UNSAFE.sub(" ", str(f)) for f in fields)])
    if len(body) > MAX_LINE - 6:
        if fields and isinstance(fields[-1], int):
            return sentence(kind, *fields[:-1])
        body = body[: MAX_LINE - 6]
    return f"${body}*{checksum(body)}\r\n".encode("ascii")


def parse(data: bytes, rest: bytes = b"") -> tuple[list[Sentence], bytes]:
    """The sentences in `data`, which continues `rest`, and the new unfinished rest.

    Each line gives one Sentence, however it is split. A line of over MAX_LINE characters is
    reported once; the rest then holds one character more than these, so that the end of the line is
    not taken for a sentence.
    """
    reported = len(rest) > MAX_LINE
    *lines, rest = re.split(rb"[\r\n]+", rest + data)
    found = [read(line) for line in lines[reported:] if line]
    if len(rest) > MAX_LINE and (lines or not reported):
        found.append(read(rest))
    return found, rest[: MAX_LINE + 1]


def read(line: bytes) -> Sentence:
    """One line, with its end or without.

    A checksum may be missing, and commas be spaces, so that a person can type commands; no checksum
    may be wrong. A sentence begins at its $: noise or a break may have left bytes before it.
    """
    if len(line) > MAX_LINE:
        return Sentence("", error=f"line of over {MAX_LINE} characters without an end")
    # the kind holds letters only: of a command it is sent back, and noise could displace the fields
    # of the answer
    match = _PATTERN.fullmatch(line.strip())
    if not match:  # examples are given without what a sentence cannot hold
        return Sentence("", error=f"not a command; send for example {TALKER} ID")
    kind, body = match["kind"].decode(), match["body"].decode()
    text, given = (
        None if group is None else group.decode() for group in match.group("text", "sum")
    )
    if given and given.upper() != checksum(body):
        return Sentence(kind, error=f"checksum {given} should be {checksum(body)}")
    return Sentence(kind, text, bool(given))
