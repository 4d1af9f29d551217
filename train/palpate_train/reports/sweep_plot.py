"""The picture of one sweep, of a recording or of a set, as SVG text twice as wide as a phone.

Each taxel is drawn over time at its place on the skin, all on one scale of raw counts. Below are
the spectrum and the spectrogram of all taxels. A skin with more than MOST rows or columns is one
image with a line for each taxel, row after row. Several axes of a taxel share its plot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import mlab
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.text import printable
from palpate.core.types import SweepFormat
from palpate.sweeps.sweep_folder import RecordedSweep
from palpate_train.data import readers, sets
from palpate_train.data.group_values import text_of
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WIDTH,
    add_axes,
    round_ticks,
    set_categories,
    set_ticks,
    to_svg,
    write,
)

WIDE, SKIN, SPECTRUM, SPECTROGRAM, HIGH = 2 * WIDTH, (0.95, 4.55), (5.6, 7.2), (8.1, 9.7), 10.25
"""Inches: the width of the picture; start and end of skin, spectrum and spectrogram; total
height."""
LEFT, RIGHT = 0.08, 0.985
"""Ends of the drawing, as shares of the width."""
NUMBER = 0.14
"""Height in inches of a taxel's number."""
MOST = 8
"""Rows and columns up to which each taxel has a plot of its own."""
FINEST = 160
"""Steps in time of one taxel's line: the lowest and the highest count of each step are drawn, so
that every peak is visible."""
PIXELS = (640, 480)
"""Largest size of the image: steps in time, and taxels. Beyond it, neighbours are averaged."""
LINE = 130
"""Characters that fit in a line."""
VERDICT = ("status", "label", "probability", "detail")
"""Fields of a verdict that are shown."""
LEAST = 8
"""Frames that a spectrum needs."""
LEAST_PIECES, PIECE, RANGE_DB = 64, 128, 40
"""For a spectrogram: the frames that it needs, the largest length of a piece, and the range of
power in dB below the maximum."""
LONGEST = 256
"""Frames of a segment of the spectrum; the frames of one second if they are more (Welch 1967)."""
SHADES = LinearSegmentedColormap.from_list("shades", [to_rgba(ACCENT, 0.0), to_rgba(ACCENT)])
"""From transparent to the accent, so that an image fits a light and a dark page."""


