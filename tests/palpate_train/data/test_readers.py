"""HDF5, TactMat and recordings become sets; broken files are refused by name."""

import io
import json
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.sweep_file import load, save
from palpate.core.types import Frames, Status, Sweep, SweepFormat
from palpate.sweeps.sweep_folder import REFUSED, RecordedSweep
from palpate_train.data import readers, sets
from tests.factories.recordings import FORMAT, record
from tests.factories.sweep_sets import held, write


def hdf5(path: Path, **changes: object) -> str:
    """A valid HDF5 set with some arrays changed, or left out if the change is None."""
    with h5py.File(path, "w") as file:
        for name, values in (held() | {"materials": ["a", "b", "ç"]} | changes).items():
            if values is not None:
                file[name] = values
    return str(path)


def tactmat(path: Path, dtype: str = "uint8", **more: object) -> np.ndarray:
    """A small file as the TactMat page describes it; its samples [3, 4, 50, 4, 4]."""
    samples = np.arange(3 * 4 * 50 * 16).reshape(3, 4, 50, 4, 4) % 155
    with h5py.File(path, "w") as file:
        file.create_dataset("samples", data=samples.astype(dtype), compression="gzip")
        for name, values in ({"materials": [b"cork", b"felt", b"tile"]} | more).items():
            file[name] = values
    return samples


def test_hdf5_holds_what_an_npz_holds(tmp_path: Path):
    """Names as text or bytes, the rate as set or attribute, another byte order."""
    a = sets.load(hdf5(tmp_path / "a.h5"))
    assert (a.format, a.materials) == (FORMAT, ("a", "b", "ç"))
    np.testing.assert_array_equal(a.samples, held()["samples"])
    np.testing.assert_array_equal(a.groups["speed"], held()["group_speed"])
    names = np.array([b"a", b"b", "ç".encode()])
    b = hdf5(tmp_path / "b.data", rate_hz=None, materials=names, samples=None)
    with h5py.File(b, "a") as file:
        file["samples"] = held()["samples"].astype(">i2")
        file["notes"] = h5py.ExternalLink("/nowhere.h5", "/x")  # not read
        file.attrs["rate_hz"] = 50
    b = sets.load(b)
    assert b.samples.dtype.isnative
    assert sets.digest(b) == sets.digest(a)


def test_a_full_disk_does_not_end_the_program():
    """h5py dies if its file raises an error while it closes; the error comes after that."""

    class FullDisk(io.BytesIO):
        """A file that takes 2 kB."""

        def write(self, data) -> int:
            """As on a full disk."""
            if self.tell() + len(data) > 2048:
                raise OSError(28, "No space left on device")
            return super().write(data)

    noise = np.random.default_rng(5).integers(0, 255, (6, 100, 4, 4))
    with pytest.raises(OSError, match="No space left"):
        readers.write_hdf5(FullDisk(), {"samples": noise, "materials": ["wood"]})


PAIR = np.zeros(6, [("a", "i4"), ("b", "f4")])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": None}, "lacks samples"),
        ({"samples": PAIR.reshape(6, 1, 1, 1)}, "samples are "),
        ({"samples": ["a"] * 6}, r"\[6\]"),
        ({"samples": h5py.Empty("u1")}, "shape None"),
        ({"labels": PAIR}, "each of 6"),
        ({"labels": ["a", "b", "c"] * 2}, r"materials \['a', 'b',"),
        ({"materials": np.array([b"a", b"b", b"\xff"])}, "utf-8"),
        ({"rate_hz": "fast"}, "rate_hz holds"),
        ({"group_speed": h5py.SoftLink("/gone")}, "'/gone'"),
        ({"samples": h5py.ExternalLink("gone.h5", "/samples")}, "'/samples'"),
        ({"samples": h5py.SoftLink("/samples")}, "'/samples'"),
        ({"labels": np.dtype("i8")}, "named type"),
    ],
)
def test_a_broken_hdf5_is_refused_by_name(tmp_path: Path, changes: dict, message: str):
    """Each fault has its message, which begins with the file."""
    with pytest.raises(FormatError, match=f"^broken.h5: .*{message}"):
        sets.load(hdf5(tmp_path / "broken.h5", **changes))


