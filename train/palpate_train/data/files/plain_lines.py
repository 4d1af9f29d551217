"""Takes from lines of numbers what people and programs write around them: brackets, labels, units,
the clock of a serial monitor, separators of thousands that cannot be anything else.

Each rewriting holds for lines that have it. A decoration that only a few lines have stays, so that
such a line is refused with its number.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from palpate.core.errors import FormatError

SAMPLED = 200
"""Number of lines at the start and at the end that show the decorations and layout of a text."""
USUAL = 0.8
"""Share of the lines with digits that have a decoration, if it is removed."""
_STAMP = r"(?:\d{4}-\d\d-\d\d[ T])?\d\d:\d\d:\d\d(?:[.,]\d+)?"
_BARE = r":?(?=[ \t]+(?:\d|-(?!\d\d:?\d\d\b))[^ ]*[,;\t])"
CLOCK = re.compile(rf"^\s*\[?({_STAMP})(?:\](?:\s*[,;\t])?|\s*->|{_BARE})\s*(.*)$")
"""The time that the serial monitor of Arduino, Tera Term in brackets, or CoolTerm before a blank,
writes before a line."""
LABEL = re.compile(r"(?<![\w.])([A-Za-z_][\w.\-\[\]]*)\s*[=:]\s*(?=[-+.\d])")
BYTES = re.compile(r"^\s*b(['\"])(.*?)(?:\\r)?(?:\\n)?\1\s*$")
"""A line of bytes as Python prints it."""
CELL = re.compile(r'"\[\s*([-+.\d][-+.\deE, ]*?)\s*\]"')
"""A list in a cell, as pandas writes it."""
OWN = re.compile(r"\(\s*\d+[.,]?\d*\s*\)\s*[;\t|]|\(\s*\d+(?:\.\d*)?\s*\)\s*,")
"""A number in parentheses of its own, as accountants write negative ones."""
BRACKETS = re.compile(rf"^\s*(?!\[{_STAMP}\])(?:array|tensor)?\s*" + r"[\[({].*\d")
ARRAY = re.compile(r"^\s*(array|tensor)")
QUOTED = re.compile(r"'([^',;\t]*\d)'")
HEXADECIMAL = re.compile(r"(?<![\w.])0[xX]([0-9a-fA-F]{1,8})(?![\w.])")
FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]\d)")
UNITS = re.compile(
    r"(?<=\d)(?:\s?(?:[kmuµnh]?(?:N|V|A|Pa|g|Ω|Ohm|T|gf|bar)(?:/[cm]?m[2²])?|[kmuµnpf]F|[kM]Hz|[muµ]m"
    r"|%|psi|mmHg|°C|lbf?|oz|dB|LSB|raw|bits?|counts?)|\s(?:F|G|Hz|a\.u\.))"
    r"(?=\s*(?:[,;\t|\])]|$))"
)
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
"""A colour of a terminal, in a log that was taken from one."""
REMARK = re.compile(r"(?<=\d)\s+(?:#|//)\s.*$")
"""A comment behind the numbers of a line."""
THOUSANDS = re.compile(r"(?<=\d)['’](?=\d{3}(?!\d))")
BLANK_THOUSANDS = re.compile(r"(?<=\d)[\u00a0\u202f\u2009](?=\d{3}(?!\d))")
"""In a text whose columns other signs separate."""


def plain(lines: Sequence[str]) -> tuple[list[str], tuple[str, ...], list[str]]:
    """The lines of a text without decorations, in their order and number; the names of the columns,
    if labels give them; and remarks."""
    lines = [COLOUR.sub("", line).translate(_MINUS) for line in lines]
    some = [*lines[:SAMPLED], *lines[max(SAMPLED, len(lines) - SAMPLED) :]]
    some = [line for line in some if re.search(r"\d", line)]
    notes = []
    for one in _REWRITINGS:
        found = sum(bool(one.shows(line)) for line in (lines if one.seldom else some))
        if found and (one.seldom or found >= USUAL * len(some)):
            one.check(lines)
            lines, some = (
                [one.rewrite(line) if one.shows(line) else line for line in part]
                for part in (lines, some)
            )
            notes.append(f"{one.what} are left out")
    names: tuple[str, ...] = ()
    if some and sum(map(_labelled, some)) >= USUAL * len(some):
        names = tuple(LABEL.findall(next(filter(_labelled, some))))
        labels = [(line, tuple(LABEL.findall(line))) for line in lines]
        lines = [LABEL.sub("", line) if found == names else line for line, found in labels]
    if some and sum(bool(CLOCK.match(line)) for line in some) >= USUAL * len(some):
        lines = [CLOCK.sub(_clocked, line) for line in lines]
        names = ("clock", *names) if names else ()
    return lines, names, notes


def _labelled(line: str) -> bool:
    """Whether each number of a line has a label. A time before them needs none."""
    found = LABEL.findall(line)
    rest = LABEL.sub("", CLOCK.sub(r"\2", line))
    return len(found) > 1 and len(found) == len(re.findall(r"[-+.\w]*\d[-+.\w]*", rest))


def _clocked(found: re.Match[str]) -> str:
    """The time as a cell of its own."""
    sign = next((s for s in (";", "\t", ",") if s in found[2]), " ")
    return f"{found[1].replace(',', '.').replace(' ', 'T')}{sign}{found[2]}"


def _spread(found: re.Match[str]) -> str:
    """The numbers of a list as cells."""
    return (";" if ";" in found.string else ",").join(found[1].replace(",", " ").split())


def _one_unit(lines: Sequence[str]) -> None:
    """Raises FormatError if the unit of a column changes, as from mV to V."""
    known: dict[int, tuple[str, int]] = {}
    for i, line in enumerate(lines, 1):
        sign = next((sign for sign in "\t;|" if sign in line), ",")
        for found in UNITS.finditer(line):
            unit = found[0].strip()
            first, at = known.setdefault(line.count(sign, 0, found.start()), (unit, i))
            if unit != first:
                raise FormatError(
                    f"line {i} has values in {unit}, line {at} in {first}; write one unit"
                )


@dataclass(frozen=True)
class Rewriting:
    """A decoration. what: its name. shows: whether a line has it. rewrite: removes it. seldom: it
    cannot be anything else, so a single line suffices. check: refuses lines that differ in it."""

    what: str
    shows: Callable[[str], object]
    rewrite: Callable[[str], str]
    seldom: bool = False
    check: Callable[[Sequence[str]], None] = lambda _: None


_NO_BRACKETS = str.maketrans("", "", "[](){}")
_MINUS = str.maketrans("\u2212\u2013\uff0d", "---")
_REWRITINGS = (
    Rewriting("comments behind numbers", REMARK.search, partial(REMARK.sub, ""), True),
    Rewriting("marks of bytes", BYTES.search, partial(BYTES.sub, r"\2")),
    Rewriting("brackets of lists", CELL.search, partial(CELL.sub, _spread)),
    Rewriting(
        "brackets",
        lambda line: BRACKETS.match(line) and not OWN.search(line),
        lambda line: ARRAY.sub("", line).translate(_NO_BRACKETS).strip(" ,"),
    ),
    Rewriting("single quotes", QUOTED.search, partial(QUOTED.sub, r"\1")),
    Rewriting("units of the cells", UNITS.search, partial(UNITS.sub, ""), check=_one_unit),
    Rewriting("separators of thousands", THOUSANDS.search, partial(THOUSANDS.sub, ""), True),
    Rewriting(
        "separators of thousands",
        lambda line: any(sign in line for sign in ";\t|") and BLANK_THOUSANDS.search(line),
        partial(BLANK_THOUSANDS.sub, ""),
        True,
    ),
    Rewriting("D in exponents", FORTRAN.search, partial(FORTRAN.sub, "e")),
    Rewriting(
        "marks of hexadecimal numbers",
        HEXADECIMAL.search,
        partial(HEXADECIMAL.sub, lambda found: str(int(found[1], 16))),
    ),
)
