"""The compact networks: the cost of each size, exactness of int8, prefixes, and the method as its
int8 graph."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper

from appliance.core.types import SweepFormat
from appliance.sim import skin
from tests.factories.sweep_sets import easy
from train.models import methods
from train.models.methods import Effort
from train.models.recipe import graph, spectrum, stages
from train.models.recipe import methods as compact_methods
from train.models.recipe.architectures import ARCHITECTURES, DEFAULT, Architecture
from train.models.recipe.augment import Augmentation
from train.models.recipe.fitted import Fit
from train.models.recipe.stages import Compact, FitRecipe
from train.onnx_tools import graph_builder
from train.studies import cost as graph_cost

SMALL = Architecture((6, 8, 8), 8, 2)
LIMITS = {"compact-10k": (1e6, 24), "compact-100k": (12e6, 96)}
"""Largest allowed multiply-accumulates and kilobytes."""
CONVOLUTIONAL = {name: shape for name, shape in ARCHITECTURES.items() if shape.channels}
"""The sizes with stages."""


def drawn(format: SweepFormat, n: int = 6, seed: int = 0) -> np.ndarray:
    """Raw counts of n sweeps: every taxel with its own offset, a tone and noise; all are about
    equally noisy."""
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
) -> tuple[Compact, onnx.ModelProto, onnx.ModelProto]:
    """A network with random weights, its float and its int8 trunk."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Compact(format, 3, 0.1, architecture=architecture)
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