SHAPE = (6, 8, 2, 3)


def _huge(file: h5py.File) -> None:
    file.create_dataset("samples", (1 << 40, 8, 2, 3), "u1", chunks=(1, 8, 2, 3))[0] = 1


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(SHAPE, "u1")
    layout[:] = h5py.VirtualSource("gone.h5", "samples", SHAPE)
    file.create_virtual_dataset("samples", layout)


def _ragged(file: h5py.File) -> None:
    file.create_dataset("samples", SHAPE, h5py.vlen_dtype("i2"))[0, 0, 0, 0] = [1, 2]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda file: file.create_group("samples"), "HDF5 group"),
        (lambda file: file.create_dataset("samples", SHAPE, "u1"), "written"),
        (_huge, "written"),
        (_virtual, "lies in"),
        (
            lambda file: file.create_dataset("samples", SHAPE, "u1", external="/etc/hostname"),
            "lies in",
        ),
        (_ragged, "object"),
    ],
)
def test_samples_that_are_not_in_the_file_are_refused(tmp_path: Path, make: Callable, message: str):
    """HDF5 would show zeros, another file, or a name that refers to itself."""
    path = hdf5(tmp_path / "odd.h5", samples=None)
    with h5py.File(path, "a") as file:
        make(file)
    with pytest.raises(FormatError, match=f"^odd.h5: .*{message}"):
        sets.load(path)


