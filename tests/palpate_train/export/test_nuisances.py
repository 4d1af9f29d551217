"""Altered copies of sweeps widen the shapes in a bundle; its model stays as it is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.errors import FormatError
from palpate.inference.novelty import ClassDistances
from palpate_train.calibration.disturbances import DisturbanceMeter
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluation_sweeps import EvaluationSweeps
from palpate_train.export import nuisances
from tests.factories import toy_bundle

FORMAT = replace(toy_bundle.FORMAT, rows=4, cols=4, window=100)


def windows(each: int = 20, seed: int = 0) -> Dataset:
    """Noisy sweeps of the materials of the toy."""
    at, rng = {"a": (0, 0), "b": (6, 0), "c": (0, 6)}, np.random.default_rng(seed)
    samples = np.stack([toy_bundle.window(*at[m], FORMAT) for m in at for _ in range(each)])
    noise = np.rint(3 * rng.standard_normal(samples.shape))
    labels = np.repeat(np.arange(3), each)
    counts = (samples + noise).clip(0, 255).astype(samples.dtype)
    return Dataset(counts, labels, tuple(at), 100.0, {}, "windows")


def toy(tmp_path: Path) -> Path:
    return toy_bundle.put(tmp_path / "toy", toy_bundle.files(format=FORMAT))


def test_copies_have_each_alteration_but_broken_taxels():
    """At several severities, of as many sweeps as there are; none is the sweep itself."""
    sweeps = windows(4)
    meter = DisturbanceMeter(FORMAT, np.zeros(FORMAT.shape), sweeps.samples)
    found = nuisances.altered(
        lambda x: x.reshape(len(x), -1)[:, :2].astype(float), EvaluationSweeps(sweeps), 0, meter
    )
    assert {"hum", "noise", "gain-down", "lost", "stretch"} <= found.copies.keys()
    assert not {"dead", "stuck", "noisy"} & found.copies.keys()
    for z, source in found.copies.values():
        assert z.shape == (12, 2)
        assert sorted(source.tolist()) == list(range(12))
    z, source = found.copies["gain-down"]
    assert (z[:, 0] < found.z[source, 0]).all()
    copied, was = found.disturbed["gain-down"]
    assert (copied < was[source]).all()
    assert found.disturbed["lost"][0].tolist() == sorted(found.disturbed["lost"][0])
    assert set(found.disturbed) < set(found.copies)


def test_simulated_sets_are_drawn_again_at_other_speeds():
    """Instead of being stretched in time; sweeps of files are stretched."""
    sweeps = sets.load("sim:T-REAL/level-blind:1:1")
    meter = DisturbanceMeter(sweeps.format, np.zeros((4, 4)), sweeps.samples[:2])
    drawn, _ = nuisances.drawn_again(sweeps, sweeps)
    assert drawn.scene
    some = drawn.take(np.arange(0, len(sweeps), 9))
    found = nuisances.altered(lambda x: x.mean(axis=(1, 2)).astype(float), some, 0, meter)
    assert {"speed-up", "force-down", "shift-grid"} <= found.copies.keys()
    assert not {"stretch", "shorten", "shift-rows"} & found.copies.keys()
    copied, was = found.disturbed["speed-up"]
    assert np.nanmedian(copied - was[found.copies["speed-up"][1]]) > 0.1


@pytest.mark.parametrize("other", ["recorded", "part"])
def test_two_sets_are_altered_alike(other: str):
    """A simulated set beside recorded sweeps, or a part of a simulated set, is not drawn again: its
    copies would have kinds that the other set lacks."""
    sweeps = sets.load("sim:T-REAL/level-blind:1:1")
    few = sweeps.select(("position<=2",))
    beside = few if other == "part" else replace(sweeps, source="recorded.npz")
    assert [of.scene for of in nuisances.drawn_again(sweeps, beside)] == [None, None]


def test_the_command_changes_shapes_and_limit_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """`palpate-train widen` keeps model, golden sweeps and class means of a bundle. A sweep with
    lower gain was unknown and counts as known afterwards."""
    folder, sweeps, fresh = toy(tmp_path), tmp_path / "set.npz", tmp_path / "fresh.npz"
    windows().save(sweeps)
    windows(seed=1).save(fresh)
    was = bundle.load(folder)
    given = ["widen", str(folder), "--trained-on", str(sweeps), "--set", str(fresh)]
    assert main(given) == 0
    now = bundle.load(folder)
    assert now.model == was.model
    assert now.classes
    assert was.classes
    assert now.classes.means.tolist() == was.classes.means.tolist()
    assert now.classes.shapes.shape == (3, *2 * now.classes.means.shape[1:])
    before, after = (json.loads(m.manifest.json()) for m in (was, now))
    figures = after["figures"].pop(nuisances.FIGURES)
    assert (figures["set"], figures["trained on"]) == ("fresh.npz", "set.npz")
    assert after.pop("disturbances")["allowances"]
    assert len(now.classes.changes) == len(now.manifest.disturbances.allowances)
    for key in before.keys() - {"known", "files"}:
        assert after[key] == before[key]
    said = capsys.readouterr().out
    assert "altered sweeps: " in said
    assert now.id in said
    assert now.manifest.known
    spaced = ClassDistances(now.classes, now.manifest.known, now.manifest.labels)
    kept = np.mean([before <= after for before, after in figures["kept"].values()])
    assert kept > 0.7
    assert not spaced.novelty(now.classes.means[0])


@pytest.mark.parametrize(
    ("spoil", "sweeps", "why"),
    [
        (lambda folder: (folder / bundle.SIGNATURE).write_bytes(b"x"), windows(), "is signed"),
        (lambda folder: None, replace(windows(), materials=("a", "b", "x")), "does not fit"),
        (lambda folder: None, windows(3), "name a larger set"),
    ],
)
def test_what_cannot_be_widened_is_refused(tmp_path: Path, spoil, sweeps: Dataset, why: str):
    """A signed bundle, sweeps of another kind, and too few; the bundle stays as it was."""
    folder = toy(tmp_path)
    spoil(folder)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(FormatError, match=why):
        nuisances.write(folder, windows(), sweeps)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_a_bundle_that_detects_no_unknown_materials_is_refused(tmp_path: Path):
    """It has no `known`."""
    files = toy_bundle.files(format=FORMAT)
    manifest = json.loads(files[bundle.MANIFEST])
    manifest["known"] = None
    del manifest["files"][bundle.MEANS]
    for key in ("moved", "early"):
        manifest[key] = None
    files[bundle.MANIFEST] = json.dumps(manifest).encode()
    with pytest.raises(FormatError, match="does not detect unknown materials"):
        nuisances.write(toy_bundle.put(tmp_path / "toy", files), windows(), windows())


def test_a_bundle_without_the_figures_says_so():
    """As do older bundles in `palpate-train export`."""
    assert "not measured" in nuisances.text({})
