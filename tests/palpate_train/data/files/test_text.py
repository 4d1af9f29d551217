"""Text: each kind of table gives its numbers, or an error with line, cell and remedy."""

import itertools
from textwrap import dedent

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data.files.table import ReadPlan, Table
from palpate_train.data.files.text import decoded, lines_of, table

ROWS = [[10 * r + c for c in range(4)] for r in range(1, 31)]
BODY = "".join(",".join(map(str, row)) + "\n" for row in ROWS)
HEAD = "a,b,c,d\n"


def read(text: str | bytes, decimal: str = "", time: str = "") -> Table:
    """The table in a text."""
    content, notes = decoded(text if isinstance(text, bytes) else text.encode())
    return table(lines_of(content), ReadPlan(decimal=decimal, time=time), notes)


def check_whole(text: str | bytes, names: tuple[str, ...] = ("a", "b", "c", "d")) -> Table:
    """The table in a text that holds all of ROWS; no cell is bad."""
    found = read(text)
    numbers = [i for i in range(found.values.shape[1]) if i not in found.texts]
    np.testing.assert_array_equal(found.values[:, numbers], ROWS)
    assert found.faults == {}
    assert tuple(found.columns[i] for i in numbers if found.columns) == names
    return found


@pytest.mark.parametrize(
    "cell", ["#N/A", "#DIV/0!", "#REF!", "#VALUE!", "#NUM!", "#NAME?", "#NULL!", "#NV", "#WERT!"]
)
def test_a_spreadsheet_error_is_never_a_comment(cell: str):
    """In whatever row and column it stands, the row stays and the cell is a fault."""
    for row, column in itertools.product((0, 12, 29), (0, 1, 3)):
        rows = [list(map(str, r)) for r in ROWS]
        rows[row][column] = cell
        found = read(HEAD + "".join(",".join(r) + "\n" for r in rows))
        assert len(found.values) == len(ROWS), (row, column)
        assert found.faults.keys() == {column}
        assert f"line {row + 2}, column {column + 1} is {cell!r}" in found.faults[column]


def test_a_row_behind_a_comment_sign_does_not_vanish():
    """A commented frame leaves a hole, so it is a fault; a remark between frames is passed over."""
    lines = BODY.splitlines()
    lines[5] = "#" + lines[5]
    assert "6, column 1 is '#60'" in read("\n".join(lines)).faults[0]
    lines = BODY.splitlines()
    lines.insert(5, "# paused")
    assert ["1 comments" in x for x in check_whole("\n".join(lines), ()).notes] == [True]


@pytest.mark.parametrize("delimiter", ["\t", ";", " "])
@pytest.mark.parametrize("sign", [",", "."])
def test_a_separator_of_thousands_is_not_a_decimal_sign(delimiter: str, sign: str):
    """1,012 beside 987 is refused with both meanings; --decimal decides."""
    text = "\n".join(delimiter.join([f"1{sign}012", "987", "5"]) for _ in range(9))
    text = text.replace(f"1{sign}012", "998", 1) if sign == "." else text
    with pytest.raises(FormatError) as e:
        read(text)
    assert "column 1 is '1" in str(e.value)
    assert "--decimal . that this is" in str(e.value)
    assert "--decimal , that it is" in str(e.value)
    other = "." if sign == "," else ","
    assert read(text, other).values[-1, 0] == 1012
    assert read(text, sign).values[-1, 0] == 1.012


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["0,5", "1,012"], [0.5, 1.012]),
        (["1,5", "1,012"], [1.5, 1.012]),
        (["1234,567", "1,012"], [1234.567, 1.012]),
        (["1,012,345", "1,012"], [1012345, 1012]),
        (["1,012.5", "1,012"], [1012.5, 1012]),
        (["1.012,5", "1.012"], [1012.5, 1012]),
        (["1.012.345", "2.012"], [1012345, 2012]),
        (["0.5", "1.012"], [0.5, 1.012]),
        (["1.012e0", "3"], [1.012, 3]),
    ],
)
def test_other_numbers_show_the_decimal_sign(cells: list[str], expected: list[float]):
    """One number that can only be read in one way decides for the text."""
    for delimiter in ("\t", ";", "  "):
        found = read("\n".join([delimiter.join(cells)] * 5))
        np.testing.assert_allclose(found.values[0], expected)


