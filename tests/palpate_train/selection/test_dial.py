"""The choice of the smallest size within the budget, the accuracy to expect, and its page."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.data.transforms import WHOLE, Change
from palpate_train.export import measure
from palpate_train.export.measure import BundleCost
from palpate_train.models.recipe import choice as head_choice
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.recipe import Settings
from palpate_train.selection import dial, reduction_curves
from palpate_train.selection.dial import (
    Budget,
    JudgedSize,
    Judgement,
    NothingFits,
    SizeWish,
)

CLOSED = Settings()
CLUSTERS = np.repeat(np.arange(8), 12)
"""Eight places of twelve sweeps."""


def nothing(line: str) -> None:
    """A log that drops every line."""


def skin(places: int = 8, each: int = 3, taxels: tuple[int, ...] = (0, 1)) -> Dataset:
    """Four materials at several places; each taxel named has half of the information."""
    labels = np.tile(np.arange(4), places * each)
    rng = np.random.default_rng(3)
    bits = np.stack([labels % 2, labels // 2], axis=1)
    strength = 3 * np.exp(0.15 * rng.standard_normal((len(labels), 6)))
    for taxel, bit in zip(taxels, bits.T, strict=True):
        strength[:, taxel] *= 1 + 2 * bit
    x = 100 + strength[:, None] * rng.standard_normal((len(labels), 120, 6))
    groups = {"place": np.repeat(np.arange(places), 4 * each)}
    return Dataset(
        np.rint(x).astype(np.int16)[..., None], labels, ("a", "b", "c", "d"), 100.0, groups, "skin"
    )


def judgement(**rights: np.ndarray) -> Judgement:
    """Sizes with these right answers, bool [96], of two labels at eight places."""
    labels = np.arange(96) % 2
    sizes = {
        name: JudgedSize(None, cast(Any, None), np.where(right, labels, 1 - labels))
        for name, right in rights.items()
    }
    setup = cast(Any, SimpleNamespace(sweeps=skin()))
    return Judgement(setup, sizes, {}, labels, CLUSTERS, ("place",))


EVERYTHING = np.ones(96, bool)


def missing(numbers: slice) -> np.ndarray:
    """All sweeps classified correctly but these."""
    right = EVERYTHING.copy()
    right[numbers] = False
    return right


def test_the_smallest_that_suffices_is_taken():
    """A gain at one place does not count; cost is the order; without .85 one standard error."""
    for small, chosen in ((missing(slice(12)), "bands"), (missing(slice(0, None, 8)), "all")):
        judged = judgement(bands=small, all=EVERYTHING)
        assert judged.choose(["bands", "all"], 0.0, EVERYTHING) == chosen
    judged = judgement(bands=EVERYTHING, all=EVERYTHING)
    assert judged.choose(["all", "bands"], 0.0, EVERYTHING) == "all"
    judged = judgement(bands=missing(slice(0, None, 8)), all=missing(slice(1)))
    assert judged.choose(["bands", "all"], 0.85, EVERYTHING) == "bands"
    assert judged.choose(["bands", "all"], 0.9, EVERYTHING) == "all"
    assert judged.choose(["bands", "all"], 1.0, EVERYTHING) == "all"


def test_the_accuracy_to_expect_is_that_of_choices_that_did_not_see_the_part():
    """The best of sixteen guessing sizes looks good; choices tested on parts that they did not use
    are guesses, on average over thirty draws. A single part gives no such figure."""
    best, expected = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        guesses = {name: rng.random(96) < 0.5 for name in map(str, range(16))}
        judged = judgement(**guesses)
        best.append(max(right.mean() for right in guesses.values()))
        found = judged.expected(list(guesses), 0.0)
        assert found
        assert sum(found["chose"].values()) == 8
        expected.append(found["mean"])
    assert np.mean(best) > 0.57
    assert np.mean(expected) == pytest.approx(0.5, abs=0.03)
    assert replace(judged, clusters=np.zeros(96, int)).expected(list(guesses), 0.0) is None


def test_cost_and_error_are_those_of_the_scarcer_and_of_groups():
    """The larger share of time and bytes; one place has a larger error than all."""
    small, fast = BundleCost(0.4, 20, 60, 1), BundleCost(0.1, 40, 50, 1)
    for budget, dearer, cheaper in (
        (Budget(ms=1, kb=1000, slower=2), small, fast),
        (Budget(ms=100, kb=50), fast, small),
        (Budget(), fast, small),
    ):
        assert budget.order(cheaper) < budget.order(dearer)
    assert Budget().order(BundleCost(0.1, 20, 50, 1)) < Budget().order(small)
    assert Budget(ms=1, kb=1000, slower=2).used(small) == {"ms": 0.8, "kb": 0.02}
    assert Budget(ms=0.5, slower=2).over(small).endswith(": 0.8 ms of 0.5")
    assert not Budget(kb=20).over(small)
    here, everywhere = missing(slice(12)), missing(slice(0, None, 8))
    one, all_ = (dial.difference(EVERYTHING, x, CLUSTERS) for x in (here, everywhere))
    assert one.mean == all_.mean == 0.125
    assert one.se == pytest.approx(0.125)  # one of eight places failed
    assert all_.se == pytest.approx(np.std(everywhere, ddof=1) / np.sqrt(96))
    same = dial.difference(EVERYTHING, EVERYTHING, CLUSTERS)
    assert same.json() == {"mean": 0, "se": 0, "low": 0, "high": 0}


@cache
def judged_skin() -> Judgement:
    """Three sizes in closed form, judged on the skin."""
    return dial.judge(skin(), Run(1), CLOSED, ["bands", "pairs", "all"])


@pytest.mark.slow
def test_all_sizes_are_judged_on_the_same_sweeps():
    """The common spectrum does not see which taxel is strong, relations do."""
    judged = judged_skin()
    assert judged.by == ("place",)
    assert len(judged.labels) == len(judged.clusters) == 96
    rights = {name: judged.right(name).mean() for name in judged.sizes}
    assert rights["bands"] < 0.8 < rights["pairs"]
    assert judged.choose(["bands", "pairs", "all"], 0.0, EVERYTHING) != "bands"
    assert not judged.staged
    made = judged.fit("pairs")
    assert (made.architecture.pools, made.architecture.relations > 0) == ((), True)


@pytest.mark.slow
def test_equal_models_are_fitted_once():
    """A single taxel has no relations: `pairs` chooses what `bands` chose, `all` more."""
    sweeps = skin()
    one = replace(sweeps, samples=sweeps.samples[:, :, :1])
    judged = dial.judge(one, Run(1), CLOSED, ["bands", "pairs", "all"])
    assert judged.first_equals() == {"bands": "bands", "pairs": "bands", "all": "all"}


@pytest.mark.slow
def test_a_size_alone_is_the_same_model():
    """The fit of a judged size has the weights of `recipe.fit` with that size."""
    alone = recipe.fit(skin(), Run(1), replace(CLOSED, size=dial.FAMILY["pairs"]))
    made = judged_skin().fit("pairs")
    assert alone.weights.keys() == made.weights.keys()
    for name, value in alone.weights.items():
        np.testing.assert_array_equal(value, made.weights[name])


@pytest.mark.slow
def test_sizes_with_stages_are_judged_where_stages_were_not_trained(
    monkeypatch: pytest.MonkeyPatch,
):
    """All sizes have the same held-out sweeps, and stages were trained once."""
    trained = []
    train = recipe._trained
    monkeypatch.setattr(recipe, "ENOUGH", 1.1)
    monkeypatch.setattr(head_choice.PairedDifference, "worse", property(lambda _: False))
    monkeypatch.setattr(recipe, "_trained", lambda setup: trained.append(1) or train(setup))
    sweeps = skin(each=8)
    sweeps = replace(sweeps, groups={"position": sweeps.group("place")})
    judged = dial.judge(sweeps, Run(1), Settings(steps=2), ["bands", "stages", "all"])
    assert (judged.staged, len(trained)) == (True, 1)
    assert judged.sizes["bands"].trunk is None
    assert judged.sizes["stages"].trunk is not None
    held = sweeps.take(judged.setup.judging.out)
    np.testing.assert_array_equal(judged.labels, held.labels)
    np.testing.assert_array_equal(judged.clusters, held.group("position"))
    assert judged.by == ("position",)
    assert judged.reduced("bands").steps == 0
    assert judged.reduced("stages").steps == 2


def test_a_size_that_the_windows_do_not_allow_is_named():
    """Thirty frames have no spectrum; with no size left each reason is named."""
    short = skin()
    short = replace(short, samples=short.samples[:, :30])
    judged = dial.judge(short, Run(1), CLOSED, ["bands", "64"])
    assert list(judged.sizes) == ["64"]
    assert "spectrum" in judged.refused["bands"]
    with pytest.raises(FormatError, match="30 frames"):
        dial.judge(short, Run(1), CLOSED, ["bands"])


@pytest.fixture
def costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fixed costs in the order of the sizes, without fits and bundles."""

    def fixed(
        fits: dict[str, Fit], sweeps: Dataset, log: object
    ) -> tuple[dict[str, BundleCost], dict[str, str]]:
        return {n: BundleCost(0.1 * i, 10.0 * i, 50.0, 1.0) for i, n in enumerate(fits, 1)}, {}

    monkeypatch.setattr(dial, "bundle_costs", fixed)
    at = np.arange(96)
    judged = judgement(bands=at % 3 > 0, pairs=at % 12 > 0, all=at % 12 > 0)
    monkeypatch.setattr(dial, "judge", lambda *args: judged)
    monkeypatch.setattr(dial.Judgement, "first_equals", lambda self: {n: n for n in self.sizes})
    monkeypatch.setattr(dial.Judgement, "fit", lambda self, name: cast(Fit, name))


