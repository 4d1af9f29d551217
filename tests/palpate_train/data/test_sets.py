"""Sweep sets: refused sets and their messages, and groups that stay together."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.data import sets
from tests.factories.sweep_sets import easy, held, write


def test_a_file_is_read_as_it_is_described(tmp_path: Path):
    """Format, materials, groups and counts as written; save writes the same arrays."""
    s = sets.load(write(tmp_path / "good.npz"))
    assert s.format == SweepFormat(2, 3, 50.0, 8, "int16")
    assert s.materials == ("a", "b", "c")
    s.save(tmp_path / "again.npz")
    again = sets.load(str(tmp_path / "again.npz"))
    np.testing.assert_array_equal(again.samples, held()["samples"])
    np.testing.assert_array_equal(again.groups["speed"], held()["group_speed"])
    assert (again.materials, again.rate_hz) == (s.materials, s.rate_hz)


@pytest.mark.parametrize("name", ["s.npz", "s.h5"])
def test_a_set_with_axes_is_read_as_it_was_written(tmp_path: Path, name: str):
    """Counts and format, from both file formats; parts of the set keep the axes."""
    samples = np.arange(6 * 8 * 2 * 3 * 3, dtype=np.int16).reshape(6, 8, 2, 3, 3)
    s = sets.load(write(tmp_path / "good.npz", samples=samples))
    assert s.format == SweepFormat(2, 3, 50.0, 8, "int16", axes=3)
    s.save(tmp_path / name)
    again = sets.load(str(tmp_path / name))
    np.testing.assert_array_equal(again.samples, samples)
    assert again.select(["material=a,b"]).format == s.format
    assert again.without_means().samples.shape == samples.shape


NAN = np.zeros((6, 8, 2, 3), np.float32)
NAN[4, 7, 1, 2] = np.nan


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": None}, "lacks samples"),
        ({"materials": None, "rate_hz": None}, "materials, rate_hz"),
        ({"samples": np.zeros((6, 8, 6), np.uint8)}, "shape \\[6, 8, 6\\]"),
        ({"samples": np.zeros((6, 0, 2, 3), np.uint8)}, "none empty"),
        ({"samples": np.zeros((6, 8, 2, 3, 1), np.uint8)}, r"shape \[6, 8, 2, 3, 1\]"),
        ({"samples": np.zeros((6, 8, 2, 3, 9), np.uint8)}, "9 axes"),
        ({"samples": np.zeros((6, 8, 2, 3))}, r"astype\('float32'\)"),
        ({"samples": np.full((6, 8, 2, 3), -1)}, r"astype\('int16'\)"),
        ({"samples": np.ones((6, 8, 2, 3), bool)}, "bool; .*'uint8'"),
        ({"samples": np.full((6, 8, 2, 3), 1 << 40)}, r"astype\('float32'\)"),
        ({"samples": np.full((6, 8, 2, 3), 1j)}, "complex128"),
        ({"samples": np.zeros((6, 8, 256, 1), np.uint8)}, "256 x 1 "),
        ({"rate_hz": np.array(np.nan)}, "is nan"),
        ({"rate_hz": np.array(2e6)}, "2000000.0 Hz"),
        ({"group_speed": np.ones(6, bool)}, "holds bool"),
        ({"group_speed": np.array([1, 2, np.nan, 1, 2, 3])}, "of sweep 2"),
        ({"group_speed": np.array([*"abcd", "", "e"])}, "sweep 4 is ''"),
        ({"group_recording": np.full(6, 1j)}, "holds complex128"),
        ({"samples": NAN}, r"samples\[4, 7, 1, 2\]"),
        ({"samples": np.nan_to_num(NAN, nan=1e20)}, r"taxel 1, 2 reads 1e\+20"),
        ({"labels": np.arange(5)}, r"\[5\]"),
        ({"labels": np.zeros(6)}, "float64"),
        ({"labels": np.array([0, 1, 2, 0, 3, 1])}, "3 of sweep 4"),
        ({"labels": np.array([0, 1, -1, 0, 2, 1])}, "-1 of sweep 2"),
        ({"labels": np.full(6, 2)}, "'c'"),
        ({"materials": np.array(["a", "b", "a"])}, "twice"),
        ({"materials": np.arange(3)}, "hold int64"),
        ({"rate_hz": np.array([50.0, 60.0])}, "number"),
        ({"rate_hz": np.array(-1.0)}, "is -1.0"),
        ({"group_speed": np.ones(7, int)}, r"holds int64 \[7\]"),
        ({"materials": np.array(["a", {}, "c"], object)}, "not a"),
        ({"unloaded": np.zeros((6, 2, 3))}, r"floats \[6, 2, 2, 3\]"),
        ({"unloaded": np.zeros((6, 2, 2, 3), int)}, "holds int64"),
    ],
)
def test_a_broken_file_is_refused_by_name(tmp_path: Path, changes: dict, message: str):
    """Each fault has its message, which begins with the file."""
    with pytest.raises(FormatError, match=f"^broken.npz: .*{message}"):
        sets.load(write(tmp_path / "broken.npz", **changes))


def test_what_is_no_set_at_all_is_refused(tmp_path: Path):
    """Text, a single array, a truncated archive, an empty file."""
    (tmp_path / "text.npz").write_text("samples")
    (tmp_path / "empty.npz").write_bytes(b"")
    np.save(tmp_path / "array.npy", np.zeros(3))
    whole = Path(write(tmp_path / "whole.npz")).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("text.npz", "empty.npz", "array.npy", "cut.npz", "missing.npz"):
        with pytest.raises(FormatError, match=f"^{name}: not a"):
            sets.load(str(tmp_path / name))


@pytest.mark.slow
def test_simulated_sets_have_their_worlds():
    """Sizes of the paper's sets, the seed in the name, positions of joined scenes."""
    real = sets.load("sim:T-REAL:5-6:1")
    assert (len(real), real.format, real.materials) == (2 * 9 * 6, skin.FORMAT, skin.MATERIALS)
    assert len(np.unique(real.groups["position"])) == 18
    hard = sets.load("sim:T-HARD", seed=6)
    assert len(hard) == 60
    np.testing.assert_array_equal(hard.samples, sets.load("sim:T-HARD:6").samples)
    np.testing.assert_array_equal(real.samples[:54], skin.sweep_set("T-REAL", 5, 1)[0])
    shear = sets.load("sim:T-HARDx3:6:1")
    assert (len(shear), shear.format) == (6, skin.SHEAR_FORMAT)
    np.testing.assert_array_equal(
        shear.samples, skin.sweep_set("T-HARD", 6, 1, skin.World(shear=True))[0]
    )