@dataclass(frozen=True, eq=False)
class ShownSweep:
    """One sweep with its title and notes.

    taxels: raw counts [T, R, C] or [T, R, C, A]. time_s: float [T], seconds from the event `since`.
    tare: raw counts [R, C] or [R, C, A] of the skin at rest, if known. gaps: int [n], the frames
    before missing ones.
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
        """Set the limits in time and mark where frames are missing."""
        for frame in self.gaps:
            axes.axvspan(*self.time_s[frame : frame + 2], color=FAINT, linewidth=0)
        axes.set_xlim(self.time_s[0], self.time_s[-1] + 1e-9)  # one frame alone has no width


@dataclass(frozen=True)
class SweepSource:
    """Sweeps that can be shown one by one. name: as given by the user. get: returns the sweep of a
    number from 0 to `count` - 1."""

    name: str
    count: int
    get: Callable[[int], ShownSweep]


def source(what: str) -> SweepSource:
    """The sweeps of a recording (.npy), a folder of recordings or a set. Raises FormatError if
    there are none."""
    path = Path(what)
    if path.suffix == ".npy":
        one = _recorded(RecordedSweep.load(path))
        return SweepSource(what, 1, lambda number: one)
    if path.is_dir():
        found = readers.usable(readers.read_recorded(path))
        return SweepSource(what, len(found), lambda number: _recorded(found[number]))
    labelled = sets.load(what, 1)
    return SweepSource(what, len(labelled), lambda number: of_set(labelled, number))


def load(what: str, number: int | None = None) -> ShownSweep:
    """The recording `what` (.npy), or a set's sweep of this number. Raises FormatError if there is
    no such sweep."""
    found = source(what)
    if Path(what).suffix == ".npy":
        if number is not None:
            raise FormatError(f"{what} is one sweep; leave --number away")
        number = 0
    if number is None or not 0 <= number < found.count:
        wanted = "" if number is None else f" and none of number {number}"
        raise FormatError(
            f"{what} holds {found.count} sweeps{wanted}; choose one with --number, from 0 on"
        )
    return found.get(number)


def _recorded(one: RecordedSweep) -> ShownSweep:
    """A recording with the content of its sidecar."""
    sweep, about = one.sweep, one.about
    if not len(sweep.frames):
        raise FormatError(
            f"{one.path}: has no frames, its status is {sweep.status}; choose another sweep"
        )
    named = [f"{by} {name}" for by in readers.NAMED_GROUPS if (name := getattr(sweep, by))]
    notes = [f"{one.path.name}, sweep {sweep.id}: {sweep.status}", str(one.format)]
    if sweep.lost:
        notes.append(f"{sweep.lost} frames lost, filled in from their neighbours")
    found = about.get("unloaded")  # what a recording without a bundle has in place of a tare
    tare = about.get("tare", found.get("level") if isinstance(found, dict) else None)
    if tare is not None:
        tare = _grid(one.path, tare, sweep.frames.taxels.shape[1:])
        notes.append("grey: the skin at rest")
    for name in ("verdict", "bundle", "source", "trigger", "device", "clock"):
        value = about.get(name)
        if name == "verdict" and isinstance(value, dict):
            value = {
                key: value.get(key)
                for key in VERDICT
                if value.get("label") or key in ("status", "detail")
            }
        if text := _plain(value):
            notes.append(f"{name}: {text}")
    return ShownSweep(
        sweep.frames.taxels,
        (sweep.frames.t_ns - sweep.start_ns) / 1e9,
        one.format,
        ", ".join([sweep.material or "no material", *named]),
        tuple(notes),
        "seconds after the start edge",
        tare,
        np.flatnonzero(np.diff(sweep.frames.seq) > 1),
    )


def of_set(labelled: sets.Dataset, number: int) -> ShownSweep:
    """A sweep of a set with its groups."""
    material = labelled.materials[labelled.labels[number]]
    named = [
        labelled.displays.get(material, material),
        *(
            f"{by} {text_of(v[number])} {labelled.units.get(by, '')}".rstrip()
            for by, v in sorted(labelled.groups.items())
        ),
    ]
    taxels = labelled.samples[number]
    notes = (f"{labelled.source}, sweep {number} of {len(labelled)}", str(labelled.format))
    time_s = np.arange(len(taxels)) / labelled.rate_hz
    return ShownSweep(
        taxels, time_s, labelled.format, ", ".join(named), notes, "seconds", None, np.empty(0, int)
    )


def _grid(path: Path, tare: Any, grid: tuple[int, ...]) -> Array:
    """The tare as float [R, C] or [R, C, A]. Raises FormatError if the sidecar's has another
    shape."""
    try:
        made = np.array(tare, float)
    except (ValueError, TypeError):
        made = np.empty(0)
    if made.shape != grid or not np.isfinite(made).all():
        raise FormatError(
            f"{path}: the tare in its .json is no {' x '.join(map(str, grid))} numbers; "
            "write null there"
        )
    return made


def _plain(value: Any) -> str:
    """A value of a sidecar as text; a list is a version."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name.replace('_', ' ')} {text}" for name, of in value.items() if (text := _plain(of))
        )
    if isinstance(value, list):
        return ".".join(map(_plain, value))
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def draw(sweep: ShownSweep, plain: bool = True) -> str:
    """The picture. plain: with its own colours instead of a page's."""
    figure = Figure((WIDE, HIGH))
    page = add_axes(figure, 0, 1, 1, 0)
    page.set(xlim=(0, WIDE), ylim=(HIGH, 0))
    page.set_axis_off()
    _head(page, sweep)
    taxels = sweep.taxels.reshape(len(sweep.taxels), -1).astype(float)
    if max(sweep.taxels.shape[1:3]) > MOST:
        shades = _image(add_axes(figure, LEFT, RIGHT, *_ends(SKIN)), sweep, taxels)
    else:
        shades = _skin(figure, sweep, taxels)
    missing = "; grey bars: frames are missing" if len(sweep.gaps) else ""
    _caption(page, SKIN[1] + 0.52, f"raw counts over {sweep.since}{shades}{missing}")
    starts = np.append(0, sweep.gaps + 1)
    runs = zip(starts, np.split(taxels, starts[1:]), strict=True)  # between missing frames
    first, longest = max(runs, key=lambda run: len(run[1]))
    moving = longest[
        :, np.ptp(longest, axis=0) > 0
    ]  # the others have no place on a logarithmic axis
    still = taxels.shape[1] - moving.shape[1]
    text = f"no spectrum: less than {LEAST} frames, or nothing moves"
    if len(moving) >= LEAST and moving.size:
        _spectrum(add_axes(figure, LEFT, RIGHT, *_ends(SPECTRUM)), moving, sweep.format)
        text = _about_spectrum(sweep.format, still)
    _caption(page, SPECTRUM[0] - 0.13, text)
    text = f"no spectrogram: less than {LEAST_PIECES} frames, or nothing moves"
    if len(moving) >= LEAST_PIECES and moving.size:
        _spectrogram(
            add_axes(figure, LEFT, RIGHT, *_ends(SPECTROGRAM)), sweep, moving, sweep.time_s[first]
        )
        text = (
            f"Hz over {sweep.since}: mean power of the taxels; "
            f"stronger colour for more, over {RANGE_DB} dB"
        )
    _caption(page, SPECTROGRAM[0] - 0.13, text)
    return to_svg(figure, f"one sweep: {printable(sweep.title, '�')}", plain=plain)


