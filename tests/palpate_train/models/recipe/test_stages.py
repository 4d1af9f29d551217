"""The trained stages: their sizes, invariances and training; exactness of int8, and prefixes."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate_studies import cost
from palpate_train.data.augment import Augmentation
from palpate_train.data.run import Run
from palpate_train.models import methods
from palpate_train.models.methods import Effort
from palpate_train.models.recipe import architectures, graph, spectrum
from palpate_train.models.recipe.architectures import STAGES, Architecture
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.recipe import Settings, Setup
from palpate_train.onnx_tools import graph_builder
from tests.factories.later import Later
from tests.factories.sweep_sets import easy
from tests.factories.trained_stages import joining, with_stages

torch = Later("torch")
stages = Later("palpate_train.models.recipe.stages")

SMALL = Architecture((6, 8, 8), 8, 2)


def drawn(format: SweepFormat, n: int = 6, seed: int = 0) -> np.ndarray:
    """n sweeps: every taxel with its own offset, a tone and noise."""
    rng, t = (
        np.random.default_rng(seed),
        np.arange(format.window).reshape(-1, *(1,) * len(format.shape)),
    )
    taxels = (n, 1, *format.shape)
    x = rng.uniform(80, 120, taxels) + rng.uniform(8, 14, taxels) * np.sin(
        t * rng.uniform(0.6, 1.2, taxels)
    )
    return (x + rng.standard_normal((n, format.window, *format.shape))).astype(format.dtype)


def trunks(
    format: SweepFormat, architecture: Architecture = SMALL, **asked: bool
) -> tuple[stages.StagesNetwork, onnx.ModelProto, onnx.ModelProto]:
    """A network with random weights, its float and its int8 trunk."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = stages.StagesNetwork(format, 3, 0.1, architecture=architecture)
        model.train()(torch.from_numpy(drawn(format).astype(np.float32)))
    model = model.fused()
    weights, found = (
        {k: v.numpy() for k, v in model.state_dict().items()},
        model.ranges(drawn(format)),
    )
    return model, *(
        graph.trunk_graph(format, 0.1, weights, architecture, ranges, **asked)
        for ranges in (None, found)
    )


