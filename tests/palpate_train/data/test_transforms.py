"""Reductions: sweeps as a sensor with such settings gives them; good taxels stay."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import transforms
from palpate_train.data.sets import Dataset
from palpate_train.data.transforms import WHOLE, Change


def counting(shape: tuple[int, ...] = (2, 12, 2, 3), kind: str = "int16") -> Dataset:
    """Raw counts that identify sweep, frame and taxel: 1000 i + 10 t + m."""
    n, frames, rows, cols = shape
    taxel = np.arange(rows * cols).reshape(rows, cols)
    x = 1000 * np.arange(n)[:, None, None, None] + 10 * np.arange(frames)[:, None, None] + taxel
    return Dataset(
        x.astype(kind), np.arange(n) % 2, ("a", "b"), 60.0, {"day": np.arange(n)}, "counting"
    )


def test_the_window_is_the_middle_or_the_set_itself():
    """The inner six of twelve frames; with nothing left out it is not even copied."""
    sweeps = counting()
    assert WHOLE.of(sweeps) is sweeps
    assert str(WHOLE) == "all"
    part = Change(window=0.5).of(counting())
    assert part.samples[0, :, 0, 0].tolist() == [30, 40, 50, 60, 70, 80]
    assert str(part.format).startswith("2x3 int16 at 60 Hz")
    assert part.groups["day"].tolist() == [0, 1]
    assert Change(window=0.01).of(counting()).format.window == 1


@pytest.mark.parametrize(("kind", "mean"), [("int16", [20, 70]), ("float32", [20, 70])])
def test_frames_are_averaged(kind: str, mean: list[int]):
    """Five become one, an incomplete group goes; the type stays, the rate is a fifth."""
    part = Change(rate=5).of(counting(kind=kind))
    assert part.samples[0, :, 0, 0].tolist() == mean
    assert (part.rate_hz, part.samples.dtype.name) == (12, kind)
    assert Change(rate=2).of(counting((1, 2, 1, 1), "uint8")).samples.ravel().tolist() == [5]
    with pytest.raises(FormatError, match="none empty"):
        Change(rate=13).of(counting())


def test_low_bits_and_whole_rows_are_left_out():
    """Also negative ones, floats as eight bits; else one column in order."""
    x = np.array([-5, -1, 0, 3, 4, 127], np.int16).reshape(1, 6, 1, 1).repeat(2, 0)
    cut = Change(bits=2).of(Dataset(x, np.array([0, 1]), ("a", "b"), 1.0))
    assert cut.samples[0].ravel().tolist() == [-8, -4, 0, 0, 4, 124]
    ramp = np.linspace(-1, 1, 4096, dtype=np.float32).reshape(1, -1, 1, 1).repeat(2, 0)
    coarse = Change(bits=4).of(Dataset(ramp, np.array([0, 1]), ("a", "b"), 1.0)).samples
    assert len(np.unique(coarse)) == 17  # sixteen steps and the maximum
    assert np.abs(coarse - ramp).max() <= 2 / 16
    grid = Change(taxels=(5, 3, 0, 2)).of(counting()).samples
    assert grid.shape == (2, 12, 2, 2)
    assert grid[0, 0].tolist() == [[0, 2], [3, 5]]
    line = Change(taxels=(4, 0, 2)).of(counting()).samples
    assert line.shape == (2, 12, 3, 1)
    assert line[0, 0, :, 0].tolist() == [0, 2, 4]


def test_changes_add_up_and_keep_or_lose_the_unloaded_skin():
    """Each removes something else; frames leave the skin, taxels take it."""
    known = replace(counting(), unloaded=np.zeros((2, 2, *counting().format.shape)))
    assert Change(window=0.5, rate=2).of(known).unloaded is known.unloaded
    assert Change(taxels=(5, 3, 0, 2)).of(known).unloaded is None
    both = Change(window=0.5).and_then(Change(rate=2)).and_then(Change(taxels=(1,)))
    assert both == Change(0.5, 2, (1,))
    assert both.of(counting()).samples[0].ravel().tolist() == [26, 46, 66]
    assert str(both).split(", ") == ["window 0.5", "rate 2", "taxels 1"]


def test_a_taxel_goes_with_all_its_axes():
    """The grid keeps its axes; a taxel whose shear alone tells materials comes first."""
    flat = counting()
    sheared = replace(flat, samples=np.stack([flat.samples, -flat.samples], axis=-1))
    grid = Change(taxels=(5, 3, 0, 2)).of(sheared)
    assert str(grid.format).startswith("2x2x2 int16")
    np.testing.assert_array_equal(
        grid.samples[..., 1], -Change(taxels=(5, 3, 0, 2)).of(flat).samples
    )
    told = textured({7: [1, 3, 1, 3], 2: [1, 1, 3, 3]})
    plain = textured({0: [1, 1, 1, 1]})
    three = replace(told, samples=np.stack([plain.samples, told.samples, plain.samples], axis=-1))
    found = transforms.rank_taxels(three)
    assert set(found[:2]) == {2, 7}
    assert sorted(found) == list(range(9))


def textured(factors_of: dict[int, list[float]], taxels: int = 9, each: int = 12) -> Dataset:
    """White noise of strength 3; `factors_of`: for each material by taxel."""
    kinds = len(next(iter(factors_of.values())))
    labels = np.tile(np.arange(kinds), each)
    rng = np.random.default_rng(5)
    strength = 3 * np.exp(0.2 * rng.standard_normal((len(labels), taxels)))
    for taxel, factors in factors_of.items():
        strength[:, taxel] *= np.array(factors)[labels]
    x = 100 + strength[:, None] * rng.standard_normal((len(labels), 80, taxels))
    names = tuple("abcdef"[:kinds])
    return Dataset(np.rint(x).astype(np.int16)[..., None], labels, names, 100.0, {}, "textured")


def test_the_informative_taxels_come_first():
    """Wherever they are; one of two that tell the same stays before any weaker one."""
    assert set(transforms.rank_taxels(textured({7: [1, 3, 1, 3], 2: [1, 1, 3, 3]}))[:2]) == {2, 7}
    sweeps = textured({4: [1, 4], 2: [1, 1.6]}, each=30)
    x = sweeps.samples.copy()
    x[:, :, 6] = x[:, :, 4]
    first = transforms.rank_taxels(Dataset(x, sweeps.labels, sweeps.materials, 100.0))
    assert first[0] in (4, 6)
    assert first[1] == 2


@pytest.mark.parametrize("kind", ["silent", "one taxel", "one frame"])
def test_any_sweeps_have_an_order(kind: str):
    """Silent sweeps, one taxel, one frame: every taxel occurs once."""
    shape = {"silent": (4, 20, 2, 2), "one taxel": (4, 20, 1, 1), "one frame": (4, 1, 2, 2)}[kind]
    most = 1 if kind == "silent" else 255
    x = np.random.default_rng(1).integers(0, most, shape, np.uint8)
    found = transforms.rank_taxels(Dataset(x, np.array([0, 0, 1, 1]), ("a", "b"), 10.0))
    assert sorted(found) == list(range(shape[2] * shape[3]))
