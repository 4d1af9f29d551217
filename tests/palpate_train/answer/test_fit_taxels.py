"""The number of broken taxels that a bundle tolerates, by the classifier of the box."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.taxels import bridged
from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.errors import BundleError
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate_train.answer import fit_taxels
from palpate_train.data import sets
from palpate_train.data.corruptions import dead
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.metrics import bundle_score, tolerances
from tests.factories import toy_bundle

FORMAT = replace(toy_bundle.FORMAT, rows=4, cols=4, window=100)


def windows(*materials: str, z: float = 6.0) -> Dataset:
    """Five sweeps of each material of the toy: "a" at (0, 0), "b" at (z, 0), "c" at (0, z)."""
    at = {"a": (0, 0), "b": (z, 0), "c": (0, z)}
    rng = np.random.default_rng(0)
    samples = np.stack([toy_bundle.window(*at[m], FORMAT) for m in materials for _ in range(5)])
    noise = np.rint(rng.standard_normal(samples.shape)).astype(samples.dtype)
    labels = np.repeat(np.arange(len(materials)), 5)
    return Dataset(samples + noise, labels, materials, 100.0, {}, "windows")


def toy(tmp_path: Path) -> Path:
    return toy_bundle.put(tmp_path / "toy", toy_bundle.files(format=FORMAT))


def test_limits_are_beyond_all_sound_sweeps():
    """No sound sweep has a broken taxel by them; sound taxels are never constant."""
    sweeps = windows("a", "b")
    rule = fit_taxels.learned(sweeps)
    assert (rule.taxels, rule.row, rule.column, rule.still) == (0, False, False, False)
    assert rule.noise >= tolerances.CLEAR
    assert rule.quietest > 1


def test_sound_taxels_that_are_constant_are_noticed():
    """For a tenth of one window, and in windows that are constant as a whole."""
    sweeps = windows("a")
    sweeps.samples[3, :10, 1, 1] = 50
    assert fit_taxels.learned(sweeps).still
    sweeps.samples[:] = 50
    assert fit_taxels.learned(sweeps).still


def test_few_sweeps_search_few_places(tmp_path: Path):
    """No more taxels than sweeps are tried, but as many as may be broken."""
    test = EvaluationSweeps.of(windows("a", "b"), 2, 0)
    rule = fit_taxels.learned(test.sweeps)
    bench = fit_taxels._Bench(bundle.load(toy(tmp_path)), rule, test, test, 0)
    assert len(bench.places()) == fit_taxels.MOST


def test_large_windows_are_searched_with_fewer_sweeps(monkeypatch: pytest.MonkeyPatch):
    """In proportion to the counts of a window, but never fewer than may be broken."""
    test = EvaluationSweeps.of(windows("a", "b"), 4, 0)
    size = test.sweeps.samples[0].size
    for large, searched in ((size, 40), (size // 2, 20), (1, fit_taxels.MOST)):
        monkeypatch.setattr(fit_taxels, "LARGE", large)
        assert fit_taxels._searched(40, test) == searched


def test_a_bundle_that_needs_one_taxel_tolerates_none(tmp_path: Path):
    """The toy knows "b" from taxel 1.1 alone; a row or a column may hold it as well."""
    loaded, sweeps = bundle.load(toy(tmp_path)), windows("a", "b", "c")
    found = fit_taxels.measure(loaded, sweeps, sweeps)
    assert (found.bridging.taxels, found.bridging.row) == (0, False)
    assert found.figures["sound"] == [15, 0]
    assert found.figures["1 taxel"]["at"] in ("taxel 1.1", "taxel 1.2")
    assert found.figures["1 taxel"]["dead"][0] <= 10
    assert found.figures["one row"]["at"] == "row 1"


def test_nothing_is_bridged_where_a_taxel_of_the_sound_skin_is_silent(tmp_path: Path):
    """A bundle that bridges nothing more would refuse the taxel at full scale in every sweep."""
    loaded, sweeps = bundle.load(toy(tmp_path)), windows("a", "b", "c")
    sweeps.samples[:, :, 3, 3] = 255
    assert fit_taxels.measure(loaded, sweeps, sweeps) is None


@pytest.mark.slow
def test_a_bundle_that_needs_no_single_taxel_tolerates_a_quarter(tmp_path: Path):
    """All sweeps are of "a", which every taxel shows."""
    loaded, sweeps = bundle.load(toy(tmp_path)), windows("a")
    found = fit_taxels.measure(loaded, sweeps, sweeps)
    rule = found.bridging
    assert (rule.taxels, rule.row, rule.column) == (4, True, True)
    assert found.figures["4 taxels"]["stuck"] == [5, 0]
    bundle.Manifest.parse(replace(loaded.manifest, bridging=rule).json())


@pytest.mark.slow
def test_loads_that_differ_in_every_sweep_bridge_better_than_neighbours(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """The loads tell a broken taxel there; where neighbours do as well, these stay."""

    class Weighed:
        """A box that names a material by the load of taxel 1.1."""

        def __init__(self, told: bundle.Bundle, *rest: Any, **more: Any) -> None:
            self.bundle, self.model_runner = told, None

    def pressed(n: int = 40) -> Dataset:
        """Two materials that differ in the load of row 1, whose taxels are pressed together, four
        times as hard as their neighbours, by different forces."""
        rng = np.random.default_rng(0)
        labels, force = np.arange(n) % 2, rng.uniform(0.8, 1.2, n)
        hard = np.array([4.0, 1.0, 1.0, 1.0])[:, None] * np.array([1.0, 1.2, 0.8, 1.1])
        level = force[:, None, None] * (60 * hard + 60 * labels[:, None, None] * (hard > 2))
        level = np.repeat(level[:, None], 100, axis=1)
        samples = np.rint(level + rng.standard_normal(level.shape)).astype(np.int16)
        return Dataset(samples, labels, ("a", "b"), 100.0, {}, "pressed")

    sweeps = pressed()

    def counts(self: Any, given: Dataset) -> list[Any]:
        rule, right = self._box.bundle.manifest.bridging, 0
        for window, label in zip(given.samples, given.labels, strict=True):
            broken = (window == 0).all(axis=0)
            filled = (
                bridged(window, broken, np.zeros((4, 4)), rule.loads) if broken.any() else window
            )
            right += int((filled[:, 0, 0].mean() / filled[:, 2, 0].mean() > 4.5) == label)
        return [right, len(given) - right, float(right)]

    monkeypatch.setattr(fit_taxels, "Classifier", Weighed)
    monkeypatch.setattr(fit_taxels._Bench, "_counts", counts)
    monkeypatch.setattr(fit_taxels._Bench, "clipped", lambda bench: (None, {}))
    loaded = bundle.load(toy(tmp_path))
    found = fit_taxels.measure(loaded, sweeps, sweeps).bridging
    assert found.loads is not None
    assert found.taxels >= 1
    even = replace(sweeps, samples=np.tile(sweeps.samples[:, :, :1, :1], (1, 1, 4, 4)))
    assert fit_taxels.measure(loaded, even, even).bridging.loads is None
    kept = replace(loaded.manifest, bridging=found)
    assert bundle.Manifest.parse(kept.json()).bridging == found


@pytest.mark.slow
def test_a_bundle_answers_clipped_sweeps_as_far_as_it_names_them(tmp_path: Path):
    """ "b" is soon lost; for "a" half of the taxels may be clipped, as the manifest says."""
    loaded, all_three, one = bundle.load(toy(tmp_path)), windows("a", "b", "c"), windows("a")
    one.samples[:, :, 2:] += 60
    few, many = (fit_taxels.measure(loaded, sweeps, sweeps) for sweeps in (all_three, one))
    assert few.saturated is None
    assert few.written(loaded.manifest).thresholds == loaded.manifest.thresholds
    assert len(few.figures[fit_taxels.CLIPPED]) == 1
    counts = many.figures[fit_taxels.CLIPPED]
    assert counts == {"0.1": [5, 0], "0.2": [5, 0], "0.35": [5, 0], "0.5": [0, 0]}
    assert many.saturated == pytest.approx(0.5)
    manifest = many.written(loaded.manifest)
    assert manifest.thresholds.saturated == many.saturated > 0.1
    assert f"answered up to {100 * many.saturated:.1f} % at full scale" in fit_taxels.text(manifest)
    assert bundle.Manifest.parse(manifest.json()) == manifest
    assert few.written(manifest).thresholds == manifest.thresholds  # as the skin needs


@pytest.mark.parametrize("scale", [1e6, 1e9])
def test_large_counts_keep_their_modes_as_far_as_a_manifest_holds_them(scale: float):
    """Counts of 24 bits have variances beyond counts; a mean of 1e10 bridges by neighbours."""
    samples = scale * np.random.default_rng(0).normal(5, 1, (9, 20, 4, 4)).astype(np.float32)
    sweeps = Dataset(samples, np.arange(9) % 2, ("a", "b"), 100.0, {}, "x")
    assert bool(fit_taxels.load_modes(sweeps)) == (scale == 1e6)


@pytest.mark.parametrize("shape", [(9, 20, 1, 3), (9, 20, 20, 20), (3, 20, 4, 4)])
def test_skins_and_sets_that_show_no_modes(shape: tuple[int, ...]):
    """Too few values of a frame, too many for a manifest, and too few sweeps."""
    labels = np.arange(shape[0]) % 2
    samples = np.random.default_rng(0).integers(0, 99, shape).astype(np.int16)
    assert fit_taxels.load_modes(Dataset(samples, labels, ("a", "b"), 100.0, {}, "x")) is None


@pytest.mark.slow
def test_the_packaged_bundle_bridges_what_its_manifest_says():
    """None is refused, one of twelve loses its label."""
    packaged = bundle.load(bundle.DEFAULT)
    assert packaged.manifest.bridging
    box = Classifier(packaged, SystemClock(), replace(UNTIL_NEW_OBJECT, strangers="loose"))
    test = EvaluationSweeps.of(sets.load("sim:T-REAL/level-blind:31:1"), 12)
    for place in range(16):
        mask = (np.arange(16) == place).reshape(1, 1, 4, 4)
        broken = dead(test.sweeps.samples, mask, np.random.default_rng(0), test)
        sweeps = replace(test.sweeps, samples=broken)
        verdicts = [verdict for _, verdict in bundle_score.verdicts(box, sweeps)]
        name = f"silent taxel {place // 4 + 1}.{place % 4 + 1}"
        assert {verdict.degraded for verdict in verdicts} == {name}
        assert sum(verdict.status is Status.OK for verdict in verdicts) >= 11


def test_a_bundle_without_the_figure_says_so(tmp_path: Path):
    """Its manifest has no entry either."""
    manifest = bundle.load(toy(tmp_path)).manifest
    assert "not measured" in fit_taxels.text(manifest)
    assert manifest.bridging is None


def test_a_manifest_that_bridges_all_taxels_is_refused(tmp_path: Path):
    """At least one taxel has to be left."""
    manifest = bundle.load(toy(tmp_path)).manifest
    rule = replace(fit_taxels.learned(windows("a")), taxels=16)
    with pytest.raises(BundleError, match="16 of 16"):
        replace(manifest, bridging=rule)