def test_what_is_no_hdf5_and_pickles_are_refused(tmp_path: Path):
    """Cut anywhere, text, empty, missing; object arrays before they are loaded."""
    whole = Path(hdf5(tmp_path / "whole.h5")).read_bytes()
    parts = {"half.h5": whole[: len(whole) // 2], "head.h5": whole[:8], "cut": whole[:-1]}
    for name, data in (parts | {"text.h5": b"x", "empty.h5": b""}).items():
        (tmp_path / name).write_bytes(data)
    for name in (*parts, "text.h5", "empty.h5", "gone.h5"):
        with pytest.raises(FormatError, match=f"^{name}: not a.*HDF5"):
            sets.load(str(tmp_path / name))
    record(tmp_path / "1.npy", "a")
    np.save(tmp_path / "1.npy", np.array([{}], object), allow_pickle=True)
    about = json.loads((tmp_path / "1.json").read_text())
    about["crc32"] = zlib.crc32((tmp_path / "1.npy").read_bytes())
    (tmp_path / "1.json").write_text(json.dumps(about))
    with pytest.raises(FormatError, match="allow_pickle"):
        readers.read(tmp_path, sets.Dataset)


@pytest.mark.parametrize("signature", [b"SNOD", b"HEAP", b"TREE", b"GCOL", b"labels"])
def test_a_damaged_hdf5_is_refused(tmp_path: Path, signature: bytes):
    """Any table of the file is overwritten, such as the header of an array (at its address)."""
    path = tmp_path / "a.h5"
    hdf5(path)
    data = bytearray(path.read_bytes())
    at = data.index(signature)
    if signature == b"labels":
        with h5py.File(path) as file:
            at = h5py.h5o.get_info(file["labels"].id).addr
    data[at] = 0xEE
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"^a\.h5: not"):
        sets.load(str(path))


@pytest.mark.parametrize("dtype", ["uint8", "int64", "float32", "float64"])
def test_tactmat_is_read(tmp_path: Path, dtype: str):
    """Labels from the first axis, repetitions from the second; counts of one byte."""
    samples = tactmat(tmp_path / "t.h5", dtype)
    s = sets.load(str(tmp_path / "t.h5"))
    assert s.format == SweepFormat(4, 4, 750.0, 50, "uint8")
    assert s.materials == ("cork", "felt", "tile")
    assert s.source.startswith("t.h5 (states no rate; ")
    np.testing.assert_array_equal(s.labels, np.repeat([0, 1, 2], 4))
    np.testing.assert_array_equal(s.groups["repetition"], [0, 1, 2, 3] * 3)
    np.testing.assert_array_equal(s.samples[7], samples[1, 3])


def test_tactmat_s_own_rate_goes_first(tmp_path: Path):
    """A rate in the file is used, and no assumption is reported."""
    tactmat(tmp_path / "t.h5", rate_hz=1000.0)
    s = sets.load(str(tmp_path / "t.h5"))
    assert (s.rate_hz, s.source) == (1000.0, "t.h5")


def test_a_folder_of_sets_names_them(tmp_path: Path):
    """The message names the sets: the user probably meant one of them."""
    write(tmp_path / "a.npz")
    with pytest.raises(FormatError, match="holds 1 "):
        sets.load(str(tmp_path))


def test_a_broken_tactmat_is_refused(tmp_path: Path):
    """Missing names or a wrong number of names, counts beyond a byte, unexpected labels."""
    for more, message in (
        ({"materials": ["cork", "felt"]}, "but there are 2 names"),
        ({"labels": np.arange(12) % 3}, "lacks rate_hz"),
        ({"labels": np.arange(12) % 3, "rate_hz": 1.0}, r"labels holds int64 \[12\]"),
    ):
        tactmat(tmp_path / "t.h5", **more)
        with pytest.raises(FormatError, match=f"^t.h5.*: .*{message}"):
            sets.load(str(tmp_path / "t.h5"))
    for bad in (256.0, np.nan, -1.0):
        tactmat(tmp_path / "t.h5", "float64")
        with h5py.File(tmp_path / "t.h5", "a") as file:
            file["samples"][1, 1, 1, 1, 1] = bad
        with pytest.raises(FormatError, match="are float64"):
            sets.load(str(tmp_path / "t.h5"))


def test_recordings_are_a_set(tmp_path: Path):
    """Each file is a recording; objects differ between folders; others are counted."""
    for i, (material, position, obj) in enumerate(
        [("b", "tip", 0), ("a", "side", 1), ("b", "side", 1), ("a", "tip", 2)]
    ):
        path = tmp_path / f"run{i // 2}" / f"sweep-{i:06d}.npy"
        record(path, material, id=i, position=position, object=obj)
    record(tmp_path / "run0" / "sweep-000009.npy", status=Status.SATURATED, id=9)
    record(tmp_path / "run1" / "sweep-000010.npy", "", Status.GAP, frames=0)
    (tmp_path / "sweep-000011.npy.part").write_bytes(b"half")
    s = sets.load(str(tmp_path))
    assert (s.format, s.materials) == (FORMAT, ("a", "b"))
    assert s.source == f"{tmp_path} (left out: {readers.counted(Counter(gap=1, saturated=1))})"
    np.testing.assert_array_equal(s.labels, [1, 0, 1, 0])
    assert {k: list(v) for k, v in s.groups.items()} == {
        "recording": [0, 1, 2, 3],
        "position": ["tip", "side", "side", "tip"],
        "object": [0, 1, 2, 3],
    }
    np.testing.assert_array_equal(s.samples[2], 2 + np.arange(48).reshape(8, 2, 3))


def test_a_place_that_is_a_number_keeps_it(tmp_path: Path):
    """If all names are whole numbers, --only position=12 selects the position 12."""
    for i, (position, session) in enumerate([("12", "7"), ("3", "07"), ("3", "8"), ("0", "7")]):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], position=position, session=session)
    groups = sets.load(str(tmp_path)).groups
    assert list(groups["position"]) == [12, 3, 3, 0]
    assert list(groups["session"]) == ["7", "07", "8", "7"]


