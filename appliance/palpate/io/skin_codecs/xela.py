"""XELA's uSkin on CAN, through an adapter that speaks slcan: a line of text for each CAN frame."""

from __future__ import annotations

import re

import numpy as np

from palpate.core.types import shown
from palpate.io.skin_codecs.frames import MOST_PACKET, Decoded, Gathering, Rest
from palpate.io.skin_profile import SkinProfile

_XELA_BASE = 0x710
_CAN_FRAME = re.compile(rb"t([0-9A-Fa-f]{3})([0-8])((?:[0-9A-Fa-f]{2}){0,8})([0-9A-Fa-f]{4})?")
_OTHER_FRAME = re.compile(
    rb"(?:T[0-9A-Fa-f]{8}|[dDbB][0-9A-Fa-f]{3}(?:[0-9A-Fa-f]{5})?)[0-9A-Fa-f](?:[0-9A-Fa-f]{2})*"
    rb"|(?:r[0-9A-Fa-f]{3}|R[0-9A-Fa-f]{8})[0-8](?:[0-9A-Fa-f]{4})?"
)
"""Frames that a uSkin does not send: extended ids, CAN FD, and remote frames without data. The last
four digits may be a time stamp of the adapter."""
_LINE_END = re.compile(rb"[\r\a\n]")
_CAN_ANSWER = re.compile(rb"[zZ]?|V[0-9A-Fa-f]{4}|N[0-9A-Za-z]{4}|F[0-9A-Fa-f]{2}")
_NO_VALUE = 250
_WRONG_TAXELS = 4
"""This many taxel numbers in succession beyond the grid are not another node."""
_ANSWER, _FOREIGN, _DAMAGED = -1, -2, -3
"""Instead of a taxel's number: the line is an answer of the adapter; a CAN frame of another node;
not a CAN frame."""


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """One CAN frame for each taxel, in the order of taxel numbers. A frame of the skin is complete
    with its last taxel. CAN frames of other nodes on the bus are passed over and counted."""
    data, taxels, frames = rest.data + new, profile.rows * profile.cols, Gathering(profile)
    found: list[bytes] = []  # the bytes of taxels 0, 1, 2, ... of the current frame
    lines: list[bytes] = []  # its lines
    at = before = beyond = foreign = 0
    while match := _LINE_END.search(data, at):
        line, at = data[at : match.end()], match.end()
        taxel, values = _taxel(line[:-1])
        if taxel == _ANSWER:
            continue
        # taxels of a larger grid follow the last one of this grid
        if taxel == taxels + beyond and not found:
            beyond += 1
        elif taxel >= 0 and beyond < _WRONG_TAXELS:
            beyond = 0
        if taxel == _FOREIGN or taxel >= taxels:
            foreign += 1
            continue
        good = taxel >= 0 and values[0] < _NO_VALUE
        if not (good and taxel == len(found)):
            # out of order, without a value, or damaged: the current frame is incomplete
            waste = sum(map(len, lines)) + len(line) * (not good or taxel > 0)
            frames.garbage, before, found, lines = frames.garbage + waste, before + waste, [], []
        if good and taxel == len(found):
            found.append(values)
            lines.append(line)
        if len(found) == taxels:
            frames.numbers.append(np.frombuffer(b"".join(found), ">u2"))
            frames.ends.append(at)
            frames.skipped.append(before)
            frames.size, before, found, lines = sum(map(len, lines)), 0, [], []
    left = b"".join(lines) + data[at:]
    if len(data) - at > MOST_PACKET:
        frames.garbage, left = frames.garbage + len(left), b""
    wrong = f"it sends taxels beyond {shown((profile.rows, profile.cols))}"
    wrong = wrong if beyond >= _WRONG_TAXELS else ""
    return frames.decoded(Rest(left), wrong=wrong, foreign=foreign)


def _taxel(line: bytes) -> tuple[int, bytes]:
    """Number of the taxel and its six bytes X Y Z; or _ANSWER, _FOREIGN, _DAMAGED."""
    if _CAN_ANSWER.fullmatch(line):
        return _ANSWER, b"\xff"
    match = _CAN_FRAME.fullmatch(line)
    if not match or len(match[3]) != 2 * int(match[2]):
        return (_FOREIGN if _OTHER_FRAME.fullmatch(line) else _DAMAGED), b"\xff"
    taxel = int(match[1], 16) - _XELA_BASE
    if taxel < 0 or int(match[2]) < 7:
        return _FOREIGN, b"\xff"
    return taxel, bytes.fromhex(match[3].decode())[1:7]
