"""Pictures of sweeps in a terminal: a tone is in its band, every format fits, a stopped terminal
blocks nothing."""

from __future__ import annotations

import io
import os
import pty
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np
import pytest

from palpate.alignment.terminal import ASCII
from palpate.core.types import Frames, SweepFormat
from palpate.sim import skin
from palpate.web.sweep_text import BANDS, HIGH, NAME, SweepPrinter, counts_table, picture
from tests.factories.feeds import OK, cut

RATE = 750.0


def plain(text: str) -> str:
    """Text without control sequences."""
    return re.sub(r"\033\[[0-9;]*m", "", text)


def tone(hz: float, format: SweepFormat = skin.FORMAT) -> np.ndarray:
    """A window [T, R, C] or [T, R, C, A] in which all taxels swing, with growing amplitude."""
    t = np.arange(format.window) / format.rate_hz
    wave = 100 + 40 * t / t[-1] * (1 + np.sin(2 * np.pi * hz * t))
    return np.broadcast_to(
        wave.reshape(-1, *(1,) * len(format.shape)), (format.window, *format.shape)
    ).astype(format.numpy_type)


@pytest.mark.parametrize(("hz", "row"), [(10, 5), (100, 4), (340, 0)])
def test_a_tone_stands_in_its_band(hz: float, row: int) -> None:
    """The darkest band contains the frequency; 0 Hz is at the bottom, 375 Hz at the top."""
    lines = picture(tone(hz), RATE, 80, colours=False)[HIGH : HIGH + BANDS]
    assert (lines[0].split()[0], lines[-1].split()[0]) == ("375", "0")
    dark = [line[NAME + 1 :].count("█") for line in lines]
    assert dark.index(max(dark)) == row


def test_the_signal_rises_where_the_load_does() -> None:
    """The bars of the last columns are higher than those of the first; highest and lowest mean are
    named."""
    lines = picture(tone(20), RATE, 80, colours=False)
    columns = list(zip(*(line[NAME + 1 :].ljust(40) for line in lines[:HIGH]), strict=True))
    heights = [sum(c != " " for c in column) for column in columns]
    assert heights[0] == 0
    assert heights[-1] == HIGH
    assert [line.split()[0] for line in (lines[0], lines[HIGH - 1])] == ["178", "100"]
    assert lines[-1].split() == ["0", "2", "s"]


@pytest.mark.parametrize("width", [80, 40, 12])
@pytest.mark.parametrize(
    "format",
    [
        skin.FORMAT,
        SweepFormat(3, 3, 100, 200, "float32", 3),
        SweepFormat(1, 1, 35, 70, "int16"),
        SweepFormat(2, 2, 10, 20, "uint16"),
        SweepFormat(2, 2, 1000, 1, "uint8"),
        SweepFormat(16, 16, 66, 132, "uint16"),
    ],
    ids=str,
)
def test_every_form_fits(format: SweepFormat, width: int) -> None:
    """No line is wider than the terminal. If the rate is too low for a spectrogram, the reason is
    shown."""
    taxels = (
        tone(3, format) if format.window > 1 else np.ones((1, *format.shape), format.numpy_type)
    )
    lines = picture(taxels, format.rate_hz, width, colours=True)
    assert max(len(plain(line)) for line in lines) <= max(width, NAME + 2)
    if width == 80:
        assert ("no spectrogram" in "".join(lines)) == (format.rate_hz < 20 or format.window == 1)


def test_a_silent_window_and_broken_counts_are_pictures_too() -> None:
    """Constant counts and counts that are not numbers give lines without a bar, and no error."""
    still = np.full((1500, 4, 4), 7, np.uint8)
    assert "█" not in "".join(picture(still, RATE, 80, colours=False))
    broken = np.full((200, 3, 3, 3), np.nan, np.float32)
    assert picture(broken, 100.0, 80, colours=False, signs=ASCII)


def test_counts_stand_in_rows_and_columns() -> None:
    """Materials below one another, positions beside one another, a dot where there is none."""
    rows = counts_table([("metal", "1", 10), ("metal", "2", 3), ("wood", "1", 4)], 80)
    assert [row.split() for row in rows] == [["1", "2"], ["metal", "10", "3"], ["wood", "4", "."]]
    assert counts_table([("wood", "", 4)], 80) == ["wood                         4"]
    assert counts_table([], 80) == []


@pytest.fixture
def screen() -> Iterator[tuple[int, TextIO]]:
    """Both ends of a terminal."""
    far, near = pty.openpty()
    with os.fdopen(near, "w", encoding="utf-8") as out:
        yield far, out
    os.close(far)


def about() -> dict[str, object]:
    """The facts of a recording."""
    return {"counts": [("wood", "1", 4)]}


def test_each_sweep_is_printed_with_the_counts(screen: tuple[int, TextIO]) -> None:
    """A sweep with a window is printed as a picture; without a window, only the counts are
    printed."""
    far, out = screen
    printer = SweepPrinter(out, RATE, about)
    printer.sweep(
        replace(
            cut(), frames=Frames(*(a[:0] for a in (cut().frames.t_ns, cut().frames.seq, tone(9))))
        ),
        OK,
        {},
    )
    assert os.read(far, 65536).decode().split() == ["1", "wood", "4"]
    n = np.arange(1500)
    printer.sweep(replace(cut(), frames=Frames(n, n, tone(100))), OK, {})
    text = os.read(far, 65536).decode()
    assert "375 Hz" in text
    assert text.splitlines()[-1].split() == ["wood", "4"]


def test_a_terminal_that_stands_still_keeps_nobody_waiting(screen: tuple[int, TextIO]) -> None:
    """After Ctrl-S, or with a connection that hangs, sweeps are not printed and the printer returns
    at once."""
    _, out = screen
    os.set_blocking(out.fileno(), False)
    while True:  # until the terminal accepts nothing more
        try:
            os.write(out.fileno(), b"x" * 4096)
        except BlockingIOError:
            break
    os.set_blocking(out.fileno(), True)
    printer = SweepPrinter(out, RATE, about)
    printer.sweep(cut(), OK, {})
    assert out.fileno() >= 0


def test_record_prints_nothing_of_it_into_a_file(tmp_path: Path) -> None:
    """Without a terminal nothing is printed: standard output holds sentences alone."""
    from palpate.cli import record_command

    assert not io.StringIO().isatty()
    assert record_command._printer(skin.FORMAT, None) == []  # type: ignore[arg-type]
