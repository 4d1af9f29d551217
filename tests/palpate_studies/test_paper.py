"""The paper's experiment: the fused sweeps, the counts of results, and its page, a single file."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.sim.skin import MATERIALS
from palpate_studies import paper_experiment, paper_report, paper_values, study
from palpate_studies.command import main
from palpate_studies.paper_experiment import Outcome, Step
from palpate_studies.paper_stamps import Stamp, stamps
from palpate_studies.study import StudyCase, StudyRun, save
from palpate_train.evaluate.evaluate import Where
from palpate_train.models.recipe.sizes import SIZES
from palpate_train.reports.html import picture
from tests.factories.page_reader import PageReader
from tests.factories.study_pages import published

SURE = 9.0
DOI = "https://doi.org/10.1109/IROS.2016.7758088"
FIGURES = [f"figure-{n}" for n in (4, 5, 6, 7, 9, 10, 11, 12, 13)] + ["methods"]


def outcome(part: str, method: str, seed: int = 1, right: float = 0.8, places: int = 3) -> Outcome:
    """An invented outcome: 4 sweeps of each material at each position, `right` of them correct.

    All others are taken for the next material.
    """
    labels = np.tile(np.repeat(np.arange(6), 4), places)
    place = np.repeat(np.arange(places), 24) + 10_000 * seed
    given = np.where(
        np.random.default_rng(seed).random(len(labels)) < right, labels, (labels + 1) % 6
    )
    confusion = np.zeros((6, 6), int)
    np.add.at(confusion, (labels, given), 1)
    about = {
        "part": part,
        "method": method,
        "seed": seed,
        "materials": list(MATERIALS),
        "machine": "abacus, 2 cores",
        "confusion": confusion.tolist(),
        "fit_s": 1.5,
        "ms_p50": 0.25,
        "ran": "7 beads" if "cnn" in method else "",
        "commit": "c0ffee<",
    }
    costs = [np.array([[1, 1.7], [7, 0.5]])] * 2 if "cnn" in method else []
    return Outcome(
        part, method, seed, labels, SURE * np.eye(6, dtype=np.float32)[given], place, costs, about
    )


def summary(quick: bool = False, cnn: bool = True) -> dict[str, Any]:
    """The results of invented outcomes, read back from their file."""
    outcomes = [
        outcome(p, m, w)
        for p in paper_experiment.FULL
        for m in (*paper_experiment.BASELINES, "static-svm", "palpate-reattached")
        for w in (1, 2)
    ]
    outcomes += [outcome(p, "paper-cnn", right=0.9) for p in ("lopo", "hard") if cnn]
    more = {"quick": quick}
    return json.loads(study.text(paper_experiment.summary(outcomes, paper_experiment.FULL) | more))


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    """A summary for many tests."""
    return summary()


@pytest.fixture(scope="module")
def made(results: dict[str, Any]) -> tuple[str, dict[str, str]]:
    """The page of the summary and its pictures."""
    return paper_report.render(results)


def test_printed_numbers_are_the_papers():
    """One number of each figure by hand. Rows of the confusion matrix sum to one, rounded. .917 is
    55 of 60.
    """
    assert [
        paper_values.ACCURACY[p][m]
        for p, m in (("lab", "H-svm"), ("lopo", "H-knn"), ("random", "L-svm"), ("hard", "L-knn"))
    ] == [0.96, 0.75, 0.83, 0.58]
    assert round(55 / 60, 3) == paper_values.ACCURACY["hard"]["paper-cnn"]
    assert np.allclose(paper_values.CONFUSION.sum(1), 1, atol=0.011)


def test_objects_begin_with_every_sweep_once_and_mix_nothing():
    """The sweeps of an object are different, and of one material and position.

    There are as many as the smallest group of a material and a position has.
    """
    o = outcome("lopo", "H-svm")
    keep = np.arange(len(o.labels)) != 5
    labels, place = o.labels[keep], o.place[keep]
    drawn = paper_experiment.objects(labels, place, seed=1)
    assert drawn.shape == (71, 3)
    assert drawn[:, 0].tolist() == list(range(71))
    assert (labels[drawn] == labels[:, None]).all()
    assert (place[drawn] == place[:, None]).all()
    assert all(len(set(row)) == 3 for row in drawn.tolist())
    assert np.array_equal(drawn, paper_experiment.objects(labels, place, seed=1))
    assert not np.array_equal(drawn, paper_experiment.objects(labels, place, seed=2))


def test_two_votes_give_what_the_first_gave_and_a_product_can_be_better():
    """Half of the sweeps are correct with a high probability, half are narrowly wrong.

    Votes of two sweeps stay at .5. Products exceed that.
    """
    o = outcome("lopo", "H-svm", right=1)
    weak = np.arange(len(o.labels)) % 2 == 0
    o.logits[weak] = np.eye(6)[(o.labels[weak] + 1) % 6]
    by = paper_experiment.several([o])
    assert [by["vote"][n][0] for n in (0, 1)] == [0.5, 0.5]
    assert by["product"][0][0] == 0.5
    assert by["product"][1][0] > 0.7
    assert all(low <= mean <= high for lines in by.values() for mean, low, high in lines)


def test_exploration_stops_when_it_is_sure():
    """Sweeps with a high probability need one sweep. Uniform probabilities use all four, and are
    correct once in six.
    """
    sure = outcome("lopo", "H-svm", right=1)
    assert [e["sweeps"] for e in paper_experiment.explored([sure])] == [1, 1, 1]
    assert all(e["share"][0] == 1 for e in paper_experiment.explored([sure]))
    sure.logits[:] = 0
    assert [(e["sweeps"], e["share"][0]) for e in paper_experiment.explored([sure])] == [
        (4, round(1 / 6, 4))
    ] * 3


def test_intervals_are_over_places():
    """Eight positions that are all correct or all wrong are not 192 independent sweeps.

    The interval is far wider than that of independent sweeps.
    """
    place = np.repeat(np.arange(8), 24)
    _, low, high = paper_experiment.estimate(place % 2 == 0, place)
    assert high - low > 0.5


def test_a_cost_curve_keeps_its_ends_in_few_points():
    """4,000 iterations become at most 160 points: the first unchanged, later ones as means, x in
    order.
    """
    cost = np.stack([np.arange(1, 4001), np.geomspace(2, 0.001, 4000)], axis=1)
    thin = paper_experiment._thinned(cost)
    assert len(thin) <= 160
    assert np.allclose(thin[0], cost[0], atol=1e-4)
    assert thin[-1, 0] > 3850
    assert (np.diff(thin[:, 0]) > 0).all()
    assert len(paper_experiment._thinned(cost[:1])) == 1


def test_summary_pools_seeds_and_keeps_each_result(results):
    """144 sweeps of two seeds at six positions, beside the printed value.

    The results contain every outcome, and 11 rows of 24 sweeps in the confusion matrix.
    """
    row = next(r for r in results["table"] if (r["part"], r["method"]) == ("lopo", "H-svm"))
    assert (row["total"], row["seeds"], row["printed"], row["attachments"][0]) == (
        144,
        [1, 2],
        0.86,
        6,
    )
    assert row["share"][0] == round(row["right"] / 144, 4)
    assert len(results["results"]) == 6 * 7 * 2 + 2
    assert np.sum(results["confusion"]["H-svm"], 1).tolist() == [24] * 6
    assert results["costs"] == {"paper-cnn": [[[1, 1.7], [7, 0.5]]] * 2}


def test_the_page_is_one_file_that_a_phone_can_read(made):
    """It is valid, as wide as the window, light or dark, and contains no address. Its tables
    scroll.
    """
    html, pictures = made
    read = PageReader(html)
    assert (read.wrong, read.open) == ([], [])
    own = ("../../README.md", "../../docs/decisions/0002-two-simulated-worlds.md")
    assert all(link.startswith("#") or link in (*own, DOI) for link in read.links)
    assert {DOI, own[1]} <= set(read.links)
    assert not re.search(r"@import|url\((?!#)|<script>|<link", html)
    assert 'name="viewport" content="width=device-width' in html
    assert "prefers-color-scheme: dark" in html
    assert html.count("<table") == len(re.findall(r'<div class="wide"[^>]*><table', html))
    assert all(picture(svg) in html and len(svg) < 150_000 for svg in pictures.values())


def test_the_page_shows_every_figure_with_printed_beside_ours(results, made):
    """Figures 4 to 7, 9 to 13 and the table of all.

    Each number has its interval, the printed value and the difference.
    """
    html, pictures = made
    assert sorted(pictures) == sorted(FIGURES)
    text = " ".join(PageReader(html).text.split())
    for row in results["table"]:
        if row["printed"] is not None:
            difference = f"{100 * (row['share'][0] - row['printed']):+.1f}".replace("-", "−")
            low, high = (f"{100 * v:.1f}" for v in row["share"][1:])
            value = f"{100 * row['printed']:.1f}".removesuffix(".0")
            assert (
                f"{low} – {high} % {value} % {difference} {row['right']} / {row['total']}" in text
            )
    for fact in (
        "simulated sweeps",
        "c0ffee<",
        "abacus, 2 cores",
        "7 beads",
        "55 of them",
        "81.9 to 96.4 %",
        "60 sweeps",
    ):
        assert fact in text


@pytest.mark.slow
def test_only_a_quick_run_says_that_it_means_nothing(results, made):
    """The banner is on the page of --quick and on no other."""
    assert "quick run" not in made[0]
    assert 'class="stop"' in paper_report.render(results | {"quick": True})[0]


def test_hard_protocols_come_first(made):
    """They come first in the summary, in the laboratory, and in the picture of all methods."""
    html, pictures = made
    titles = (
        ">T-REAL, leave one position out",
        ">trained on T-REAL, tested on T-HARD",
        ">level-blind T-REAL, leave",
        "<summary>T-LAB, random",
    )
    places = [html.index(title) for title in titles]
    assert places == sorted(places)
    grid = pictures["methods"]
    assert grid.index(">leave<") < grid.index(">T-HARD<") < grid.index(">level-blind<")


@pytest.mark.slow
def test_a_plan_without_the_network_still_makes_a_page():
    """Figures 9 to 11 need the paper's CNN. All others are there."""
    html, pictures = paper_report.render(summary(cnn=False))
    assert set(FIGURES) - set(pictures) == {"figure-9", "figure-10", "figure-11"}
    assert not PageReader(html).wrong
    assert "The CNN was not run" in html