def chosen(**budget: float) -> dial.Selection:
    """The choice on the skin within these limits."""
    wanted = SizeWish(Budget(**budget), sizes=("bands", "pairs", "all"))
    return dial.choose(skin(), Run(1), CLOSED, wanted)


@pytest.mark.usefixtures("costs")
def test_what_is_over_the_budget_is_not_chosen():
    """The best of the others, with each limit; without limits the smallest."""
    assert chosen().chosen == "pairs"
    for budget in ({"ms": 0.15}, {"kb": 15}, {"ms": 0.3, "slower": 2.0}):
        found = chosen(**budget)
        assert (found.chosen, found.order) == ("bands", ["bands"])
        assert "over the budget" in found.why_not["pairs"]
    assert chosen(kb=15).why_not["pairs"].endswith(": 20 kb of 15")


@pytest.mark.usefixtures("costs")
def test_nothing_fits(monkeypatch: pytest.MonkeyPatch):
    """The nearest size with its limit; what cannot be packed with the reason."""
    nearest = r"nearest is bands, over the budget: 10 kb of 5: raise the budget"
    with pytest.raises(NothingFits, match=nearest):
        chosen(kb=5)
    refused = dict.fromkeys(("bands", "pairs", "all"), "too few recordings")
    monkeypatch.setattr(dial, "bundle_costs", lambda *args: ({}, refused))
    with pytest.raises(NothingFits, match="few recordings"):
        chosen()


