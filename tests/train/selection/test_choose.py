"""The choice of the smallest sufficient model within the budget, its unbiased figure, and
reductions of the sweeps."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import onnx
import pytest

from appliance.bundle import bundle
from appliance.core.errors import FormatError
from train.cli.main import main
from train.data.progress import Progress, ProgressLine
from train.data.sets import Dataset
from train.evaluation import evaluate
from train.evaluation.evaluate import Where
from train.export import measure
from train.models import methods
from train.models.methods import FULL_EFFORT, Method
from train.onnx_tools.graph_builder import GraphBuilder, run
from train.selection import nested_cv, reduction_curves, scene, select
from train.selection.select import BundleCost

HERE = Where(jobs=1, cache=None)


@dataclass
class Powers:
    """Answers with the material with the nearest log power on each taxel; taxels from `first` on
    are ignored."""

    means: np.ndarray
    first: int
    sweeps: Dataset

    def graph(self) -> onnx.ModelProto:
        """The graph from `sweep` to `logits`."""
        g, form = GraphBuilder(), self.sweeps.format
        x = g("Cast", "sweep", to=1)
        x = g("Sub", x, g("ReduceMean", x, axes=[1], keepdims=1))
        power = g("ReduceMean", g("Mul", x, x), axes=[1], keepdims=0)
        seen = g(
            "Log", g("Reshape", g("Add", power, g.constant(0.01)), g.constant([1, -1], "int64"))
        )
        means = self.means * (np.arange(form.rows * form.cols) < self.first)
        inner = g("MatMul", seen, g.constant(8 * means.T))
        g("Add", inner, g.constant(-4 * (means**2).sum(1)), output="logits")
        return g.model(form, "logits", len(means))

    def logits(self, given: np.ndarray) -> np.ndarray:
        """The logits of the graph."""
        return run(self.graph(), given)


def learn(sweeps: Dataset, given: np.ndarray, seed: int, first: int = 99) -> Powers:
    """Train the fake, which needs four frames."""
    if given.shape[1] < 4:
        raise FormatError(f"a window of {given.shape[1]} frames is too short; use at least 4")
    seen = np.log(given.astype(float).var(axis=1).reshape(len(given), -1) + 0.01)
    there = [
        seen[sweeps.labels == k].mean(0) if (sweeps.labels == k).any() else 0 * seen[0] - 9
        for k in range(len(sweeps.materials))
    ]
    return Powers(np.stack(there).astype(np.float32), first, sweeps)


def guess(sweeps: Dataset, given: np.ndarray, seed: int, number: int = 0) -> Powers:
    """A method without information: its means are drawn at random."""
    drawn = np.random.default_rng(number).standard_normal((len(sweeps.materials), given[0, 0].size))
    return Powers(3 + drawn.astype(np.float32), 99, sweeps)


def skin(
    places: int = 8, each: int = 3, taxels: tuple[int, ...] = (0, 1), noise: float = 0.15
) -> Dataset:
    """Four materials at several places. Each of the named taxels has half of the information, in
    the strength of its signal."""
    labels = np.tile(np.arange(4), places * each)
    rng = np.random.default_rng(3)
    bits = np.stack([labels % 2, labels // 2], axis=1)
    strength = 3 * np.exp(noise * rng.standard_normal((len(labels), 6)))
    for taxel, bit in zip(taxels, bits.T, strict=True):
        strength[:, taxel] *= 1 + 2 * bit
    x = 100 + strength[:, None] * rng.standard_normal((len(labels), 60, 6))
    groups = {
        "place": np.repeat(np.arange(places), 4 * each),
        "day": np.repeat(np.arange(places) % 4, 4 * each),
    }
    return Dataset(
        np.rint(x).astype(np.int16)[..., None], labels, ("a", "b", "c", "d"), 100.0, groups, "skin"
    )


FAKES = {
    f"see-{n}": Method(f"see-{n}", f"{n} taxels", "raw", partial(learn, first=n))
    for n in (1, 2, 4, 6)
}
COSTS = {name: BundleCost(0.1 * (i + 1), 10.0 * (i + 1), 50.0) for i, name in enumerate(FAKES)}


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A function that replaces the real methods by fakes with fixed costs."""

    def put(known: dict[str, Method] = FAKES, costs: dict[str, BundleCost] = COSTS) -> None:
        monkeypatch.setattr(methods, "every", lambda effort=FULL_EFFORT: known)
        monkeypatch.setattr(methods, "module_of", lambda name: "train.models.methods")
        monkeypatch.setattr(select, "candidates", lambda asked: list(known))
        monkeypatch.setattr(select, "bundle_costs", lambda *args: costs)

    put()
    return put


