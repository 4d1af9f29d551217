"""The contract of every peer: learning, absent materials, its seed, its graph."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.core.errors import FormatError
from palpate.inference.session import session
from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from palpate_train.models.methods import Effort, Model
from tests.factories.costly import OF_LIBRARIES, WITH_GRAPH, quick_first
from tests.factories.later import Later
from tests.factories.sheared import sheared
from tests.factories.sweep_sets import easy

aeon_peers = Later("palpate_studies.peers.aeon_peers")
minirocket = Later("palpate_studies.peers.minirocket")
sthmp = Later("palpate_studies.peers.sthmp")

FEATURES = ("L-gauss", "L-knn", "L-svm", "fishel-bayes")
DESKTOP = ("static-svm", "spectrogram-svm")
AEON = ("minirocket", "minirocket-augmented", "multirocket-hydra", "quant")
ALONE = ("multirocket-hydra", "quant")
"""Methods that run in aeon alone."""
COMPILED = [pytest.mark.slow, pytest.mark.timeout(1200)]
"""Marks of what numba compiles for its first test: that takes minutes on a busy machine."""
NETS = (
    *("paper-cnn", "paper-cnn-centred", "tactnet2", "recurrent", "ds-cnn", "lite"),
    "edge-spectral",
)
SLOW = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("st-hmp", "paper-cnn", "edge-spectral")
]
SLOW += [pytest.param(name, marks=COMPILED) for name in AEON[:2]]
LONG = [pytest.param(name, marks=[*COMPILED, pytest.mark.thorough]) for name in ALONE]
every = pytest.mark.parametrize(
    "name", [*FEATURES, *DESKTOP, *SLOW, *LONG, *quick_first(NETS[1:-1])]
)
with_graph = pytest.mark.parametrize("name", [*FEATURES, *SLOW, *quick_first(NETS[1:-1])])


@pytest.fixture(autouse=True)
def light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models that are fitted in a moment."""
    monkeypatch.setattr("palpate_studies.peers.minirocket.FEATURES", 500)
    for key, value in {"ATOMS": 20, "SAMPLED": 300, "ROUNDS": 3}.items():
        monkeypatch.setattr(f"palpate_studies.peers.sthmp.{key}", value)


def inputs(name: str, sweeps: Dataset) -> Any:
    """The inputs of the method."""
    (method,) = methods.find([name])
    return methods.model_inputs(method.input, sweeps)


def fitted(name: str, sweeps: Dataset, seed: int = 1, share: float = 0.01) -> Model:
    """The method trained on all sweeps. share: of the iterations of networks."""
    if name in AEON:
        pytest.importorskip("aeon")
    (method,) = methods.find([name], Effort(share))
    return method.train(sweeps, inputs(name, sweeps), seed)


def long(n: int, seed: int = 0) -> Dataset:
    """Easy sweeps with enough frames for every feature, and with a load for each material."""
    sweeps = easy(n, seed=seed)
    samples = np.concatenate([sweeps.samples] * 3, axis=1)
    loads = 30 * sweeps.labels[:, None, None, None]
    return replace(sweeps, samples=(samples + loads).astype(np.uint8))


@every
def test_sweeps_that_are_easy_are_learnt(name: str):
    """Sweeps of another seed are classified correctly, with logits float32 [n, K]."""
    share = {"paper-cnn": 0.1, "paper-cnn-centred": 0.1}.get(name, 0.25)
    other = long(8, seed=1)
    logits = fitted(name, long(12), share=share).logits(inputs(name, other))
    assert (logits.dtype, logits.shape) == (np.float32, (24, 3))
    assert np.mean(logits.argmax(1) == other.labels) > 0.8


@every
def test_a_material_not_trained_on_is_never_given(name: str):
    """Its logit is far below the others, which keep their places."""
    sweeps = long(8)
    two = sweeps.labels != 1
    logits = fitted(name, sweeps.take(two)).logits(inputs(name, sweeps))
    assert logits.shape == (24, 3)
    assert softmax(logits)[:, 1].max() < 1e-8
    if name not in NETS:  # these are hardly trained
        assert np.mean(logits.argmax(1)[two] == sweeps.labels[two]) > 0.8


@every
def test_silence_and_saturation_get_finite_logits(name: str):
    """Of a model that has seen signals, and of one that has seen none."""
    sweeps = long(4)
    still = replace(sweeps, samples=np.full_like(sweeps.samples, 7))
    full = replace(sweeps, samples=np.full_like(sweeps.samples, 255))
    model = fitted(name, sweeps)
    for shown in (still, full):
        assert np.isfinite(model.logits(inputs(name, shown))).all()
    if name in (*AEON, "st-hmp", *NETS):
        assert np.isfinite(fitted(name, still).logits(inputs(name, sweeps))).all()