def test_both_worlds_stand_side_by_side(results, made):
    """The cases of the level-blind world have its sets; ours is compared with the others in each.

    The difference is that of the table, with an interval around it.
    """
    sets = {part: case.sets for part, case in paper_experiment.FULL.items()}
    assert sets["lopo"] == ("sim:T-REAL:{w}",)
    assert sets["lopo/level-blind"] == ("sim:T-REAL/level-blind:{w}",)
    assert sets["hard/level-blind"] == (
        "sim:T-REAL/level-blind:{w}",
        "sim:T-HARD/level-blind:{a}-{b}:3",
    )
    shares = {(row["part"], row["method"]): row["share"][0] for row in results["table"]}
    lines = paper_report.PaperReport(results).run()["ahead"]
    assert [len(line) for line in lines] == [3] * 4
    for line, part in zip(lines, paper_report.COLUMNS, strict=True):
        gap = 100 * (shares[part, "palpate-reattached"] - shares[part, "H-svm"])
        assert line[1].startswith(f"{gap:+.1f} [".replace("-", "−"))
        assert (line[2] == "–") == part.endswith("level-blind")
    text = " ".join(PageReader(made[0]).text.split())
    assert all(value in text for line in lines for value in line)
    loads = [f"{100 * shares[part, 'static-svm']:.1f} %" for part in ("hard", "hard/level-blind")]
    assert f"Mean loads alone (static-svm) name {loads[0]} of T-HARD in the laboratory" in text
    assert f"and {loads[1]} in the level-blind world" in text


