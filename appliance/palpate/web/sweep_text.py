"""Pictures of a sweep for a terminal, for `palpate record` and `palpate watch`: the signal over
time and, if the rate allows it, the spectrogram."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from palpate.alignment.heat_map import side_by_side, uncoloured
from palpate.alignment.terminal import ASCII, BLOCKS, abilities
from palpate.core.errors import FormatError
from palpate.core.observer import Observer
from palpate.core.types import Sweep, Verdict, normal
from palpate.signal import features

NAME, COLUMNS = 8, 40
"""Characters of the names at the left, and most characters of the time axis."""
HIGH, BANDS = 3, 6
"""Lines of the signal, and most lines of the spectrogram."""


def picture(
    taxels: NDArray[Any], rate_hz: float, width: int, *, colours: bool, signs: str = BLOCKS
) -> list[str]:
    """The picture in lines of at most `width` characters. taxels: raw counts [T, R, C] or [T, R, C,
    A]. rate_hz: frames per second."""
    mean = np.nan_to_num(normal(taxels, 1).astype(np.float64)).reshape(len(taxels), -1).mean(axis=1)
    bands, why = _bands(taxels, rate_hz)
    columns = max(1, min(width - NAME - 2, COLUMNS, bands.shape[1] or len(mean)))
    names = [f"{mean.max():.4g}", *[""] * (HIGH - 2), f"{mean.min():.4g}"]
    drawn = [
        f"{name:>{NAME}} {row}"
        for name, row in zip(names, _bars(_pooled(mean, columns), signs), strict=True)
    ]
    if why:
        drawn.append(f"{'':{NAME}} no spectrogram: {why}"[:width])
    else:
        top = min(features.HIGH_HZ[1], rate_hz / 2)
        drawn += _shades(np.array([_pooled(band, columns) for band in bands]), top, colours, signs)
    seconds = f"{len(mean) / rate_hz:g} s"
    return [*drawn, f"{'':{NAME}} {'0':<{max(0, columns - len(seconds))}}{seconds}"[:width]]


def _pooled(values: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    """Means of `parts` parts."""
    return np.array([part.mean() for part in np.array_split(values, columns)])


def _bars(values: NDArray[np.float64], signs: str) -> list[str]:
    """HIGH lines of bars, with half characters if the terminal has them."""
    full, half = (signs[4], "▄") if signs != ASCII else ("#", "_")
    level = values - values.min()
    halves = np.rint(level / max(float(level.max()), 1e-12) * 2 * HIGH).astype(int)
    rows = range(HIGH - 1, -1, -1)
    return [
        "".join(full if n >= 2 * row + 2 else half if n == 2 * row + 1 else " " for n in halves)
        for row in rows
    ]


def _bands(taxels: NDArray[Any], rate_hz: float) -> tuple[NDArray[np.float64], str]:
    """Shares of power (features.h_features) of at most BANDS bands [bands, short windows], or the
    reason why there are none."""
    try:
        shape = features.h_shape(len(taxels), rate_hz)
        shares = features.h_features(np.nan_to_num(taxels), rate_hz, "hann").reshape(shape).T
    except FormatError as e:
        return np.empty((0, 0)), str(e)
    return np.array(
        [part.sum(axis=0) for part in np.array_split(shares, min(BANDS, len(shares)))]
    ), ""


def _shades(bands: NDArray[np.float64], top_hz: float, colours: bool, signs: str) -> list[str]:
    """A line for each band, the highest band first; a field is a character wide."""
    rows = bands[::-1].tolist()
    names = [f"{top_hz:.0f} Hz", *[""] * (len(rows) - 2), "0 Hz"][: len(rows)]
    lines = next(side_by_side([rows], max(float(bands.max()), 1e-12), len(rows[0]) + 4, signs))
    return [
        f"{name:>{NAME}}{line if colours else uncoloured(line)}"
        for name, line in zip(names, lines, strict=True)
    ]


def counts_table(counts: Sequence[Sequence[Any]], width: int) -> list[str]:
    """Counts per material (rows) and position (columns) as lines. counts: (material, position,
    number)."""
    materials, positions = (sorted({str(row[i]) for row in counts}) for i in (0, 1))
    held = {(material, position): number for material, position, number in counts}
    wide = max([6, *(len(position) + 2 for position in positions)])
    head = (
        [f"{'':24}" + "".join(f"{position:>{wide}}" for position in positions)]
        if any(positions)
        else []
    )
    rows = [
        f"{m:<24}" + "".join(f"{held.get((m, p), '.'):>{wide}}" for p in positions)
        for m in materials
    ]
    return [line[:width] for line in (*head, *rows)]


class SweepPrinter(Observer):
    """Prints each recorded sweep on a terminal: its picture, then the counts per material and
    position.

    A terminal that does not accept output misses the sweep. rate_hz: of the sweeps. about: see
    RecordingSession.about.
    """

    def __init__(self, out: TextIO, rate_hz: float, about: Callable[[], Mapping[str, Any]]) -> None:
        self._out, self._rate_hz, self._about = out, rate_hz, about
        self._colours, self._signs = abilities(out)

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        if not select.select([], [self._out], [], 0)[1]:
            return
        width = os.get_terminal_size(self._out.fileno()).columns or 80
        lines: list[str] = []
        if len(sweep.frames):
            lines = picture(
                sweep.frames.taxels, self._rate_hz, width, colours=self._colours, signs=self._signs
            )
        lines += counts_table(self._about()["counts"], width)
        self._out.write("".join(f"{line}\n" for line in lines))
        self._out.flush()