def test_signs_that_could_be_either_are_refused():
    """0,5 beside 0.5: the cell is named; 1,012 in quotes, as spreadsheets write it."""
    with pytest.raises(FormatError, match="'0,5'"):
        read("0,5\t0.25\n" * 4)
    with pytest.raises(FormatError, match="column 2 is '1,012'"):
        read('987,"1,012",5\n' * 4)
    assert read('987,"1,012",5\n' * 4, ".").values[0].tolist() == [987, 1012, 5]


@pytest.mark.parametrize(
    ("usual", "cell", "decimal"),
    [
        ("0,5", "1.23,5", ""),
        ("0,5", "1.23,5", ","),
        ("0.5", "1,23.5", ""),
        ("3", "1,01", "."),
        ("3", "1.0.1", ","),
    ],
)
def test_a_separator_at_a_wrong_place_is_a_fault(usual: str, cell: str, decimal: str):
    """1.23,5 is neither 123.5 nor 1.235, whatever the decimal sign is."""
    found = read(f"{usual};{usual}\n" * 5 + f"{usual};{cell}\n", decimal)
    assert found.faults.keys() == {1}
    assert "line 6, column 2" in found.faults[1]


@pytest.mark.parametrize(
    ("end", "note"),
    [
        ("@@\n", "'@@'"),
        ('"@@"\n', "'\"@@\"'"),
        ("End of recording\n", "'End"),
        ("25.5,25.5,25.5,Mean\n", "'25.5"),
        (",25.5,25.5,25.5\n", "',25.5"),
        ("\nMean of column a: 12.5\nby hand\n", "column a: 12.5'"),
        ("310,31", "cut off: 2"),
        ("310,311,", "cut off: 2"),
        ("3", "32, which"),
        ("\0\0\0\0", "4 bytes"),
        ("\x1a", "1 bytes"),
    ],
)
def test_what_follows_the_frames_is_said(end: str, note: str):
    """A footer, a cut line, bytes without content: the frames before it are read."""
    assert any(note in said for said in check_whole(HEAD + BODY + end).notes)


def test_text_and_bytes_between_frames_are_refused():
    """A second head or table, a row of statistics, a block of NULs, a cell of 256 kB."""
    with pytest.raises(FormatError, match="32 begins with 'Sum'"):
        read(HEAD + BODY + "Sum,25.5,25.5,25.5\n" + BODY)
    with pytest.raises(FormatError, match="32 has 1"):
        read(HEAD + BODY + "again\n" + BODY)
    assert read(HEAD + BODY + HEAD + BODY).faults[0].startswith("line 32, column 1 is 'a'")
    fault = read(HEAD + BODY + "1,\0\0\0\0,3,4\n" + BODY).faults[1]
    assert fault.startswith("line 32, column 2")
    assert "\\x00\\x00" in fault
    with pytest.raises(FormatError, match="line 32"):
        read(HEAD + BODY + f"1,{'x' * 262144},3,4\n" + BODY)


def test_a_column_of_notes_refuses_no_frame():
    """A mark in a column that is blank else stands on a frame: its numbers are read."""
    lines = [f"{'tap' if i == 30 else ''},{i},{i + 1},{i + 2}" for i in range(60)]
    table = read("note,a,b,c\n" + "\n".join(lines) + "\n")
    np.testing.assert_array_equal(table.values[:, 1:], np.arange(60)[:, None] + np.arange(3))


@pytest.mark.parametrize("at", [0, 2, 4])
@pytest.mark.parametrize("text", ["wood", "2026-01-01 12:00:00.{:03}", "skin_frame", '"a, b"'])
def test_a_text_column_stands_beside_numbers(at: int, text: str):
    """Labels, dates, names of frames: the column keeps its text, the others their numbers."""
    head, rows = HEAD.strip().split(","), [list(map(str, row)) for row in ROWS]
    head.insert(at, "what")
    for k, row in enumerate(rows):
        row.insert(at, text.format(k))
    found = check_whole("\n".join(",".join(row) for row in [head, *rows]))
    assert found.texts[at][7] == text.format(7).strip('"')
    assert found.columns[at] == "what"


