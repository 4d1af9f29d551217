"""`palpate skin check` for skins with a profile: frames next to their bytes, and the byte that does
not fit; and the profile that `palpate skin detect` proposes for lines of numbers."""

from __future__ import annotations

import os
import re
import threading
import tomllib
from dataclasses import replace

import pytest

from palpate.cli.main import main
from palpate.io import checksums, skin_codecs, skin_profile
from palpate.io.skin_codecs import Rest
from palpate.io.skin_profile import SkinProfile
from palpate.tools import pseudo_terminal, skin_bytes, skin_text
from tests.factories.skin_wires import NAMES, profile, wire

MARKED = SkinProfile("m", "s", codec="fixed", marker=b"\xaa\x55")
SUMMED = replace(MARKED, checksum="crc8", trailer=b"\r\n", marker=b"")


@pytest.mark.parametrize("name", NAMES)
def test_the_frames_of_every_skin_are_shown_and_fit(name):
    """A stream that begins and ends within a frame: frames with their numbers, and no misfit."""
    data = b"".join(wire(name, i) for i in range(12))[5:-3]
    lines, good = skin_bytes.report(profile(name), data)
    assert good, lines
    assert not re.search(r"\[..\]", "\n".join(line for line in lines if line.startswith("  0")))
    assert sum(line.startswith("frame ") for line in lines) == skin_bytes.SHOWN_FRAMES
    first = skin_codecs.codec(profile(name))(Rest(), data).taxels[0]
    assert f"{first.flat[0]:g}".rstrip("0") in "\n".join(lines)


@pytest.mark.parametrize(
    ("p", "change", "at"),
    [
        (replace(MARKED, cols=3), lambda data: data, 14),
        (MARKED, lambda data: data[:60] + data[61:], 72),
        (replace(MARKED, marker=b"\xaa\x56"), lambda data: data, 0),
        (SUMMED, lambda data: data[:40] + b"\x7f" + data[41:], 54),
        (replace(SUMMED, checksum="crc8-maxim"), lambda data: data, 35),
    ],
    ids=["other grid", "lost byte", "other marker", "damaged", "other checksum"],
)
def test_the_byte_that_does_not_fit_is_in_brackets(p, change, at):
    """Offset and value of the first byte that is not as the profile says."""

    def stream(p: SkinProfile, n: int = 8) -> bytes:
        """`n` frames of 4 x 4 uint8 with the marks and the checksum of `p`."""
        made, check = b"", checksums.parsed(p.checksum)
        for i in range(n):
            frame = p.marker + bytes((3 * i + k) % 100 for k in range(16))
            made += frame + (bytes([check.of(frame)]) if check else b"") + p.trailer
        return made

    sent = replace(p, cols=4, marker=MARKED.marker if p.marker else b"")
    data = change(stream(replace(sent, checksum="crc8" if p.checksum else "")))
    lines, good = skin_bytes.report(p, data)
    text = "\n".join(lines)
    assert not good
    assert f"byte {at} does not fit" in text
    assert f"[{data[at]:02x}]" in text


def test_a_line_of_text_that_does_not_fit():
    """The line between two frames with another text around its numbers; silence fits nothing."""
    p = skin_profile.from_json(
        {"about": "a", "source": "s", "codec": "text", "lines": "frames", "rows": 1, "cols": 3}, "t"
    )
    good = b"1 2 3\n4 5 6\n"
    lines, fits = skin_bytes.report(p, good + b"x=1 2 3\n" + good)
    assert not fits
    assert f"byte {len(good)} does not fit" in "\n".join(lines)
    assert skin_bytes.report(p, good)[1]
    assert not skin_bytes.report(p, b"")[1]


TEXTS = {
    "time": (
        b"".join(b"%d,%d,%d,%d,%d\n" % (i * 10, 5, i % 3, 7, 9 - i % 4) for i in range(30)),
        {"skip_columns": [0], "rows": 2, "cols": 2, "lines": "frames"},
    ),
    "labels": (
        b"".join(b"S1:%d S2:%d\r\n" % (i % 5, i % 7) for i in range(30)),
        {"around": "S#:S#:", "rows": 1, "cols": 2},
    ),
    "comma": (
        b"".join(b"0,%d;1,%d;2,5\n" % (i % 9, i % 4) for i in range(30)),
        {"decimal": ",", "cols": 3},
    ),
    "json": (
        b"".join(b'{"v": [[%d, 2], [3, %d]]}\n' % (5 * i % 9, i % 4) for i in range(30)),
        {"around": '"v":', "rows": 2, "cols": 2},
    ),
}


@pytest.mark.parametrize(("data", "expected"), TEXTS.values(), ids=TEXTS)
def test_a_profile_is_proposed_for_lines_of_numbers(data, expected):
    """It has the form of the lines, and reads nearly all of their frames at their rate."""
    table = tomllib.loads(skin_text.proposed(data, 2.0))
    assert table | expected == table
    made = skin_profile.from_json(table, "the proposal")
    found = skin_codecs.codec(made)(Rest(), data)
    assert len(found) >= 18
    assert found.garbage == 0
    assert made.rate_hz == pytest.approx(len(found) / 2.0, rel=0.1)


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"boot\nready\n" * 9, bytes(range(256)) * 4, b"1 2 3\n" * 5),
        b"1\n1 2\n1 2 3\n" * 9,
        b"".join(b"row %d: %d 20 30 40\n" % (i % 4, i % 7) for i in range(40)),
        b"".join(b"%d %d\n" % (i % 16, 50 + i % 7) for i in range(99)),
        b"".join(wire("3d-vitac", i) for i in range(20)),
    ],
)
def test_no_profile_is_proposed_for_anything_else(data):
    """Too few lines, words, bytes, lines of different lengths, and frames of several lines."""
    assert skin_text.proposed(data, 1.0) == ""


@pytest.mark.slow
def test_the_commands(tmp_path, capsys):
    """`skin detect` proposes, the file is written as printed, and `skin check` reads its frames."""
    stop = threading.Event()

    def send(far: int) -> None:
        for i in range(10**6):
            if stop.wait(0.01):
                return
            os.write(far, b"%d %d\n" % (3 * i % 7, 3 * i % 5))

    with pseudo_terminal.pair() as (far, path):
        sender = threading.Thread(target=send, args=(far,), daemon=True)
        sender.start()
        try:
            assert main(["skin", "detect", "--port", path]) == 1
            told = capsys.readouterr().out
            text = told[told.index("about = ") :]
            (tmp_path / "mine.toml").write_text(text)
            skin = ["--skin", str(tmp_path / "mine.toml"), "--port", path]
            assert main(["skin", "check", *skin, "--seconds", "1"]) == 0
            assert "frame 3: " in capsys.readouterr().out
            (tmp_path / "mine.toml").write_text(text.replace("cols = 2", "cols = 3"))
            assert main(["skin", "check", *skin, "--seconds", "1"]) == 1
            assert "fit" in capsys.readouterr().out
        finally:
            stop.set()
            sender.join()
