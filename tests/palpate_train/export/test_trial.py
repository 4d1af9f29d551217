"""A bundle holds the rules that pay on altered copies of its held-out sweeps and on junk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.correlation import Correlations
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate_train.answer import fit_early, rules
from palpate_train.answer.rules import ALL, RULES, Asked
from palpate_train.cli.main import main
from palpate_train.data import junk, sets
from palpate_train.export import trial
from palpate_train.export.trial import Counts
from palpate_train.metrics import bundle_score, tolerances

SWEEPS = "sim:T-REAL/level-blind:41:1"
ALONE = {"slide", "vibration", "hum", "taxels"}
"""Rules that the tests below leave to the trial."""


def packaged() -> Bundle:
    """The bundle with every rule, without early answers."""
    return RULES["early"].without(bundle.load(bundle.DEFAULT))


@pytest.mark.parametrize("name", RULES)
def test_a_bundle_answers_without_any_rule(name: str):
    """Each can be left out; then the bundle has it no more, and another time it cannot be."""
    every = bundle.load(bundle.DEFAULT)
    every = replace(every, manifest=replace(every.manifest, correlations=Correlations(0.0)))
    less = rules.without(every, [name])
    assert name not in rules.present(less)
    given = next(bundle_score.verdicts(Classifier(less, SystemClock()), sets.load(SWEEPS)))
    assert given[1].bundle == less.id
    with pytest.raises(FormatError, match=name):
        rules.without(less, [name])


@pytest.mark.parametrize(
    ("needed", "junk_needs", "asked", "out"),
    [
        (set(), set(), ALL, ALONE),
        ({"hum"}, set(), ALL, ALONE - {"hum"}),
        (set(), {"slide"}, ALL, ALONE - {"slide"}),
        (set(), set(), Asked(kept=("taxels",)), ALONE - {"taxels"}),
        ({"hum", "slide"}, {"taxels"}, Asked(left_out=("hum",)), {"vibration", "hum"}),
    ],
)
def test_a_rule_is_dropped_kept_or_forced(
    needed: set[str],
    junk_needs: set[str],
    asked: Asked,
    out: set[str],
    monkeypatch: pytest.MonkeyPatch,
):
    """Half a point of copies, any junk, or a wish keeps it."""

    def counts(needed: set[str], junk_needs: set[str]):
        """Answers of a box that needs some rules for copies, and others for junk."""

        def counted(of: Bundle, given: list[trial.Given]) -> Counts:
            there = set(rules.present(of))
            return Counts(300 - 2 * len(needed - there), 9 + len(junk_needs - there))

        return counted

    monkeypatch.setattr(trial, "EACH", 6)
    monkeypatch.setattr(trial, "_counted", counts(needed, junk_needs))
    monkeypatch.setattr(tolerances, "LOST", 1 / 300)
    judge = rules.without(packaged(), ["disturbance", "displacement"])
    found, figures = trial.decided(judge, sets.load(SWEEPS), 0, asked)
    assert set(found) == out
    assert {name for name, of in figures.items() if not of["kept"]} == out
    said = rules.text(replace(judge.manifest, figures={rules.FIGURES: figures}))
    assert said.count("\n") == len(figures) - 1 == 3
    assert said.count("not needed") == len(out - set(asked.left_out))


def test_rules_are_kept_where_they_are_fitted_and_few_sweeps_judge():
    """The card claims no other; few sweeps would decide by chance; none can be both."""
    figures = {"hum": {"kept": False, "because": "absent"}}
    made = packaged().manifest
    assert "kept" not in rules.text(replace(made, figures={rules.FIGURES: figures}))
    few = sets.load(SWEEPS).take(np.arange(trial.EACH - 1))
    assert trial.decided(packaged(), few, 0, Asked(left_out=("hum",)))[0] == ["hum"]
    with pytest.raises(FormatError, match="hum"):
        Asked(("hum",), ("taxels", "hum"))


def test_of_two_rules_that_do_the_same_one_stays(monkeypatch: pytest.MonkeyPatch):
    """Two rules refuse a rest; the trial keeps the second."""

    def counted(of: Bundle, given: list[trial.Given]) -> Counts:
        return Counts(300, 5 * (not {"slide", "vibration"} & set(rules.present(of))))

    monkeypatch.setattr(trial, "_counted", counted)
    found, _ = trial.decided(packaged(), sets.load(SWEEPS), 0, ALL)
    assert len({"slide", "vibration"} & set(found)) == 1


@pytest.mark.slow
def test_rules_against_faults_stay_although_held_out_sweeps_are_clean(
    monkeypatch: pytest.MonkeyPatch,
):
    """Broken taxels, rests and noise are made for the trial."""
    monkeypatch.setattr(trial, "EACH", 6)
    found, figures = trial.decided(packaged(), sets.load(SWEEPS), 0, ALL)
    assert not {"taxels", "disturbance"} & set(found)
    assert len({"slide", "vibration"} & set(found)) < 2
    right, fewer = figures["taxels"]["right"]
    assert fewer < right


@pytest.mark.parametrize("kind", junk.JUNK)
def test_junk_is_made_of_any_counts(kind: str):
    """Whole windows of the sweeps' type, unlike the sweeps; of one axis and of three."""
    sweeps = sets.load(SWEEPS).take(np.arange(0, 54, 9))
    tare = np.zeros(sweeps.format.shape)
    made = junk.windows(kind, sweeps, 4, tare, 0)
    assert made.shape == (4, *sweeps.samples.shape[1:])
    assert made.dtype == sweeps.samples.dtype
    assert not any((made[0] == window).all() for window in sweeps.samples)
    three = replace(sweeps, samples=np.stack([sweeps.samples] * 3, axis=-1))
    shape = junk.windows(kind, three, 4, np.zeros(three.format.shape), 0).shape
    assert shape == (4, *three.samples.shape[1:])


def test_score_shows_the_difference(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """A line with and without the rules; a rule that the bundle lacks is refused with its name."""
    args = ["score", str(bundle.DEFAULT), "--set", SWEEPS, "--without", "slide", "vibration"]
    assert main(args) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert "without slide, vibration" in said
    assert said.count("classified correctly") == 2


def test_early_answers_are_measured_as_the_box_gives_them():
    """Part of the window; never sure needs all."""
    made, held_out = bundle.load(bundle.DEFAULT), sets.load(SWEEPS)
    m = made.manifest
    assert m.early
    never = replace(made, manifest=replace(m, early=replace(m.early, least=(1.1,) * 9)))
    early, late = (trial.early_answers(of, held_out, 0, 2) for of in (made, never))
    assert 0.2 <= early["share"] < late["share"] == 1
    assert early["junk"][1] == late["junk"][1] == 2 * (len(junk.JUNK) - len(junk.SLIDES_FIRST))
    text = fit_early.text(replace(m, figures={fit_early.FIGURES: early}))
    assert f"{early['share']:.0%}" in text