def curve(step: int = 400, seed: int = 1, left: int | None = 4, world: str = "") -> dict[str, Any]:
    """A file of cnn_curve after some iterations, with nine positions.

    The last position is always taken for the next material. left: one more, that is always right.
    """
    newest = {}
    for key, part, places in (("new", "lopo", 9), ("hard", "hard", 9), ("left", "lopo", 1)):
        made = outcome(part, "paper-cnn", right=1.0, places=places)
        made.logits[made.place == 10_008] = np.eye(6)[1]
        newest[key] = {
            "labels": made.labels.tolist(),
            "position": (made.place - 10_000).tolist(),
            "logits": made.logits.tolist(),
        }
    if left is None:
        del newest["left"]
    return {
        "about": ["whole", seed, False],
        "world": world,
        "left": left,
        "steps": 4000,
        "points": [{"step": n, "cost": 1 / n} for n in (25, 50, step)],
        "newest": newest,
        "commit": "c0de",
        "machine": "x",
    }


def test_followed_trainings_stand_for_the_network_as_printed(tmp_path: Path):
    """Their last points are in Figs. 9 to 11 and 13, at any iteration; those of a seed do not take
    the place of another's. Another training is refused.
    """
    file = save(tmp_path / "paper.json", summary(cnn=False))
    named = []
    for seed, left in ((1, 4), (2, 5)):
        followed = save(tmp_path / f"{seed}.json", curve(seed=seed, left=left))
        named += ["--curve", str(followed)]
    blind = save(tmp_path / "3.json", curve(left=None, world="level-blind"))
    assert main(["paper", *named, "--curve", str(blind), "--out", str(file)]) == 0
    taken = json.loads(file.read_text())
    text = " ".join(PageReader(published("paper", taken, tmp_path).read_text()).text.split())
    for fact in (
        "paper-cnn 400 of 4000 iterations of 50",
        "1 4 24 / 24 400 of 4000 c0de 2 5 24 / 24",
        "1, level-blind none – 400 of 4000",
        "Commit c0de: paper-cnn; commit c0ffee<: all other methods".replace("; c", "; C"),
        "ended at 0.0025",
        "Fig. 9: cost",
    ):
        assert fact in text, fact
    rows = {row["part"]: row for row in taken["table"] if row["method"] == "paper-cnn"}
    assert set(rows) == {"lopo", "hard", "lopo/level-blind", "hard/level-blind"}
    at = ("right", "total", "seeds", "ms_p50")
    assert [rows["lopo"][key] for key in at] == [440, 480, [1, 2], None]
    assert rows["lopo"]["attachments"] == [20, round(1 / 6, 4), 1.0]
    assert [rows["lopo/level-blind"][key] for key in at] == [196, 216, [1], None]
    assert taken["several"]["paper-cnn"]["product"][0][0] == rows["lopo"]["share"][0]
    for other in ({"about": ["small", 1, False]}, {"about": ["whole", 1, True]}, {"points": []}):
        with pytest.raises(
            FormatError,
            match=r"not of the CNN as printed; run python -m .* --size whole",
        ):
            paper_experiment.with_curves(taken, [curve() | other])


