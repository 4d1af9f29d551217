"""Trainings for a report: learning curve, materials left out, joined sets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Where
from palpate_train.models import methods
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.reports import bundle_trainings
from tests.factories.page_reader import PageReader
from tests.factories.sweep_sets import easy, tones

NOTHING = lambda line: None  # noqa: E731


def where(folder: Path) -> Where:
    """One process, with its results below `folder`."""
    return Where(jobs=1, cache=folder)


@pytest.mark.slow
def test_the_curve_rises_with_sweeps_to_all_of_them(tmp_path: Path):
    """Points at 2, 4, 8 and all 16 of each; each tests all, and more is as good here."""
    made = {"method": "static-svm"}
    test = easy(30, seed=5)
    found = bundle_trainings.run(made, easy(16), test, where(tmp_path), NOTHING)
    assert [p["each"] for p in found["curve"]] == [2, 4, 8, 16]
    assert {p["n"] for p in found["curve"]} == {len(test)}
    assert all(p["low"] <= p["share"] <= p["high"] for p in found["curve"])
    assert found["trained"]["method"] == "static-svm"
    assert "left_out" not in found  # an SVM knows no novelty
    assert found["why_not"]


@pytest.mark.parametrize(
    ("errors", "gain"),
    [((0.4, 0.2, 0.1), 0.05), ((0.1, 0.1, 0.1), 0), ((0.1, 0.2, 0.3), 0), ((0.0, 0.0, 0.0), 0)],
)
def test_what_twice_as_many_sweeps_bring(errors: tuple[float, ...], gain: float):
    """Halved errors halve once more; the interval holds the gain."""
    points = [{"each": 2.0**i, "share": 1 - e, "n": 1000} for i, e in enumerate(errors)]
    found, low, high = bundle_trainings.doubled(points)
    assert found == pytest.approx(gain, abs=0.001)
    assert low <= found <= high


@pytest.mark.slow
@pytest.mark.thorough  # fits again for each material
def test_each_material_is_left_out_where_the_method_knows_novelty(tmp_path: Path):
    """For each material the share with a known label, and known sweeps that are kept. The same
    training gives the last point of the curve."""
    train, test = tones(10), tones(4, noise=1.5)
    found = bundle_trainings.run({"chosen": "filters"}, train, test, where(tmp_path), NOTHING)
    assert set(found["left_out"]["materials"]) == {"a", "b", "c"}
    for m in found["left_out"]["materials"].values():
        assert (m["known"], m["unknown"]) == (16, 8)
        assert 0 <= m["false_known"] <= 1
    assert found["trained"]["method"] == "palpate"
    args = where(tmp_path), NOTHING, methods.FULL_EFFORT
    assert found["curve"] == bundle_trainings.curve("palpate", train, test, *args)


def test_curves_need_a_method_and_the_form_of_the_bundle(tmp_path: Path):
    """Else the reason stands in their place, before any training."""
    found = bundle_trainings.run({}, easy(4), easy(4), where(tmp_path), NOTHING)
    assert found.keys() == {"why_not"}
    other: Dataset = tones()
    with pytest.raises(FormatError, match=r"easy .* tones"):
        bundle_trainings.run(
            {"method": "static-svm"}, easy(4), other, Where(jobs=1, cache=None), NOTHING
        )


def test_materials_are_matched_by_name():
    """In any order; those without a match are left out."""
    train, other = easy(4), easy(6)
    mixed = replace(other, materials=("high", "felt", "low"))
    found = bundle_trainings.aligned(mixed, train)
    assert found.materials == train.materials
    assert len(found) == 12
    assert [train.materials[k] for k in found.labels] == [
        mixed.materials[k] for k in mixed.labels if k != 1
    ]
    with pytest.raises(FormatError, match="easy"):
        bundle_trainings.aligned(tones(), train)


@pytest.mark.slow
def test_a_fit_gives_back_all_its_sweeps():
    """The training sweeps come first, then the held-out ones, with their groups."""
    whole = easy(20)
    made = recipe.fit(whole, Run(1), recipe.Settings())
    again = bundle_trainings.whole(made)
    assert len(again) == len(whole)
    np.testing.assert_array_equal(
        np.sort(again.group("recording")), np.sort(whole.group("recording"))
    )
    assert again.materials == whole.materials


@pytest.mark.slow
@pytest.mark.thorough  # fits again for each part of the report
def test_the_report_of_a_fit_is_that_of_its_bundle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Two commands lead from a fit to its page, with a curve."""
    tones(12).save(tmp_path / "t.npz")
    fit, page = tmp_path / "mine.npz", tmp_path / "r.html"
    assert main(f"fit --set {tmp_path / 't.npz'} --seed 1 --out {fit}".split()) == 0
    assert f"palpate-train report {fit} --set " in capsys.readouterr().out.splitlines()[-1]
    tones(4, noise=1.5).save(tmp_path / "test.npz")
    named = f"report {fit} --set {tmp_path / 'test.npz'} --out {page} --jobs 1".split()
    assert main([*named, "--cache", str(tmp_path / "cache")]) == 0
    text = PageReader(page.read_text()).text
    assert "mine 1: " in text
    assert "training on 2, 4, 8" in text
    assert "gets a known label" in text
    said = capsys.readouterr().err
    assert all(step in said for step in ("export", "answers", "trainings", "pictures"))
    assert isinstance(Fit.load(fit), Fit)
    assert main(["report", str(tmp_path / "t.npz"), *named[2:]]) == FormatError.exit_code
    assert "t.npz: not a fit" in capsys.readouterr().err