def seen(model: Compact, counts: np.ndarray) -> np.ndarray:
    """The features that PyTorch's head sees of the counts."""
    with torch.no_grad():
        return model.head_input(torch.from_numpy(counts.astype(np.float32))).numpy()


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set."""
    return stages.fit_network(easy(), 1, FitRecipe(steps=40), architecture=SMALL)


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
    """For any data type and window, float agrees up to rounding and int8 closely; a silent sweep
    gives the same features at any level."""
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
    """The integer taps of every kernel sum to zero in at most seven bits, so offsets change nothing
    at all."""
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
    """Row d does not depend on any frame after (d + 1) / 10 of the window, to the bit, but on the
    frames just before."""
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
    """They do not respond to hum of any phase, but to twice its frequency, in training and after; a
    kernel shorter than a period responds to both."""
    at = torch.arange(750) / 750
    hum, tone = (
        torch.sin(2 * np.pi * hz * at + torch.rand(16, 1)) for hz in (mains_hz, 2 * mains_hz)
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        deaf, short = (
            Compact(
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
    """It is attenuated to three times the noise of the fifth of sixteen. The others are unchanged
    to the bit, and all are if only a few are touched."""
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
    """A noisy taxel changes the features of the graphs as PyTorch's, and much less than without the
    limit."""
    format = SweepFormat(4, 4, 750.0, 600, dtype)
    model, plain, int8 = trunks(format)
    counts = drawn(format, 4)
    counts[:, :, 1, 2] = np.random.default_rng(3).integers(0, 250, counts.shape[:2])
    want = seen(model, counts)
    np.testing.assert_allclose(graph_builder.run(plain, counts), want, atol=1e-3)
    assert np.abs(graph_builder.run(int8, counts) - want).mean() < 0.1


def test_tenths_are_means_of_what_was_known():
    """In float, the features of the first half are those of a window of half the length, because
    both have the same responses."""
    format = SweepFormat(2, 2, 100.0, 800, "uint8")
    model, trunk, _ = trunks(format, prefixes=True)
    counts = drawn(format, 3)
    half = graph_builder.run(trunk, counts)[:, 4]
    np.testing.assert_allclose(half, seen(model, counts[:, :400]), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVOLUTIONAL)
def test_a_size_costs_what_it_states(name: str):
    """The weights of the float graph and the multiply-accumulates of its convolutions and head are
    as stated and within the limits."""
    cost = ARCHITECTURES[name].cost(skin.FORMAT, 6)
    assert cost.weights == pytest.approx(1000 * int(name[:-1]), rel=0.45)
    plain = (
        Compact(skin.FORMAT, 6, 0.1, norm=False, architecture=ARCHITECTURES[name]).eval().graph()
    )
    assert graph_cost.weights(plain) == cost.weights
    inferred = onnx.shape_inference.infer_shapes(plain, strict_mode=True, data_prop=True).graph
    steps = {v.name: v.type.tensor_type.shape.dim[-1].dim_value for v in inferred.value_info}
    sizes = {c.name: c.dims for c in plain.graph.initializer}
    macs = sum(
        np.prod(sizes[n.input[1]]) * steps[n.output[0]]
        for n in plain.graph.node
        if n.op_type == "Conv"
    )
    assert cost.macs == macs + np.prod(sizes["head.weight"])
    macs, kilobytes = LIMITS.get(f"compact-{name}", (12e6, 96))
    assert cost.macs <= macs
    for shape, limit in (
        (ARCHITECTURES[name], kilobytes),
        (replace(ARCHITECTURES[name], spectrum=True), 96),
    ):
        _, _, int8 = trunks(skin.FORMAT, architecture=shape)
        features = sum(shape.channels) + shape.spectrum * spectrum.count(skin.FORMAT)
        whole = graph_builder.with_head(int8, np.zeros((6, features)), np.zeros(6))
        assert len(whole.SerializeToString()) <= limit * 1024


def test_every_operator_of_int8_is_fused(tmp_path: Path):
    """onnxruntime runs whole-number convolutions on bytes in their order, and integer sums, without
    a transposition."""
    _, _, int8 = trunks(skin.FORMAT, architecture=ARCHITECTURES["20k"])
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
    """Logits are those of the graph to the bit; its precision "float" is the network of the fit;
    the same fit gives the same head."""
    s = easy(12)
    model = methods.find(["compact-1k"], Effort(share=0.02))[0].train(s, s.samples, 1)
    np.testing.assert_array_equal(
        model.logits(s.samples), graph_builder.run(model.graph(), s.samples)
    )
    assert any(n.op_type == "MatMulInteger" for n in model.graph().graph.node)
    plain = model.precisions["float"]
    np.testing.assert_allclose(
        plain.logits(s.samples), graph_builder.run(plain.graph(), s.samples), atol=1e-3
    )
    assert not any(n.op_type == "QuantizeLinear" for n in plain.graph().graph.node)
    weight, bias = model.fit.int8_head()
    z = model.features(s.samples) @ weight.T + bias
    np.testing.assert_allclose(model.logits(s.samples), z, atol=1e-3)
    size = sum(model.fit.architecture.channels) + model.fit.bands
    assert model.features(s.samples[:2], prefixes=True).shape == (2, 10, size)


def test_all_sizes_share_one_recipe():
    """Names are in order of size; `compact` is a size that may lose all stages; the effort reaches
    all."""
    made = {m.name: m for m in compact_methods.methods(Effort(share=0.01))}
    assert list(made) == [*(f"compact-{size}" for size in ARCHITECTURES), "compact"]
    assert made["compact"].train.keywords["architecture"] == replace(ARCHITECTURES["20k"], fewest=0)
    assert {name: shape.fewest for name, shape in ARCHITECTURES.items()} == dict.fromkeys(
        ARCHITECTURES, 1
    ) | {"bands": 0}
    assert ARCHITECTURES["bands"].spectrum
    assert {m.effort for m in made.values()} == {"6 iterations"}


FIRST, SECOND, THIRD, BANDS = (np.repeat(np.arange(4), (6, 8, 8, 5)) == k for k in range(4))
"""Columns of the features of SMALL for 64 frames."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("useful", "depth", "banded"),
    [
        (FIRST, 1, False),
        (SECOND, 2, False),
        (THIRD, 3, False),
        (BANDS, 0, True),
        (FIRST | BANDS, 1, True),
        (SECOND | BANDS, 2, True),
        (THIRD | BANDS, 3, True),
    ],
)
def test_what_only_knows_its_training_is_cut(useful: np.ndarray, depth: int, banded: bool):
    """The heads see the stages, and the spectrum or not, that help on unseen sweeps, even without
    any stage if that is allowed. A set without a spectrum has no such choice."""
    rng, labels, held = np.random.default_rng(0), np.arange(90) % 3, np.arange(60) % 3
    model, _, _ = trunks(SweepFormat(2, 2, 100.0, 64, "uint8"))
    known = rng.standard_normal((3, 27))
    x, y = known[labels] + rng.standard_normal((90, 27)), rng.standard_normal((60, 27))
    y += np.where(useful, known[held], rng.standard_normal((60, 27)))
    for fewest in (0, 1):
        model.architecture = replace(SMALL, spectrum=True, fewest=fewest)
        less, weights = stages._select_depth(model, ((x, y), (x, y)), labels, held)
        least = max(depth, fewest)
        assert (len(less.convs), less.architecture) == (
            least,
            model.architecture.cut(least, banded),
        )
        seen_by_heads = sum(SMALL.channels[:least]) + 5 * banded
        assert weights["int8.weight"].shape == weights["head.weight"].shape == (3, seen_by_heads)
    if not useful[BANDS].any():
        model.architecture = SMALL
        less, _ = stages._select_depth(model, ((x[:, ~BANDS], y[:, ~BANDS]),) * 2, labels, held)
        assert less.architecture == SMALL.cut(depth)


