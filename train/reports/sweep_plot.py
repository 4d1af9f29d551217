"""The room of the picture of one sweep. In: a recording or a sweep of a set. Out: SVG text, in the style of ink.py.

Each taxel over time where it lies on the skin, all in the same digits; below, the spectrum of all. A skin of more than
MOST rows or columns is one field, a line for each taxel, row after row. The picture is twice as wide as those for a phone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from scipy.signal import welch

from appliance.core.errors import FormatError
from appliance.core.sweep_set import Array
from appliance.core.types import SweepFormat
from train.data import readers, sets
from train.data.readers import RecordedSweep
from train.reports.plot_style import ACCENT, FAINT, GREY, INK, PAPER, SMALL, TEXT, WIDTH, add, scale, svg, write

WIDE, SKIN, SPECTRUM, HIGH = 2 * WIDTH, (0.95, 4.55), (5.45, 7.05), 7.45
"""Inches: the picture's width, from where to where the skin and the spectrum are, and the height of all."""
LEFT, RIGHT = 0.08, 0.985
"""Ends of what is drawn, as shares of the width."""
NUMBER = 0.14
"""Inches: the height of a taxel's number."""
MOST = 8
"""Rows and columns whose taxels are drawn each by itself."""
FINEST = 160
"""Steps in time of one taxel's line: of each the least and the highest digit is drawn, and no peak is lost."""
PIXELS = (640, 480)
"""Of the one field, at most: steps in time, and taxels; where there are more, means of neighbours."""
LINE = 130
"""Characters that fit beside each other."""
SAID = ("status", "label", "probability", "detail")
"""Of a verdict."""
LEAST = 8
"""Frames of which there is a spectrum."""
LONGEST = 256
"""Frames of a segment of the spectrum, or those of one second where they are more (Welch 1967)."""
SHADES = LinearSegmentedColormap.from_list("ink", [PAPER, ACCENT, INK])


@dataclass(frozen=True)
class Look:
    """One sweep and what is said above it.

    taxels: digits [T, R, C]. time_s: float [T], and since when. tare: digits [R, C] of the skin at rest, where known.
    gaps: int [n], the frames after which some are missing.
    """

    taxels: Array
    time_s: Array
    format: SweepFormat
    title: str
    notes: tuple[str, ...]
    since: str
    tare: Array | None
    gaps: Array

    def span(self, axes: Axes) -> None:
        """The field's time, and where in it frames are missing."""
        for frame in self.gaps:
            axes.axvspan(*self.time_s[frame : frame + 2], color=FAINT, linewidth=0)
        axes.set_xlim(self.time_s[0], self.time_s[-1] + 1e-9)  # one frame alone has no width


def look(what: str, number: int | None = None) -> Look:
    """The recording `what` (.npy), or a set's sweep of this number. Raises FormatError where there is no such sweep."""
    path = Path(what)
    if path.suffix == ".npy":
        if number is not None:
            raise FormatError(f"{what} is one sweep; leave --number away")
        return _recorded(readers.RecordedSweep.load(path))
    held = readers.ok(readers.recorded(path)) if path.is_dir() else sets.load(what, 1)
    if number is None or not 0 <= number < len(held):
        wanted = "" if number is None else f" and none of number {number}"
        raise FormatError(f"{what} holds {len(held)} sweeps{wanted}; choose one with --number, from 0 on")
    return _recorded(held[number]) if isinstance(held, list) else _of_set(held, number)


def _recorded(one: RecordedSweep) -> Look:
    """A recording with what its sidecar knows."""
    sweep, about = one.sweep, one.about
    if not len(sweep.frames):
        raise FormatError(f"{one.path}: has no frames, its status is {sweep.status}; choose one that is ok")
    named = [f"{by} {name}" for by in readers.NAMED if (name := getattr(sweep, by))]
    notes = [f"{one.path.name}, sweep {sweep.id}: {sweep.status}", str(one.format)]
    if sweep.lost:
        notes.append(f"{sweep.lost} frames lost, filled in from their neighbours")
    tare = about.get("tare")
    if tare is not None:
        tare = _grid(one.path, tare, sweep.frames.taxels.shape[1:])
        notes.append("grey: the skin at rest")
    for name in ("verdict", "bundle", "source", "device", "clock"):
        said = about.get(name)
        if said := _plain({k: said.get(k) for k in SAID} if name == "verdict" and isinstance(said, dict) else said):
            notes.append(f"{name}: {said}")
    return Look(
        sweep.frames.taxels, (sweep.frames.t_ns - sweep.start_ns) / 1e9, one.format,
        ", ".join([sweep.material or "no material", *named]), tuple(notes),
        "seconds after the start edge", tare, np.flatnonzero(np.diff(sweep.frames.seq) > 1),
    )  # fmt: skip