def test_what_else_a_sidecar_holds_changes_nothing(tmp_path: Path):
    """Recordings with device, clock, tare and verdict, beside recordings without them."""
    for i in range(4):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i, position="tip")
    before = sets.digest(sets.load(str(tmp_path)))
    for i in range(2):
        about = {"device": {"serial": "x"}, "tare": [[0] * 3] * 2}
        about["verdict"] = {"status": ("unknown", "unsure")[i]}
        save(tmp_path / f"{i}.npy", *load(tmp_path / f"{i}.npy"), about)
    assert sets.digest(sets.load(str(tmp_path))) == before


def test_the_unloaded_skin_is_kept(tmp_path: Path):
    """For each sweep that has its numbers, NaN for others; without any no array."""
    level = [[1.0, 2, 3], [4, 5, 6]]
    for i in range(4):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i)
    assert sets.load(str(tmp_path)).unloaded is None
    for i, known in enumerate(
        [{"level": level, "noise": level}, None, {"level": level, "noise": [[np.nan] * 3] * 2}]
    ):
        save(tmp_path / f"{i}.npy", *load(tmp_path / f"{i}.npy"), {"unloaded": known})
    unloaded = sets.load(str(tmp_path)).unloaded
    assert unloaded.shape == (4, 2, 2, 3)
    assert unloaded[0].tolist() == [level, level]
    assert np.isnan(unloaded[1:]).all()


@pytest.mark.parametrize(
    "known",
    [
        7,
        [],
        {"level": [[1.0] * 3] * 2},
        {"level": [1.0], "noise": [1.0]},
        {"level": [["a"] * 3] * 2, "noise": [[1.0] * 3] * 2},
    ],
)
def test_an_unloaded_skin_of_another_form_is_named(tmp_path: Path, known: object):
    """The message gives the file, the expected shape and the remedy."""
    for i in range(2):
        record(tmp_path / f"{i}.npy", "ab"[i], id=i)
    save(tmp_path / "1.npy", *load(tmp_path / "1.npy"), {"unloaded": known})
    with pytest.raises(FormatError, match=r"\[2, 3\]"):
        sets.load(str(tmp_path))


def test_what_the_box_refused_is_left_out(tmp_path: Path):
    """Not touched, broken, or cut short by an early answer: whatever the label."""
    for i in range(9):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i)
    for i, status in enumerate(REFUSED):
        path = tmp_path / f"{i}.npy"
        save(path, *load(path), {"verdict": {"status": str(status)}})
    record(tmp_path / "9.npy", "a", frames=3, share=0.4)
    s = sets.load(str(tmp_path))
    left = {"early", *map(str, REFUSED)}
    assert {part[2:] for part in s.source.strip(")").partition("out: ")[2].split(", ")} == left
    assert list(s.samples[:, 0, 0, 0]) == [5, 6, 7, 8]


def test_objects_of_several_runs_in_one_folder_stay_apart(tmp_path: Path):
    """Each run of the box counts its objects from 1 and writes its name into the sidecar."""
    for i, (run, obj) in enumerate([(0, 1), (0, 1), (2, 1), (2, 2)]):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i, object=obj)
        save(tmp_path / f"{i}.npy", *load(tmp_path / f"{i}.npy"), {"run": run})
    assert list(sets.load(str(tmp_path)).groups["object"]) == [0, 0, 1, 2]