def stamped(**changes: Any) -> dict[int, Stamp]:
    """The stamps of a run that has the printed values, with some changed.

    changes: shares by "part method", costs, confusion, or several of a method.
    """
    table = [
        {"part": part, "method": m, "share": [changes.get(f"{part} {m}", share)]}
        for part, shares in paper_values.ACCURACY.items()
        for m, share in shares.items()
    ]
    confusion = {
        "paper-cnn": paper_values.CONFUSION * 1000,
        "H-svm": np.diag([5, 6, 7, 8, 9, 9]) + 1,
    }
    several = {
        m: {"product": [[value or 0.9] for value in values]}
        for m, values in paper_values.SEVERAL.items()
    }
    return stamps(
        {
            "table": table,
            "results": [{"materials": list(MATERIALS)}],
            "costs": {"paper-cnn": [changes.get("costs", [*paper_values.COST, (4000, 0.001)])]},
            "confusion": confusion | changes.get("confusion", {}),
            "several": several | changes.get("several", {}),
        }
    )


def test_the_printed_values_themselves_are_stamped_reproduced():
    """Every figure is. The reason repeats the numbers."""
    made = stamped()
    assert list(made) == [4, 5, 6, 7, 9, 10, 11, 12, 13]
    assert all(stamp.reproduced for stamp in made.values())
    assert "0.0 points" in made[4].why
    assert "92.3 % on new positions (92.3 printed)" in made[10].why
    assert "97.3 % after 2 sweeps (97.3 printed)" in made[13].why