def test_a_named_world_is_drawn_in_its_physics() -> None:
    """Equal seeds have equal positions in all worlds; an unknown world is refused."""
    name = "sim:T-HARD/level-blind:6:1"
    blind, usual = sets.load(name), sets.load("sim:T-HARD:6:1")
    drawn = skin.sweep_set("T-HARD", 6, 1, skin.LEVEL_BLIND)[0]
    np.testing.assert_array_equal(blind.samples, drawn)
    assert not np.array_equal(blind.samples, usual.samples)
    np.testing.assert_array_equal(blind.labels, usual.labels)
    assert blind.source == name
    shear = sets.load("sim:T-LABx3/level-blind:6-7:1")
    assert shear.format == skin.SHEAR_FORMAT
    with pytest.raises(FormatError, match="'flat'"):
        sets.load("sim:T-REAL/flat:1")


@pytest.mark.parametrize(
    "spec", ["sim:T-SOFT", "sim:T-REAL:x", "sim:T-REAL:1:0", "sim:", "sim:T-REAL:2-1"]
)
def test_an_unknown_simulated_set_is_refused(spec: str):
    """The message repeats the name."""
    with pytest.raises(FormatError, match=f"^set '{spec}' is "):
        sets.load(spec)


def test_select_keeps_what_fulfils_every_condition():
    """All of = <= >=, any of several values; other materials go, labels are renumbered."""
    s = easy(8)
    part = s.select(["speed>=1", "speed<=2"])
    assert set(part.groups["speed"]) == {1, 2}
    assert len(part) == len(s) // 2
    assert len(s.select([])) == len(s)
    upper = s.select(["recording>=8"])
    assert upper.materials == ("middle", "high")
    np.testing.assert_array_equal(np.bincount(upper.labels), [8, 8])
    np.testing.assert_array_equal(upper.samples, s.samples[8:])
    assert set(s.select(["speed=0, 3"]).groups["speed"]) == {0, 3}
    part = s.select(["material=high, low"])
    assert part.materials == ("low", "high")
    np.testing.assert_array_equal(part.samples, s.samples[np.r_[:8, 16:24]])
    assert s.select(["material=high,low", "speed=1"]).format == s.format


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("speed<2", "be read"),
        ("speed", "be read"),
        ("load=1", "'load'"),
        ("speed=", "''"),
        ("speed=1,fast", "'fast'"),
        ("speed<=1,2", "one number$"),
        ("material>=low", "material holds names"),
        ("speed=9", "speed=9"),
        ("speed=1,9", "speed=9"),
        ("material=low,hihg", "material=hihg"),
        ("recording>=99999999999999999999", "fulfils recording>=9+"),
        ("recording<=7", "'low'"),
        ("force<=slow", "'slow'"),
        ("force<=5mN", "'5mN'"),
        ("force=0.7", "force=0.7"),
        ("pace<=1", "pace holds names"),
        ("pace=1", "pace=1"),
    ],
)
def test_select_names_what_is_wrong(condition: str, message: str):
    """A typing error, unit or missing value is never an empty filter."""
    force, pace = [0.0, 0.5, 1.0, 1.5] * 6, ["slow", "fast"] * 12
    s = easy(8)
    groups = s.groups | {"force": np.array(force), "pace": np.array(pace)}
    with pytest.raises(FormatError, match=message):
        replace(s, groups=groups, units={"force": "N"}).select([condition])


