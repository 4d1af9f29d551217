"""Numbers as lines of text: 3D-ViTac, ReSkin, sketches for Arduino, lines of JSON."""

from __future__ import annotations

import re
from functools import lru_cache, reduce
from operator import xor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_codecs.frames import MOST_PACKET, Decoded, Gathering, Rest
from palpate.io.skin_profile import SkinProfile

SEPARATORS, BRACKETS = b",;\t\r ", b"[](){}"
"""What may stand between numbers: any separator, and brackets, as lists are printed with them."""
_BLANKS = bytes.maketrans(SEPARATORS + BRACKETS, b" " * len(SEPARATORS + BRACKETS))
_BETWEEN = {
    ".": _BLANKS,
    # a comma in such a line is a decimal mark
    ",": bytes.maketrans(
        SEPARATORS[1:] + BRACKETS + b",", b" " * len(SEPARATORS[1:] + BRACKETS) + b"."
    ),
}
_WHOLE = re.compile(rb"[+-]?[0-9]{1,9}")
_NUMBER = (
    rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
    rb"|[+-]?(?i:nan|null|inf|infinity|ovf)"
)
"""A number, or what firmware prints for a taxel that gave none, such as Arduino's ovf."""
_DECIMAL = re.compile(_NUMBER)
_STAMP = re.compile(
    rb"(?:[0-9]{4}-[0-9]{2}-[0-9]{2}[T ])?[0-9]{2}:[0-9]{2}:[0-9]{2}(?:[.,][0-9]+)?Z?"
)
"""The time of day, as terminals and loggers put it before a line."""
_AMONG = re.compile(
    rb"(?<![\w.])(?:" + _NUMBER + rb")"
    rb"(?![0-9.]|[A-Za-z]*[0-9_]|\w*[\"']?\s*[:=])"
)
"""A number among other text, perhaps with its unit. Digits in a name, or before a colon or an
equals sign, label one."""
_SUM = re.compile(rb"\$([^*]*)\*([0-9A-Fa-f]{2})\s*")
"""A sentence with the exclusive or of its characters, as in NMEA 0183."""

COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
"""What log lines begin and end with on a terminal."""
_DIGITS = re.compile(rb"[0-9]+")
_MOST_FLOAT = float(np.finfo(np.float32).max)
_SHOWN = 40
"""Characters of a line that are shown in a message."""


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Numbers between separators, brackets, and the text that the profile gives. A line is a frame,
    or a row of a frame that a shorter line ends; with an index, a part with its number."""
    if profile.index:
        return _indexed(profile, rest.data + new)
    data, mark, prefix = rest.data + new, profile.line_end.encode(), profile.prefix.encode()
    per_line = profile.cols * profile.values * (profile.rows if profile.lines == "frames" else 1)
    lines = 1 if profile.lines == "frames" else profile.rows
    frames, at, broken, misfit = Gathering(profile), 0, False, ""
    rows: list[NDArray[Any]] = []
    while (end := data.find(mark, at)) >= 0:
        line, begin, at = data[at:end], at, end + 1
        if prefix and prefix not in line:
            frames.passed_over(begin, at)
            continue
        row, why = _numbers(profile, line, per_line)
        misfit = why or misfit
        if row is not None and len(row) == per_line:
            rows.append(row)
        closed = profile.lines == "frames" or row is None or len(row) < per_line or closes(line)
        # a line that begins with other text stands between two frames
        broken |= len(row) > per_line if row is not None else not _stands_between(line)
        if not closed:
            continue
        if len(rows) == lines and not broken:
            frames.frame(at, rows)
        else:
            frames.waste(at)
        rows, broken = [], False
    if len(data) - frames.begun > MOST_PACKET * lines:
        frames.waste(len(data))
    return frames.decoded(Rest(data[frames.begun :]), misfit)


def _indexed(profile: SkinProfile, data: bytes) -> Decoded:
    """The frames of lines that hold their numbers; other lines are passed over."""
    frames, begins, at, misfit = Gathering(profile), beginning(profile.index), 0, ""
    per_line = profile.values * (profile.cols if profile.lines == "rows" else 1)
    while (end := data.find(profile.line_end.encode(), at)) >= 0:
        line, begin, at = data[at:end], at, end + 1
        if not (match := begins.match(line)):
            frames.passed_over(begin, at)
            continue
        row, why = _numbers(profile, line[match.end() :], per_line)
        misfit = why or misfit
        if row is None or len(row) != per_line:
            frames.waste(at)
            continue
        number = int(match[1])
        if profile.index.count("#") > 1:
            number = number * profile.cols + int(match[2])
        frames.put(begin, at, number, row)
    if len(data) - at > MOST_PACKET:
        frames.waste(len(data))
    return frames.decoded(Rest(data[frames.begun :]), misfit)


@lru_cache(4)
def beginning(index: str) -> re.Pattern[bytes]:
    """Matches the beginning of a line, with a group for each # of `index`."""
    parts = [
        rb"\s*".join(map(re.escape, part.encode().split())) + rb"\s*" for part in index.split("#")
    ]
    return re.compile(rb"\s*" + rb"([0-9]{1,6})(?![0-9.])\s*".join(parts))


