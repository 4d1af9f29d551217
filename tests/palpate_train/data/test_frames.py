"""Frames of taxels: time, columns by name, fields in columns, impossible readings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import frames, raw_files
from palpate_train.data.file_names import NamePattern
from palpate_train.data.files.table import ReadPlan, Table
from palpate_train.data.import_plan import ImportPlan, Length
from tests.factories.later import Later

scipy_io = Later("scipy.io")

NAMES = NamePattern("{material}.{}")


def plan(**changes: object) -> ImportPlan:
    given = {"pattern": NAMES, "rate_hz": 100.0, "window": Length("20", "--window")} | changes
    return ImportPlan(**given)


def cube(rows: int, columns: int, count: int, axes: int = 0) -> np.ndarray:
    """Frames [n, R, C] or [n, R, C, A] whose counts all differ."""
    shape = (count, rows, columns, axes) if axes else (count, rows, columns)
    return np.arange(np.prod(shape), dtype=np.int32).reshape(shape)


@pytest.mark.parametrize("how", ["npy", "mat", "v7.3", "h5", "h5 of MATLAB"])
@pytest.mark.parametrize(
    ("rows", "columns", "axes"), [(4, 4, 0), (2, 5, 0), (4, 4, 3), (16, 16, 0)]
)
@pytest.mark.parametrize("grid", [True, False])
def test_the_last_axis_is_the_time_if_only_it_fits(
    tmp_path: Path, how: str, rows: int, columns: int, axes: int, grid: bool
):
    """(row, column, frame) and (frame, row, column) give the same frames; the first is said."""

    def stored(path: Path, values: np.ndarray, how: str) -> Table:
        """A table read from a file of `values`, as each program stores them."""
        if how == "npy":
            np.save(path.with_suffix(".npy"), values)
            return raw_files.read(path.with_suffix(".npy"))
        if how == "mat":
            scipy_io.savemat(path.with_suffix(".mat"), {"skin": values})
            return raw_files.read(path.with_suffix(".mat"))
        suffix = ".mat" if how == "v7.3" else ".h5"
        with h5py.File(path.with_suffix(suffix), "w") as file:
            if how == "h5":
                file["skin"] = values
            else:
                file["skin"] = values.T
                file["skin"].attrs["MATLAB_class"] = np.bytes_("int32")
        return raw_files.read(path.with_suffix(suffix))

    x = cube(rows, columns, 60, axes)
    last = np.moveaxis(x, 0, -1)
    name = f"{rows}x{columns}x{axes}" if axes else f"{rows}x{columns}"
    asked = plan(grid=name if grid else "")
    turned = f"its last axis is the time: frames of {[*x.shape[1:]]}"
    for values, notes in ((x, []), (last, [turned])):
        found, time_s, said = frames.frames(stored(tmp_path / "a", values, how), asked)
        np.testing.assert_array_equal(found, x)
        square = how == "h5" and values is x and rows == columns and not axes
        assert (time_s, said) == (None, [frames.SQUARE] if square else notes)


@pytest.mark.parametrize(
    ("shape", "grid", "answer"),
    [
        ((30, 30, 30), "", "first"),
        ((30, 30, 30), "30x30", "first"),
        ((40, 32, 64), "", "first"),
        ((16, 16, 16), "", "neither"),
    ],
)
def test_what_both_axes_could_be_is_asked_for(shape: tuple[int, ...], grid: str, answer: str):
    """The message shows the shape and both answers, and each of them works."""
    x = np.arange(np.prod(shape)).reshape(shape)
    what = "could both be the time" if answer == "first" else "neither end can be"
    with pytest.raises(FormatError, match=what) as e:
        frames.frames(Table(x), plan(grid=grid))
    assert str(list(shape)) in str(e.value)
    assert all(f"--axes {axes}" in str(e.value) for axes in ("frame,row,", "row,column,frame"))
    np.testing.assert_array_equal(frames.frames(Table(x), plan(axes="frame,row,column"))[0], x)
    last, _, _ = frames.frames(Table(x), plan(axes="row,column,frame"))
    np.testing.assert_array_equal(last, np.moveaxis(x, -1, 0))
    swapped, _, _ = frames.frames(Table(x), plan(axes="column,row,frame"))
    np.testing.assert_array_equal(swapped, x.T)


def test_a_square_array_is_asked_for_unless_times_show_the_axis():
    """16 frames of 16 taxels; a vector of times has as many values as there are frames."""
    x = np.arange(256).reshape(16, 16)
    with pytest.raises(FormatError, match="16 taxels"):
        frames.frames(Table(x), plan(grid="4x4"))
    asked = plan(grid="4x4", axes="taxel,frame")
    np.testing.assert_array_equal(frames.frames(Table(x), asked)[0], x.T.reshape(16, 4, 4))
    with pytest.raises(FormatError, match=r"holds \[2, 3, 4\], but"):
        frames.frames(Table(np.zeros((2, 3, 4))), plan(transpose=True))
    x = cube(30, 30, 40)
    beside = {"t": np.arange(40) / 100}
    asked = plan(rate_hz=None, time="t:s")
    for values in (x, np.moveaxis(x, 0, -1)):
        found, time_s, _ = frames.frames(Table(values, vectors=beside, beside=("t",)), asked)
        np.testing.assert_array_equal(found, x)
        np.testing.assert_array_equal(time_s, beside["t"])


def text(names: tuple[str, ...], **more: object) -> Table:
    return Table(np.arange(40.0 * len(names)).reshape(40, -1), names, **more)


@pytest.mark.parametrize("option", ["columns", "time", "pattern", "field"])
def test_a_name_that_occurs_twice_needs_numbers(option: str):
    """Columns 2 and 4 are called s: neither is taken, whichever option names them."""
    table = text(("t", "s", "a", "s", "b"))
    asked = {
        "columns": {"columns": "s,a"},
        "pattern": {"columns": "*"},
        "time": {"time": "s:ms"},
        "field": {"fields": {"session": "s"}},
    }[option]
    with pytest.raises(FormatError, match="'s'"):
        frames.frames(table, plan(grid="2x2", **asked))
    with pytest.raises(FormatError, match="'s'"):
        frames.fields(table, {"session": "s"}, 40)
    found, _, _ = frames.frames(table, plan(grid="2x2", columns="2-5"))
    np.testing.assert_array_equal(found.reshape(40, 4), table.values[:, 1:])


def test_only_used_columns_must_be_clear_numbers():
    """Is 2 a name or a number? Texts are passed over, and refused by --columns."""
    with pytest.raises(FormatError, match="'2'"):
        frames.frames(text(("0", "1", "2", "3")), plan(grid="2x1", columns="2,3"))
    table = text(("t", "a", "b"), faults={2: "line 3, column 3 is '', which is not a number"})
    assert frames.frames(table, plan(grid="1x1", columns="a"))[0].shape == (40, 1, 1)
    for asked in ({"columns": "b"}, {"columns": "a", "time": "b:s"}, {"time": "t:s"}):
        grid = "1x2" if asked == {"time": "t:s"} else "1x1"
        with pytest.raises(FormatError, match="column 3 is ''"):
            frames.frames(table, plan(grid=grid, **asked))
    table = text(("label", "a", "b"), texts={0: ["wood"] * 40})
    found, _, _ = frames.frames(table, plan(grid="1x2"))
    np.testing.assert_array_equal(found[:, 0], table.values[:, 1:])
    with pytest.raises(FormatError, match="'label'"):
        frames.frames(table, plan(grid="1x1", columns="label"))
    with pytest.raises(FormatError, match="'wood'"):
        frames.frames(table, plan(grid="1x2", time="label:s"))


@pytest.mark.parametrize("shape", [(1, 40, 2, 3), (40, 1, 2, 3), (40, 2, 3, 1), (1, 2, 3, 40)])
def test_axes_of_length_one_are_left_out(shape: tuple[int, ...]):
    """A batch, a channel, an axis: the grid does not have them. A grid with them keeps them."""
    values = cube(2, 3, 40)
    moved = np.moveaxis(values, 0, -1) if shape[-1] == 40 else values
    found, _, _ = frames.frames(Table(moved.reshape(shape)), plan(grid="2x3"))
    np.testing.assert_array_equal(found, values)
    found, _, _ = frames.frames(Table(values.reshape(40, 6, 1)), plan(grid="6x1"))
    np.testing.assert_array_equal(found, values.reshape(40, 6, 1))


def test_a_column_of_dates_gives_the_times():
    """With a clock time; days that could be months are refused where they change."""
    dates = [f"2026-01-31 12:00:{k / 10:06.3f}" for k in range(40)]
    table = text(("when", "a"), texts={0: dates})
    _, time_s, _ = frames.frames(table, plan(grid="1x1", time="when:date", rate_hz=None))
    np.testing.assert_allclose(time_s, np.arange(40) / 10)
    dates[3] = "noon"
    with pytest.raises(FormatError, match="4: 'noon'"):
        frames.frames(table, plan(grid="1x1", time="when:date", rate_hz=None))
    texts = ["01/02/2026 12:00:00"] * 39 + ["02/02/2026 12:00:00"]
    table = text(("when", "a"), texts={0: texts})
    with pytest.raises(FormatError, match="from '01/02/2026' to"):
        frames.frames(table, plan(grid="1x1", time="when:date", rate_hz=None))


@pytest.mark.parametrize(
    "form",
    [
        *("{} sec", "{}s", "{} seconds", "{} \u00b5s", "{}nsec", "{} min", "{} hrs", "{} days"),
        *("{} microseconds", "{} nanoseconds"),
    ],
)
def test_times_may_have_their_unit_behind_each(form: str):
    """As MATLAB writes durations; another unit than that of --time is refused."""
    times = [form.format(k / 100).replace(".", ",."[k % 2]) for k in range(40)]
    table = text(("t", "a"), texts={0: times})
    words = {"\u00b5": "us", "n": "ns", "mic": "us", "min": "min", "h": "h", "d": "d"}
    word = form.strip("{} ")
    unit = next((unit for start, unit in words.items() if word.startswith(start)), "s")
    _, time_s, _ = frames.frames(table, plan(grid="1x1", time=f"t:{unit}", rate_hz=None))
    np.testing.assert_allclose(time_s / frames.sampling.UNITS_S[unit], np.arange(40) / 100)
    with pytest.raises(FormatError, match=f"--time t:{unit}"):
        frames.frames(table, plan(grid="1x1", time="t:ms", rate_hz=None))


@pytest.mark.parametrize(
    "form",
    [
        "2026-01-31T12:59:{0:06.3f}+01:00",
        "2026-01-31 12:59:{0:06.3f}Z",
        "31.01.2026 12:59:{0:06.3f}",
        "1/31/2026 12:59:{0:06.3f} PM",
        "31-Jan-2026 12:59:{0:06.3f}",
        "January 31, 2026 12:59:{0:06.3f} PM",
        "12:59:{0:06.3f}",
        "12:59:{1:02d},{2:03d}",
        "12:59:{1:02d}:{2:03d}",
        "12:59:{1:02d}:{2:03d}000",
        "Sat, 31 Jan 2026 12:59:{0:06.3f}",
        "Sat Jan 31 12:59:{0:06.3f} 2026",
        "31-Jan-26 12:59:{0:06.3f}",
        "31. Januar 2026 12:59:{0:06.3f}",
        "2026-01-31, 12:59:{0:06.3f} UTC",
        "2026-01-31_12:59:{0:06.3f}",
        "2026-01-31 12:59:{0:06.3f}+01",
        "2026-01-31 12:59:{0:06.3f} CET",
        "2026-01-31T12:59:{0:06.3f}+01:00[Europe/Berlin]",
        "12:59:{0:06.3f} p.m.",
        "1.02:59:{0:010.7f}",
        "20260131T1259{0:06.3f}Z",
        "20260131_1259{1:02d}_{2:03d}",
        "59:{0:06.3f}",
        "2 days 00:59:{0:09.6f}",
        "2026\u5e741\u670831\u65e5 12:59:{0:06.3f}",
        "'2026-01-31 12:59:{0:06.3f}",
        "2026-01-31-12-59-{1:02d}-{2:03d}",
        "Jan 31 12:59:{0:06.3f}",
    ],
)
def test_dates_of_other_forms_give_the_times(form: str):
    """With a zone, of other countries, of a clock alone, with a decimal comma."""
    at = 40 + np.arange(40) / 4
    dates = [form.format(s, int(s), round(s % 1 * 1000)) for s in at.tolist()]
    table = text(("when", "a"), texts={0: dates})
    _, time_s, _ = frames.frames(table, plan(grid="1x1", time="when:date", rate_hz=None))
    np.testing.assert_allclose(time_s, np.arange(40) / 4)


def test_clocks_without_zeros_and_zones_that_change():
    """3:5:9.5 as sketches write it; CET after CEST does not say how the hours go on."""
    times = [f"3:{5 + k // 60}:{k % 60}.5" for k in range(40, 80)]
    asked = plan(grid="1x1", time="when:date", rate_hz=None)
    _, time_s, _ = frames.frames(text(("when", "a"), texts={0: times}), asked)
    np.testing.assert_allclose(time_s, np.arange(40))
    zones = [f"02:59:{k:02} {'CEST' if k < 20 else 'CET'}" for k in range(40)]
    with pytest.raises(FormatError, match="CEST and CET"):
        frames.frames(text(("when", "a"), texts={0: zones}), asked)


@pytest.mark.parametrize("columns", ["", "s*"])
def test_names_in_the_order_of_letters_go_by_their_numbers(columns: str):
    """s0, s1, s10, s11, s2: programs sort names so, and HDF5 its members. Another order stays."""
    values = cube(3, 4, 40).reshape(40, 12)
    names = [f"s{i}" for i in range(12)]
    order = sorted(range(12), key=lambda i: names[i])
    asked = plan(grid="3x4", columns=columns)
    table = Table(values[:, order], tuple(names[i] for i in order))
    np.testing.assert_array_equal(frames.frames(table, asked)[0], values.reshape(40, 3, 4))
    table = Table(values, tuple(names[::-1]))
    np.testing.assert_array_equal(frames.frames(table, asked)[0], values.reshape(40, 3, 4))


def test_a_row_for_each_taxel_may_begin_with_its_name():
    """The names are those of the columns then; a time may be among them."""
    rows = np.vstack([np.arange(40) / 10, cube(2, 2, 40).reshape(40, 4).T])
    table = Table(np.hstack([np.full((5, 1), np.nan), rows]), texts={0: ["t", *"abcd"]})
    asked = plan(grid="2x2", time="t:s", rate_hz=None, transpose=True)
    found, time_s, _ = frames.frames(table, asked)
    np.testing.assert_array_equal(found, cube(2, 2, 40))
    np.testing.assert_allclose(time_s, np.arange(40) / 10)


@pytest.mark.parametrize(
    "form",
    [
        *("2026-01-{0} {1}", "{0}.1.2026 {1}", "{0}-Jan-2026 {1}", "Jan {0}, 2026 {1}", "{1}"),
        *("1/{0}/2026 {1}", "{0}/1/2026 {1}", "{0} Sept. 2026 {1}", "{0}. M\u00e4rz 2026 {1}"),
        *("Jan {0} {1}", "2026\u5e741\u6708{0}\u65e5 {1}"),
    ],
)
def test_dates_go_on_at_midnight(form: str):
    """Days that change, and a clock that begins again."""
    clock = [(23, 59, 59), (0, 0, 0), (0, 0, 1)]
    texts = [
        form.format(30 + (not hour), f"{hour:02}:{minute:02}:{second:02}")
        for hour, minute, second in clock
    ]
    table = text(("when", "a"), texts={0: texts})
    table = replace(table, values=table.values[:3])
    _, time_s, _ = frames.frames(table, plan(grid="1x1", time="when:date", rate_hz=None))
    assert time_s is not None
    assert time_s.tolist() == [0, 1, 2]


def test_fields_cut_a_table_where_they_change():
    """A label gives the material, a date the session; numbers are written as they are."""
    labels = ["wood"] * 10 + ["felt"] * 20 + ["wood"] * 10
    days = [f"2026-01-3{k // 35} 12:00" for k in range(40)]
    table = text(("l", "d", "n", "a"), texts={0: labels, 1: days})
    table.values[:, 2] = 7
    found = frames.fields(table, {"material": "l", "session": "d", "trial": "n"}, 40)
    assert [(part.start, part.stop) for part, _ in found] == [(0, 10), (10, 30), (30, 35), (35, 40)]
    assert found[1][1] == {"material": "felt", "session": "2026-01-30", "trial": "7"}
    unnamed = replace(table, columns=())
    assert frames.fields(unnamed, {"material": "1"}, 40)[1][1] == {"material": "felt"}
    labels[4] = ""
    with pytest.raises(FormatError, match="frame 5"):
        frames.fields(table, {"material": "l"}, 40)


@pytest.mark.parametrize(("value", "shown"), [(1e20, "1e+20"), (-3e15, "-3e+15"), (np.inf, "inf")])
def test_a_reading_that_cannot_be_is_named(value: float, shown: str):
    """Frame and taxel of the first; a skin of 32-bit integers is not concerned."""
    table = text(("a", "b", "c", "d"))
    table.values[12, 2] = value
    with pytest.raises(FormatError, match=f"taxel 2, 1 is {shown}".replace("+", r"\+")):
        frames.frames(table, plan(grid="2x2"))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"axes": "row,column"}, "--axes row,column"),
        ({"axes": "frame,frame"}, "--axes frame,frame"),
        ({"axes": "frame,time"}, "--axes frame,time"),
        ({"axes": "taxel,frame", "transpose": True}, "--axes"),
        ({"decimal": "'"}, "--decimal '"),
        ({"rate_hz": None}, "or --time"),
        ({"time": "t"}, "--time t"),
        ({"grid": "4"}, "--grid 4"),
        ({"dtype": "int8"}, "--dtype int8"),
        ({"pattern": None}, "give --pattern"),
        ({"fields": {"material": "l"}}, "--labels"),
    ],
)
def test_an_option_that_cannot_be_read_is_named(changes: dict, why: str):
    """Before any file is read."""
    with pytest.raises(FormatError) as e:
        plan(**changes)
    assert why in str(e.value)


@pytest.mark.parametrize(("late", "refused"), [(0.0, False), (0.004, False), (0.02, True)])
def test_a_taxel_with_other_times_is_refused(late: float, refused: bool):
    """Each taxel may have a time of its own under the same name, if it is the frame's."""
    t = np.arange(40) / 100
    values = np.stack([t, 3 * t, t + late, 5 * t], axis=1)
    table = Table(values, ("X[s]", "S0", "X[s]", "S1"))
    asked = plan(time="1:s", rate_hz=None, columns="2,4", grid="1x2")
    if refused:
        with pytest.raises(FormatError, match="column 3"):
            frames.frames(table, asked)
    else:
        np.testing.assert_array_equal(frames.frames(table, asked)[0][:, 0], values[:, [1, 3]])


