"""Disturbed copies of sweeps widen the shapes of known materials."""

from dataclasses import replace

import numpy as np

from palpate_train.answer import altered_sweeps
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_disturbance import DisturbanceMeter
from palpate_train.answer.fit_unknown import Embed
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
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


def test_copies_have_each_alteration_but_broken_taxels():
    """At several severities, of as many sweeps as there are; none is the sweep itself."""
    sweeps = windows(4)
    meter = DisturbanceMeter(FORMAT, np.zeros(FORMAT.shape), sweeps.samples)
    found = altered_sweeps.disturbed(
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


def embedded(sweeps: Dataset) -> tuple[Embed, Embedding]:
    """An embedding of the loads of two corners, with the means of its materials."""

    def embed(samples: np.ndarray) -> np.ndarray:
        return samples.mean(axis=1)[:, [0, 3], [0, 3]].astype(float)

    z = embed(sweeps.samples)
    means = np.stack([z[sweeps.labels == k].mean(axis=0) for k in range(3)])
    return embed, Embedding(np.eye(2), np.eye(2), np.zeros(2), means, np.empty((3, 0, 0)))


def test_held_out_copies_widen_shapes_and_set_the_limit():
    """Few teach nothing; a bundle without the figures says so in words."""
    train, held = windows(), windows(seed=1)
    embed, judge = embedded(train)
    tare = np.zeros(FORMAT.shape)
    found = altered_sweeps.measure(embed, train, held, judge, tare=tare)
    assert found is not None
    assert found.shapes[0].shape == (3, 2, 2)
    assert len(found.changes[0]) == len(found.disturbances.allowances) > 0
    assert found.rule.limit > 0
    kept = np.mean([before <= after for before, after in found.figures["kept"].values()])
    assert kept > 0.7
    assert "altered sweeps: " in altered_sweeps.text({altered_sweeps.FIGURES: found.figures})
    assert altered_sweeps.measure(embed, train, windows(3), judge, tare=tare) is None
    assert "not measured" in altered_sweeps.text({})