def asked(**more) -> scene.Scene:
    """A scene in which the place varies."""
    return scene.Scene(
        **{"name": "drawer", "varies": ("place",), "folds": 3, "path": Path("scene.toml"), **more}
    )


def chosen(sweeps: Dataset, where: Where = HERE, **more) -> select.Selection:
    """The choice for a scene."""
    return select.choose(sweeps, asked(**more), FULL_EFFORT, where, lambda line: None)


def parts_of(sweeps: Dataset, **more) -> nested_cv.Trials:
    """Trials before the first run."""
    return nested_cv.Trials(
        sweeps, asked(**more), FULL_EFFORT, HERE, Progress(0, lambda line: None)
    )


@cache
def two() -> Dataset:
    """A skin whose first two taxels have all the information."""
    return skin()


def test_the_smallest_that_will_do_is_taken(fakes):
    """One taxel has half of the information, two have all. The model with two is chosen, with
    reasons against less and more; four and six are not tried."""
    choice = chosen(two())
    result = choice.json(asked())
    assert result["chosen"] == "see-2"
    assert result["smaller"]["method"] == "see-1"
    assert result["smaller"]["low"] > 0.3
    assert result["honest"]["chose"] == {"see-2": 3}
    assert result["honest"]["mean"] > 0.95
    assert result["next"] == "see-4"
    assert "even a faultless one" in {r["method"]: r["why_not"] for r in result["rungs"]}["see-4"]


def test_the_cheapest_is_taken_where_it_suffices(fakes):
    """Two materials can be distinguished by the first taxel."""
    sweeps = two().take(two().labels < 2).select(())
    choice = chosen(sweeps)
    assert choice.final.chosen == "see-1"
    assert choice.json(asked())["smaller"] is None


def test_a_gain_within_the_error_is_no_reason(fakes):
    """A gain at one place only does not justify a larger model; a small gain at all places does."""
    better = np.ones((1, len(two())))
    here, everywhere = better.copy(), better.copy()
    here[0, :3] = 0
    everywhere[0, ::12] = 0
    assert (
        select.SizeSearch(parts_of(two()), None, {"cheap": here, "dear": better}).chosen == "cheap"
    )
    assert (
        select.SizeSearch(parts_of(two()), None, {"cheap": everywhere, "dear": better}).chosen
        == "dear"
    )


def test_the_search_in_a_family_ends_where_larger_ones_change_nothing(fakes):
    """Two larger models without a gain end the search, unless the second is better than the first;
    other families continue."""
    half, more = np.zeros((2, 1, len(two())))
    half[0, ::2], more[0] = 1, 1
    more[0, ::6] = 0
    one = select.SizeSearch(parts_of(two()), None, {"L-a": half})
    known = {"net-1": 0 * half, "net-2": 0 * half, "net-4": more}
    one.trials.scores = lambda name, aside: known[name]  # what training would give
    for name in ("net-1", "net-2"):
        assert not one.enough(name)
        one.add(name)
    assert one.enough("net-4") == "not tried: 2 larger ones of its family changed nothing"
    assert not one.enough("H-a")
    known["net-2"] = half / 2 + more / 8  # still below L-a, but rising
    rising = select.SizeSearch(one.trials, None, {"L-a": half})
    for name in ("net-1", "net-2"):
        rising.add(name)
    assert not rising.enough("net-4")
    rising.add("net-4")
    assert rising.chosen == "net-4"


def test_the_order_is_that_of_cost(fakes):
    """With other costs, the same methods give another choice: the cheapest, although it uses more
    taxels."""
    fakes(costs={name: replace(COSTS[name], kb=100 - COSTS[name].kb) for name in reversed(FAKES)})
    assert chosen(two()).final.chosen == "see-6"