def test_speed_and_force_are_groups_if_all_have_them(tmp_path: Path):
    """In um/s and mN, rounded; what only some have is a remark and no group."""
    for i, speed in enumerate((30, 30.5, 12.3456, 0.1)):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i, speed_mm_s=speed)
    s = sets.load(str(tmp_path))
    assert list(s.groups) == ["recording", "speed"]
    assert s.groups["speed"].tolist() == [30_000, 30_500, 12_346, 100]
    assert s.source == str(tmp_path)
    assert len(s.select(["speed<=12346"])) == 2
    record(tmp_path / "0.npy", "a", speed_mm_s=30.0, force_n=1.5)
    s = sets.load(str(tmp_path))
    assert "force" not in s.groups
    assert "1 of 4 have force_n" in s.source


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"material": ""}, "2.npy"),
        ({"position": "tip"}, "0.npy"),
        ({"session": 3}, "session = 3"),
        ({"material": 7}, "material = 7"),
        ({"object": "cup"}, "object = 'cup'"),
        ({"frames": 7}, "2.npy: 7 frames"),
        ({"format": SweepFormat(2, 3, 100.0, 8, "int16")}, "100 Hz"),
    ],
)
def test_a_recording_that_does_not_fit_is_named(tmp_path: Path, more: dict, message: str):
    """The message gives the file that lacks something or has another format."""
    record(tmp_path / "0.npy", "a")
    record(tmp_path / "1.npy", "b")
    record(tmp_path / "2.npy", **more)
    with pytest.raises(FormatError, match=f"^{tmp_path}/.*{message}"):
        sets.load(str(tmp_path))


def test_broken_recordings_are_named(tmp_path: Path):
    """A truncated table, no sidecar, an empty one, no ok sweep, a single material."""
    with pytest.raises(FormatError, match="`palpate record`"):
        sets.load(str(tmp_path))
    record(tmp_path / "0.npy", status=Status.SHORT)
    with pytest.raises(FormatError, match="1 short"):
        sets.load(str(tmp_path))
    record(tmp_path / "1.npy", "a")
    with pytest.raises(FormatError, match="'a'"):
        sets.load(str(tmp_path))
    whole, about = (tmp_path / "1.npy").read_bytes(), json.loads((tmp_path / "1.json").read_text())
    (tmp_path / "1.npy").write_bytes(whole[:-9])
    with pytest.raises(FormatError, match=r"1\.npy"):
        sets.load(str(tmp_path))
    (tmp_path / "1.npy").write_bytes(whole)
    (tmp_path / "1.json").write_text(json.dumps(about | {"status": "fine"}))
    with pytest.raises(FormatError, match=r"1\.npy"):
        sets.load(str(tmp_path))
    record(tmp_path / "2.npy", "b")
    (tmp_path / "1.json").unlink()
    with pytest.raises(FormatError, match=r"1\.npy"):
        sets.load(str(tmp_path))


@pytest.mark.parametrize("suffix", [".csv", ".CSV", ".txt", ".tsv", ".dat", ".mat", ".npy"])
def test_a_file_of_frames_names_the_import(tmp_path: Path, suffix: str):
    """The message gives the command that makes a set of a file or folder of frames."""
    np.save(tmp_path / "x.npy", np.zeros((9, 4)))
    path = (tmp_path / "x.npy").rename(tmp_path / f"x{suffix}")
    with pytest.raises(FormatError, match="palpate-train import"):
        sets.load(str(path))
    with pytest.raises(FormatError, match=f"1 {suffix.lower()} files: "):
        sets.load(str(tmp_path))


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.data", "folder"])
def test_what_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    """Before a library's own words, or a claim of an empty folder."""
    (tmp_path / "folder").mkdir()
    Path(write(tmp_path / "b.npz")).rename(tmp_path / ("c" if name == "folder" else name))

    def denied(self: Path, mode: str = "r") -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(FormatError, match=f"{name}: .*Permission denied"):
        sets.load(str(tmp_path / name))


def tared(folder: Path, levels: dict[str, float | None], dtype: str = "int16") -> np.ndarray:
    """Record sweeps with these levels (None: not noted); the pressure of all, [8, 2, 3]."""
    format, pressed = replace(FORMAT, dtype=dtype), np.arange(48).reshape(8, 2, 3) % 7 + 20
    folder.mkdir(exist_ok=True)
    for name, level in levels.items():
        n = np.arange(format.window)
        taxels = (pressed + (300 if level is None else level)).astype(format.numpy_type)
        sweep = Sweep(1, 0, 1, Status.OK, Frames(n, n, taxels), material=name[0])
        rest = level is not None and {
            "level": np.full((2, 3), level).tolist(),
            "noise": np.full((2, 3), 0.5).tolist(),
        }
        save(folder / f"{name}.npy", sweep, format, {"unloaded": rest or None})
    return pressed


