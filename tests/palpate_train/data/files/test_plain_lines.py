"""What people and programs write around numbers is left out of lines that all have it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.files.table import Table

SKIN = np.random.default_rng(3).integers(1000, 9000, (40, 4))
NAMES = ("s0", "s1", "s2", "s3")


def read(folder: Path, line: Callable[[list[int]], str], head: str = "") -> Table:
    """The table of a file with these lines."""
    text = head + "\n" * bool(head) + "\n".join(map(line, SKIN.tolist()))
    (folder / "a.csv").write_text(text)
    return raw_files.read(folder / "a.csv")


def joined(sign: str, form: str) -> Callable[[list[int]], str]:
    return lambda row: sign.join(form.format(value) for value in row)


def labelled(sign: str, mark: str) -> Callable[[list[int]], str]:
    return lambda row: sign.join(f"s{i}{mark}{value}" for i, value in enumerate(row))


@pytest.mark.parametrize(
    ("line", "what"),
    [
        (lambda row: str(row), "brackets"),
        (lambda row: f"tensor([{' '.join(map(str, row))}]),", "brackets"),
        (lambda row: f"[[{row[0]}, {row[1]}], [{row[2]}, {row[3]}]]", "brackets"),
        (joined(",", "'{}'"), "single quotes"),
        (lambda row: repr(f"{row}\r\n".encode()), "bytes+brackets"),
        (lambda row: f'"{row}"', "lists"),
        (lambda row: f'{row[0]};"[{row[1]} {row[2]} {row[3]}]"', "lists"),
        (joined(",", "{} mV"), "units"),
        (joined(";", "{}N"), "units"),
        (joined(";", "{} kΩ"), "units"),
        *((joined(",", "{} " + unit), "units") for unit in ("gf", "pF", "F", "LSB", "mbar", "µT")),
        (joined(",", "{:x}".replace("{", "0x{")), "hexadecimal"),
        (joined(",", "{}.0D+00"), "exponents"),
        (labelled(",", ":"), ""),
        (labelled(" ", "="), ""),
        (labelled(", ", " = "), ""),
        (lambda row: str(dict(zip(NAMES, row, strict=True))), "brackets+single quotes"),
        (joined("|", " {} "), ""),
    ],
)
def test_decorations_are_left_out(tmp_path: Path, line: Callable[[list[int]], str], what: str):
    """The numbers are read, and a remark says each decoration."""
    found = read(tmp_path, line)
    np.testing.assert_array_equal(found.values, SKIN)
    wanted = what.split("+") if what else []
    assert all(one in said for one, said in zip(wanted, found.notes, strict=True))
    if "s1" in line(SKIN[0].tolist()):
        assert found.columns == NAMES


@pytest.mark.parametrize("sign", ["'", "’", "\u00a0", "\u202f", "\u2009"])
def test_separators_that_are_no_decimal_sign(tmp_path: Path, sign: str):
    """Switzerland's apostrophe and the blanks of ISO 31, in columns that a semicolon separates."""
    found = read(tmp_path, lambda row: ";".join(f"{v:,}".replace(",", sign) for v in row))
    np.testing.assert_array_equal(found.values, SKIN)
    assert ["thousands" in said for said in found.notes] == [True]


def test_signs_of_typographers_are_read(tmp_path: Path):
    """Blanks of other widths separate columns, without another sign; U+2212 and U+2013 are a minus;
    colours of a terminal are left out."""
    found = read(tmp_path, joined("\u00a0", "{}"))
    np.testing.assert_array_equal(found.values, SKIN)
    for form in ("\u2212{}", "\u2013{}", "\x1b[0;32m-{}\x1b[0m"):
        found = read(tmp_path, joined(";", form))
        np.testing.assert_array_equal(found.values, -SKIN)