def _about_spectrum(format: SweepFormat, still: int) -> str:
    """The caption of a spectrum. still: number of constant taxels, which are left out."""
    text = "raw counts per √Hz over Hz: mean power of the taxels; light: their range"
    if format.numpy_type.kind != "f":
        text += "; dots: the noise of rounding to whole counts"
    return text + f"; without {still} constant taxel{'s' * (still > 1)}" * (still > 0)


def _ends(inches: tuple[float, float]) -> tuple[float, float]:
    """Top and bottom as shares of the height, from below."""
    return 1 - inches[0] / HIGH, 1 - inches[1] / HIGH


def _caption(page: Axes, y: float, text: str) -> None:
    """Write the caption of a plot at its left end. y: inches."""
    write(page, LEFT * WIDE, y, text, GREY, SMALL, ha="left")


def _head(page: Axes, sweep: ShownSweep) -> None:
    """Title and notes, as many as fit into three lines."""
    title = _cut(printable(sweep.title, "�"), 80)
    write(page, 0.12, 0.2, title, size=MEDIUM + 3, weight="bold", ha="left")
    lines = [""]
    for note in (printable(note, "�") for note in sweep.notes):
        together = f"{lines[-1]} · {note}" if lines[-1] else note
        lines = [*lines[:-1], together] if len(together) <= LINE else [*lines, note]
    for i, line in enumerate(lines[:3]):
        write(page, 0.12, 0.44 + 0.18 * i, _cut(line, LINE), GREY, SMALL, ha="left")


