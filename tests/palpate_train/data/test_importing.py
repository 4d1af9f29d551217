"""Folders of CSV, text, MAT, HDF5 and .npy become sets; other files get a line each."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate_train.data import sets
from palpate_train.data.file_names import NamePattern
from palpate_train.data.import_plan import ImportPlan, Length
from palpate_train.data.importing import Imported, LeftOutFile, import_folder
from tests.factories.lab_files import write
from tests.factories.later import Later

scipy_io = Later("scipy.io")

NAMES = NamePattern("{material}_{trial:d}.{}")
COUNTS = np.arange(40 * 4).reshape(40, 4) % 150


def plan(**changes: object) -> ImportPlan:
    """Four taxels at 100 Hz, windows of ten frames."""
    given = {"grid": "2x2", "rate_hz": 100.0, "window": Length("10", "--window")} | changes
    return ImportPlan(**{"pattern": NAMES} | given)


def taken(folder: Path, **changes: object) -> Imported:
    """The imported sweeps; every file fits and is used."""
    left_out: list[LeftOutFile] = []
    made = import_folder(folder, plan(**changes), lambda line: None, left_out)
    assert left_out == []
    return made


def reasons(folder: Path, **changes: object) -> dict[str, str]:
    """Why files were left out, by name."""
    left_out: list[LeftOutFile] = []
    with suppress(FormatError):  # if no file could be imported
        import_folder(folder, plan(**changes), lambda line: None, left_out)
    return {one.name: one.why for one in left_out}


def both(folder: Path, save: Callable[[Path], object], suffix: str = "csv") -> None:
    """The same recording of two materials."""
    for name in ("cork_1", "felt_1"):
        save(folder / f"{name}.{suffix}")


def text(path: Path, counts: np.ndarray = COUNTS, delimiter: str = ",", head: str = "") -> Path:
    """Counts as text, without times."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        head + "".join(delimiter.join(f"{c:g}" for c in row) + "\n" for row in counts.tolist())
    )
    return path


