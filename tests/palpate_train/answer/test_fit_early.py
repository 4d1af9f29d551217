"""Early answers: the rule on constructed prefixes, heads, the graph against the box."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer import early as box_early
from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest, Thresholds
from palpate.bundle.pruning import prune
from palpate.core.clock import SystemClock
from palpate.inference import classifier
from palpate_train.answer import calibrate, embedding, fit_early
from palpate_train.export.bundle_graph import bundle_graph
from palpate_train.export.contents import means_file
from palpate_train.onnx_tools.graph_builder import run
from tests.factories.calibration_inputs import plain_inputs
from tests.factories.later import Later
from tests.factories.trunk import FORMAT, trunk

lda = Later("sklearn.discriminant_analysis")


def prefixes(n: int, places: int = 8, seed: int = 0, strength=None):
    """Features [N, 10, 5] of three materials at each position, better with each tenth."""
    rng = np.random.default_rng(seed)
    labels = np.tile(np.repeat(np.arange(3), n), places)
    means = 4 * np.eye(5)[:3]
    grown = np.linspace(0.3, 1.5, 10) if strength is None else np.asarray(strength)
    x = means[labels][:, None] * grown[:, None] + rng.standard_normal((len(labels), 10, 5))
    return x, labels, np.repeat(np.arange(places), 3 * n)


def certain(labels, when, wrong=()):
    """Probabilities [n, 10, 3]: .4 of another material before the step `when` [n] and .9996 from
    then on; `wrong` sweeps name another until the last."""
    p = np.full((len(labels), 10, 3), 0.3)
    for i, (k, w) in enumerate(zip(labels, when, strict=True)):
        p[i, :w, (k + 2) % 3] = 0.4
        p[i, w:] = 2e-4
        p[i, w:, (k + (i in wrong)) % 3] = 0.9996
        p[i, 9] = 2e-4
        p[i, 9, k] = 0.9996
    return p


def test_the_rule_decides_when_the_steps_are_certain():
    """From the third tenth on nothing is lost; few sweeps or a late clarity give a reason."""
    labels = np.arange(300) % 3
    found = fit_early.find_rule(certain(labels, np.full(300, 2)), labels)
    assert found.early
    assert found.early.agree == 1
    assert (found.share, found.lost, found.why) == (pytest.approx(0.3), 0.0, "")
    labels = np.arange(30) % 3
    assert "30 sweeps" in fit_early.find_rule(certain(labels, np.full(30, 2)), labels).why
    labels = np.arange(300) % 3
    assert "before the end" in fit_early.find_rule(certain(labels, np.full(300, 9)), labels).why


def test_a_rule_asks_for_agreement_and_the_strictest_level():
    """One certain tenth is wrong in 2 %; luck at a looser level does not count."""
    labels = np.arange(300) % 3
    p = certain(labels, np.full(300, 2))
    p[:6, 2] = np.roll(p[:6, 2], 1, axis=1)
    found = fit_early.find_rule(p, labels)
    assert found.early
    assert found.early.agree == 2
    assert found.share == pytest.approx(0.4, abs=0.01)
    assert found.lost == 0
    labels = np.arange(200) % 3
    p = certain(labels, np.full(200, 9))
    p[:, 4] = 0.05
    p[np.arange(200), 4, labels] = 0.9  # right at .9
    p[:10, 2] = 0.02
    p[np.arange(10), 2, (labels[:10] + 1) % 3] = 0.96  # ten are wrong at .96
    assert (
        fit_early.find_rule(p, labels).early is None
        or fit_early.find_rule(p, labels).early.least[0] > 0.96
    )


@pytest.mark.parametrize(("wrong", "off"), [(1, False), (2, True)])
def test_half_a_point_and_no_more(wrong: int, off: bool):
    """Of 300 sweeps one may turn wrong, two, which stay wrong, may not."""
    labels = np.arange(300) % 3
    found = fit_early.find_rule(certain(labels, np.full(300, 2), range(wrong)), labels)
    assert (found.early is None) is off
    assert bool(found.why) is off


@pytest.mark.parametrize("agree", [1, 2, 3])
def test_many_sweeps_are_decided_as_the_box_decides_each(agree: int):
    """early.decide equals inference.classifier on random probabilities, some above 1."""
    rng = np.random.default_rng(agree)
    p = softmax(2 * rng.standard_normal((200, 10, 3)))
    rule = Early(tuple(rng.choice([0.5, 0.7, 0.9, 1.5], 9).tolist()), agree)
    named, share = fit_early.decide(p, rule)
    for i in range(200):
        step = next((d for d in range(9) if box_early.decides(p[i, : d + 1], rule)), 9)
        assert (share[i], named[i]) == ((step + 1) / 10, p[i, step].argmax())


@pytest.mark.slow
def test_temperatures_calibrate_each_step():
    """Cross-fitted over positions, the highest probability is the accuracy at every step."""
    x, y, at = prefixes(40)
    done = calibrate.fit_calibration(plain_inputs(x, y, at, np.ones(len(y), bool)))
    new, labels, _ = prefixes(60, seed=9)
    p = done.probabilities(new)
    right = (p.argmax(2) == labels[:, None]).mean(0)
    assert right[0] < 0.75 < 0.99 < right[9]
    assert np.abs(p.max(2).mean(0) - right).max() < 0.04


@pytest.mark.slow
def test_each_step_has_its_own_temperature():
    """The last temperature is that of the whole window, the others are those of their own steps."""
    x, y, at = prefixes(10, places=3, seed=3)
    # the sweeps of a material at one position lie together: the heads are too sure of other
    # positions
    x = x + 3 * np.random.default_rng(4).standard_normal((9, 1, 5))[3 * at + y]
    done, every = (
        calibrate.fit_calibration(plain_inputs(x, y, at, np.ones(len(y), bool))),
        np.ones(len(y), bool),
    )
    judging = embedding.cross_fitted(x[:, -1], y, at, every)
    logits, numbers = fit_early.cross_fitted_logits(x, y, judging)
    cooler = fit_early.fit_temperatures(logits, y[numbers], at[numbers])
    assert len(set(cooler)) > 2
    assert min(done.temperature, cooler[-1]) > 1
    raw = fit_early.heads(done.embedding(x), y, 3)
    assert np.allclose(done.steps.weight * cooler[:-1, None, None], raw.weight, rtol=1e-5)


@pytest.mark.slow
def test_a_material_of_one_place_and_two_materials():
    """A material at one position is learned, and two materials are; nothing is NaN."""
    x, y, at = prefixes(20)
    keep = (y != 2) | (at == 0)
    done = calibrate.fit_calibration(
        plain_inputs(x[keep], y[keep], at[keep], np.ones(keep.sum(), bool))
    )
    assert np.isfinite(done.probabilities(x)).all()
    assert (done.logits(x[:, -1]).argmax(1) == y).mean() > 0.9
    two = calibrate.fit_calibration(plain_inputs(x[y < 2], y[y < 2], at[y < 2], at[y < 2] < 4))
    assert np.isfinite(two.probabilities(x[y < 2])).all()


@pytest.fixture(scope="module")
def made():
    """A bundle on the toy trunk: Calibration, features, raw counts, labels, Bundle."""
    rng = np.random.default_rng(0)
    labels = np.tile(np.repeat(np.arange(3), 4), 6)
    level = np.array([[[20, 60], [40, 40]], [[60, 20], [40, 40]], [[40, 40], [60, 20]]])
    counts = level[labels][:, None] + rng.normal(0, [4, 9, 6], (FORMAT.window, 2, 2, 3))[
        None, ..., 0
    ].repeat(72, 0)
    counts = np.rint(counts + rng.normal(0, 5, counts.shape)).astype(np.int16)
    trunks = trunk(FORMAT, True)
    x, size = run(trunks, counts), 1
    done = calibrate.fit_calibration(
        plain_inputs(x, labels, np.repeat(np.arange(6), 12), np.ones(72, bool), size)
    )
    done = replace(done, rule=fit_early.EarlyRule(Early((0.9,) * 9, 2)))
    model = bundle_graph(done, trunk(FORMAT), trunks)
    files = {bundle.MODEL: model.SerializeToString(), bundle.MEANS: means_file(done.classes())}
    named = "toy", "1", FORMAT, "raw", ("a", "b", "c"), Thresholds(1.0, 32767.0)
    entries = {k: bundle.file_entry(v) for k, v in files.items()}
    manifest = Manifest(
        *named, entries, early=done.rule.early, known=done.limits.known(done.class_mean_temperature)
    )
    golden = counts[:2], run(model, counts[:2])
    whole = bundle.Bundle(manifest, "0", files[bundle.MODEL], *golden, done.embedding.classes())
    return done, x, counts, labels, whole


def test_the_graph_gives_what_training_computed(made):
    """Logits, embedding and early heads in the box's classifier are those of Calibration."""
    done, x, counts, _, whole = made
    box = classifier.Classifier(whole, SystemClock())
    box.self_test()
    for i in (0, 17, 40):
        assert np.allclose(
            box.outputs(counts[i], "embedding")[0], done.embedding(x[i, -1]), atol=1e-3
        )
        have = softmax(np.vstack([box.outputs(counts[i], "early")[0], box.logits(counts[i])]))
        assert np.allclose(have, done.probabilities(x[i : i + 1])[0], atol=1e-3)


