"""Neural methods: the paper's CNN as printed, graphs against PyTorch, small trainings."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.bundle.onnx_check import reader
from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate_studies import cost
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import evaluate, fold
from palpate_train.models import methods
from palpate_train.models.methods import Effort, Method
from palpate_train.onnx_tools import graph_builder
from tests.factories.costly import quick_first
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

torch = Later("torch")
lite = Later("palpate_studies.peers.lite")
networks = Later("palpate_studies.peers.networks")
paper_cnn = Later("palpate_studies.peers.paper_cnn")
recurrent = Later("palpate_studies.peers.recurrent")

pytestmark = pytest.mark.slow

NETS = (
    "paper-cnn",
    "paper-cnn-centred",
    "tactnet2",
    "recurrent",
    "ds-cnn",
    "lite",
    "edge-spectral",
)
BRIEF = Effort(share=0.01)
"""Two to eight iterations, for tests that are not about accuracy."""


def method(name: str, effort: Effort = BRIEF) -> Method:
    """The method of this name."""
    return methods.find([name], effort)[0]


def made(
    shape: tuple[int, ...], dtype: str, classes: int = 3, seed: int = 0, rate_hz: float = 100.0
) -> Dataset:
    """Noise [N, T, R, C] whose strength depends on the class; two sweeps a recording."""
    rng, labels = np.random.default_rng(seed), np.arange(shape[0]) // 2 % classes
    samples = 60 + (1 + 6 * labels)[:, None, None, None] * rng.standard_normal(shape)
    names = tuple(f"material {k}" for k in range(classes))
    groups = {"recording": np.arange(shape[0]) // 2}
    return Dataset(samples.astype(dtype), labels, names, rate_hz, groups, "made")


def train(name: str, s: Dataset, effort: Effort = BRIEF, seed: int = 1) -> networks.NetworkModel:
    """Train the method on all sweeps."""
    return method(name, effort).train(s, s.samples, seed)


def check_agrees(model: networks.NetworkModel, samples: np.ndarray) -> None:
    """The graph in the box's session gives the logits of the model, which are finite."""
    want = model.logits(samples)
    assert want.dtype == np.float32
    assert np.isfinite(want).all()
    have = graph_builder.run(model.graph(), samples)
    np.testing.assert_allclose(have, want, atol=1e-3, rtol=1e-4)


def test_the_paper_s_cnn_is_the_paper_s():
    """15,891,910 parameters; 1500 x 16 -> 150 -> 15; TactNet-II has about 1.84 M."""
    net = paper_cnn.build_paper_cnn(skin.FORMAT, 6, np.zeros((1, 1, 1, 1)))
    assert sum(p.numel() for p in net.parameters()) == 15_891_910
    assert [tuple(c.weight.shape) for c in net.convs] == [(32, 1, 15, 5), (64, 32, 15, 5)]
    assert net.dense.in_features == 15 * 16 * 64
    r = paper_cnn.PAPER_RECIPE
    assert (r.batch, r.peak_rate, r.dropout, paper_cnn.PAPER_STEPS) == (50, 1e-4, 0.25, 4000)
    assert (r.weight_decay, r.smoothing, r.ema, r.noise, r.gain, r.adversarial) == (0,) * 6
    assert not r.cycle
    other = paper_cnn.build_tactnet2(skin.FORMAT, 6, np.zeros((1, 1, 1, 1)))
    assert sum(p.numel() for p in other.parameters()) == pytest.approx(1.84e6, rel=0.01)


@pytest.mark.parametrize(
    ("window", "steps"), [(1500, (150, 15)), (128, (13, 2)), (101, (11, 2)), (5, (1, 1))]
)
def test_pooling_runs_over_the_end(window: int, steps: tuple[int, int]):
    """With zero padding the rest at the end makes one more step, and changes the output."""
    net = paper_cnn.ImageNetwork(
        SweepFormat(1, 1, 100.0, window, "float32"), 2, 1.0, 0.0, paper_cnn.PAPER
    )
    assert net.dense.in_features == 64 * steps[1]
    counts = torch.rand(1, window, 1, 1)
    with torch.no_grad():
        before = net(counts)
        counts[0, -1] += 100
        assert not torch.equal(net(counts), before)