@pytest.mark.parametrize(
    ("figure", "changes"),
    [
        (5, {"lopo L-knn": 0.85}),
        (9, {"costs": [(1, 2.0), (500, 0.4), (4000, 0.002)]}),
        (10, {"hard paper-cnn": 0.85}),
        (10, {"lopo paper-cnn": 0.88}),
        (11, {"confusion": {"paper-cnn": np.eye(6)[::-1] * 9 + np.eye(6)}}),
        (11, {"confusion": {"paper-cnn": np.eye(6) * 9}}),
        (12, {"confusion": {"H-svm": np.diag([9, 6, 7, 8, 9, 5]) + 1}}),
        (13, {"several": {"paper-cnn": {"product": [[0.923], [0.923], [0.975]]}}}),
    ],
)
def test_each_stamp_can_be_lost(figure: int, changes: dict[str, Any]):
    """A number that is too far from the printed one takes its figure's stamp, and no other's.

    A CNN that is near enough, but hardly ahead of H-svm, is not reproduced.
    """
    made = stamped(**changes)
    assert [n for n, stamp in made.items() if not stamp.reproduced] == [figure]


def test_no_result_is_stamped_neither_way():
    """A training that is not finished, and a CNN that was not run."""
    assert stamped(costs=[(1, 2.0), (400, 0.1)])[9].reproduced is None
    without = stamps(summary(cnn=False))
    assert set(without) == {4, 5, 6, 7, 12, 13}
    assert without[13].reproduced is None


def test_the_page_stamps_each_figure(results, made):
    """The first screen lists them; each caption has its own stamp and the numbers behind it."""
    text = " ".join(PageReader(made[0]).text.split())
    found = stamps(results)
    for number, stamp in found.items():
        assert f"{stamp.word} Fig. {number}: " in text
        assert stamp.why in text
    first = text[: text.index("In short")]
    assert "not reproduced Figs. 4, 5, 6, 7: the accuracy of spectral features; " in first
    assert "reproduced Fig. 10: the accuracy of the CNN and its lead" in first
    assert "beyond the paper" in text


def test_some_methods_are_run_again_and_the_others_stay():
    """The new result replaces the old. A quick run is not mixed with a full run."""
    earlier, new = summary(), summary(cnn=False)
    for row in new["table"]:
        row["right"] = 1
    new["table"] = [row for row in new["table"] if row["method"] == "palpate-reattached"]
    new["results"] = [one for one in new["results"] if one["method"] == "palpate-reattached"]
    both = paper_experiment.joined(new, earlier)
    assert len(both["table"]) == len(earlier["table"])
    assert {row["method"] for row in both["table"] if row["right"] == 1} == {"palpate-reattached"}
    assert len(both["results"]) == len(earlier["results"])
    assert both["several"].keys() == earlier["several"].keys()
    left = paper_experiment.planned(earlier, [Step(("palpate-reattached",), ("lopo",), (1,), 1)])
    assert (
        {row["method"] for row in left["table"]}
        == left["confusion"].keys()
        == {"palpate-reattached", "paper-cnn"}
    )
    with pytest.raises(FormatError, match="a quick run and a whole one cannot be joined"):
        paper_experiment.joined(new, earlier | {"quick": True})