def test_what_is_over_the_budget_is_not_tried(fakes):
    """Time on the board, size and memory are each named with their limit. The best of the others is
    chosen, whether or not it reaches the wanted accuracy."""
    for budget in ({"ms": 0.3, "slower": 2.0}, {"kb": 15}):
        choice = chosen(two(), budget=scene.Budget(**budget))
        assert choice.final.chosen == "see-1"
        assert choice.why_not["see-2"].startswith("over the budget: ")
    assert choice.why_not["see-2"] == "over the budget: 20 kb of 15"


def test_nothing_fits(fakes):
    """The nearest model is named with the exceeded limit."""
    with pytest.raises(
        select.NothingFits, match=r"nearest is see-1, over the budget: 10 kb of 5: raise the budget"
    ):
        chosen(two(), budget=scene.Budget(kb=5))
    short = replace(two(), samples=two().samples[:, :3])
    with pytest.raises(
        select.NothingFits, match="see-6 cannot be used here: a window of 3 frames is too short"
    ):
        chosen(short)


def test_a_method_that_is_refused_does_not_stop_the_others(fakes):
    """A method without a cost, or with a refused training: the reason is reported, and the others
    are tried."""
    never = Method(
        "see-0", "refuses", "raw", lambda sweeps, given, seed: learn(sweeps, given[:, :1], seed)
    )
    fakes(
        {"see-0": never, **FAKES, "bad": never},
        {"see-0": BundleCost(0.01, 1, 1), **COSTS, "bad": BundleCost(refused="no graph")},
    )
    choice = chosen(two())
    assert choice.final.chosen == "see-2"
    assert (choice.why_not["see-0"], choice.why_not["bad"]) == (
        "a window of 1 frames is too short; use at least 4",
        "no graph",
    )
    json.dumps(choice.json(asked()), allow_nan=False)


@pytest.mark.slow
def test_the_nested_figure_is_not_optimistic(fakes):
    """The best of sixteen guessing methods looks good; the choice, judged on parts that it did not
    use, is a guess."""
    known = {
        f"g{i}-": Method(f"g{i}-", "guesses", "raw", partial(guess, number=i)) for i in range(16)
    }
    fakes(known, {name: BundleCost(0.1, 10 + i, 50) for i, name in enumerate(known)})
    sweeps = skin(places=6, each=2)
    sweeps = sweeps.take(sweeps.labels < 2).select(())
    shuffled = replace(sweeps, labels=np.random.default_rng(8).permutation(sweeps.labels))
    choice = chosen(shuffled, folds=3)
    best = choice.trials.mean(choice.final.scores[choice.final.best])
    nested = choice.trials.mean(choice.nested)
    assert best > 0.6
    assert nested < best - 0.08
    assert nested == pytest.approx(0.5, abs=0.1)


def test_an_inner_choice_never_sees_its_part(fakes):
    """The part is neither trained on nor tested on, in all trainings and in all scores of the inner
    choice."""
    trials = parts_of(two(), varies=("place", "day"))
    for p, part in enumerate(trials.parts):
        for tested, unseen in trials.seen_from(p).items():
            train, test = trials._split(unseen)
            assert not part.out[train].any()
            assert trials.parts[tested].out[test % len(two())].any()
        trials.run("see-1", list(trials.seen_from(p).values()))
        scores = trials.scores("see-1", p)
        assert np.isnan(scores[:, part.out]).all()
        assert np.isfinite(scores[:, ~part.out]).all()


def test_the_error_is_that_of_what_fails_together(fakes):
    """The same loss at one place has a larger error than at all places; no loss has no error."""
    trials = parts_of(two())
    ones = np.ones((1, len(two())))
    here, everywhere = ones.copy(), ones.copy()
    here[0, :12] = 0
    everywhere[0, ::8] = 0
    assert trials.difference(ones, here).mean == trials.difference(ones, everywhere).mean == 0.125
    assert trials.difference(ones, here).se == pytest.approx(0.125)  # of eight places one failed
    assert trials.difference(ones, everywhere).se == pytest.approx(
        np.std(everywhere, ddof=1) / np.sqrt(96)
    )
    assert trials.difference(ones, ones).json() == {"mean": 0, "se": 0, "low": 0, "high": 0}