@pytest.mark.usefixtures("costs")
def test_the_result_has_every_size_with_its_reason():
    """The chosen size between its neighbours, in the order of cost."""
    result = chosen(kb=25).json()
    assert [line["method"] for line in result["rungs"]] == ["bands", "pairs", "all"]
    assert (result["chosen"], result["smaller"]["method"]) == ("pairs", "bands")
    assert result["smaller"]["low"] > 0
    assert result["larger"] is None
    assert result["rungs"][2]["why_not"].endswith(": 30 kb of 25")
    assert result["honest"]["mean"] == pytest.approx(result["accuracy"]["mean"], abs=0.05)
    assert result["confused"] == sorted(result["confused"], key=lambda pair: -pair["share"])
    json.dumps(result, allow_nan=False)


def reduced(sweeps: Dataset, kind: str, wanted: float = 0.0) -> tuple[dict[str, Any], Change]:
    """The curve of one kind for the size "pairs", and the change of the fit."""
    judged = dial.judge(sweeps, Run(1), CLOSED, ["pairs"])
    some = SizeWish(accuracy=wanted, sizes=("pairs",))
    cost = {"pairs": BundleCost(0.1, 10, 50, 1)}
    choice = dial.Selection(judged, some, ["pairs"], cost, {}, "pairs", cast(Any, None))
    (curve,), change = reduction_curves.curves(choice, [kind])
    return curve, change


@pytest.mark.slow
def test_two_taxels_are_all_that_is_needed():
    """The third and the fifth of six have all the information; nothing is applied."""
    curve, change = reduced(skin(taxels=(2, 4)), "taxels")
    assert curve["kept"] == "2 taxels"
    assert curve["taxels"] == [[2, 0], [4, 0]]
    assert [point["fine"] for point in curve["points"]] == [True, True, True, False]
    assert (curve["applied"], change) == (False, WHOLE)
    assert curve["set"].startswith("connect only these")


@pytest.mark.slow
def test_a_shorter_window_is_applied_and_what_cannot_be_is_reported():
    """Half of the frames are enough; a window that is too short ends the curve with the reason."""
    curve, change = reduced(skin(), "window")
    assert curve["applied"]
    assert change.window < 1
    short = skin()
    curve, _ = reduced(replace(short, samples=short.samples[:, :48]), "window")
    assert "too short" in curve["points"][-1]["refused"]


@pytest.mark.slow
def test_rate_and_bits_are_reported():
    """White noise needs neither all frames nor all bits; how to set the sensor is said."""
    curve, change = reduced(skin(), "rate")
    assert curve["kept"] == "all" or "readout board" in curve["set"]
    curve, change = reduced(skin(), "bits")
    assert curve["kept"] == "all" or "converter" in curve["set"]
    assert change == WHOLE