def _of_set(held: sets.Dataset, number: int) -> Look:
    """A sweep of a set with its groups."""
    named = [held.materials[held.labels[number]], *(f"{by} {v[number]}" for by, v in sorted(held.groups.items()))]
    taxels = held.samples[number]
    notes = (f"{held.source}, sweep {number} of {len(held)}", str(held.format))
    time_s = np.arange(len(taxels)) / held.rate_hz
    return Look(taxels, time_s, held.format, ", ".join(named), notes, "seconds", None, np.empty(0, int))


def _grid(path: Path, tare: Any, grid: tuple[int, ...]) -> Array:
    """float [R, C]. Raises FormatError where the sidecar's is another."""
    try:
        made = np.array(tare, float)
    except (ValueError, TypeError):
        made = np.empty(0)
    if made.shape != grid or not np.isfinite(made).all():
        raise FormatError(f"{path}: the tare in its .json is no {grid[0]} x {grid[1]} numbers; write null there")
    return made


def _plain(value: Any) -> str:
    """What a sidecar holds, in words; a list is a version."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {said}" for name, of in value.items() if (said := _plain(of)))
    if isinstance(value, list):
        return ".".join(map(_plain, value))
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def draw(seen: Look) -> str:
    """The picture."""
    figure = Figure((WIDE, HIGH))
    page = add(figure, 0, 1, 1, 0)
    page.set(xlim=(0, WIDE), ylim=(HIGH, 0))
    page.set_axis_off()
    _head(page, seen)
    taxels = seen.taxels.reshape(len(seen.taxels), -1).astype(float)
    if max(seen.taxels.shape[1:]) > MOST:
        said = _field(add(figure, LEFT, RIGHT, *_ends(SKIN)), seen, taxels)
    else:
        said = _skin(figure, seen, taxels)
    missing = "; grey bars: frames are missing" if len(seen.gaps) else ""
    _say(page, SKIN[1] + 0.35, f"digits over {seen.since}{said}{missing}")
    longest = max(np.split(taxels, seen.gaps + 1), key=len)
    moving = longest[:, np.ptp(longest, axis=0) > 0]  # a logarithm has no place for the others
    if len(moving) < LEAST or not moving.size:
        said = f"no spectrum: less than {LEAST} frames, or nothing moves"
    else:
        _spectrum(add(figure, LEFT, RIGHT, *_ends(SPECTRUM)), moving, seen.format)
        said = "digits per √Hz over Hz: the taxels' mean power; light: their range"
        if seen.format.digits.kind != "f":
            said += "; dots: what rounding to whole digits makes"
        if still := taxels.shape[1] - moving.shape[1]:
            said += f"; without {still} that stand still"
    _say(page, SPECTRUM[0] - 0.13, said)
    return svg(figure, f"one sweep: {_printable(seen.title)}")


def _ends(inches: tuple[float, float]) -> tuple[float, float]:
    """Top and bottom as shares of the height, from below."""
    return 1 - inches[0] / HIGH, 1 - inches[1] / HIGH


def _say(page: Axes, y: float, text: str) -> None:
    """What a field shows, at its left end; y: inches."""
    write(page, LEFT * WIDE, y, text, GREY, SMALL, ha="left", parse_math=False)


def _head(page: Axes, seen: Look) -> None:
    """Title and notes, as many as fit into three lines."""
    how = {"ha": "left", "parse_math": False}
    write(page, 0.12, 0.2, _cut(_printable(seen.title), 80), size=TEXT + 3, weight="bold", **how)
    lines = [""]
    for note in map(_printable, seen.notes):
        together = f"{lines[-1]} · {note}" if lines[-1] else note
        lines = [*lines[:-1], together] if len(together) <= LINE else [*lines, note]
    for i, line in enumerate(lines[:3]):
        write(page, 0.12, 0.44 + 0.18 * i, _cut(line, LINE), GREY, SMALL, **how)


def _skin(figure: Figure, seen: Look, taxels: Array) -> str:
    """A field for each taxel where it lies on the skin, and what is to be said. taxels: float [T, R * C]."""
    rows, columns = seen.taxels.shape[1:]
    top, bottom = _ends(SKIN)
    high, wide = (top - bottom) / rows, (RIGHT - LEFT) / columns
    held = taxels if seen.tare is None else np.append(taxels, seen.tare)
    low, up = held.min(), held.max()
    head = NUMBER * rows / (0.88 * (SKIN[1] - SKIN[0]))  # share of a field that is free for its taxel's number
    room = max(up - low, 1) * np.array([0.08, 1.08 * head / (1 - head)])
    times, digits = _ticks(*seen.time_s[[0, -1]], 4), _ticks(low, up, 3)
    for row, column in np.ndindex(rows, columns):
        left, above = LEFT + column * wide, top - row * high
        axes = add(figure, left, left + 0.94 * wide, above, above - 0.88 * high)
        seen.span(axes)
        axes.set_ylim(low - room[0], up + room[1])
        if seen.tare is not None:
            axes.axhline(seen.tare[row, column], color=GREY, linewidth=0.8)
        axes.plot(*_thinned(seen.time_s, taxels[:, row * columns + column]), color=ACCENT, linewidth=0.7)
        axes.grid(color=FAINT, linewidth=0.6)
        write(axes, 1, 1 - head / 2, f"{row + 1},{column + 1}", GREY, SMALL - 1, ha="right", xycoords="axes fraction")
        for axis, ticks, outer in ((axes.xaxis, times, row == rows - 1), (axes.yaxis, digits, column == 0)):
            scale(axis, ticks, [f"{tick:g}" if outer else "" for tick in ticks])
    return ""


def _field(axes: Axes, seen: Look, taxels: Array) -> str:
    """All taxels as lines of one field, darker where the digits are higher, and what is to be said."""
    rows, columns = seen.taxels.shape[1:]
    times, lines = (_edges(n, most) for n, most in zip(taxels.shape, PIXELS, strict=True))
    means = np.add.reduceat(np.add.reduceat(taxels, times[:-1]), lines[:-1], axis=1) / np.outer(
        *map(np.diff, (times, lines))
    )
    ends_s = np.append(seen.time_s[times[:-1]], seen.time_s[-1] + 1 / seen.format.rate_hz)
    axes.pcolormesh(ends_s, lines / columns, means.T, cmap=SHADES, rasterized=True)
    seen.span(axes)
    axes.set_ylim(rows, 0)
    ticks = _ticks(*ends_s[[0, -1]], 8)
    scale(axes.xaxis, ticks, [f"{tick:g}" for tick in ticks])
    first = np.arange(0, rows, -(-rows // 10))
    scale(axes.yaxis, first + 0.5, [f"row {row + 1}" for row in first])
    return f", from light, {means.min():.4g}, to dark, {means.max():.4g}; in each row its {columns} taxels"


def _spectrum(axes: Axes, taxels: Array, form: SweepFormat) -> None:
    """Mean power of all taxels and their range as amplitudes per root hertz; with white noise of rounding. float [T, n]."""
    hz, power = welch(taxels, form.rate_hz, nperseg=min(len(taxels), max(LONGEST, round(form.rate_hz))), axis=0)
    hz, power = hz[1:], np.maximum(power[1:], 1e-12 * power.max())
    low, mean, high = (np.sqrt(of(axis=1)) for of in (power.min, power.mean, power.max))
    axes.fill_between(hz, low, high, color=ACCENT, alpha=0.15, linewidth=0)
    axes.plot(hz, mean, color=ACCENT, linewidth=1.1)
    axes.set(xscale="log", yscale="log", xlim=(hz[0], hz[-1]))
    if form.digits.kind != "f":
        axes.axhline(np.sqrt(1 / 6 / form.rate_hz), color=INK, linewidth=0.8, linestyle=(0, (2, 2)))
    axes.grid(color=FAINT, linewidth=0.6)
    for axis, (first, last) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        steps = (1, 2, 5) if last / first < 2000 else (1,)
        ticks = [step * 10.0**k for k in range(-9, 9) for step in steps if first <= step * 10.0**k <= last]
        scale(axis, ticks, [f"{tick:g}" for tick in ticks])


def _thinned(time_s: Array, digits: Array) -> tuple[Array, Array]:
    """A line [n] of at most FINEST steps, of each the least and the highest digit in the order in which they came."""
    if len(digits) <= 2 * FINEST:
        return time_s, digits
    edges = _edges(len(digits), FINEST)
    pairs = [sorted((a + int(digits[a:b].argmin()), a + int(digits[a:b].argmax()))) for a, b in pairwise(edges)]
    keep = np.unique(pairs)
    return time_s[keep], digits[keep]


def _edges(n: int, most: int) -> Array:
    """Ends [k + 1] of the k parts, at most `most`, into which n things are put together."""
    return np.linspace(0, n, min(most, n) + 1).astype(int)


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Round values from `low` to `high`, at most `most` and one more."""
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-6)))
    step *= next(k for k in (0.1, 0.2, 0.5, 1, 2, 5) if (high - low) / (k * step) <= most or k == 5)
    return list(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "�" for c in text)


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