@pytest.mark.slow
def test_the_loop_is_adam_as_the_paper_prints_it():
    """Step by step PyTorch's Adam: batches of a set that is shuffled for each round."""
    training = Later("palpate_train.models.training")
    s, r = (
        made((6, 12, 2, 1), "float32", 2),
        replace(paper_cnn.PAPER_RECIPE, steps=5, batch=4, dropout=0.0),
    )
    with torch.random.fork_rng():
        torch.manual_seed(3)
        mine = paper_cnn.ImageNetwork(s.format, 2, 0.1, 60.0, replace(paper_cnn.PAPER, dense=8))
        plain = pickle.loads(pickle.dumps(mine))
    trained, cost = training.learn(mine, s, r, 7, augment=r.perturbed)
    rng = torch.Generator().manual_seed(7)
    order = torch.cat([torch.randperm(6, generator=rng) for _ in range(4)])
    adam = torch.optim.Adam(plain.parameters(), 1e-4, betas=(0.9, 0.999), eps=1e-8)
    for step in range(5):
        pick = order[4 * step : 4 * step + 4]
        logits = plain(torch.from_numpy(s.samples[pick.numpy()]))
        loss = torch.nn.functional.cross_entropy(logits, torch.from_numpy(s.labels)[pick])
        adam.zero_grad()
        loss.backward()
        adam.step()
        assert cost[step] == (step + 1, pytest.approx(loss.item(), rel=1e-5))
    for have, want in zip(trained.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(have, want, rtol=1e-5, atol=1e-7)


def test_adversarial_training_sees_the_worse_sweep():
    """The gradient is that of the sweep plus that of the sweep moved by its sign."""
    s = made((6, 20, 2, 2), "float32", 2)
    net = paper_cnn.ImageNetwork(
        s.format, 2, 0.1, 60.0, paper_cnn.ImageLayers((4, 4), ((2, 1), (2, 1)), 2, False, 8)
    )
    x, labels = net.prepare(torch.from_numpy(s.samples)), torch.from_numpy(s.labels)
    still = x.clone().requires_grad_()
    cost = torch.nn.functional.cross_entropy(net.training_logits(still), labels)
    cost.backward()
    worse = torch.nn.functional.cross_entropy(
        net.training_logits(x + 0.1 * still.grad.sign()), labels
    )
    assert worse > cost
    worse.backward()
    want = [p.grad.clone() for p in net.parameters()]
    net.zero_grad()
    net.adversarial = 0.1
    loss = net.backward(x, labels, 0.0)
    assert loss == pytest.approx(cost.item())
    for p, gradient in zip(net.parameters(), want, strict=True):
        torch.testing.assert_close(p.grad, gradient)


@pytest.mark.slow
@pytest.mark.parametrize("name", quick_first(NETS))
@pytest.mark.parametrize(
    ("shape", "dtype", "classes"),
    [((12, 64, 3, 3), "int16", 2), ((12, 21, 1, 1), "uint16", 3), ((12, 7, 16, 1), "float32", 3)],
)
def test_any_form_goes_all_the_way(name: str, shape: tuple[int, ...], dtype: str, classes: int):
    """Odd grids, windows and types: finite logits, the same in the box's session."""
    s = made(shape, dtype, classes)
    model = train(name, s)
    assert model.logits(s.samples[:5]).shape == (5, classes)
    check_agrees(model, s.samples[:3])
    check_agrees(model, np.zeros_like(s.samples[:1]))


@pytest.mark.slow
@pytest.mark.parametrize("name", quick_first(NETS))
def test_small_sets_are_trained_whole(name: str):
    """Two recordings of one sweep each cannot be split; one position alone can."""
    tiny = easy(2)
    check_agrees(train(name, tiny), tiny.samples)
    one = easy(6)
    one.groups["position"] = np.zeros(len(one), int)
    check_agrees(train(name, one), one.samples[:2])
    with pytest.raises(FormatError, match="'low'"):
        train(name, easy(4).take(np.arange(4)))


@pytest.mark.slow
def test_probabilities_come_from_what_was_held_out():
    """With random labels a network overfits, and held-out sweeps lower its probabilities."""
    s = easy(40)
    lot = replace(s, labels=np.random.default_rng(1).permutation(s.labels))
    model = train("tactnet2", lot, Effort(share=0.5))
    other = easy(seed=9)
    assert softmax(model.logits(other.samples)).max(1).mean() < 0.6


def test_effort_is_kept():
    """Names and iterations follow the effort; methods can be sent to another process."""
    edge_spectral = Later("palpate_studies.peers.edge_spectral")
    ds_cnn = Later("palpate_studies.peers.ds_cnn")
    peers = paper_cnn, recurrent, ds_cnn, lite, edge_spectral
    networks = [one for peer in peers for one in peer.methods()]
    assert tuple(m.name for m in networks) == NETS
    assert all(m.input == "raw" and "\n" not in m.about for m in networks)
    if not torch.cuda.is_available():
        assert f"{paper_cnn.PROCESSOR_STEPS} iterations" in paper_cnn.methods()[0].about
    s = easy(4)
    again = pickle.loads(pickle.dumps(method("recurrent")))
    np.testing.assert_array_equal(
        again.train(s, s.samples, 1).logits(s.samples), train("recurrent", s).logits(s.samples)
    )


@pytest.mark.parametrize(
    ("name", "share", "size", "away"),
    [
        ("paper-cnn", 0.01, 0.3, 0.1),
        ("paper-cnn-centred", 0.01, 0.3, 0.1),
        pytest.param("ds-cnn", 0.1, 0.6, 0.25, marks=pytest.mark.thorough),
        pytest.param("lite", 0.05, 1.0, 0.25, marks=pytest.mark.thorough),
    ],
)
def test_int8_forms_answer_nearly_as_the_float_ones(
    name: str, share: float, size: float, away: float
):
    """Smaller, read by the box, with nearly the same probabilities."""
    s = easy(8)
    model = train(name, s, Effort(share))
    int8 = model.precisions["int8"]
    assert cost.precision(int8.graph()) == "int8"
    reader.read(int8.graph().SerializeToString())
    whole = len(model.graph().SerializeToString())
    assert len(int8.graph().SerializeToString()) < size * whole
    sure, rough = softmax(model.logits(s.samples)), softmax(int8.logits(s.samples))
    np.testing.assert_allclose(rough, sure, atol=away)
    assert not np.array_equal(rough, sure)
    if name.startswith("paper-cnn"):
        moved = softmax(model.logits(s.samples + np.float32(5)))
        assert np.allclose(moved, sure, atol=1e-4) == (name == "paper-cnn-centred")


def test_forms_are_kept_and_counted(tmp_path: Path):
    """Logits of the other precision are read from the file and reported too."""
    s = easy(12)
    order = np.arange(len(s))
    made_ = fold.run(fold.FoldTask("paper-cnn", BRIEF, 1, order[::2], order[1::2]), s, s.samples)
    made_.save(tmp_path / "fold.npz")
    again = fold.Fold.load(tmp_path / "fold.npz")
    assert set(again.forms) == {"int8"}
    np.testing.assert_array_equal(again.forms["int8"], made_.forms["int8"])
    figures = evaluate.Result("paper-cnn", "random:2", False, 1, s, [again]).json()["forms"]["int8"]
    assert figures["window"]["right"] == int(
        (made_.forms["int8"].argmax(1) == s.labels[made_.test]).sum()
    )
    assert figures["agreement"] == np.mean(
        made_.forms["int8"].argmax(1) == made_.logits.argmax(1)
    ).round(4)
    assert 0 < figures["probability_difference"] < 0.2