def _skin(figure: Figure, sweep: ShownSweep, taxels: Array) -> str:
    """Plot each taxel at its place on the skin; returns an addition to the caption. taxels: float
    [T, R * C * A]."""
    rows, columns = sweep.taxels.shape[1:3]
    lines = taxels.reshape(len(taxels), rows, columns, -1)
    tare = None if sweep.tare is None else sweep.tare.reshape(lines.shape[1:])
    # about its own level: offsets between taxels would make flat lines of all signals
    level = np.median(lines, axis=0) if tare is None else tare
    lines = lines - level
    top, bottom = _ends(SKIN)
    high, wide = (top - bottom) / rows, (RIGHT - LEFT) / columns
    low, up = min(lines.min(), 0.0), max(lines.max(), 0.0)
    # share of a plot that is free for its taxel's number
    head = NUMBER * rows / (0.88 * (SKIN[1] - SKIN[0]))
    margins = max(up - low, 1) * np.array([0.08, 1.08 * head / (1 - head)])
    times, counts = round_ticks(sweep.time_s[0], sweep.time_s[-1], 4), round_ticks(low, up, 3)
    for row, column in np.ndindex(rows, columns):
        left, above = LEFT + column * wide, top - row * high
        axes = add_axes(figure, left, left + 0.94 * wide, above, above - 0.88 * high)
        sweep.span(axes)
        axes.set_ylim(low - margins[0], up + margins[1])
        _taxel(axes, sweep, lines[:, row, column], tare is not None)
        place = {"ha": "right", "xycoords": "axes fraction"}
        write(axes, 1, 1 - head / 2, f"{row + 1},{column + 1}", GREY, SMALL - 1, **place)
        if sweep.format.axes == 1:
            place["ha"] = "left"
            text = f"{level[row, column, 0]:.5g}"
            write(axes, 0, 1 - head / 2, text, GREY, SMALL - 1, **place)
        lowest, leftmost = row == rows - 1, column == 0
        for axis, ticks, outer in ((axes.xaxis, times, lowest), (axes.yaxis, counts, leftmost)):
            set_ticks(axis, ticks, bare=not outer)
        axes.set_xlabel("s" if lowest else "", color=GREY, size=SMALL, labelpad=1)
        axes.set_ylabel("counts" if leftmost else "", color=GREY, size=SMALL)
    axes_told = f"; {sweep.format.axes} axes, the normal one dark" * (sweep.format.axes > 1)
    about = "the skin at rest" if tare is not None else "its median"
    shown = ", which stands above it" * (sweep.format.axes == 1)
    return f"; each taxel about {about}{shown}{axes_told}"


def _taxel(axes: Axes, sweep: ShownSweep, counts: Array, tared: bool) -> None:
    """Draw the lines of one taxel over the grid. counts: [T, A] about its level; tared: whether
    that is the level of the skin at rest."""
    if tared:
        axes.axhline(0.0, color=GREY, linewidth=0.8)
    for k in range(sweep.format.axes):
        normal, line = k == sweep.format.axes - 1, _thinned(sweep.time_s, counts[:, k])
        axes.plot(*line, color=ACCENT, linewidth=0.7, alpha=None if normal else 0.4)
    axes.grid(color=FAINT, linewidth=0.6)


