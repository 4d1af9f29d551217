"""The terminal shows a LiveView in colour, without colour, or in a line a second."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest

from palpate.sim.rig import VirtualClock
from palpate.tools.skin_monitor import LiveView
from palpate.tools.skin_screen import SkinScreen, faults, figures, line, picture

VIEW = LiveView(
    7,
    "usb",
    "flexitac 2x3 uint8 at 100 Hz",
    "streaming",
    "",
    (2, 3, 1),
    load=(((0, 1, 2), (30, 60, 120)),),
    full=120,
    rate_hz=99.84,
    noise=(((1, 1, 2), (1, 1, 9)),),
    frames=12345,
    lost=3,
)


def plain(text: str) -> str:
    """Text without control sequences."""
    return re.sub(r"\033\[[0-9;]*m", "", text)


def test_figures_name_rate_loss_and_noise() -> None:
    """Figures name rate loss and noise."""
    assert figures(VIEW) == "99.8 Hz, 12,345 frames, 3 lost, noise 1, at most 9 raw counts"
    assert "loss cannot be known" in figures(replace(VIEW, lost=None))


def test_faulty_taxels_are_named_and_many_are_counted() -> None:
    """Faulty taxels are named and many are counted."""
    assert faults(VIEW) == ""
    assert (
        faults(replace(VIEW, stuck=("1.2",), dead=("2.1", "2.2"))) == "stuck: 1.2; dead: 2.1, 2.2"
    )
    assert faults(replace(VIEW, dead=tuple(f"1.{i}" for i in range(30)))).endswith(
        "1.7 and 22 more"
    )


def test_every_taxel_stands_in_the_picture_with_its_count() -> None:
    """Every taxel stands in the picture with its count."""
    drawn = plain("\n".join(picture(VIEW, 80, colours=True)))
    assert [row.split() for row in drawn.splitlines()[4:6]] == [
        ["0", "1", "2"],
        ["30", "60", "120"],
    ]


@pytest.mark.parametrize("width", [40, 80, 200])
@pytest.mark.parametrize("shape", [(4, 4, 1), (16, 32, 1), (3, 3, 3), (16, 16, 3)])
def test_no_line_is_wider_than_the_terminal(width: int, shape: tuple[int, int, int]) -> None:
    """No line is wider than the terminal."""
    rows, cols, axes = shape
    load = tuple(
        tuple(tuple(float(c) for c in range(cols)) for _ in range(rows)) for _ in range(axes)
    )
    view = replace(VIEW, shape=shape, load=load, dead=tuple(f"{i}.1" for i in range(9)))
    lines = [plain(text).rstrip() for text in picture(view, width, colours=True)]
    assert max(map(len, lines)) <= width
    assert sum("axis" in text for text in lines) >= (axes > 1)


def test_without_colours_no_control_sequence_shades_a_taxel() -> None:
    """Without colours no control sequence shades a taxel."""
    assert not any("38;5" in text for text in picture(VIEW, 80, colours=False))


def test_a_skin_that_does_not_stream_says_why() -> None:
    """A skin that does not stream says why."""
    gone = LiveView(1, "sim", "palpate", "absent", "no skin is there; plug it in", (4, 4, 1))
    assert line(gone) == "SIMULATED  palpate  absent: no skin is there; plug it in"
    assert any("plug it in" in text for text in picture(gone, 80, colours=False))


def test_no_terminal_gets_one_line_a_second() -> None:
    """No terminal gets one line a second."""
    out, clock = io.StringIO(), VirtualClock()
    with SkinScreen(out, clock, "http://127.0.0.1:1") as screen:
        for _ in range(10):
            screen.show(VIEW)
            clock.sleep_until(clock.now_ns() + 250_000_000)
    lines = out.getvalue().splitlines()
    assert lines[0] == "page: http://127.0.0.1:1"
    assert len(lines) == 1 + 3