@pytest.mark.parametrize("dtype", ["int16", "float32", "uint16"])
def test_recordings_that_were_tared_differently_compare(tmp_path: Path, dtype: str):
    """Shifted to the most common level, in whole counts; small drifts stay."""
    pressed = tared(tmp_path, {"a0": 300.0, "a1": 301.0, "b0": 0.0, "b1": 300.0, "b2": None}, dtype)
    s = sets.load(str(tmp_path))
    assert s.samples.dtype == dtype
    for samples, level in zip(s.samples, (300, 301, 300, 300, 300), strict=True):
        np.testing.assert_array_equal(samples, pressed + level)
    np.testing.assert_array_equal(s.unloaded[:4, 0, 0, 0], [300, 301, 300, 300])
    assert np.isnan(s.unloaded[4]).all()
    assert "1 of 5" in s.source


def test_sets_that_were_tared_differently_compare_once_they_are_joined(tmp_path: Path):
    """The smaller set is brought to the level of the other; unknown levels stay."""
    pressed = tared(tmp_path / "tared", {"a0": 0.0, "b0": 0.0})
    tared(tmp_path / "raw", {"a0": 300.0, "a1": 300.0, "b0": 300.0})
    joined = sets.join([sets.load(str(tmp_path / name)) for name in ("tared", "raw")])
    for samples in joined.samples:
        np.testing.assert_array_equal(samples, pressed + 300)
    np.testing.assert_array_equal(joined.unloaded[:, 0], 300)
    assert "2 of 5" in joined.source
    tared(tmp_path / "unknown", {"a0": None, "b0": None})
    other = sets.join([sets.load(str(tmp_path / name)) for name in ("tared", "unknown")])
    np.testing.assert_array_equal(other.samples[:2, 0], np.stack([pressed[0]] * 2))
    assert "brought" not in other.source


def test_recordings_that_were_tared_alike_stay_to_the_bit(tmp_path: Path):
    """Of two halves one is shifted to a level that exists; counts stay in range."""
    pressed = tared(tmp_path, {"a0": 300.0, "b0": 301.0, "b1": 300.5})
    s = sets.load(str(tmp_path))
    assert s.source == str(tmp_path)
    assert s.samples[2].max() == (pressed + 300.5).astype(np.int16).max()
    tared(tmp_path / "half", {"a0": 0.0, "b0": 300.0})
    half = sets.load(str(tmp_path / "half"))
    np.testing.assert_array_equal(half.samples[0], half.samples[1])
    assert half.unloaded[0, 0, 0, 0] in (0, 300)
    tared(tmp_path / "low", {"a0": 0.0, "a1": 0.0, "b0": 40.0}, "uint8")
    low = sets.load(str(tmp_path / "low"))
    np.testing.assert_array_equal(low.samples[2], low.samples[0])
    tared(tmp_path / "clipped", {"a0": 230.0, "a1": 230.0, "b0": 0.0}, "uint8")
    assert sets.load(str(tmp_path / "clipped")).samples[2].max() == 255


def test_an_impossible_reading_of_a_recording_is_named(tmp_path: Path):
    """File, frame and taxel of a reading whose square overflows."""
    format = SweepFormat(2, 3, 100.0, 8, "float32")
    taxels = np.ones((8, 2, 3), np.float32)
    taxels[5, 1, 2] = 1e20
    frames = Frames(np.arange(8), np.arange(8), taxels)
    sweep = Sweep(7, 0, 8, Status.OK, frames, material="wood")
    one = RecordedSweep(tmp_path / "sweep-000007.npy", sweep, format, {})
    with pytest.raises(FormatError, match=r"taxel 2, 3 reads 1e\+20,"):
        readers.from_recorded([one], tmp_path, sets.Dataset)