def _image(axes: Axes, sweep: ShownSweep, taxels: Array) -> str:
    """Draw all taxels as lines of one image, darker for higher counts; returns an addition to the
    caption."""
    rows, columns = sweep.taxels.shape[1:3]
    each = f", of each its {sweep.format.axes} axes" if sweep.format.axes > 1 else ""
    times, lines = (_edges(n, most) for n, most in zip(taxels.shape, PIXELS, strict=True))
    means = np.add.reduceat(np.add.reduceat(taxels, times[:-1]), lines[:-1], axis=1) / np.outer(
        *map(np.diff, (times, lines))
    )
    means = means - np.median(means, axis=0)
    ends_s = np.append(sweep.time_s[times[:-1]], sweep.time_s[-1] + 1 / sweep.format.rate_hz)
    axes.pcolormesh(
        ends_s, lines / (columns * sweep.format.axes), means.T, cmap=SHADES, rasterized=True
    )
    sweep.span(axes)
    axes.set_ylim(rows, 0)
    set_ticks(axes.xaxis, round_ticks(ends_s[0], ends_s[-1], 8))
    axes.set_xlabel("s", color=GREY, size=SMALL, labelpad=1)
    first = np.arange(0, rows, -(-rows // 10))
    set_categories(axes.yaxis, first + 0.5, [f"row {row + 1}" for row in first])
    return (
        f"; each line about its median, from light, {means.min():.4g}, to dark, "
        f"{means.max():.4g}; in each row its {columns} taxels{each}"
    )


def _spectrum(axes: Axes, taxels: Array, format: SweepFormat) -> None:
    """Plot the mean power of all taxels and their range as amplitudes per root hertz, with the
    noise of rounding. taxels: [T, n]."""
    piece = min(len(taxels), max(LONGEST, round(format.rate_hz)))
    power, hz = _powers(mlab.psd, taxels, format.rate_hz, piece, piece // 2)
    hz, power = hz[1:], np.maximum(power[:, 1:], 1e-12 * power.max())
    low, mean, high = (np.sqrt(of(axis=0)) for of in (power.min, power.mean, power.max))
    axes.fill_between(hz, low, high, color=ACCENT, alpha=0.15, linewidth=0)
    axes.plot(hz, mean, color=ACCENT, linewidth=1.1)
    axes.set(xscale="log", yscale="log", xlim=(hz[0], hz[-1]))
    if format.numpy_type.kind != "f":
        axes.axhline(
            np.sqrt(1 / 6 / format.rate_hz), color=BLACK, linewidth=0.8, linestyle=(0, (2, 2))
        )
    axes.grid(color=FAINT, linewidth=0.6)
    for axis, (first, last) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        steps = (1, 2, 5) if last / first < 2000 else (1,)
        ticks = [
            step * 10.0**k
            for k in range(-9, 9)
            for step in steps
            if first <= step * 10.0**k <= last
        ]
        set_ticks(axis, ticks)
    axes.set_xlabel("Hz", color=GREY, size=SMALL, labelpad=1)
    axes.set_ylabel("counts/√Hz", color=GREY, size=SMALL)


def _powers(of: Callable[..., Any], taxels: Array, rate_hz: float, piece: int, overlap: int) -> Any:
    """Power densities [n, ...] of taxels [T, n] by mlab's psd or specgram, and its frequencies and
    times. The mean of each piece is subtracted (Welch 1967)."""
    window = np.hanning(piece + 1)[:-1]
    how = {"detrend": "mean", "window": window, "noverlap": overlap}
    power, *axes = zip(*(of(taxel, piece, rate_hz, **how) for taxel in taxels.T), strict=True)
    return np.stack(power), *(axis[0] for axis in axes)


def _spectrogram(axes: Axes, sweep: ShownSweep, taxels: Array, start_s: float) -> None:
    """Draw the mean power of all taxels [T, n] in decibels over time and frequency, on the time
    axis of the signals."""
    piece = min(len(taxels) // 4, PIECE)
    power, hz, s = _powers(mlab.specgram, taxels, sweep.format.rate_hz, piece, 3 * piece // 4)
    db = 10 * np.log10(np.maximum(power.mean(axis=0), 1e-12))  # [frequencies, pieces]
    half_s, half_hz = (s[1] - s[0]) / 2, (hz[1] - hz[0]) / 2
    ends = (start_s + s[0] - half_s, start_s + s[-1] + half_s, hz[0] - half_hz, hz[-1] + half_hz)
    axes.imshow(
        db,
        origin="lower",
        aspect="auto",
        cmap=SHADES,
        vmin=db.max() - RANGE_DB,
        vmax=db.max(),
        extent=ends,
        interpolation="none",
    )
    axes.set_xlim(sweep.time_s[0], sweep.time_s[-1])
    axes.set_ylim(0, hz[-1])
    set_ticks(axes.xaxis, round_ticks(sweep.time_s[0], sweep.time_s[-1], 8))
    set_ticks(axes.yaxis, round_ticks(0, hz[-1], 4))
    axes.set_xlabel("s", color=GREY, size=SMALL, labelpad=1)
    axes.set_ylabel("Hz", color=GREY, size=SMALL)


def _thinned(time_s: Array, counts: Array) -> tuple[Array, Array]:
    """A line [n] of at most FINEST steps: the lowest and the highest count of each, in the order of
    time."""
    if len(counts) <= 2 * FINEST:
        return time_s, counts
    edges = _edges(len(counts), FINEST)
    pairs = [
        sorted((a + int(counts[a:b].argmin()), a + int(counts[a:b].argmax())))
        for a, b in pairwise(edges)
    ]
    keep = np.unique(pairs)
    return time_s[keep], counts[keep]


def _edges(n: int, most: int) -> Array:
    """Ends [k + 1] of the k parts, at most `most`, into which n items are divided."""
    return np.linspace(0, n, min(most, n) + 1).astype(int)


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