def zipped(path: Path, name: str, data: bytes) -> None:
    """An archive with one member."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, data)


FORMS = {
    "csv": lambda path: text(path),
    "txt": lambda path: text(path, delimiter=" ", head="# a b c d\n\n"),
    "tsv": lambda path: text(path, delimiter="\t", head="Recorded by hand\na\tb\tc\td\n"),
    "dat": lambda path: path.write_text(text(path, delimiter=";").read_text().replace("\n", ";\n")),
    "npy": lambda path: np.save(path, COUNTS.astype(np.uint8)),
    "npz": lambda path: np.savez(path, frames=COUNTS.astype(np.uint8), t=np.arange(40.0)),
    "mat": lambda path: scipy_io.savemat(path, {"frames": COUNTS, "rate": 100.0}),
    "h5": lambda path: h5py.File(path, "w").create_dataset("run/frames", data=COUNTS).file.close(),
}


@pytest.mark.parametrize("suffix", FORMS)
def test_every_format_gives_the_same_sweeps(tmp_path: Path, suffix: str):
    """The middle ten frames of each file [10, 2, 2] in the smallest type, with groups."""
    for name in ("cork_1", "felt_1", "wool_2"):
        FORMS[suffix](tmp_path / f"{name}.{suffix}")
    s = taken(tmp_path).sweeps
    assert s.format == SweepFormat(2, 2, 100.0, 10, "uint8")
    np.testing.assert_array_equal(s.samples, np.tile(COUNTS[15:25].reshape(10, 2, 2), (3, 1, 1, 1)))
    assert (s.materials, s.labels.tolist()) == (("cork", "felt", "wool"), [0, 1, 2])
    assert s.groups["trial"].tolist() == [1, 1, 2]
    assert s.groups["recording"].tolist() == [0, 1, 2]
    s.save(tmp_path / "set.npz")
    assert sets.digest(sets.load(str(tmp_path / "set.npz"))) == sets.digest(s)


def test_columns_are_named_numbered_or_all_but_the_time(tmp_path: Path):
    """By name, by number from 1 on, by range, by a pattern; in the given order."""
    both(tmp_path, lambda path: write(path, COUNTS, 100.0))
    whole = COUNTS[15:25].reshape(10, 2, 2)
    for given in ({"time": "time:ms", "rate_hz": None}, {"columns": "2-5"}, {"columns": "s*"}):
        np.testing.assert_array_equal(taken(tmp_path, **given).sweeps.samples[0], whole)
    assert "no column 's2-'" in reasons(tmp_path, columns="s0,3,s2-,5")["cork_1.csv"]
    turned = taken(tmp_path, columns="s3,4,3,s0").sweeps.samples[0]
    np.testing.assert_array_equal(turned, whole.reshape(10, 4)[:, ::-1].reshape(10, 2, 2))


def test_columns_in_another_order_are_refused_unless_they_are_named(tmp_path: Path):
    """Taxels would change places, silently. The place of the times does not matter."""
    timed = np.column_stack([np.arange(40) / 100, COUNTS])
    text(tmp_path / "felt_1.csv", np.roll(timed, -1, axis=1) + 1, head="a,b,c,d,t\n")
    text(tmp_path / "felt_2.csv", timed[:, ::-1], head="d,c,b,a,t\n")
    text(tmp_path / "wood_1.csv", timed, head="t,a,b,c,d\n")
    ((name, why),) = reasons(tmp_path, time="t:s", rate_hz=None).items()
    assert name == "felt_2.csv"
    assert "'d' where" in why
    made = taken(tmp_path, time="t:s", rate_hz=None, columns="a,b,c,d")
    np.testing.assert_array_equal(made.sweeps.samples[1], made.sweeps.samples[2])


@pytest.mark.parametrize("changes", [{}, {"variable": "{}"}])
def test_a_pattern_without_a_field_matches(tmp_path: Path, changes: dict):
    """The material stands in a column: `{}.npz` takes every such file, and no other."""
    rows = np.zeros(40, [("what", "U4"), ("taxels", "i4", 4)])
    for name in ("cork", "felt"):
        rows["what"], rows["taxels"] = name, COUNTS + len(name) + (name == "felt")
        np.savez(tmp_path / f"{name}.npz", rows)
    np.savez(tmp_path / "other.zip.npz", COUNTS)
    names = NamePattern("{}t.npz")
    given = {"pattern": names, "fields": {"material": "what"}} | changes
    (tmp_path / "cork.npz").rename(tmp_path / "corkt.npz")
    found = reasons(tmp_path, **given)
    assert found.keys() == {"other.zip.npz"}


def test_windows_and_times_are_those_of_the_recording(tmp_path: Path):
    """The middle or at intervals, all of one; ms at 300 Hz give the right rate."""
    both(tmp_path, text)
    s = taken(tmp_path, every=Length("150ms", "--every")).sweeps
    assert s.groups["recording"].tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(s.samples[1].reshape(10, 4), COUNTS[15:25])
    assert taken(tmp_path, window=Length("0.25s", "--window")).sweeps.format.window == 25
    both(tmp_path, lambda path: write(path, COUNTS, 300.0, np.round(1000 * np.arange(40) / 300)))
    made = taken(tmp_path, time="time:ms", rate_hz=None)
    assert made.sweeps.rate_hz == pytest.approx(300, rel=0.005)
    np.testing.assert_array_equal(made.sweeps.samples[0].reshape(10, 4), COUNTS[15:25])
    assert [cut.notes for cut in made.taken] == ["", ""]


def test_times_that_wander_are_interpolated(tmp_path: Path):
    """A ramp at irregular times becomes a ramp in whole counts, and the report says so."""
    late = 25 * np.sin(np.arange(400) / 20)  # ms, for periods of 10 ms
    times = 10 * np.arange(400) + late
    ramp = np.repeat(np.rint(times)[:, None] + 100, 4, axis=1)
    both(tmp_path, lambda path: write(path, ramp, 100.0, times))
    made = taken(tmp_path, time="time:ms", rate_hz=100.0)
    steps = np.diff(made.sweeps.samples[0, :, 0, 0].astype(float))
    assert np.abs(steps - 10).max() <= 1
    assert made.sweeps.samples.dtype == np.int16
    assert "interpolated" in made.taken[0].notes


def test_no_window_goes_over_a_gap(tmp_path: Path):
    """Half a second without frames: windows lie before and after the gap, none across it."""
    times = 10.0 * np.arange(40)
    times[25:] += 500
    both(tmp_path, lambda path: write(path, COUNTS, 100.0, times))
    made = taken(tmp_path, time="time:ms", rate_hz=100.0, every=Length("5", "--every"))
    starts = [
        int(np.flatnonzero((w.reshape(10, 4)[0] == COUNTS).all(1))[0])
        for w in made.sweeps.samples[:6]
    ]
    assert starts == [0, 5, 10, 15, 25, 30]
    assert made.taken[0].notes == "1 gaps"
    why = reasons(tmp_path, time="time:ms", rate_hz=100.0, window=Length("26", "--window"))
    assert "25 frames" in why["cork_1.csv"]


@pytest.mark.parametrize(
    ("dtype", "recorded", "expected"),
    [
        ("", np.int16, "int16"),
        ("", np.float64, "uint8"),
        ("", np.int64, "uint8"),
        ("", ">i2", "int16"),
        ("", ">f4", "float32"),
        ("float32", np.int16, "float32"),
    ],
)
def test_types_stay_as_recorded_or_are_the_first_that_holds_all(
    tmp_path: Path, dtype: str, recorded: str | type, expected: str
):
    """In this machine's order; --dtype wins."""
    both(tmp_path, lambda path: np.save(path, COUNTS.astype(recorded)), "npy")
    samples = taken(tmp_path, dtype=dtype).sweeps.samples
    assert samples.dtype == expected
    np.testing.assert_array_equal(samples[0].reshape(10, 4), COUNTS[15:25])