@pytest.mark.parametrize("sign", [",", " "])
@pytest.mark.parametrize(
    ("before", "mark", "clock"),
    [
        ("", " -> ", "12:00:01.100"),
        ("", ": ", "12:00:01.100"),
        ("2026-01-31 ", " ", "2026-01-31T12:00:01.100"),
        ("[2026-01-31 ", "] ", "2026-01-31T12:00:01.100"),
        ("[2026-01-31 ", "],", "2026-01-31T12:00:01.100"),
    ],
)
def test_the_serial_monitors_clock_is_a_column(
    tmp_path: Path, before: str, mark: str, clock: str, sign: str
):
    """Of Arduino, picocom, CoolTerm and Tera Term. With labels, too; its times can be used."""
    if sign == mark[-1] and mark.strip(": ") == "":
        return  # blanks alone do not end a time
    text = "\n".join(
        f"{before}12:00:0{i // 10}.{i % 10}00{mark}" + sign.join(map(str, row))
        for i, row in enumerate(SKIN.tolist())
    )
    (tmp_path / "a.txt").write_text(text)
    found = raw_files.read(tmp_path / "a.txt")
    np.testing.assert_array_equal(found.values[:, 1:], SKIN)
    assert found.texts[0][11] == clock
    if sign == " " or mark in (" ", ": ", "],"):
        return
    (tmp_path / "a.txt").write_text(text.replace(mark, f"{mark}force:").replace(",", ",b:"))
    found = raw_files.read(tmp_path / "a.txt")
    np.testing.assert_array_equal(found.values[:, 1:], SKIN)
    assert found.columns == ("clock", "force", "b", "b", "b")


def test_what_a_decoration_may_mean_is_not_left_out(tmp_path: Path):
    """A column that changes from mV to V; a number in parentheses, which may be negative."""
    lines = [f"{a} mV;{b} mV" for a, b in SKIN[:, :2].tolist()]
    lines[7] = lines[7].replace("mV", "V", 1)
    (tmp_path / "a.csv").write_text("\n".join(lines))
    with pytest.raises(FormatError, match="V, line 1 in mV"):
        raw_files.read(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("\n".join(f"({a});{b}" for a, b in SKIN[:, :2].tolist()))
    assert raw_files.read(tmp_path / "a.csv").texts[0][0] == f"({SKIN[0, 0]})"


def test_comments_behind_numbers_and_with_slashes(tmp_path: Path):
    """On lines of their own, and behind the numbers of a few lines."""
    lines = [",".join(map(str, row)) for row in SKIN.tolist()]
    lines[7] += " # touched"
    lines[9] += "\t// let go"
    text = "\n".join(["// my log", *lines[:20], "// paused", *lines[20:]])
    (tmp_path / "a.csv").write_text(text)
    found = raw_files.read(tmp_path / "a.csv")
    np.testing.assert_array_equal(found.values, SKIN)
    behind, between = found.notes
    assert "behind numbers" in behind
    assert between.startswith("1 comments")


def spoilt(folder: Path, row: str) -> Path:
    """Bracketed lines; the eighth is `row`."""
    lines = [*map(str, SKIN.tolist())]
    lines[7] = row
    (folder / "a.txt").write_text("\n".join(lines))
    return folder / "a.txt"


@pytest.mark.parametrize("cell", ["x", ""])
def test_a_bad_cell_is_still_named_by_its_line(tmp_path: Path, cell: str):
    """Nothing is spliced over it, and lines keep their numbers."""
    found = raw_files.read(spoilt(tmp_path, f"[1, {cell}, 3, 4]"))
    assert found.faults.keys() == {1}
    assert f"line 8, column 2 is {cell!r}" in found.faults[1]


def test_decorations_hide_no_missing_number_or_other_label(tmp_path: Path):
    """Brackets around too few numbers, and another label, are faults."""
    with pytest.raises(FormatError, match="8 has 3"):
        raw_files.read(spoilt(tmp_path, "[1, 2, 3]"))
    lines = [labelled(",", ":")(row) for row in SKIN.tolist()]
    lines[7] = lines[7].replace("s1", "s9")
    (tmp_path / "a.txt").write_text("\n".join(lines))
    assert "line 8, column 1" in raw_files.read(tmp_path / "a.txt").faults[0]


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32", "utf-16"])
def test_wide_texts_are_read(tmp_path: Path, encoding: str):
    """With a mark at the beginning or without."""
    text = "t,s1\n" + "\n".join(f"{a},{b}" for a, b in SKIN[:, :2].tolist())
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    found = raw_files.read(tmp_path / "a.csv")
    assert found.columns == ("t", "s1")
    np.testing.assert_array_equal(found.values, SKIN[:, :2])