@pytest.mark.slow
@settings(max_examples=60)
@given(st.integers(1, 7), st.floats(0.05, 0.95), st.integers(0, 2**32 - 1))
def test_split_never_separates_a_recording(pieces: int, share: float, seed: int):
    """No recording on both sides, no sweep lost; each material close to the share."""
    s = easy(21, pieces=pieces) if 21 % pieces == 0 else easy(6 * pieces, pieces=pieces)
    first, second = s.split("recording", share, seed)
    assert not set(first.groups["recording"]) & set(second.groups["recording"])
    assert len(first) + len(second) == len(s)
    for part, ideal in ((first, share), (second, 1 - share)):
        per_material = np.bincount(part.labels, minlength=3) / (len(s) / 3)
        recordings = len(np.unique(s.groups["recording"])) / 3
        assert np.all(np.abs(per_material - ideal) <= 1 / recordings + 1e-9)


def test_split_is_the_seed_s_alone_and_trains_on_each_material():
    """Another seed gives others; a material of one group is trained on, or it is refused."""
    s = easy(20)
    parts = [s.split("recording", 0.5, seed)[0].groups["recording"] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(parts[0], parts[1])
    assert set(parts[0]) != set(parts[2])
    s = easy(8).take(np.arange(19))  # 8 low, 8 middle, 3 high
    s.groups["box"] = np.array([0] * 8 + [1] * 4 + [2] * 7)
    outcomes = set()
    for seed in range(20):
        try:
            outcomes.add(s.split("box", 0.5, seed)[0].labels.max())
        except FormatError as e:
            outcomes.add("lacks 'high'" if "'high'" in str(e) else str(e))
    assert outcomes == {2, "lacks 'high'"}


def test_sweeps_of_other_things_are_taught_apart():
    """The material `not this` is dropped; two others must remain."""
    s = easy(8)
    assert s.taught() == (s, None)
    named, others = replace(s, materials=("low", NOT_THIS, "high")).taught()
    assert named.materials == ("low", "high")
    np.testing.assert_array_equal(named.labels, s.labels[s.labels != 1] // 2)
    np.testing.assert_array_equal(others, s.samples[s.labels == 1])
    with pytest.raises(FormatError, match="'low'"):
        replace(s, materials=("low", NOT_THIS, "high")).take(s.labels < 2).taught()


def test_split_refuses_what_would_flatter():
    """Groups that cut recordings, a part without a material, an invalid share."""
    s = easy(8, pieces=2)
    s.groups["half"] = np.arange(len(s)) % 2
    with pytest.raises(FormatError, match="'half'"):
        s.split("half", 0.5, 0)
    s.groups["material"] = s.labels
    del s.groups["recording"]
    s.groups["one"] = np.zeros(len(s), int)
    with pytest.raises(FormatError, match="1 groups"):
        s.split("one", 0.5, 0)
    for share in (0.0, 1.0, 1.5):
        with pytest.raises(FormatError, match="splits nothing"):
            s.split("material", share, 0)


def test_join_holds_the_materials_of_all_sets():
    """Each sweep keeps its material, though sets know others or have them in another order."""
    a = easy(4)
    b = replace(a, materials=("z", *a.materials[::-1][1:]))
    both = sets.join([a, b])
    assert both.materials == (*a.materials, "z")
    named = [np.array(s.materials)[s.labels] for s in (a, b)]
    np.testing.assert_array_equal(np.array(both.materials)[both.labels], np.concatenate(named))


def test_join_keeps_recordings_apart_and_forces_together():
    """Number 0 becomes two, a speed of 2 stays 2; `set` counts in the given order."""
    a, b = easy(4, pieces=2), easy(4, seed=1)
    both = sets.join([a, b])
    assert not set(both.groups["recording"][:12]) & set(both.groups["recording"][12:])
    np.testing.assert_array_equal(
        both.groups["speed"], np.append(a.groups["speed"], b.groups["speed"])
    )
    del b.groups["recording"]
    assert len(np.unique(sets.join([a, b]).groups["recording"])) == 6 + 12
    with pytest.raises(FormatError, match="differ"):
        sets.join([a, easy(4, dtype="int16")])
    real, hard = sets.load("sim:T-REAL:1001:1"), sets.load("sim:T-HARD:1001-1002:2")
    both = sets.join([real, hard])
    np.testing.assert_array_equal(both.groups["set"], [0] * 54 + [1] * 24)
    np.testing.assert_array_equal(both.groups["world"], [1001] * 66 + [1002] * 12)
    assert not set(both.groups["position"][:54]) & set(both.groups["position"][54:])
    assert sets.join([hard]) is hard
    assert "set" not in hard.groups


def grouped(**groups: object) -> sets.Dataset:
    """A set of twelve sweeps with these groups, and their units after a colon in the names."""
    named = {name.partition("__")[0]: np.array(v) for name, v in groups.items()}
    units = {k.partition("__")[0]: k.partition("__")[2] for k in groups if "__" in k}
    return replace(easy(4), groups=named, units=units, source="grouped")


@pytest.mark.parametrize("file", ["s.npz", "s.h5"])
def test_values_of_groups_are_kept(tmp_path: Path, file: str):
    """Fractions, names and units are in both files, in parts and in the digest."""
    s = grouped(force__N=[0.0, 0.5, 1.0, 1.5] * 3, speed=["slow", "fast", "käse"] * 4)
    s.save(tmp_path / file)
    again = sets.load(str(tmp_path / file))
    assert again.groups["force"].tolist() == [0.0, 0.5, 1.0, 1.5] * 3
    assert again.groups["speed"].tolist() == ["slow", "fast", "käse"] * 4
    assert again.units == {"force": "N"}
    assert sets.digest(again) == sets.digest(s)
    others = [grouped(force=[0.0, 0.5, 1.0, v] * 3, speed=["slow"] * 12) for v in (1.5, 1.25)]
    assert len({sets.digest(x) for x in (s, *others)}) == 3
    held_names = np.array(["p1", "p1", "p2", "p0", "p0", "p2"])
    named = sets.load(write(tmp_path / "n.npz", group_recording=held_names))
    assert named.groups["recording"].tolist() == [1, 1, 2, 0, 0, 2]
    short = np.array([0.1, 0.2, 0.3] * 2, np.float32)
    assert sets.load(write(tmp_path / "f.npz", group_force=short)).groups["force"][1] == 0.2


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ("force<=1", 9),
        ("force>=0.5", 9),
        ("force=0.5,1.5", 6),
        ("force=0.5N", 3),
        ("force<=1 N", 9),
        ("speed=slow", 4),
        ("speed=slow, fast", 8),
        ("speed=a, b", 4),
        ("trial=01", 6),
    ],
)
def test_conditions_speak_of_values(condition: str, kept: int):
    """Numbers with fractions and units, names, one with a comma, one like a number."""
    speed, trial = ["slow", "fast", "a, b"] * 4, ["01", "1"] * 6
    s = grouped(force__N=[0.0, 0.5, 1.0, 1.5] * 3, speed=speed, trial=trial)
    assert len(s.select([condition])) == kept