def seen(model: stages.StagesNetwork, counts: np.ndarray) -> np.ndarray:
    """The features of the counts in PyTorch."""
    with torch.no_grad():
        return model.features(model.prepare(torch.from_numpy(counts.astype(np.float32)))).numpy()


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set."""
    return with_stages(easy())


@pytest.mark.slow
def test_stages_follow_the_window():
    """The kernels of the two known windows; every window gets a last stage, or a message."""
    assert [(s.kernel, s.stride) for s in STAGES.stages(1500)] == [(32, 4), (5, 2), (5, 2)]
    assert [(s.kernel, s.stride) for s in STAGES.stages(128)] == [(4, 1), (5, 2), (5, 2)]
    assert STAGES.stages(1500)[-1] == architectures.FilterStage(5, 2, 89, 32 + 4 * 4 + 4 * 8, 16)
    bare = Architecture((), planned=3)
    for window in range(16, 3000):
        last = STAGES.stages(window)[-1]
        assert last.steps >= (architectures.MIN_LAST_STEPS if window >= 108 else 1)
        assert (last.steps - 1) * last.hop + last.reach <= window
        assert bare.stages(window) == ()
        assert bare.zero_sum(window) == STAGES.zero_sum(window)
    for shape in (STAGES, bare):
        with pytest.raises(FormatError, match="15 frames"):
            shape.stages(15)


def test_stages_are_as_large_as_stated_and_tenths_what_was_known():
    """50,000 weights, 96 kB in int8; half the window is a window of half the length."""
    model, plain, int8 = trunks(skin.FORMAT, STAGES)
    size = sum(p.numel() for p in model.convs.parameters())
    assert size == cost.weights(plain) == pytest.approx(50_000, rel=0.1)
    assert cost.macs(plain) < 12e6
    more, features = replace(STAGES, spectrum=True), 152 + spectrum.count(skin.FORMAT)
    both = graph.trunk_graph(
        skin.FORMAT, 0.1, model.weights(), more, model.ranges(drawn(skin.FORMAT))
    )
    whole = graph_builder.with_head(both, np.zeros((6, features)), np.zeros(6))
    assert len(int8.SerializeToString()) < len(whole.SerializeToString()) <= 96 * 1024
    format = SweepFormat(2, 2, 100.0, 800, "uint8")
    model, trunk, _ = trunks(format, prefixes=True)
    counts = drawn(format, 3)
    half = graph_builder.run(trunk, counts)[:, 4]
    np.testing.assert_allclose(half, seen(model, counts[:, :400]), atol=1e-3)


@pytest.mark.slow
def test_stages_ignore_offsets():
    """A constant changes nothing, because of the kernels and not of `prepare`."""
    model = stages.StagesNetwork(skin.FORMAT, 6, 0.1, norm=False)
    rng = np.random.default_rng(0)
    counts = torch.from_numpy(rng.integers(0, 100, (2, 16, 1500)).astype(np.float32))
    offset = torch.from_numpy(rng.integers(0, 100, (2, 16, 1)).astype(np.float32))
    with torch.no_grad():
        torch.testing.assert_close(
            model.training_logits(counts + offset), model.training_logits(counts), rtol=0, atol=1e-4
        )
        assert (
            model.training_logits(counts * 2) - model.training_logits(counts)
        ).abs().max() > 0.01


@pytest.mark.slow
def test_fused_norms_change_nothing():
    """The folded network answers as the trained one in evaluation."""
    model = stages.StagesNetwork(SweepFormat(2, 2, 100.0, 64, "uint8"), 3, 0.1)
    counts = torch.from_numpy(easy(8).samples.astype(np.float32))
    for norm in model.norms:
        torch.nn.init.uniform_(norm.weight, 0.5, 2)
        torch.nn.init.uniform_(norm.bias, -1, 1)
    with torch.no_grad():
        model(counts)  # moves the running means
        torch.testing.assert_close(model.fused()(counts), model.eval()(counts))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "cols", "window", "dtype", "axes"),
    [
        (4, 4, 1500, "uint8", 1),
        (3, 3, 150, "int16", 1),
        (1, 1, 20, "uint16", 1),
        (16, 1, 128, "float32", 1),
        (3, 3, 600, "float32", 3),
        (2, 1, 150, "uint8", 2),
    ],
)
def test_both_graphs_are_the_network(rows: int, cols: int, window: int, dtype: str, axes: int):
    """Any type and window: float up to rounding, int8 closely; silence at any level."""
    format = SweepFormat(rows, cols, 100.0, window, dtype, axes)
    model, plain, int8 = trunks(format)
    counts = drawn(format, seed=1)
    want = seen(model, counts)
    np.testing.assert_allclose(graph_builder.run(plain, counts), want, atol=1e-3)
    have = graph_builder.run(int8, counts)
    assert have.shape == want.shape
    assert np.abs(have - want).mean() < 0.1
    silent = np.stack([np.full(counts.shape[1:], level, dtype) for level in (0, 90)])
    quiet = graph_builder.run(int8, silent)
    np.testing.assert_array_equal(quiet[0], quiet[1])
    assert np.isfinite(quiet).all()


def test_no_offset_moves_a_bit_of_bytes():
    """Integer taps sum to zero in at most seven bits, so offsets change nothing."""
    format = skin.FORMAT
    _, _, int8 = trunks(format)
    values = {c.name: numpy_helper.to_array(c) for c in int8.graph.initializer}
    first = next(v for v in values.values() if v.dtype == np.int8 and v.ndim == 3)
    np.testing.assert_array_equal(first.sum(axis=2, dtype=int), 0)
    assert np.abs(first).max() == graph_builder.MAX_TAP
    counts = drawn(format, 2)
    offset = np.random.default_rng(1).integers(0, 60, (2, 1, 4, 4)).astype(np.uint8)
    np.testing.assert_array_equal(
        graph_builder.run(int8, counts + offset), graph_builder.run(int8, counts)
    )


def test_rounding_to_zero_sums_moves_as_little_as_it_can():
    """Of all ways to round up or down to a sum of zero none is nearer; whole taps do not change."""
    rng = np.random.default_rng(0)
    taps = rng.uniform(-60, 60, (40, 3, 6))
    taps -= taps.mean(axis=2, keepdims=True)
    have = graph_builder.zero_sum_taps(taps)
    np.testing.assert_array_equal(have.sum(axis=2), 0)
    ways = np.stack(np.meshgrid(*[(0, 1)] * 6, indexing="ij"), -1).reshape(-1, 6)
    rounded = np.floor(taps)[:, :, None] + ways
    cost = np.where(rounded.sum(3) == 0, np.abs(rounded - taps[:, :, None]).sum(3), np.inf).min(2)
    np.testing.assert_allclose(np.abs(have - taps).sum(2), cost, atol=1e-9)
    whole = np.array([[[64.0, -64, 3, -3]]])
    np.testing.assert_array_equal(graph_builder.zero_sum_taps(whole), whole)


@pytest.mark.slow
@pytest.mark.parametrize("int8", [False, True])
@pytest.mark.parametrize(("window", "dtype"), [(1500, "uint8"), (128, "int16"), (25, "float32")])
def test_a_tenth_knows_nothing_of_what_follows(int8: bool, window: int, dtype: str):
    """Row d does not depend on later frames, to the bit, but on those just before."""
    format = SweepFormat(2, 2, 100.0, window, dtype)
    trunk, whole = trunks(format, prefixes=True)[1 + int8], trunks(format)[1 + int8]
    counts, other = drawn(format, 3), drawn(format, 3, seed=7)
    want = graph_builder.run(trunk, counts)
    assert want.shape == (3, 10, 22)
    np.testing.assert_allclose(want[:, -1], graph_builder.run(whole, counts), atol=2e-5)
    for d in range(9):
        end = window * (d + 1) // 10
        have = graph_builder.run(trunk, np.concatenate([counts[:, :end], other[:, end:]], axis=1))
        np.testing.assert_array_equal(have[:, : d + 1], want[:, : d + 1])
        held = graph_builder.run(
            trunk,
            np.concatenate(
                [counts[:, :end], np.repeat(counts[:, end - 1 : end], window - end, 1)], 1
            ),
        )
        np.testing.assert_array_equal(held[:, d], want[:, d])
    if window == 1500:
        assert not np.array_equal(have[:, 9], want[:, 9])
        early = counts.copy()
        early[:, 1200:1300] = other[:, 1200:1300]
        assert (graph_builder.run(trunk, early)[:, 8:] != want[:, 8:]).any(axis=2).all()


@pytest.mark.parametrize("mains_hz", [50, 60])
def test_the_first_kernels_do_not_hear_the_mains(mains_hz: int):
    """No response to hum of any phase, but to twice its frequency; short kernels to both."""
    at = torch.arange(750) / 750
    hum, tone = (
        torch.sin(2 * np.pi * hz * at + torch.rand(16, 1)) for hz in (mains_hz, 2 * mains_hz)
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        deaf, short = (
            stages.StagesNetwork(
                skin.FORMAT, 3, 1.0, architecture=Architecture((6, 8), kernel, 4, mains_hz=mains_hz)
            )
            for kernel in (16, 8)
        )
    with torch.no_grad():
        for model in (deaf, deaf.fused()):
            first = model.convs[0]
            assert (first(hum) - first.bias[:, None]).abs().max() < 1e-4
            assert (first(tone) - first.bias[:, None]).abs().max() > 0.1
        assert (short.convs[0](hum) - short.convs[0].bias[:, None]).abs().max() > 0.1


def test_a_noisy_taxel_is_attenuated():
    """To three times the noise of the fifth of sixteen; the others stay to the bit."""
    x = torch.randn(2, 16, 1500, generator=torch.Generator().manual_seed(0))
    loud = x.clone()
    loud[0, 3] *= 40
    have = stages.limit_noise(loud)
    noise = (have[:, :, 1::10] - have[:, :, :-1:10]).abs().mean(2)
    assert noise[0, 3] == pytest.approx(
        3 * noise[0].sort(descending=True).values[4].item(), rel=1e-5
    )
    others = torch.arange(16) != 3
    assert torch.equal(have[:, others], x[:, others])
    assert torch.equal(have[1], x[1])
    loud[:, 4:] = 0
    assert torch.equal(stages.limit_noise(loud), loud)
    assert torch.equal(stages.limit_noise(loud[:, 3:4]), loud[:, 3:4])


@pytest.mark.parametrize("dtype", ["uint8", "int16"])
def test_int8_attenuates_as_the_network_does(dtype: str):
    """It changes the graphs' features as PyTorch's, much less than without the limit."""
    format = SweepFormat(4, 4, 750.0, 600, dtype)
    model, plain, int8 = trunks(format)
    counts = drawn(format, 4)
    counts[:, :, 1, 2] = np.random.default_rng(3).integers(0, 250, counts.shape[:2])
    want = seen(model, counts)
    np.testing.assert_allclose(graph_builder.run(plain, counts), want, atol=1e-3)
    assert np.abs(graph_builder.run(int8, counts) - want).mean() < 0.1


def test_every_operator_of_int8_is_fused(tmp_path: Path):
    """onnxruntime convolves bytes in whole numbers, without a transposition."""
    _, _, int8 = trunks(skin.FORMAT, STAGES)
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimized.onnx")
    options.log_severity_level = 3
    onnxruntime.InferenceSession(
        int8.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    done = Counter(n.op_type for n in onnx.load(tmp_path / "optimized.onnx").graph.node)
    assert (done["QLinearConv"], done["QLinearMul"], done["MatMulInteger"]) == (3, 1, 3)
    assert not {"Conv", "DequantizeLinear", "Range", "Less", "MatMul"} & set(done)
    assert done["Transpose"] == 0


@pytest.mark.slow
def test_the_method_is_its_int8_graph():
    """Its logits to the bit; "float" is the float trunk with a head of its own."""
    s = easy(12)
    with joining():
        (method,) = methods.find(["palpate-stages"], Effort(share=0.02))
        model = method.train(s, s.samples, 1)
    np.testing.assert_array_equal(
        model.logits(s.samples), graph_builder.run(model.graph(), s.samples)
    )
    assert any(n.op_type == "MatMulInteger" for n in model.graph().graph.node)
    plain = model.precisions["float"]
    assert not any(n.op_type == "QuantizeLinear" for n in plain.graph().graph.node)
    size = sum(STAGES.channels) + model.fit.bands
    features = graph_builder.run(model.fit.trunk(int8=False), s.samples)
    assert features.shape == (len(s), size)
    with torch.no_grad():
        counts = torch.from_numpy(s.samples.astype(np.float32))
        network = stages.network_of(model.fit)
        features[:, : sum(STAGES.channels)] = network.features(network.prepare(counts))
    head = (model.fit.weights[f"head.{part}"] for part in ("weight", "bias"))
    z = features @ next(head).T + next(head)
    np.testing.assert_allclose(plain.logits(s.samples), z, atol=1e-3)
    weight, bias = model.fit.int8_head()
    z = model.features(s.samples) @ weight.T + bias
    np.testing.assert_allclose(model.logits(s.samples), z, atol=1e-3)
    assert model.features(s.samples[:2], prefixes=True).shape == (2, 10, size)


@pytest.mark.slow
def test_a_fit_learns_what_is_easy(fitted: Fit):
    """Far above chance on another seed, as it says; held-out recordings are not trained on."""
    other = easy(seed=9)
    model = graph_builder.with_head(fitted.trunk(), *fitted.int8_head())
    assert np.mean(graph_builder.run(model, other.samples).argmax(1) == other.labels) > 0.9
    assert not set(fitted.train.groups["recording"]) & set(fitted.held.groups["recording"])
    assert fitted.about["validation"]["accuracy"] > 0.9


@pytest.mark.slow
def test_trained_stages_depend_on_their_seed_alone():
    """The same bits for any random state outside; another seed gives other bits."""

    def trained(seed: int) -> dict[str, np.ndarray]:
        return stages.train_stages(easy(8), 0.1, Run(seed), 4, Augmentation())[0]

    first = trained(1)
    torch.manual_seed(99)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    again = trained(1)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    for name, value in first.items():
        np.testing.assert_array_equal(again[name], value)
    assert not np.array_equal(trained(2)["convs.0.weight"], first["convs.0.weight"])


@pytest.mark.slow
def test_positions_are_held_out_where_there_are_several():
    """Stages are judged by a position that their training never saw."""
    s = easy()
    s.groups["position"] = np.arange(len(s)) % 5
    setup = Setup.of(s, Run(1), Settings())
    seen, held = (side.groups["position"] for side in setup.sides)
    assert setup.judging.group == "position"
    assert len(np.unique(held)) == 1
    assert not set(seen) & set(held)


@pytest.mark.slow
def test_a_fit_of_another_form_is_refused(tmp_path: Path, fitted: Fit):
    """Weights that do not fit the file's architecture are refused, and an unknown change of the
    sweeps."""
    unknown = json.loads(json.dumps(fitted.about))
    unknown["recipe"]["augmentation"]["twisted"] = 0.5
    replace(fitted, about=unknown).save(tmp_path / "fit.npz")
    with pytest.raises(FormatError, match="twisted"):
        Fit.load(tmp_path / "fit.npz")
    replace(fitted, architecture=SMALL).save(tmp_path / "fit.npz")
    with pytest.raises(FormatError, match=r"8, 8\).*; fit again$"):
        Fit.load(tmp_path / "fit.npz")
    with np.load(tmp_path / "fit.npz") as z:
        old = dict(z)
    meta = json.loads(str(old["meta"]))
    del meta["architecture"]
    np.savez(tmp_path / "old.npz", **old | {"meta": np.array(json.dumps(meta))})
    with pytest.raises(FormatError, match=r"again: 'architecture'$"):
        Fit.load(tmp_path / "old.npz")


@pytest.mark.parametrize("frames", [64, 1500])
def test_training_augments_as_its_generator_says(frames: int):
    """The same sweeps for the same state of the generator, which moves on."""
    format, x = SweepFormat(2, 2, 100.0, frames, "uint8"), torch.randn(6, frames, 4).transpose(1, 2)
    before, rng, again = (
        x.clone(),
        torch.Generator().manual_seed(3),
        torch.Generator().manual_seed(3),
    )
    change = stages.augmenter(format, Augmentation())
    first, second, same = change(x, rng), change(x, rng), change(x, again)
    assert first.shape == x.shape
    assert first.dtype == torch.float32
    assert torch.equal(first, same)
    assert not torch.equal(first, second)
    assert torch.equal(x, before)