def test_corruptions_count_like_sweeps_as_recorded(fakes):
    """Each condition has its figure, and the accuracy is their mean."""
    choice = chosen(skin(each=2), stress={"noise": 0.5})
    result = choice.json(asked())
    assert [c["name"] for c in result["conditions"]] == ["as recorded", "noise 0.5 deviations"]
    assert result["accuracy"]["mean"] == pytest.approx(
        np.mean([c["accuracy"] for c in result["conditions"]]), abs=1e-3
    )


@pytest.mark.parametrize(
    ("sweeps", "varies", "why"),
    [
        (skin(places=1), ("place",), "group 'place' has one value, 0; take it out"),
        (skin(places=2), ("place",), "a group that varies needs three values"),
        (
            skin().take((np.arange(96) % 4 != 3) | (np.arange(96) < 12)),
            ("place",),
            "without place 0.* there is no 'd' to",
        ),
        (skin(places=1, each=2), (), "random:3 needs 3 recordings of each material"),
    ],
)
def test_a_scene_that_cannot_be_judged_is_refused(
    fakes, sweeps: Dataset, varies: tuple[str, ...], why: str
):
    """Too few values of a group, or a material that has only one of them, is refused before any
    training."""
    with pytest.raises(FormatError, match=why):
        chosen(sweeps, varies=varies)


def test_parts_are_whole_and_few():
    """All values of a group are in exactly one part; five parts at most, or as many as
    requested."""
    found = nested_cv.parts(two(), ("place", "day"))
    assert [p.group for p in found] == ["place"] * 4 + ["day"] * 4
    assert np.sum([p.out for p in found[:4]], axis=0).tolist() == [1] * 96
    assert len(nested_cv.parts(two(), ("place",))) == 5
    assert len(nested_cv.parts(two(), ("place",), folds=8)) == 8
    assert [p.values for p in nested_cv.parts(two(), ("day",))] == [
        p.values for p in nested_cv.parts(two(), ("day",))
    ]
    assert len(nested_cv.parts(two(), ())) == 5


def reduced(sweeps: Dataset, **more) -> dict[str, dict]:
    """The curves of a scene by reduction, and under "change" the reduction for the bundle."""
    wish = asked(**more)
    result, change, accuracy = reduction_curves.curves(chosen(sweeps, **more), wish)
    return {curve["kind"]: curve for curve in result} | {"change": change, "accuracy": accuracy}


def test_two_taxels_are_all_that_is_needed(fakes):
    """Of six taxels, the third and the fifth have all the information: these two are kept, and one
    alone is not enough."""
    fakes({"see-6": FAKES["see-6"]}, {"see-6": COSTS["see-6"]})
    found = reduced(skin(taxels=(2, 4)), reduce=("taxels",), apply=("taxels",))
    assert found["taxels"]["kept"] == "2 taxels"
    assert found["taxels"]["taxels"] == [[2, 0], [4, 0]]
    assert [p["fine"] for p in found["taxels"]["points"]] == [True, True, True, False]
    assert found["change"].taxels == (2, 4)
    assert found["accuracy"]["mean"] > 0.95


def hum(slow: float, fast: float, places: int = 4) -> Dataset:
    """Two materials that differ in the strength of an oscillation of 40 frames, of one of two
    frames, or of both."""
    labels = np.tile([0, 1], places * 3)
    rng = np.random.default_rng(2)
    strength = np.exp(0.3 * rng.standard_normal((2, len(labels), 1)))
    swing = (
        strength[0]
        * slow ** labels[:, None]
        * np.sin(2 * np.pi * (np.arange(160) / 40 + rng.random((len(labels), 1))))
    )
    edge = 9 * strength[1] * fast ** labels[:, None] * np.cumprod(-np.ones(160))
    x = 100 + swing + edge + 0.1 * rng.standard_normal((len(labels), 160))
    groups = {"place": np.repeat(np.arange(places), 6)}
    return Dataset(x.astype(np.float32)[..., None, None], labels, ("a", "b"), 200.0, groups, "hum")