def test_sets_are_joined_by_values():
    """Names stay together, units are converted, different kinds are refused."""
    one = grouped(speed=["fast", "slow"] * 6, force__mN=[300, 1500] * 6, position=["tip"] * 12)
    two = grouped(speed=["medium", "slow"] * 6, force__N=[0.3, 2.0] * 6, position=["tip"] * 12)
    both = sets.join([one, two])
    assert both.groups["speed"].tolist() == ["fast", "slow"] * 6 + ["medium", "slow"] * 6
    assert both.groups["force"].tolist() == [300, 1500] * 6 + [300, 2000] * 6
    assert (both.units, sets.join([two, one]).units) == ({"force": "mN"}, {"force": "N"})
    assert sets.join([two, one]).groups["force"][12:].tolist() == [0.3, 1.5] * 6
    assert set(both.groups["position"]) == {"tip"}
    old = grouped(speed=[0, 1] * 6, force=[300, 1500] * 6, position=[0, 1] * 6)
    mixed = sets.join([old, old, one])
    assert sorted(set(mixed.groups["speed"])) == ["0", "1", "fast", "slow"]
    assert sorted(set(mixed.groups["position"])) == ["0", "1", "2", "3", "tip"]
    assert (mixed.groups["force"][0], mixed.units) == (300, {})
    with pytest.raises(FormatError, match="'force'"):
        sets.join([one, grouped(force__mm=[1] * 12)])


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
def test_without_means_leaves_the_texture(dtype: str):
    """Float32, mean zero, a constant taxel exactly zero; differences in time stay."""
    s = easy(4, dtype=dtype)
    s.samples[2, :, 1, 0] = 3.3 if dtype == "float32" else 3
    s = replace(s, samples=s.samples[:, :49])  # in float32 the mean of this many 3.3 is not 3.3
    bare = s.without_means()
    assert bare.samples.dtype == np.float32
    assert np.abs(bare.samples.mean(axis=1, dtype=np.float64)).max() < 1e-6
    assert not bare.samples[2, :, 1, 0].any()
    np.testing.assert_allclose(
        np.diff(bare.samples, axis=1), np.diff(s.samples.astype(float), axis=1), atol=1e-4
    )
    assert (bare.labels is s.labels, bare.groups, bare.materials) == (True, s.groups, s.materials)