@pytest.mark.parametrize(
    ("dtype", "value", "why"),
    [
        ("uint8", 300, "300, and uint8"),
        ("int16", 40000, "40000, and int16"),
        ("uint16", -1, "-1, and uint16"),
        ("int16", 0.5, "0.5, and int16"),
        ("", 16777217, "a count is 16777217"),
        ("", 1e300, "21, taxel 2, 1 is 1e+300"),
    ],
)
def test_a_count_that_does_not_fit_leaves_its_file_out(
    tmp_path: Path, dtype: str, value: float, why: str
):
    """The message gives the file, the count and the range of the type; other files are imported."""
    for name in ("cork_1", "felt_1", "felt_2"):
        np.save(tmp_path / f"{name}.npy", COUNTS.astype(np.float64))
    bad = COUNTS.astype(np.float64)
    bad[20, 2] = value
    np.save(tmp_path / "felt_2.npy", bad)
    ((name, said),) = reasons(tmp_path, dtype=dtype).items()
    assert name == "felt_2.npy"
    assert why in said


GOOD = "1,2,3,4\n" * 20
BAD = {
    "empty": (b"", "no line of numbers"),
    "words": (b"time,a,b\nnone,of,these\n", "no line of numbers"),
    "noise": (bytes(range(256)) * 9, "is not a text"),
    "short line": (b"1,2,3,4\n1,2,3\n" + GOOD.encode(), "line 2 has 3 columns"),
    "word": (b"a,b,c,d\n" + GOOD.encode() + b"1,2,x,4\n", "line 22, column 3 is 'x'"),
    "hole": (GOOD.encode() + b"1,,3,4\n", "line 21, column 2 is ''"),
    "nan": (GOOD.encode() + b"1,nan,3,4\n", "frame 21, taxel 1, 2 is nan"),
    "numbers": (bytes([1, 0, 0, 0] * 99), "is not a text"),
    "sound": (b"RIFF\x24\x08\0\0WAVEfmt \x10\0\0\0" + b"\1\2" * 900, "is a sound"),
    "floats": (np.arange(2000, dtype="<f4").tobytes(), "is not a text"),
    "bytes behind": (b"1,2,3,4\n" * 20 + bytes([1, 2, 3]) * 99, "is not a text"),
    "wide": (b"1,2,3,4,5\n" * 20, "see --columns and --grid"),
    "taxels x frames": (b"1,2,3,4,5\n" * 4, "4 rows, so add --transpose"),
    "few": (b"1,2,3,4\n" * 9, "has 9 frames"),
}


@pytest.mark.parametrize("name", BAD)
def test_each_bad_text_gets_one_exact_line(tmp_path: Path, name: str):
    """The line gives the place and the bad text; other files are imported."""
    content, why = BAD[name]
    both(tmp_path, lambda path: path.write_text(GOOD))
    (tmp_path / "felt_2.csv").write_bytes(content)
    ((name, said),) = reasons(tmp_path).items()
    assert name == "felt_2.csv"
    assert why in said