def test_less_does_not_fall_below_what_is_wanted():
    """A loss within the error is refused below the wanted accuracy."""
    less = missing(slice(1))

    def choice(wanted: float) -> dial.Selection:
        judged, wish = judgement(all=EVERYTHING), SizeWish(accuracy=wanted)
        return dial.Selection(judged, wish, ["all"], {}, {}, "all", cast(Any, None))

    assert reduction_curves.fine(choice(0.9), EVERYTHING, less)
    assert not reduction_curves.fine(choice(0.995), EVERYTHING, less)
    assert reduction_curves.fine(choice(1.0), less, less)


@pytest.mark.slow
def test_materials_that_look_alike_are_proposed_as_one():
    """With one taxel of information a and c, b and d are alike; only proposed."""
    sweeps = skin(taxels=(0, 5))
    blind = sweeps.samples.copy()
    blind[:, :, 5] = blind[:, :, 4]
    curve, change = reduced(replace(sweeps, samples=blind), "classes", 0.9)
    assert sorted(map(sorted, curve["proposed"])) == [["a", "c"], ["b", "d"]]
    assert [point["name"] for point in curve["points"]] == ["4", "3", "2"]
    assert curve["points"][-1]["accuracy"]["mean"] > 0.9
    assert (curve["applied"], change) == (False, WHOLE)
    assert not reduced(skin(), "classes", 0.9)[0]["proposed"]


def command(folder: Path, *more: str) -> list[str]:
    """`fit` with a scene beside the set."""
    skin().save(folder / "skin.npz")
    (folder / "scene.toml").write_text('set = ["skin.npz"]\nbudget-ms = 1000\nslower = 3\n')
    scene, out = folder / "scene.toml", folder / "mine.npz"
    return ["fit", "--scene", str(scene), "--seed", "1", "--out", str(out), *more]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bundles are packed and not timed."""
    one = BundleCost(0.5, 12.0, 50.0, 0.6)
    monkeypatch.setattr(measure, "measure_all", lambda folders, sweeps: [one] * len(folders))


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_the_command_fits_what_it_chose_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Fit and --rest have its window; the page is whole."""
    rest = tmp_path / "rest.npz"
    more = ["--size", "pairs", "--reduce", "window", "classes", "--accuracy", "0.8"]
    more += ["--split", "place:0.75", "--rest", str(rest)]
    assert main(command(tmp_path, *more)) == 0
    result = json.loads((tmp_path / "mine-why" / "choice.json").read_text())
    made = Fit.load(tmp_path / "mine.npz")
    assert result["chosen"] == made.about["size"] == "pairs"
    frames = round(120 * result["applied"]["window"])
    assert made.train.format.window == result["bundle"]["format"]["window"] == frames < 120
    assert sets.load(str(rest)).format == made.train.format
    assert result["bundle"]["used"] == {"ms": 0.002}
    assert result["command"].startswith("palpate-train fit --")
    assert {"commit", "machine", "digest", "seeds"} <= result.keys()
    page = (tmp_path / "mine-why" / "index.html").read_text()
    assert "http" not in page.replace("http://www.w3.org", "")
    output = capsys.readouterr().out
    assert "pairs with" in output
    assert ": 80 %" in output


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_a_reduction_that_cannot_be_packed_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The fit is that of whole sweeps, and the page says why."""

    def never(*args: object) -> None:
        raise FormatError("too few frames")

    monkeypatch.setattr(dial, "reduced", never)
    assert main(command(tmp_path, "--size", "pairs", "--reduce", "window")) == 0
    assert Fit.load(tmp_path / "mine.npz").train.format.window == 120
    assert "not shortened" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_what_is_wanted_and_not_reached_is_said_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The best is reported and fitted although it misses the wanted accuracy."""
    assert main(command(tmp_path, "--size", "bands", "--accuracy", "0.99")) == 0
    printed = capsys.readouterr().out
    assert "Not reached: 99 %" in printed
    assert 'class="stop">' in (tmp_path / "mine-why" / "index.html").read_text()
    assert Fit.load(tmp_path / "mine.npz").about["size"] == "bands"


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["--slower", "3"], "needs --budget-ms"),
        (["--budget-ms", "0"], "--budget-ms 0"),
        (["--accuracy", "90"], "--accuracy 90"),
        ([], "--set, or"),
    ],
)
def test_wishes_that_make_no_sense_are_refused_first(
    more: list[str], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Before any set is read."""
    named = ["--set", "none.npz"] if more else []
    assert main(["fit", *named, "--seed", "1", "--out", str(tmp_path / "x.npz"), *more]) != 0
    assert why in capsys.readouterr().err


def test_every_size_has_a_name():
    """The family ends with everything, and limits are infinite by default."""
    assert list(dial.FAMILY)[-1] == dial.ALL
    assert Budget() == Budget(math.inf, math.inf, 1.0)