@pytest.mark.parametrize("name", ["s.npz", "s.h5"])
def test_the_unloaded_skin_goes_with_its_sweeps(tmp_path: Path, name: str):
    """In both formats, parts and joined sets; not without means."""
    known = 0.1 * np.random.default_rng(1).random((12, 2, 2, 2))  # differences smaller than a load
    s = replace(easy(4), unloaded=known)
    s.save(tmp_path / name)
    again = sets.load(str(tmp_path / name))
    np.testing.assert_array_equal(again.unloaded, known)
    others = easy(4), replace(s, unloaded=known + 0.1)
    assert len({sets.digest(again), sets.digest(s), *map(sets.digest, others)}) == 3
    np.testing.assert_array_equal(
        s.select(["material=low,high"]).unloaded, np.delete(known, np.s_[4:8], 0)
    )
    both = sets.join([easy(4, seed=1), s])
    assert np.isnan(both.unloaded[:12]).all()
    np.testing.assert_array_equal(both.unloaded[12:], known)
    assert sets.join([easy(4), easy(4)]).unloaded is None
    assert s.without_means().unloaded is None


def test_digest_names_the_data_and_nothing_else(tmp_path: Path):
    """Equal for a set read back from any file; different after each change."""
    s = easy(4)
    for name in ("a.npz", "b.h5"):
        s.save(tmp_path / name)
        assert sets.digest(sets.load(str(tmp_path / name))) == sets.digest(s)
    assert re.fullmatch("[0-9a-f]{16}", sets.digest(s))
    other = s.samples.copy()
    other[-1, -1, -1, -1] ^= 1
    x, recording = s.samples, s.groups["recording"]
    changes = [
        *({"samples": y} for y in (other, x.astype(np.int16), x.astype(np.uint16))),
        {"samples": x.reshape(12, 64, 4, 1)},
        {"labels": s.labels[::-1]},
        {"materials": ("low", "middle", "top")},
        {"rate_hz": 101.0},
        {"groups": {"recording": recording}},
        {"groups": s.groups | {"speed": recording}},
    ]
    assert len({sets.digest(replace(s, **change)) for change in ({}, *changes)}) == 10
    assert sets.digest(
        replace(s, source="elsewhere", labels=s.labels.astype(np.uint8))
    ) == sets.digest(s)