@pytest.mark.parametrize(
    ("suffix", "save", "why"),
    [
        ("npy", lambda p: np.save(p, np.zeros(9)), "holds float64 [9]"),
        ("npy", lambda p: np.save(p, np.array(["a"])), "holds <U1 [1]"),
        ("npy", lambda p: np.save(p, np.array([{}]), allow_pickle=True), "of Python"),
        ("npy", lambda p: p.write_bytes(b"\x93NUMPY"), "be read: "),
        ("npy", lambda p: np.save(p, np.zeros((20, 3, 3))), "[3, 3]"),
        ("npz", lambda p: p.write_bytes(b"PK\3\4"), "be read: "),
        ("npz", lambda p: zipped(p, "a.npy", b"nothing"), "no array"),
        ("npz", lambda p: np.savez(p, a=COUNTS, b=COUNTS), "2 arrays"),
        ("mat", lambda p: p.write_bytes(b"MATLAB 5.0" + bytes(200)), "4 to 7.3"),
        ("h5", lambda p: p.write_bytes(b"nothing"), "be read: "),
        ("h5", lambda p: h5py.File(p, "w").close(), "no array"),
    ],
)
def test_each_bad_binary_gets_one_exact_line(tmp_path: Path, suffix: str, save, why: str):
    """Damaged files, objects, other shapes; nothing is unpickled."""
    both(tmp_path, text)
    save(tmp_path / f"felt_2.{suffix}")
    (found,) = reasons(tmp_path).values()
    assert why in found
    assert "\n" not in found


def test_an_array_is_chosen_and_turned(tmp_path: Path):
    """--variable chooses an array; --transpose reads taxels x frames; times stand beside."""
    for name in ("cork_1", "felt_1"):
        np.savez(
            tmp_path / f"{name}.npz", other=np.zeros((3, 3)), frames=COUNTS.T, t=np.arange(40) / 50
        )
    made = taken(tmp_path, variable="frames", transpose=True, time="t:s", rate_hz=None)
    assert made.sweeps.rate_hz == 50
    np.testing.assert_array_equal(made.sweeps.samples[0].reshape(10, 4), COUNTS[15:25])
    assert "other [3, 3]" in reasons(tmp_path, variable="x")["cork_1.npz"]


