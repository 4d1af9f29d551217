"""Large sets are mapped: they are the same sets, and hardly any of them is held in memory."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import mapped, sets
from palpate_train.data.sets import Dataset
from tests.factories.sweep_sets import easy

FORMS = ("set.npz", "set.h5")


@pytest.fixture
def sweeps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Dataset:
    """A set that counts as large, in parts of a few sweeps."""
    whole = easy(24)
    monkeypatch.setattr(mapped, "LEAST", whole.samples.nbytes // 4)
    monkeypatch.setattr(mapped, "BATCH", 3 * whole.samples[0].nbytes)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(mapped.tempfile, "tempdir", None)
    return whole


def same(a: Dataset, b: Dataset) -> bool:
    """Whether two sets hold the same."""
    return sets.digest(a) == sets.digest(b)


@pytest.mark.parametrize("name", FORMS)
def test_a_mapped_set_is_the_set(sweeps: Dataset, tmp_path: Path, name: str):
    """Loaded, split and joined it stays mapped and the same; a small part is in memory."""
    sweeps.save(tmp_path / name)
    read = sets.load(str(tmp_path / name))
    assert mapped.is_mapped(read.samples)
    assert not mapped.is_mapped(sweeps.samples)
    assert same(read, sweeps)
    for one, other in zip(
        read.split("recording", 0.5, 1), sweeps.split("recording", 0.5, 1), strict=True
    ):
        assert mapped.is_mapped(one.samples)
        assert same(one, other)
    assert same(sets.join([read, read]), sets.join([sweeps, sweeps]))
    assert mapped.is_mapped(sets.join([read, sweeps]).samples)
    few = read.take(np.array([7, 2]))
    assert not mapped.is_mapped(few.samples)
    assert same(few, sweeps.take(np.array([7, 2])))
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


def written(sweeps: Dataset, path: Path, samples: np.ndarray, save: Callable = np.savez) -> None:
    about = {"labels": sweeps.labels, "materials": np.array(sweeps.materials)}
    save(path, samples=samples, rate_hz=np.array(sweeps.rate_hz), **about)


@pytest.mark.parametrize(
    "write",
    [
        lambda s, path: s.take(np.r_[0:3, -3:0]).save(path),
        lambda s, path: written(s, path, s.samples, np.savez_compressed),
        lambda s, path: written(s, path, s.samples.astype(">i2")),
        lambda s, path: written(s, path, np.asfortranarray(s.samples)),
    ],
)
def test_other_sets_are_read(sweeps: Dataset, tmp_path: Path, write: Callable):
    """Small ones, compressed ones, those of another byte order or another order of axes."""
    write(sweeps, tmp_path / "set.npz")
    read = sets.load(str(tmp_path / "set.npz"))
    assert not mapped.is_mapped(read.samples)
    held, wanted = ({str(one.tolist()) for one in s.samples} for s in (read, sweeps))
    assert held <= wanted


@pytest.mark.parametrize("name", FORMS)
def test_objects_are_never_mapped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str):
    """The file would hold addresses, which NumPy would follow."""
    h5py = pytest.importorskip("h5py")
    monkeypatch.setattr(mapped, "LEAST", 8)
    path = tmp_path / name
    if name.endswith(".npz"):
        np.savez(path, samples=np.array([[1], {}], dtype=object))
        found = mapped.of_npz(path)
    else:
        with h5py.File(path, "w") as file:
            data = file.create_dataset("samples", (2,), dtype=h5py.vlen_dtype(np.int32))
            data[0] = data[1] = [1, 2, 3]
        with h5py.File(path) as file:
            found = mapped.of_hdf5(path, file["samples"])
    assert found == {}


@pytest.mark.parametrize("name", FORMS)
def test_the_file_may_be_written_again_while_it_is_mapped(
    sweeps: Dataset, tmp_path: Path, name: str
):
    """The new file is whole, and the mapped set still holds what it held."""
    path = tmp_path / name
    sweeps.save(path)
    read, before = sets.load(str(path)), sets.digest(sweeps)
    first, _ = read.split("recording", 0.5, 1)
    first.save(path)
    assert sets.digest(read) == before
    assert same(sets.load(str(path)), first)
    sets.load(str(path)).save(path)
    assert same(sets.load(str(path)), first)


@pytest.mark.parametrize("name", FORMS)
def test_a_file_that_was_cut_is_refused(sweeps: Dataset, tmp_path: Path, name: str):
    """It is not mapped beyond its end."""
    path = tmp_path / name
    sweeps.save(path)
    path.write_bytes(path.read_bytes()[: sweeps.samples.nbytes // 2])
    with pytest.raises(FormatError, match=f"^{name}: not a"):
        sets.load(str(path))


def test_a_disk_without_room_is_named(
    sweeps: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """With the wanted room and the variable that names another folder."""
    sweeps.save(tmp_path / "set.npz")
    read = sets.load(str(tmp_path / "set.npz"))
    monkeypatch.setattr(mapped.tempfile, "tempdir", "/dev/full")
    with pytest.raises(FormatError, match="/dev/full: "):
        read.split("recording", 0.5, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_a_mapped_set_takes_no_memory(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch):
    """Load, split and save allocate less than a quarter of the set, a tenth for the first part."""
    monkeypatch.setattr(mapped, "LEAST", 20_000_000)
    monkeypatch.setattr(mapped, "BATCH", 1_000_000)
    s = easy(24)
    times = 60_000_000 // (16 * s.samples.nbytes) + 1
    repeated = {
        "samples": np.tile(s.samples, (times, 16, 1, 1)),
        "labels": np.tile(s.labels, times),
        "groups": {"recording": np.arange(times * len(s)) // 2},
    }
    large = replace(s, **repeated)
    size = large.samples.nbytes
    large.save(tmp_path / name)
    del large, repeated
    tracemalloc.start()
    try:
        read = sets.load(str(tmp_path / name))
        assert tracemalloc.get_traced_memory()[1] < size / 20
        first, rest = read.split("recording", 0.1, 1)
        assert len(first) == pytest.approx(len(read) / 10, rel=1e-3)
        assert len(first) + len(rest) == len(read)
        assert not mapped.is_mapped(first.samples)
        assert mapped.is_mapped(rest.samples)
        rest.save(tmp_path / f"rest-{name}")
        buffer = 16 << 20  # of NumPy, to write
        assert tracemalloc.get_traced_memory()[1] < size / 4 + buffer
    finally:
        tracemalloc.stop()