def test_labels_may_be_names(tmp_path: Path):
    """With or without materials; a name that is not among them is refused."""
    texts = np.array(["b", "a", "b", "a", "c", "c"])
    bare = sets.load(write(tmp_path / "bare.npz", labels=texts, materials=None))
    assert (bare.materials, bare.labels.tolist()) == (("a", "b", "c"), [1, 0, 1, 0, 2, 2])
    given = sets.load(
        write(tmp_path / "given.npz", labels=texts, materials=np.array(["c", "b", "a"]))
    )
    assert (given.materials, given.labels.tolist()) == (("c", "b", "a"), [1, 2, 1, 2, 0, 0])
    with pytest.raises(FormatError, match=r"materials \['a', 'b'\]"):
        sets.load(write(tmp_path / "less.npz", labels=texts, materials=np.array(["a", "b"])))


@pytest.mark.parametrize("name", ["labels", "materials", "group_speed"])
def test_objects_are_refused_with_the_remedy(tmp_path: Path, name: str):
    """Object arrays, which numpy makes of pandas data and lists of names; nothing is unpickled."""
    arrays = held()
    np.savez(tmp_path / "o.npz", **arrays | {name: arrays[name].astype(object)})
    with pytest.raises(FormatError, match=rf"np.array\({name}, dtype=str\)"):
        sets.load(str(tmp_path / "o.npz"))
    with pytest.raises(FormatError, match="materials hold"):
        sets.load(write(tmp_path / "s.npz", materials=np.array([b"a", b"b", b"c"])))