@pytest.mark.parametrize(
    ("times", "why"),
    [
        (np.r_[np.arange(30), 5, np.arange(31, 40)] * 10.0, "frame 31"),
        (np.zeros(40), "--rate"),
        (np.arange(40) // 8 * 80.0, "bursts"),
        (np.arange(40) // 4 * 40.0 + np.arange(40) % 4 * 0.1, "bursts"),
        (np.arange(40) * 20.0, "50 Hz"),
        (np.r_[0:10, 12:30, 29, 30:41] * 10.0, "frames 28 and 29"),
        (np.r_[np.nan, 1:40] * 10.0, "frame 1 "),
    ],
)
def test_times_that_cannot_be_are_named(tmp_path: Path, times: np.ndarray, why: str):
    """Back, still, in bursts or at another rate: that file alone is left out."""
    both(tmp_path, lambda path: write(path, COUNTS, 100.0))
    write(tmp_path / "felt_2.csv", COUNTS, 100.0, times)
    ((name, said),) = reasons(tmp_path, time="time:ms", rate_hz=None).items()
    assert name == "felt_2.csv"
    assert why in said


@pytest.mark.parametrize("length", ["", "0s", "-1s", "2 s", "0", "x"])
def test_a_length_is_seconds_or_frames(length: str):
    """2 alone is two frames; nothing and nonsense are refused."""
    assert Length("2", "--window").frames(100) == 2
    with pytest.raises(FormatError, match="--window"):
        Length(length, "--window")


def test_names_of_materials_are_checked_before_anything_is_read(tmp_path: Path):
    """All bad names at once; --rename changes and joins; an unknown one is refused."""
    for name in ("a,b", "x" * 30, "felt"):
        (tmp_path / f"{name}_1.csv").write_text("nothing to read")
    bad = {"a,b": "c,d", "felt": "y" * 30}
    with pytest.raises(FormatError, match=r"characters\), 'y+' \(30"):
        taken(tmp_path, renames=bad)
    for k, name in enumerate(("a,b", "x" * 30, "felt")):
        text(tmp_path / f"{name}_1.csv", COUNTS + k)
    s = taken(tmp_path, renames={"a,b": "ab", "x" * 30: "ab"}).sweeps
    assert (s.materials, s.labels.tolist()) == (("ab", "felt"), [0, 1, 0])
    text(tmp_path / "Felt_1.csv", COUNTS + 3)
    notes = taken(tmp_path, renames={"a,b": "ab", "x" * 30: "ab"}).notes
    assert ["'Felt' and 'felt'" in note for note in notes].count(True) == 1
    with pytest.raises(FormatError, match="'felz'"):
        taken(tmp_path, renames={"felz": "wool"})


def test_shapes_that_differ_are_refused(tmp_path: Path):
    """Arrays of two grids, a path of a file, a pattern that matches nothing."""
    np.save(tmp_path / "cork_1.npy", np.zeros((20, 2, 2)))
    np.save(tmp_path / "felt_1.npy", np.zeros((20, 2, 3)))
    with pytest.raises(FormatError, match="shape"):
        taken(tmp_path, grid="")
    with pytest.raises(FormatError, match="a folder"):
        taken(tmp_path / "cork_1.npy")
    with pytest.raises(FormatError, match="'cork_1"):
        taken(tmp_path, pattern=NamePattern("{material}.csv"))


def test_axes_are_the_last_of_a_frame_and_a_grid_is_needed(tmp_path: Path):
    """Columns x, y, z of each taxel; without a grid no other file is read."""
    counts = np.arange(20 * 12).reshape(20, 12) % 250
    both(tmp_path, lambda path: text(path, counts))
    s = taken(tmp_path, grid="2x2x3").sweeps
    np.testing.assert_array_equal(s.samples[0], counts[5:15].reshape(10, 2, 2, 3))
    assert taken(tmp_path, grid="3x4x1").sweeps.samples.shape == (2, 10, 3, 4)
    text(tmp_path / "a_1.csv")
    (tmp_path / "b_2.csv").write_text("not read")
    left_out: list[LeftOutFile] = []
    with pytest.raises(FormatError, match="4 columns"):
        import_folder(tmp_path, plan(grid=""), lambda line: None, left_out)
    assert left_out == []


def test_a_name_that_cannot_be_sent_becomes_a_display_name(tmp_path: Path):
    """With an ASCII label that no other material has."""
    names = ("felt", "Filz, weiß", "Filz weiss", "木", "x" * 30, "a,b")
    for k, name in enumerate(names):
        text(tmp_path / "in" / f"{name}_1.csv", COUNTS + k)
    made = taken(tmp_path / "in", renames={"a,b": "felt"})
    displays = {"Filz weiss 2": "Filz, weiß", "material 5": "木", "x" * 24: "x" * 30, "felt": "a,b"}
    assert made.sweeps.displays == displays
    assert set(made.sweeps.materials) == {"Filz weiss", *displays}
    assert any("'木'" in note and "'material 5'" in note for note in made.notes)
    for name in ("set.npz", "set.h5"):
        made.sweeps.save(tmp_path / name)
        assert sets.load(str(tmp_path / name)).displays == displays


ARRAYS = {
    "npz": lambda path, arrays: np.savez(path, **arrays),
    "mat": lambda path, arrays: scipy_io.savemat(path, arrays),
    "h5": lambda path, arrays: [
        h5py.File(path, "a").create_dataset(f"day/{name}", data=x).file.close()
        for name, x in arrays.items()
    ],
}


@pytest.mark.parametrize("suffix", ARRAYS)
def test_each_array_whose_name_matches_is_a_recording(tmp_path: Path, suffix: str):
    """Material and trial from the array's name, the session from the file's."""
    for session, first in (("mo", 1), ("tu", 3)):
        arrays = {f"{m}_{k}": COUNTS + k for k in (first, first + 1) for m in ("felt", "wool")}
        ARRAYS[suffix](
            tmp_path / f"{session}.{suffix}", arrays | {"t": np.arange(40.0), "x": COUNTS}
        )
    made = taken(
        tmp_path,
        pattern=NamePattern("{session}.{}"),
        variable="{material}_{trial:d}",
    ).sweeps
    assert made.materials == ("felt", "wool")
    columns = made.labels, made.group("session"), made.group("trial"), made.samples[:, 0, 0, 0]
    first = int(COUNTS[15, 0])
    wanted = [(m, "mo" if k < 3 else "tu", k, first + k) for m in (0, 1) for k in (1, 2, 3, 4)]
    found = [(int(a), str(b), int(c), int(d)) for a, b, c, d in zip(*columns, strict=True)]
    assert sorted(found) == wanted
    assert len(np.unique(made.group("recording"))) == 8


def test_arrays_alone_say_all_or_are_named(tmp_path: Path):
    """A label that cannot be sent gets another; no array, no match, several ways."""
    whole = tmp_path / "whole.npz"
    np.savez(whole, **{"Filz weiß 1": COUNTS, "wool 2": COUNTS + 1})
    made = taken(tmp_path, pattern=None, variable="{material} {trial:d}").sweeps
    assert made.materials == ("Filz weiss", "wool")
    assert made.displays == {"Filz weiss": "Filz weiß"}
    whole.unlink()
    text(tmp_path / "a.csv")
    np.savez(tmp_path / "b.npz", felt=COUNTS, t=np.arange(40.0))
    np.savez(tmp_path / "c.npz", felt_a_b=COUNTS, felt_c=COUNTS, **{"wool_1": COUNTS[:3]})
    why = reasons(tmp_path, pattern=None, variable="{material}_{trial}")
    for name, said in {
        "a.csv": "holds no named arrays",
        "b.npz": "it holds felt",
        "c.npz felt_a_b": "in several ways",
        "c.npz wool_1": "has 3 frames",
    }.items():
        assert said in why.pop(name)
    assert why == {}


@pytest.mark.parametrize(
    ("variable", "pattern", "message"),
    [
        ("{material", "{material}.csv", "--variable '{material'"),
        ("{trial}", None, "--variable '{trial}'"),
        ("", "{trial}.csv", "not known in --pattern '{trial}.csv'"),
        ("{material}", "{material}.csv", "--pattern and"),
        ("{material}{recording}", None, "--variable"),
    ],
)
def test_patterns_of_arrays_that_cannot_be(variable: str, pattern: str | None, message: str):
    """Each is refused by the name of its option."""
    named = NamePattern(pattern) if pattern else None
    with pytest.raises(FormatError, match=re.escape(message)):
        plan(pattern=named, variable=variable)


def test_a_square_grid_of_hdf5_may_have_its_axes_reversed(tmp_path: Path):
    """Said, unless --axes or MATLAB itself settles it."""
    frames = np.arange(640, dtype=np.int16).reshape(40, 4, 4)
    for name, kind in (("felt_1", None), ("wool_1", b"int16")):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            made = file.create_dataset("skin", data=frames if kind is None else frames.T)
            if kind:
                made.attrs["MATLAB_class"] = np.bytes_(kind)
    plain = taken(tmp_path, grid="4x4")
    notes = {one.name: one.notes for one in plain.taken}
    assert "--axes frame,column,row" in notes["felt_1.h5"]
    assert "h5write" not in notes["wool_1.h5"]
    (tmp_path / "wool_1.h5").unlink()
    turned = taken(tmp_path, grid="4x4", axes="frame,column,row")
    assert "h5write" not in turned.taken[0].notes
    np.testing.assert_array_equal(turned.sweeps.samples[0], plain.sweeps.samples[0].swapaxes(1, 2))


@pytest.mark.parametrize("name", ["FELT_1.CSV", "felt_1.Csv"])
def test_capitals_are_given_as_the_reason(tmp_path: Path, name: str):
    """A pattern with other capitals than a file leaves it out as broken; alone, it is the error."""
    asked = {"pattern": NamePattern("{material}_{trial:d}.csv")}
    text(tmp_path / name)
    with pytest.raises(FormatError, match="capitals"):
        taken(tmp_path, **asked)
    text(tmp_path / "cork_1.csv", COUNTS + 1)
    assert "capitals" in reasons(tmp_path, **asked)[name]


def test_what_recorders_write_beside_is_passed_over(tmp_path: Path):
    """metadata.yaml of ROS is not read as a recording."""
    text(tmp_path / "cork_1.csv")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    assert len(taken(tmp_path).taken) == 1
