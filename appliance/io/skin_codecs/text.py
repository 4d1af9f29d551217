"""Numbers as lines of text: 3D-ViTac, ReSkin, sketches for Arduino."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.io.skin_codecs.frames import MOST_PACKET, Decoded, Rest, collected
from appliance.io.skin_profile import SkinProfile

_BETWEEN = bytes.maketrans(b",;\t", b"   ")
_WHOLE = re.compile(rb"[+-]?[0-9]{1,9}")
_DECIMAL = re.compile(rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?|(?i:nan)")

_MOST_FLOAT = float(np.finfo(np.float32).max)


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Numbers between spaces, commas, semicolons or tabs. A line is a frame, or a row of a frame
    that a shorter line ends."""
    data = rest.data + new
    per_line = profile.cols * profile.values * (profile.rows if profile.lines == "frames" else 1)
    lines = 1 if profile.lines == "frames" else profile.rows
    numbers: list[NDArray[Any]] = []
    ends: list[int] = []
    skipped: list[int] = []
    rows: list[NDArray[Any]] = []
    at = begun = garbage = before = size = 0  # begun: where the lines in `rows` begin
    broken = False
    while (end := data.find(b"\n", at)) >= 0:
        row = _numbers(profile, data[at:end], per_line)
        if row is not None and len(row) == per_line:
            rows.append(row)
        closed = profile.lines == "frames" or row is None or len(row) < per_line
        broken |= row is None or len(row) > per_line
        at = end + 1
        if not closed:
            continue
        if len(rows) == lines and not broken:
            numbers.append(np.concatenate(rows))
            ends.append(at)
            skipped.append(before)
            size, before = at - begun, 0
        else:
            garbage, before = garbage + at - begun, before + at - begun
        rows, begun, broken = [], at, False
    if len(data) - begun > MOST_PACKET * lines:
        garbage, begun = garbage + len(data) - begun, len(data)
    return collected(profile, numbers, ends, skipped, garbage, Rest(data[begun:]), size)


def _numbers(profile: SkinProfile, line: bytes, most: int) -> NDArray[Any] | None:
    """The numbers of a line; None if it contains anything else, or a number outside the range of
    its type. A line with more than `most` is cut after most + 1."""
    words = line.translate(_BETWEEN).split()[: most + 1]
    if profile.number == "float32":
        if not all(map(_DECIMAL.fullmatch, words)):
            return None
        numbers = np.array([float(word) for word in words])
        return None if (np.abs(numbers) > _MOST_FLOAT).any() else numbers.astype(np.float32)
    if not all(map(_WHOLE.fullmatch, words)):
        return None
    values = [int(word) for word in words]
    limits = np.iinfo(profile.number)
    if values and not limits.min <= min(values) <= max(values) <= limits.max:
        return None
    return np.array(values, profile.number)