def test_a_cut_network_gives_what_its_first_stages_gave():
    """Each stage is unchanged; after them comes the spectrum, or the spectrum is alone."""
    model, _, _ = trunks(SweepFormat(2, 2, 100.0, 64, "uint8"))
    counts = drawn(model.format)
    model.architecture = replace(SMALL, spectrum=True)
    every = seen(model, counts)
    assert every.shape == (6, 27)
    for depth, banded, columns in (
        (2, False, FIRST | SECOND),
        (1, True, FIRST | BANDS),
        (0, True, BANDS),
    ):
        less = model.cut(depth, banded)
        np.testing.assert_array_equal(seen(less, counts), every[:, columns])
        assert less.architecture.stages(64) == SMALL.stages(64)[:depth]
        assert less.architecture.zero_sum(64) == SMALL.zero_sum(64)


@pytest.fixture(scope="module")
def bare() -> compact_methods.CompactModel:
    """The method on a set for which stages say nothing about held-out sweeps."""

    def blind(model: Compact, *others: object) -> stages.HeadInputs:
        inputs, size = seen_by_heads(model, *others), sum(model.architecture.channels)
        for _, held in inputs:
            held[:, :size] = 9 * np.random.default_rng(0).standard_normal((len(held), size))
        return inputs

    seen_by_heads, s = stages._head_inputs, easy()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "_head_inputs", blind)
        return methods.find(["compact"], Effort(share=0.01))[0].train(s, s.samples, 1)


@pytest.mark.slow
def test_compact_may_end_without_a_convolution(bare: compact_methods.CompactModel):
    """Then nothing in its graph is int8, both precisions agree, and it still learns an easy set."""
    assert bare.fit.architecture == DEFAULT.cut(0, spectrum=True)
    assert bare.fit.ranges.responses == ()
    done = {n.op_type for n in bare.graph().graph.node}
    assert not {"Conv", "QuantizeLinear", "DequantizeLinear", "MatMulInteger"} & done
    other = easy(seed=9).samples
    logits = bare.logits(other)
    np.testing.assert_array_equal(logits, graph_builder.run(bare.graph(), other))
    np.testing.assert_allclose(bare.precisions["float"].logits(other), logits, atol=2e-3)
    np.testing.assert_allclose(
        graph_builder.run(bare.precisions["float"].graph(), other), logits, atol=2e-3
    )
    assert np.mean(logits.argmax(1) == easy(seed=9).labels) > 0.9
    assert bare.features(other[:2], prefixes=True).shape == (2, 10, bare.fit.bands)


def test_a_fit_without_a_convolution_survives_its_file(
    bare: compact_methods.CompactModel, tmp_path: Path
):
    """It gives the same bits in PyTorch and in its graphs."""
    bare.fit.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert (again.architecture, again.ranges, again.bands) == (
        bare.fit.architecture,
        bare.fit.ranges,
        5,
    )
    counts = easy(2).samples
    with torch.no_grad():
        x = torch.from_numpy(counts.astype(np.float32))
        assert torch.equal(stages.network_of(again)(x), stages.network_of(bare.fit)(x))
    for prefixes in (False, True):
        assert again.trunk(prefixes=prefixes) == bare.fit.trunk(prefixes=prefixes)
        assert again.trunk(int8=False, prefixes=prefixes) == again.trunk(prefixes=prefixes)


@pytest.mark.parametrize("frames", [64, 1500])
def test_training_augments_as_its_generator_says(frames: int):
    """PyTorch trains on the same sweeps for the same state of its generator, which moves on; the
    original sweeps do not change."""
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