def test_tables_of_pandas_and_r_are_read():
    """A head ,0,1,2,3 with a count before each row; a head one name short or empty."""
    rows = [f"{k},{','.join(map(str, row))}" for k, row in enumerate(ROWS)]
    check_whole("\n".join([",0,1,2,3", *rows]), ("0", "1", "2", "3"))
    rows = [f'"{k}" {" ".join(map(str, row))}' for k, row in enumerate(ROWS, 1)]
    check_whole("\n".join(['"a" "b" "c" "d"', *rows]))
    check_whole("\n".join(["a b c d", *(row.replace('"', "") for row in rows)]))
    check_whole("\n".join(['"","a","b","c","d"', *(row.replace(" ", ",") for row in rows)]))
    check_whole("\n".join(["a\tb\tc\td", *(row.replace(" ", "\t") for row in rows)]))
    names = [f'"w {k}" {" ".join(map(str, row))}' for k, row in enumerate(ROWS, 1)]
    assert check_whole("\n".join(['"a" "b" "c" "d"', *names])).texts[0][0] == "w 1"


@pytest.mark.parametrize("first", [0, 1])
def test_columns_may_be_named_by_numbers(first: int):
    """A head of mats and insoles: a word, then 0 to N - 1 or 1 to N; never the first frame."""
    names = [str(first + k) for k in range(3)]
    check_whole(f"time,{','.join(names)}\n{BODY}", ("time", *names))
    head = ",".join(map(str, range(first, first + 4)))
    frames = "9,9,7,9\n5,8,9,9\n8,9,9,8\n"
    assert len(read(f"{head}\n{frames}").values) == 3
    assert len(read(f"{head}\n0,9,9,9\n{frames}").values) == 5  # within reach
    labels = "".join(f"cork,{line}\n" for line in ["1,2,3,4", *BODY.splitlines()])
    assert len(read(labels).values) == len(ROWS) + 1  # all rows begin with a word


@pytest.mark.parametrize("word", ["Mean", '"Max"', "std dev", "2\u03c3", "95 % CI", "75%"])
def test_rows_of_statistics_are_no_frames(word: str):
    """A word where all frames have a number, above or below: left out, and said."""
    row = f"{word},25.5,25.5,25.5\n"
    sums = row.replace("25.5", "{}").format(1.5, 2.5, 7)
    for text in (HEAD + BODY + row + row, HEAD + row + BODY, HEAD + sums + sums + BODY):
        check_whole(text)
    for text in (row + row + BODY, HEAD + BODY + row, HEAD + sums + BODY):
        found = read(text)
        np.testing.assert_array_equal(found.values, ROWS)
        assert any(word.strip('"') in said for said in found.notes)


def test_names_stand_on_the_last_line_before_the_numbers():
    """Remarks above, units, ranges and gains below them are not the names."""
    check_whole("a,b,c,d\nRange=,10.000 V,5 mV,10 V\n" + BODY)
    for cell in ("x10", "uint8", "0 to 5 V", "-10-10 V", "5.0"):
        check_whole(f"a,b,c,d\ns,{cell},{cell},{cell}\n" + BODY)
    check_whole("Recorded,by,hand,today\n" + HEAD + BODY)
    check_whole(HEAD + "(N),(N),(N),(V)\n" + BODY)
    check_whole(HEAD + "N,N,N,V\n" + BODY)
    check_whole("# " + HEAD + BODY)
    found = read(HEAD + "CH=0,CH=1,CH=2,CH=3\n" + BODY, time="a")
    assert found.columns == ("a", "b", "c", "d")


WIDE = [[7 * r + c * c for c in range(16)] for r in range(1, 31)]


PLACES = [10 * row + column for row in range(1, 5) for column in range(1, 5)]