def test_texts_for_each_frame_and_packed_counts_of_hdf5(tmp_path: Path):
    """An array of texts, an attribute of one text; counts that xarray packed."""
    x = cube(2, 2, 40)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["skin"] = x
        file["skin"].attrs.update({"scale_factor": 0.5, "add_offset": [3.0], "_FillValue": [8]})
        file["label"] = [b"wood"] * 20 + [b"felt"] * 20
        file.attrs["who"] = ["Ada"]
    table = raw_files.read(tmp_path / "a.h5", ReadPlan(fields=("label", "who")))
    np.testing.assert_array_equal(table.values, np.where(x == 8, np.nan, x * 0.5 + 3))
    parts = frames.fields(table, {"material": "label", "session": "who"}, 40)
    assert [part.start for part, _ in parts] == [0, 20]
    assert parts[1][1] == {"material": "felt", "session": "Ada"}


def test_facts_about_a_recording_are_fields(tmp_path: Path):
    """Attributes and single values, from file to array; no link."""
    x = cube(2, 2, 40)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = "far"
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.attrs["material"], file.attrs["session"] = "cork", 3
        for k in range(2):
            file[f"data/demo_{k}/obs/skin"] = x + k
        file["data/demo_1"].attrs["material"] = b"felt"
        file["data/demo_0/operator"] = "Ada"
        file["meta/finger"] = "left"
        file["data/demo_0/secret"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/secret")
    asked = {"material": "material", "session": "session"}
    for k, name in enumerate(("cork", "felt")):
        path = f"data/demo_{k}/obs/skin"
        table = raw_files.read(tmp_path / "a.hdf5", ReadPlan(path, fields=("material",)))
        ((part, found),) = frames.fields(table, asked, 40)
        assert (part, found) == (slice(0, 40), {"material": name, "session": "3"})
        assert ("operator" in table.facts) == (k == 0)
        assert "secret" not in table.facts
        with pytest.raises(FormatError, match="'task'"):
            frames.fields(table, {"material": "task"}, 40)
    table = raw_files.read(tmp_path / "a.hdf5", ReadPlan(path, fields=("meta/finger",)))
    assert table.facts["meta/finger"] == "left"
    for suffix in (".h5", ".nc"):  # netCDF of version 4 is HDF5
        with h5py.File(tmp_path / f"b{suffix}", "w") as file:
            file["run/skin"] = x
            file["run/skin"].attrs["material"] = "wood"
            file["run/when"] = [f"2026-01-31 12:00:{k}" for k in range(40)]
        asked = ReadPlan(time="when", fields=("material",))
        table = raw_files.read(tmp_path / f"b{suffix}", asked)
        assert table.facts["material"] == "wood"
        _, time_s, _ = frames.frames(table, plan(grid="2x2", time="when:date", rate_hz=None))
        np.testing.assert_array_equal(time_s, np.arange(40))
    lines = {"material": "wood", "rate": 100, "frames": x.reshape(40, 4).tolist()}
    (tmp_path / "a.json").write_text(json.dumps(lines))
    table = raw_files.read(tmp_path / "a.json")
    assert frames.fields(table, {"material": "material"}, 40)[0][1] == {"material": "wood"}
    counts, _, _ = frames.frames(
        table, plan(pattern=None, grid="2x2", fields={"material": "material"})
    )
    np.testing.assert_array_equal(counts, x)
