"""XELA's uSkin on CAN, through an adapter that speaks slcan: a line of text for each CAN frame."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import shown
from appliance.io.skin_codecs.frames import MOST_PACKET, Decoded, Rest, collected
from appliance.io.skin_profile import SkinProfile

_XELA_BASE = 0x710
_CAN_FRAME = re.compile(rb"t([0-9A-Fa-f]{3})([0-8])((?:[0-9A-Fa-f]{2}){0,8})([0-9A-Fa-f]{4})?")
_LINE_END = re.compile(rb"[\r\a\n]")
_CAN_ANSWER = re.compile(rb"[zZ]?|V[0-9A-Fa-f]{4}|N[0-9A-Za-z]{4}")
_NO_VALUE = 250
_WRONG_TAXELS = 4
"""This many taxel numbers beyond the grid in one read are not noise."""


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """One CAN frame for each taxel, in the order of taxel numbers. A frame of the skin is complete
    with its last taxel."""
    data = rest.data + new
    taxels = profile.rows * profile.cols
    numbers: list[NDArray[Any]] = []
    ends: list[int] = []
    skipped: list[int] = []
    found: list[bytes] = []  # the bytes of taxels 0, 1, 2, ... of the current frame
    at = begun = garbage = before = size = beyond = 0
    while match := _LINE_END.search(data, at):
        line, at = data[at : match.start()], match.end()
        if _CAN_ANSWER.fullmatch(line):
            begun = begun if found else at
            continue
        taxel, values = _xela_taxel(line)
        beyond += taxel >= taxels
        if taxel == len(found) < taxels and values[0] < _NO_VALUE:
            found.append(values)
        else:
            # out of order, without a value, or not a taxel: the current frame is incomplete, and
            # taxel 0 begins another
            fresh = taxel == 0 and values[0] < _NO_VALUE
            upto = match.end() - len(line) - 1 if fresh else at
            garbage, before = garbage + upto - begun, before + upto - begun
            found, begun = ([values], upto) if fresh else ([], at)
        if len(found) == taxels:
            numbers.append(np.frombuffer(b"".join(found), ">u2"))
            ends.append(at)
            skipped.append(before)
            size, before, found, begun = at - begun, 0, [], at
    if len(data) - at > MOST_PACKET:
        garbage, begun = garbage + len(data) - begun, len(data)
    wrong = (
        f"it sends taxels beyond {shown((profile.rows, profile.cols))}"
        if beyond >= _WRONG_TAXELS
        else ""
    )
    return collected(
        profile, numbers, ends, skipped, garbage, Rest(data[begun:]), size, wrong=wrong
    )


def _xela_taxel(line: bytes) -> tuple[int, bytes]:
    """Number of the taxel and its six bytes X Y Z; (-1, b"\\xff") for any other line."""
    match = _CAN_FRAME.fullmatch(line)
    if not match or len(match[3]) != 2 * int(match[2]) or int(match[2]) < 7:
        return -1, b"\xff"
    taxel = int(match[1], 16) - _XELA_BASE
    return (taxel, bytes.fromhex(match[3].decode())[1:7]) if taxel >= 0 else (-1, b"\xff")