def test_a_low_rate_is_enough_for_slow_things(fakes):
    """Averaging removes the fast noise: the lowest rate is kept, with the setting for it; nothing
    is applied without a request."""
    found = reduced(hum(slow=5, fast=1), reduce=("rate",))
    assert found["rate"]["kept"] == "25 Hz"
    assert found["rate"]["set"] == "set the readout board to average 8 frames and send one"
    assert found["rate"]["applied"] is False
    assert found["change"] == reduction_curves.WHOLE


def test_a_rate_that_is_needed_is_kept(fakes):
    """Materials that differ only in the fast part: half the rate loses it, and the curve ends after
    the fall."""
    found = reduced(hum(slow=1, fast=5), reduce=("rate",), apply=("rate",))
    assert (found["rate"]["kept"], found["change"].rate) == ("all", 1)
    assert [p["fine"] for p in found["rate"]["points"]] == [True, False, False]


@pytest.mark.slow
def test_a_shorter_window_is_applied_and_what_cannot_be_is_reported(fakes):
    """Sixty frames are more than needed; the fake refuses fewer than four, and the curve states
    it."""
    found = reduced(two(), reduce=("window",))
    assert found["window"]["kept"] == "0.15 s"
    assert found["window"]["applied"] is True
    assert found["change"].window == 0.25
    short = reduced(replace(two(), samples=two().samples[:, :12]), reduce=("window",))["window"]
    assert short["points"][-1]["refused"] == "a window of 3 frames is too short; use at least 4"


def test_less_does_not_fall_below_what_is_wanted(fakes):
    """A loss within the error is refused if the whole sweeps reach the wanted accuracy and the
    reduced ones do not."""
    trials = parts_of(two())
    full, less = np.ones((2, 1, len(two())))
    less[0, 0] = 0
    assert reduction_curves._fine(trials, asked(accuracy=0.9), full, less)
    assert not reduction_curves._fine(trials, asked(accuracy=0.995), full, less)
    assert reduction_curves._fine(trials, asked(accuracy=1.0), less, less)


@pytest.mark.slow
def test_materials_that_look_alike_are_proposed_as_one(fakes):
    """Only the first taxel has information, and it cannot distinguish a from c and b from d. The
    pairs are proposed and not applied."""
    sweeps = skin(taxels=(0, 0))
    strength = replace(
        sweeps,
        samples=np.where(
            np.arange(6)[:, None] == 0, skin().samples, skin(taxels=(5, 5)).samples[:, :, :1]
        ),
    )
    found = reduced(strength, reduce=("classes",), accuracy=0.9)["classes"]
    assert sorted(map(sorted, found["proposed"])) == [["a", "c"], ["b", "d"]]
    assert [p["name"] for p in found["points"]] == ["4", "3", "2"]
    assert found["points"][-1]["accuracy"]["mean"] > 0.9
    assert not reduced(two(), reduce=("classes",), accuracy=0.9)["classes"]["proposed"]