def split(line: bytes, decimal: str = ".") -> tuple[list[bytes], str]:
    """The numbers of a line, and its other characters without separators, brackets and the time of
    day. The digits of a label count as "#", so that they may change."""
    words = line.translate(_BETWEEN[decimal]).split()
    if all(map(_DECIMAL.fullmatch, words)):
        return words, ""
    text = _STAMP.sub(b" ", COLOUR.sub(b"", line))
    if summed := _SUM.fullmatch(text):
        if reduce(xor, summed[1], 0) != int(summed[2], 16):
            return [], "another sum"
        text = b"$" + summed[1]
    if decimal == ",":
        text = re.sub(rb"(?<=[0-9]),(?=[0-9])", b".", text)
    around = _DIGITS.sub(b"#", _AMONG.sub(b" ", text)).translate(_BLANKS)
    return _AMONG.findall(text), b"".join(around.split()).decode("utf-8", "replace")


def closes(line: bytes) -> bool:
    """Whether a list of lists ends with this line, as arrays are printed."""
    return line.rstrip().endswith(b"]]") and not line.lstrip().startswith(b"[[")


def _stands_between(line: bytes) -> bool:
    """Whether a line that holds no row begins with something else than a number."""
    return not re.match(rb"[\s\[({]*[-+.]?[0-9]", line)


def _numbers(profile: SkinProfile, line: bytes, most: int) -> tuple[NDArray[Any] | None, str]:
    """The numbers of a line, and its fault; None if it contains anything else, or a
    number outside the range of its type. A line with more than `most` is cut after most + 1."""
    skip = profile.skip_columns
    if prefix := profile.prefix.encode():
        line = line.lstrip()
        if not line.startswith(prefix):
            return None, ""
        line = line.removeprefix(prefix)
    words = line.translate(_BETWEEN[profile.decimal]).split()
    if profile.around or not all(map(_DECIMAL.fullmatch, words)):
        words, around = split(line, profile.decimal)
        if around != profile.around:
            return None, _strange(line, around, profile) if words else ""
    if skip:
        short = len(words) <= max(skip)
        words = words[: min(skip)] if short else [w for i, w in enumerate(words) if i not in skip]
    words = words[: most + 1]
    if profile.number == "float32":
        numbers = np.array([as_float(word) for word in words])
        large = np.flatnonzero(np.abs(numbers) > _MOST_FLOAT)
        if len(large):
            return None, _unfit(words[large[0]], "float32", "check the skin's firmware")
        return numbers.astype(np.float32), ""
    limits, wider = np.iinfo(profile.number), 'set number = "float32" in its profile'
    for word in words:
        if not _WHOLE.fullmatch(word) or not limits.min <= int(word) <= limits.max:
            return None, _unfit(word, profile.number, wider)
    return np.array([int(word) for word in words], profile.number), ""


def as_float(word: bytes) -> float:
    """The value of a number in a line, NaN for a taxel that gave none."""
    return float(word) if any(48 <= one < 58 for one in word) else np.nan


def _unfit(word: bytes, kind: str, remedy: str) -> str:
    sent = word[:_SHOWN].decode("ascii", "replace")
    return f"it sends {sent}, which {kind} cannot hold; {remedy}"


def _strange(line: bytes, around: str, profile: SkinProfile) -> str:
    found = line[:_SHOWN].decode("utf-8", "replace").strip()
    if not found.isprintable() or "\ufffd" in found:
        return ""  # no text at all: another skin, or another baud
    wanted = f"{profile.around[:_SHOWN]!r} is expected" if profile.around else "none is expected"
    return (
        f"{around[:_SHOWN]!r} stands around its numbers, {wanted}: "
        f"{found!r}; set around in its profile"
    )