@pytest.mark.parametrize(
    "count", [range(16), range(1, 17), range(17, 33), range(16, 0, -1), range(0, 32, 2), PLACES]
)
@pytest.mark.parametrize("form", ["{}", "{:02d}", "{}.0", '"{}"'])
@pytest.mark.parametrize(
    ("word", "before"), [("time", "1.5,"), ("label", "cork,"), ("", "3,"), (None, "")]
)
def test_many_numbers_that_count_are_no_frame(count, form, word, before):
    """Columns named by numbers, by their places or by rows and columns; a frame that begins so
    stays."""
    rows = [before + ",".join(map(str, row)) for row in WIDE]
    head = ",".join([*([word] if word is not None else []), *map(form.format, count)])
    found = read("\n".join([head, *rows]))
    assert len(found.values) == len(WIDE)
    np.testing.assert_array_equal(found.values[:, -16:], WIDE)
    if word == "label":
        assert len(read("\n".join([head.replace("label", "cork"), *rows])).values) == 31


def test_a_row_of_the_number_of_frames_is_no_frame():
    """BIOPAC writes it for each channel, perhaps not for the time; frames that count stay."""
    for row in ("30,30,30,30\n", ",30,30,30\n"):
        np.testing.assert_array_equal(read(HEAD + row + BODY).values, ROWS)
    ramp = "".join(",".join(map(str, range(k, k + 16))) + "\n" for k in range(30))
    assert len(read(ramp).values) == 30


@pytest.mark.parametrize(("text", "shown"), [("", "empty"), ("1^2^3\n" * 9, r"'1\^2\^3'")])
def test_a_text_without_numbers_shows_one_of_its_lines(text: str, shown: str):
    """The message holds a line as it stands, or says that there is none."""
    with pytest.raises(FormatError, match=shown):
        read(text)


@pytest.mark.parametrize("sign", [".", ","])
@pytest.mark.parametrize("tail", ["", "\t"])
def test_labviews_measurements_are_read(sign: str, tail: str):
    """Names from the line after the last header; the header states the decimal sign."""
    lvm = dedent("""\
    LabVIEW Measurement\t
    Writer_Version\t2
    Reader_Version\t2
    Separator\tTab
    Decimal_Separator\t{0}
    Multi_Headings\tNo
    X_Columns\tOne
    Time_Pref\tAbsolute
    Date\t2026/01/31
    ***End_of_Header***\t\t\t\t\t
    Channels\t4\t\t\t\t
    Samples\t30\t30\t30\t30\t
    Date\t2026/01/31\t2026/01/31\t2026/01/31\t2026/01/31\t
    X_Dimension\tTime\tTime\tTime\tTime\t
    X0\t0{0}0\t0{0}0\t0{0}0\t0{0}0\t
    Delta_X\t0{0}01\t0{0}01\t0{0}01\t0{0}01\t
    ***End_of_Header***\t\t\t\t\t
    X_Value\ta\tb\tc\td\tComment
    """)
    rows = "".join(
        f"{k / 100:.6f}".replace(".", sign) + "\t" + "\t".join(map(str, row)) + f"{tail}\n"
        for k, row in enumerate(ROWS)
    )
    found = read(lvm.format(sign) + rows)
    assert found.columns == ("X_Value", "a", "b", "c", "d")
    np.testing.assert_array_equal(found.values[:, 1:], ROWS)
    np.testing.assert_allclose(found.values[:, 0], np.arange(30) / 100)


def test_decimal_commas_between_blanks_and_utf_16_are_read():
    """1,5 2,5 are two numbers; with its mark UTF-16 is read, and Latin-1 names stay."""
    assert read("1,5 2,5 3,25\n" * 5).values[0].tolist() == [1.5, 2.5, 3.25]
    assert "column 1 is '1_000'" in read("1_000,2\n1,2\n1,2\n").faults[0]
    check_whole((HEAD + BODY).encode("utf-16"))
    assert read(("Größe,b,c,d\n" + BODY).encode("latin-1")).columns[0] == "Größe"
    assert read("Gro\u0308ße,b,c,d\n" + BODY).columns[0] == "Größe"


@pytest.mark.parametrize("empty", [1, 2])
def test_empty_cells_of_a_channel_that_ended_are_not_cut_off(empty: int):
    """A slower channel, perhaps with times of its own, ends earlier than the taxels."""
    more = "".join(f",{k}" for k in range(empty))
    rows = [line + (more if k < 5 else "," * empty) for k, line in enumerate(BODY.splitlines())]
    found = read("\n".join(rows))
    assert found.values.shape == (len(ROWS), 4 + empty)
    assert found.notes == ()