@pytest.mark.slow
def test_an_interrupted_choice_continues(fakes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Finished trainings do not run again, and the choice is the same."""
    where, calls, train = Where(jobs=1, cache=tmp_path), [], evaluate.run

    def counted(*args):
        calls.append(1)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return train(*args)

    monkeypatch.setattr(evaluate, "run", counted)
    with pytest.raises(KeyboardInterrupt):
        chosen(two(), where)
    first = chosen(two(), where).json(asked())
    assert len(calls) == 8 + 2 * 6 - 7
    assert chosen(two(), where).json(asked()) == first
    assert len(calls) == 8 + 2 * 6 - 7


def test_all_trainings_have_one_count(fakes):
    """From the first candidate to the last reduction, the count never restarts, and the largest
    number left only falls."""
    lines: list[ProgressLine] = []
    wish = asked(reduce=("window", "taxels", "classes"), apply=("window",))
    choice = select.choose(
        two(),
        wish,
        FULL_EFFORT,
        HERE,
        lines.append,
        lambda t: reduction_curves.most(t, wish.reduce),
    )
    before = len(lines)
    reduction_curves.curves(choice, wish)
    assert [line.done for line in lines] == [*range(1, len(lines) + 1)]
    totals = [line.total for line in lines]
    assert totals == sorted(totals, reverse=True)
    assert totals[0] == 4 * 6 + (1 + 3 + 1 + 3) * 3
    assert before < len(lines) <= totals[-1]
    assert lines[-1].endswith("(see-2, taxels 1)")


@pytest.mark.slow
@pytest.mark.thorough  # a whole choice
def test_the_command_packs_what_it_chose_and_says_why(tmp_path: Path, capsys):
    """With real methods and a real bundle, L-features suffice and are packed; the page loads
    nothing from elsewhere."""
    skin().save(tmp_path / "skin.npz")
    (tmp_path / "scene.toml").write_text(
        'name = "drawer"\nsets = ["skin.npz"]\nmaterials = ["a", "d"]\nvaries = ["place"]\n'
        "folds = 3\naccuracy = 0.8\n"
        'methods = ["L-svm", "L-gauss"]\nreduce = ["window", "classes"]\n[budget]\n'
        "ms = 50\nkb = 500\nmb = 500\nslower = 3\n"
    )
    args = [
        "choose",
        "--scene",
        str(tmp_path / "scene.toml"),
        "--out",
        str(tmp_path / "b"),
        "--jobs",
        "1",
        "--cache",
        str(tmp_path / "c"),
    ]
    assert main(args) == 0
    result = json.loads((tmp_path / "b-why" / "choice.json").read_text())
    packed = bundle.load(tmp_path / "b")
    assert result["chosen"] == packed.manifest.made["method"]
    assert (packed.manifest.name, packed.manifest.labels) == ("drawer", ("a", "d"))
    assert (
        packed.format.window
        == result["bundle"]["format"]["window"]
        == round(60 * result["applied"]["window"])
    )
    nested = packed.manifest.figures["the choice, made without each part and tested on it"]
    assert nested["accuracy"] == result["honest"]["mean"] > 0.9
    assert 0 < max(result["bundle"]["used"].values()) < 1
    assert {"commit", "machine", "digest", "seeds", "command"} <= result.keys()
    page = (tmp_path / "b-why" / "index.html").read_text()
    assert "http" not in page.replace("http://www.w3.org", "")
    output = capsys.readouterr().out
    assert f"{result['chosen']} with" in output or f"{result['chosen']} is enough" in output
    assert "Reached: 80 % is wanted" in output
    assert main(args) == 0  # again, from what is kept
    assert json.loads((tmp_path / "b-why" / "choice.json").read_text())["rungs"] == result["rungs"]


@pytest.mark.slow
def test_what_is_wanted_and_not_reached_is_said_first(
    fakes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    """The best is reported and packed although it misses the wanted accuracy."""
    monkeypatch.setattr(measure, "memory", lambda folder, sweeps: {"rss_mib": 50.0, "foreign": []})
    hard = skin(noise=0.9)
    hard.save(tmp_path / "skin.npz")
    (tmp_path / "scene.toml").write_text(
        'sets = ["skin.npz"]\nvaries = ["place"]\naccuracy = 0.99\nreduce = []\n'
    )
    scene_file, out, cache = (str(tmp_path / name) for name in ("scene.toml", "b", "c"))
    assert (
        main(["choose", "--scene", scene_file, "--out", out, "--jobs", "1", "--cache", cache]) == 0
    )
    printed = capsys.readouterr().out
    assert "Not reached: 99 % is wanted" in printed
    assert printed.splitlines()[-1].endswith(
        f"palpate-train report {out} --set SET --out report.html"
    )
    assert 'class="stop">Not reached' in (tmp_path / "b-why" / "index.html").read_text()
    assert bundle.load(tmp_path / "b").manifest.name == "scene"


def test_cheap_is_what_takes_little_of_the_scarcer():
    """Cost is the larger of the shares of time and storage; without a budget the size; among equals
    the time."""
    small, fast = BundleCost(0.4, 20, 60), BundleCost(0.1, 40, 50)
    tight = {
        "time": scene.Budget(ms=1, kb=1000, slower=2),
        "storage": scene.Budget(ms=100, kb=50),
        "none": scene.Budget(),
    }
    cheaper = {
        name: min((small, fast), key=lambda cost: cost.order(b)) for name, b in tight.items()
    }
    assert cheaper == {"time": fast, "storage": small, "none": small}
    assert BundleCost(0.1, 20, 50).order(scene.Budget()) < small.order(scene.Budget())
    assert small.used(tight["time"]) == {"ms": 0.8, "kb": 0.02}