@every
@pytest.mark.slow
def test_a_seed_gives_one_model_and_random_states_stay(name: str):
    """Global random states stay; another seed gives another network."""
    torch = Later("torch")
    sweeps = long(6)
    np.random.seed(4)
    before, torch_before = np.random.get_state()[1].copy(), torch.get_rng_state()
    one, two = (fitted(name, sweeps).logits(inputs(name, sweeps)) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    if name in AEON:  # scikit-learn draws from the global stream
        assert np.array_equal(np.random.get_state()[1], before)
    if name in NETS:
        assert torch.equal(torch.get_rng_state(), torch_before)
        assert not np.array_equal(fitted(name, sweeps, 2).logits(inputs(name, sweeps)), one)


@with_graph
def test_the_box_gives_the_logits(name: str):
    """The graph in the box's session, sweep by sweep."""
    sweeps = long(6)
    model, given = fitted(name, sweeps), inputs(name, sweeps)
    run = session(model.graph().SerializeToString())
    feed = run.get_inputs()[0].name
    box = np.concatenate([run.run(None, {feed: one[None]})[0] for one in given])
    np.testing.assert_allclose(box, model.logits(given), atol=1e-3, rtol=1e-4)


@every
def test_too_little_to_learn_from_is_refused(name: str):
    """One material."""
    with pytest.raises(FormatError):
        fitted(name, long(4).take(np.arange(4)))


def test_the_lists_of_methods_are_complete():
    """Every installed method is tested: it has a graph, or says which library runs it."""
    libraries = {name: bool(method.library) for name, method in methods.every().items()}
    assert libraries == dict.fromkeys(WITH_GRAPH, False) | dict.fromkeys(OF_LIBRARIES, True)


@pytest.fixture(scope="module")
def three_axes() -> Dataset:
    """Half a second of six tubes at nine positions."""
    return sheared(1, frames=360)


@pytest.mark.slow
@pytest.mark.parametrize("name", quick_first((*WITH_GRAPH, *OF_LIBRARIES)))
def test_a_method_takes_three_axes(name: str, three_axes: Dataset):
    """The graph takes [1, T, R, C, A] and answers as the desktop; shear changes the logits."""
    (method,) = methods.find([name])
    given = methods.model_inputs(method.input, three_axes)
    model = fitted(name, three_axes)
    logits = model.logits(given[:4])
    assert logits.shape == (4, 6)
    assert np.isfinite(logits).all()
    if method.library:
        return
    run = session(model.graph().SerializeToString())
    (takes,) = run.get_inputs()
    box = np.concatenate([run.run(None, {takes.name: one[None]})[0] for one in given[:4]])
    np.testing.assert_allclose(box, logits, atol=2e-3, rtol=1e-3)
    if method.input == "raw":
        assert takes.shape == [1, 360, 2, 2, 3]
        other = given[:4].copy()
        other[..., 0] = np.roll(other[..., 0] * 3, 1, axis=0)
        assert (model.logits(other) != logits).any(), "shear is not looked at"


@pytest.mark.parametrize(("name", "frames"), [*((name, 8) for name in AEON), ("st-hmp", 7)])
def test_a_window_that_is_too_short_is_refused(name: str, frames: int):
    """The error says how long it is."""
    sweeps = easy(4)
    with pytest.raises(FormatError, match=f"{frames} frames"):
        fitted(name, replace(sweeps, samples=sweeps.samples[:, :frames]))


@pytest.mark.parametrize("name", AEON)
def test_without_aeon_the_extra_is_advised(name: str, monkeypatch: pytest.MonkeyPatch):
    """aeon comes with the extra `peers`; methods that run in aeon alone have no graph."""
    if name in ALONE:
        with pytest.raises(FormatError, match="aeon"):
            aeon_peers.AeonModel(name, len, np.arange(2), 2).graph()
    for part in (
        "transformations.collection.convolution_based",
        "classification.convolution_based",
        "classification.interval_based",
    ):
        monkeypatch.setitem(sys.modules, f"aeon.{part}", None)
    sweeps = easy(4)
    (method,) = methods.find([name])
    with pytest.raises(FormatError, match=r"palpate-train\[peers\]"):
        method.train(sweeps, sweeps.samples, 1)