def test_only_methods_of_the_plan_are_run():
    """Steps without any of them are left out. An unknown method is reported."""
    steps = paper_experiment.narrowed(paper_experiment.FULL_STEPS, ["palpate", "H-svm"])
    assert [step.methods for step in steps] == [("H-svm",), ("palpate",)]
    with pytest.raises(
        FormatError, match="method 'quant' is not in the paper's experiment; use some of L-gauss"
    ):
        paper_experiment.narrowed(paper_experiment.FULL_STEPS, ["quant"])


def test_plans_name_methods_and_parts_that_exist():
    """In the full and the quick plan all methods of each step are known and its parts planned.

    Both have every bar of Figs. 4 to 7; the paper's CNN of Fig. 10 comes from cnn_curve, or from a
    quick run. The paper's experiment leaves out the sizes of the recipe, and the methods that
    `development` compares.
    """
    known = set(paper_experiment.methods.every())
    newer = {
        "multirocket-hydra",
        "quant",
        "minirocket-augmented",
        "ds-cnn",
        "lite",
        "edge-spectral",
    }
    bars = {(p, m) for p, shares in paper_values.ACCURACY.items() for m in shares}
    for parts, steps, absent in (
        (paper_experiment.FULL, paper_experiment.FULL_STEPS, "paper-cnn"),
        (paper_experiment.QUICK, paper_experiment.QUICK_STEPS, "paper-cnn-centred"),
    ):
        ran = {(part, m) for step in steps for part in step.parts for m in step.methods}
        left = known ^ {m for _, m in ran}
        assert left == {f"palpate-{size}" for size in SIZES} | {absent} | newer
        assert {part for part, _ in ran} == set(parts) == set(paper_report.TITLES)
        assert bars - {(part, absent) for part in parts} <= ran


@pytest.mark.slow
def test_run_writes_everything_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The results of a tiny plan make page and pictures. A second run uses the cached folds and
    gives the same figures.
    """
    real, one = "sim:T-REAL:100{w}:2", ("position<=1",)
    parts = {
        "lopo": StudyCase((real,), "leave:position", one, folds=2),
        "hard": StudyCase((real, "sim:T-HARD:100{w}:2"), "split:set=0->1", one, folds=1),
        "lab": StudyCase(("sim:T-LAB:100{w}:2",), "random:2", folds=2),
        "random": StudyCase((real,), "random:2", one, folds=2),
    }
    monkeypatch.setattr(paper_experiment, "QUICK", parts)
    monkeypatch.setattr(
        paper_experiment, "QUICK_STEPS", (Step(("L-gauss", "H-svm"), tuple(parts), (1,), 0.1),)
    )
    where, lines = Where(jobs=1, cache=tmp_path / "cache"), []
    results = paper_experiment.results(StudyRun(where, lines.append, quick=True))
    made = published("paper", results, tmp_path)
    assert 'class="stop"' in made.read_text()
    assert {p.stem for p in made.parent.glob("*.svg")} == {
        f"figure-{n}" for n in (4, 5, 6, 7, 12, 13)
    } | {"methods"}
    assert len(results["results"]) == 8
    assert len(lines) == 14
    assert "4/4 random, seed 1" in lines[-1]
    assert all(" left" in line for line in lines)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "cache").iterdir()}
    again = paper_experiment.results(StudyRun(where, lines.append, quick=True))
    assert kept == {p: p.stat().st_mtime_ns for p in (tmp_path / "cache").iterdir()}
    assert results == again