def test_without_early_answers_the_box_runs_the_graph_that_has_none(made):
    """Without `early` the rest is, byte for byte, the model that was made without prefixes."""
    done, _, _, _, whole = made
    assert (
        prune(whole.model, {"logits", "embedding"})
        == bundle_graph(done, trunk(FORMAT)).SerializeToString()
    )
    assert len(prune(whole.model, {"early"})) < len(whole.model)


@pytest.mark.parametrize(("materials", "each"), [(2, 5), (3, 20), (6, 4)])
def test_the_heads_are_scikit_learns_shrinkage_lda(materials: int, each: int):
    """To the last bits of float32; a constant feature changes nothing."""
    rng = np.random.default_rng(materials)
    labels = np.repeat(np.arange(materials), each)
    x = rng.normal(size=(len(labels), 12)) + 2 * rng.normal(size=(materials, 12))[labels]
    x[:, 3] = 7
    weight, bias = fit_early.lda(x, labels, materials)
    prior = np.full(materials, 1 / materials)
    theirs = lda.LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto", priors=prior)
    wanted = theirs.fit(x, labels).decision_function(x)
    logits = x @ weight + bias
    if materials == 2:
        logits = logits[:, 1] - logits[:, 0]
    np.testing.assert_allclose(logits, wanted, rtol=1e-5, atol=1e-4)


def test_a_rule_needs_limits_that_its_held_out_sweeps_can_carry():
    """With too few of them there is a reason against early answers, which says their number."""
    assert fit_early.no_limits(fit_early.MIN_SWEEPS) is None
    few = fit_early.MIN_SWEEPS - 1
    assert f"{few} sweeps" in fit_early.no_limits(few)
