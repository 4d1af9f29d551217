"""Export: the graphs, the checks that a bundle must pass, and its refusals with their reasons."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest
from palpate.cli.main import main as palpate
from palpate.core import sweep_set
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError, FormatError
from palpate.core.types import SweepFormat
from palpate.inference.classifier import Classifier
from palpate.inference.session import session
from palpate.sim import skin
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_studies import cost, references
from palpate_train.answer import rules, stranger_limits
from palpate_train.answer.heads import HeadData
from palpate_train.answer.rules import RULES, Asked, present
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.export import card, contents, pack, quantized_bundle
from palpate_train.export.contents import ExportRefused
from palpate_train.metrics import bundle_score, tolerances
from palpate_train.metrics.score import REFUSED
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.recipe import graph as recipe_graph
from palpate_train.models.recipe import loads, recipe
from palpate_train.models.recipe.fitted import Fit, finished
from palpate_train.models.recipe.sizes import SIZES
from palpate_train.onnx_tools import graph_builder, parity
from palpate_train.onnx_tools.quantize import quantize
from tests.factories.later import Later
from tests.factories.sweep_sets import easy
from tests.factories.trained_stages import with_stages

torch = Later("torch")
stages = Later("palpate_train.models.recipe.stages")

pytestmark = pytest.mark.slow
ALONE_AND_FUSED = ("network alone", "by recording")
"""Figures beside that of the box's answers to single sweeps."""


def close(n: int = 80) -> Dataset:
    """Sweeps [n, 64, 2, 2] of three materials that hum at nearly equal rates, in much noise."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), n)
    pitch = np.array([0.11, 0.15, 0.2])[labels] * rng.uniform(0.9, 1.1, 3 * n)
    phase = 2 * np.pi * (pitch[:, None] * np.arange(64) + rng.random((3 * n, 1)))
    offset = rng.uniform(80, 120, (3 * n, 1, 2, 2))
    samples = offset + 12 * np.sin(phase)[:, :, None, None]
    samples = (samples + 8 * rng.standard_normal((3 * n, 64, 2, 2))).astype("uint8")
    groups, names = {"recording": np.arange(3 * n)}, ("low", "middle", "high")
    return Dataset(samples, labels, names, 100.0, groups, "close")


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set, two sweeps to a recording, of a skin that reads 0 without contact."""
    sweeps = easy(pieces=2)
    rest = np.zeros((len(sweeps), 2, *sweeps.format.shape))
    shown = {"low": "tief, 低い", "gone": "weg"}
    return with_stages(replace(sweeps, unloaded=rest, displays=shown))


@pytest.fixture(scope="module")
def tight() -> Fit:
    """A fit on a set that needs the whole resolution of int8."""
    return with_stages(close(), steps=60)


def export(fit: Fit | MethodFit, target: Path, name: str = "easy", **more: Any) -> Manifest:
    """Export it as version 1 of a commit; the manifest."""
    return quantized_bundle.export(fit, target, name, "1", "0123abcd", **more)


@pytest.fixture(scope="module")
def packed(fitted: Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundle of `fitted`."""
    target = tmp_path_factory.mktemp("export") / "bundle"
    export(fitted, target)
    return target


def box(folder: Path) -> Classifier:
    """The classifier of the box for a bundle."""
    return Classifier(bundle.load(folder), SystemClock())


def operators(folder: Path) -> set[str]:
    """The operators of a bundle's graph."""
    return {n.op_type for n in onnx.load(folder / bundle.MODEL).graph.node}


def negated(fitted: Fit) -> Fit:
    """A fit whose float head gives the opposite logits."""
    return replace(fitted, weights=fitted.weights | {"head.weight": -fitted.weights["head.weight"]})


@pytest.mark.parametrize("dtype", graph_builder.TENSOR)
def test_the_float_graph_is_the_network(dtype: str):
    """For each type PyTorch's logits, fixed shapes, and the sensor's counts as input."""

    def shapes(model: onnx.ModelProto) -> list[list[int]]:
        """Every inferred shape of the graph."""
        graph = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
        return [
            [d.dim_value for d in v.type.tensor_type.shape.dim]
            for v in (*graph.input, *graph.value_info, *graph.output)
        ]

    form = SweepFormat(3, 2, 100.0, 128, dtype)
    torch.manual_seed(0)
    model = stages.StagesNetwork(form, 3, 0.1, norm=False).eval()
    weights = model.weights()
    trunk = recipe_graph.trunk_graph(model.format, model.scale, weights, model.architecture)
    graph = graph_builder.with_head(trunk, weights["head.weight"], weights["head.bias"])
    counts = np.random.default_rng(0).integers(0, 200, (5, 128, 3, 2)).astype(dtype)
    with torch.no_grad():
        want = model(torch.from_numpy(counts.astype(np.float32))).numpy()
    np.testing.assert_allclose(parity.logits(graph, counts), want, atol=1e-3)
    assert all(size > 0 for shape in shapes(graph) for size in shape)
    (given,) = graph.graph.input
    assert (given.name, given.type.tensor_type.elem_type) == ("sweep", graph_builder.TENSOR[dtype])
    assert [d.dim_value for d in given.type.tensor_type.shape.dim] == [1, 128, 3, 2]


def test_the_int8_graph_computes_its_convolutions_in_int8(fitted: Fit, packed: Path):
    """Seven bits, a scale a channel; every convolution between quantizers; 1 x K."""
    model = onnx.load(packed / bundle.MODEL)
    maker = {name: n for n in model.graph.node for name in n.output}
    values = {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}
    convs = [n for n in model.graph.node if n.op_type == "Conv"]
    assert len(convs) == len(fitted.architecture.channels)
    for conv in convs:
        assert [maker[name].op_type for name in conv.input] == ["DequantizeLinear"] * 3
        weight, scale = (values[name] for name in maker[conv.input[1]].input[:2])
        assert weight.dtype == np.int8
        assert 60 <= np.abs(weight.astype(int)).max() <= 64
        assert scale.shape == (len(weight),)
        (after,) = (n for n in model.graph.node if conv.output[0] in n.input)
        assert after.op_type == "QuantizeLinear"
    run = session(model.SerializeToString())
    assert [(i.name, i.shape, i.type) for i in run.get_inputs()] == [
        ("sweep", [1, 64, 2, 2], "tensor(uint8)")
    ]
    assert [(o.name, o.shape, o.type) for o in run.get_outputs()] == [
        (name, [1, size], "tensor(float)")
        for name, size in (("logits", 3), ("embedding", 2 + fitted.bands))
    ]


def test_quantizing_leaves_its_model_alone(fitted: Fit):
    """onnxruntime empties the model that it gets; ours still runs."""
    trunk = fitted.trunk(int8=False)
    before = trunk.SerializeToString()
    quantize(trunk, fitted.train.samples[:4])
    assert trunk.SerializeToString() == before


def test_a_bundle_passes_its_own_tests(fitted: Fit, packed: Path):
    """Golden sweeps of two materials, held-out figures, trained thresholds, small files."""
    it = box(packed)
    assert it.self_test() < 1e-6
    manifest = it.bundle.manifest
    assert it.bundle.golden_logits.argmax(1).tolist() == [0, 2]
    held = manifest.figures["held-out speed"]
    assert held["n"] == len(fitted.held)
    others = held["wrong"] + held["unsure"] + held["unknown"]
    assert held["accuracy"] + others / held["n"] == pytest.approx(1, abs=1e-4)
    assert held["refused"] == 0
    alone, fused = (manifest.figures[f"held-out speed, {how}"] for how in ALONE_AND_FUSED)
    assert alone["accuracy"] >= held["accuracy"]
    assert fused["n"] == len(fitted.held) / 2
    result = manifest.figures["parity"]
    assert result["agreement"] >= quantized_bundle.LEAST_AGREEMENT
    assert result["lost"] <= tolerances.LOST
    assert result["total"] == len(fitted.held)
    weakest = fitted.train.samples.mean(axis=1).max(axis=(1, 2)).min()
    assert manifest.thresholds.contact == pytest.approx(0.1 * weakest)
    assert manifest.thresholds.full_scale == 255
    assert manifest.labels == ("low", "middle", "high")
    assert (manifest.made["commit"], manifest.made["seed"]) == ("0123abcd", 1)
    assert np.mean(bundle_score.labels_of(it, easy(seed=5))[0] == easy(seed=5).labels) > 0.9


def test_a_rule_for_moved_sweeps_needs_places(fitted: Fit, packed: Path, tmp_path: Path):
    """The distance of taxels gives it; else no arrays for it."""
    export(fitted, tmp_path / "placed", pitch_mm=4.0, asked=Asked(("displacement",)))
    placed, plain = bundle.load(tmp_path / "placed"), bundle.load(packed)
    assert placed.manifest.contact
    assert placed.manifest.displacement
    assert placed.classes
    assert placed.classes.displaced
    assert plain.manifest.displacement is None
    with np.load(packed / bundle.MEANS) as arrays:
        assert not [name for name in arrays if name.startswith("displaced")]


def test_rules_are_left_out_as_asked(fitted: Fit, tmp_path: Path):
    """Early answers are not in the graph, and nothing measures how well a material is known."""
    asked = Asked(left_out=("unknown", "early", "taxels"))
    export(fitted, tmp_path / "less", proven=False, asked=asked)
    less = bundle.load(tmp_path / "less")
    assert not set(present(less)) & set(asked.left_out)
    assert less.classes is None
    assert "early" not in [output.name for output in onnx.load_from_string(less.model).graph.output]
    assert box(tmp_path / "less").self_test() < bundle.GOLDEN_TOLERANCE


def test_figures_of_held_out_sweeps_are_not_of_heads_that_saw_them(fitted: Fit):
    """Heads fitted to held-out sweeps would give their wrong labels; others do not."""
    wrong = replace(fitted.held, labels=(fitted.held.labels + 1) % 3)
    spoilt = replace(fitted, held=wrong)
    honest, misled = (
        finished(one).held_out_figures()["held-out speed, network alone"]["accuracy"]
        for one in (fitted, spoilt)
    )
    assert honest > 0.9
    assert misled < 0.1


def test_the_same_fit_gives_the_same_bytes(
    fitted: Fit, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """From the file of the fit, which keeps calibration and contacts."""
    fitted.save(tmp_path / "fit.npz")
    monkeypatch.setattr(quantized_bundle, "finished", None)
    read = Fit.load(tmp_path / "fit.npz")
    for made in (fitted, read):
        assert made.calibration
        assert made.contacts
    export(read, tmp_path / "again")
    for file in (bundle.MANIFEST, bundle.MODEL, bundle.GOLDEN, bundle.MEANS):
        assert (tmp_path / "again" / file).read_bytes() == (packed / file).read_bytes(), file
    assert sorted(f.name for f in tmp_path.iterdir()) == ["again", "fit.npz"]


def test_scores_are_fused_by_recording(packed: Path):
    """A window gets the label of its recording's product; refused ones get -1."""
    it, s = box(packed), easy(10, pieces=5, seed=7)
    s.samples[3] = 0
    s.samples[9] = s.samples[29]
    alone, fused = bundle_score.labels_of(it, s)[0], bundle_score.labels_of(it, s, fused=True)[0]
    assert np.flatnonzero(alone == REFUSED).tolist() == [3]
    assert alone[9] != fused[9]
    p = softmax(np.stack([it.logits(x) for x in s.samples]))
    for recording in np.unique(s.groups["recording"]):
        member = s.groups["recording"] == recording
        assert set(fused[member]) == {np.log(p[member & (alone != REFUSED)]).sum(0).argmax()}


def test_a_head_that_says_otherwise_stays_in_float(fitted: Fit, packed: Path, tmp_path: Path):
    """int8 disagrees with a spoilt float head: the bundle is float, with the reason."""
    made = export(negated(fitted), tmp_path / "bundle")
    why = made.made["float_because"]
    assert re.match(r"int8 loses .*limit 0\.5", why)
    assert "QuantizeLinear" not in operators(tmp_path / "bundle")
    assert "float_because" not in bundle.load(packed).manifest.made


def test_stages_are_compared_with_pytorch_beside_any_feature(fitted: Fit):
    """PyTorch computes no loads; the head here ignores them."""
    size, at = loads.count(fitted.train.format), sum(fitted.architecture.channels)
    weight = np.insert(fitted.weights["head.weight"], [at] * size, 0, axis=1)
    more = replace(
        fitted,
        architecture=replace(fitted.architecture, loads=True),
        weights=fitted.weights | {"head.weight": weight, "int8.weight": weight},
    )
    differences = [
        quantized_bundle._torch_difference(fit, quantized_bundle.graphs(fit)[0])
        for fit in (fitted, more)
    ]
    assert differences[0] == pytest.approx(differences[1], abs=1e-4)
    assert 0 < differences[0] < quantized_bundle.MOST_TORCH_DIFFERENCE


def without_numbers(fitted: Fit) -> dict[str, np.ndarray]:
    """Weights whose float head gives nan."""
    return fitted.weights | {"head.bias": fitted.weights["head.bias"] * np.nan}


def judged(fitted: Fit) -> None:
    """Compare both precisions as export does."""
    reference, int8 = quantized_bundle.graphs(fitted)
    quantized_bundle.check(
        *parity.measure(int8, reference, fitted.held.samples, fitted.held.labels)
    )


def ranged(fitted: Fit, responses: Sequence[float]) -> Fit:
    """A fit with these ranges of its stages in int8, its head refitted."""
    other = replace(fitted, ranges=replace(fitted.ranges, responses=tuple(responses)))
    seen, unseen = (
        graph_builder.run(other.trunk(), s.samples) for s in (fitted.train, fitted.held)
    )
    labels = fitted.train.labels
    weight, bias = fitted.plan.fit(
        HeadData(seen, labels, lambda: seen[:0], labels[:0], np.empty((len(labels), 0))), 3
    )
    temperature = platt_temperature(unseen @ weight.T + bias, fitted.held.labels)
    weight, bias = weight / temperature, bias / temperature
    return replace(other, weights=fitted.weights | {"int8.weight": weight, "int8.bias": bias})


@pytest.mark.thorough  # a fit of its own
def test_a_range_for_one_outlier_is_refused(tight: Fit):
    """Ranges reach to the largest value: an outlier leaves too little for others."""
    wild = tight.train.samples[:1].astype(np.float32)
    wild = wild.mean(axis=1, keepdims=True) + 1000 * (wild - wild.mean(axis=1, keepdims=True))
    network = stages.network_of(tight)
    with torch.no_grad():
        responses = network.responses(network.prepare(torch.from_numpy(wild)))
    with pytest.raises(ExportRefused, match="limit"):
        judged(ranged(tight, [float(x.max()) for x in responses]))
    judged(ranged(tight, tight.ranges.responses))


def test_a_saturated_layer_and_an_old_head_are_refused(tight: Fit):
    """No head makes up for .3 % of a range; behind int8 only a head of its own copes."""
    first, *others = tight.ranges.responses
    with pytest.raises(ExportRefused, match="limit"):
        judged(ranged(tight, (0.003 * first, *others)))
    *before, last = tight.ranges.responses
    refitted = ranged(tight, (*before, 0.1 * last))
    judged(refitted)
    stale = {f"int8.{name}": refitted.weights[f"head.{name}"] for name in ("weight", "bias")}
    with pytest.raises(ExportRefused, match=r"(loses|moves|is right)"):
        judged(replace(refitted, weights=refitted.weights | stale))


@pytest.mark.parametrize(
    ("good", "bad", "message"),
    [
        ({"n": 1200, "lost": 6}, {"n": 1200, "lost": 7}, r"of 1200 .* 0\.58 points"),
        ({"n": 60, "lost": 4}, {"n": 60, "lost": 5}, r"55 of 60"),
        ({"n": 300, "lost": 12, "won": 6}, {"n": 300, "lost": 13, "won": 4}, "3.00 points lost"),
        ({"expected_loss": 0.0049}, {"expected_loss": 0.0051}, r"loses 0\.51 points .*"),
        (
            {"probability_difference": 0.29},
            {"probability_difference": 0.31},
            r"to 0\.310 \(limit 0\.3\)",
        ),
        ({"probability_mean": 0.024}, {"probability_mean": 0.026}, r"average \(limit 0\.025\)"),
        ({"agreement": 0.96}, {"agreement": 0.95}, r"of 100 .*\(limit 0\.96\)"),
        ({"n": 10, "agreement": 0.9}, {"n": 10, "agreement": 0.8}, r"0\.800 of 10"),
        ({}, {"expected_loss": np.nan}, "nan points"),
        ({}, {"probability_mean": np.nan}, "by nan"),
    ],
)
def test_each_limit_is_where_it_stands(good: dict, bad: dict, message: str):
    """Beyond a limit the message names number, limit and remedy."""

    def found(
        n: int = 100, lost: int = 0, won: int = 0, **apart: float
    ) -> tuple[parity.AnswerDifference, parity.AccuracyLoss]:
        """`n` sweeps with some lost and some won by int8; the rest is perfect."""
        right = np.arange(n) >= won, np.arange(n) < n - lost
        usual = {
            "agreement": 1,
            "expected_loss": 0,
            "probability_difference": 0,
            "probability_mean": 0,
        }
        difference = parity.AnswerDifference(**(usual | apart), logit_difference=0, logit_mean=0)
        return difference, parity.loss(*right)

    quantized_bundle.check(*found(**good))
    with pytest.raises(ExportRefused, match=message) as refused:
        quantized_bundle.check(*found(**bad))
    assert str(refused.value).endswith(", or record more")


def test_a_bundle_whose_sweeps_the_box_refuses_is_refused(fitted: Fit, tmp_path: Path):
    """Beyond the full scale they count as saturated, said before a robot meets it."""
    with pytest.raises(ExportRefused, match=r"saturated.*-full-scale$"):
        export(fitted, tmp_path / "bundle", full_scale=60)


def test_a_bundle_that_calls_too_many_sweeps_unknown_is_refused(
    fitted: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The message has their number, the limit, and the distance beyond which a sweep is unknown."""
    monkeypatch.setattr(pack, "MOST_UNKNOWN", -0.5)
    with pytest.raises(ExportRefused, match=r"limit -50%, .* \d"):
        export(fitted, tmp_path / "bundle")


def test_the_box_must_answer_as_export_did(fitted: Fit, packed: Path):
    """If labels of box and int8 model differ, their number is said."""
    logits = np.stack([box(packed).logits(x) for x in fitted.held.samples])
    assert "held-out" in pack.judge(bundle.load(packed), fitted.held, logits, "held-out")
    logits[:2] = -logits[:2]
    with pytest.raises(ExportRefused, match="2 of 30"):
        pack.judge(bundle.load(packed), fitted.held, logits, "held-out")


def test_a_material_never_recognised_is_refused(fitted: Fit):
    """It has no golden sweep."""
    logits = np.tile(np.float32([1, 0, 0]), (len(fitted.train), 1))
    with pytest.raises(ExportRefused, match="'high'"):
        contents.golden_sweeps(fitted.train, logits, logits)


def test_a_bundle_is_replaced_whole_or_not_at_all(fitted: Fit, packed: Path, tmp_path: Path):
    """A refusal leaves the old bundle; a good export replaces it, no other folder."""
    target = tmp_path / "bundle"
    shutil.copytree(packed, target)
    (target / "stray").write_text("left over")
    before = (target / bundle.MANIFEST).read_bytes()
    with pytest.raises(ExportRefused):
        export(replace(fitted, weights=without_numbers(fitted)), target, "new")
    assert (target / bundle.MANIFEST).read_bytes() == before
    export(fitted, target, "new")
    assert bundle.load(target).manifest.name == "new"
    assert sorted(f.name for f in target.iterdir()) == sorted(
        [bundle.MANIFEST, bundle.MODEL, bundle.GOLDEN, bundle.MEANS, "card.md"]
    )
    (tmp_path / "letters").mkdir()
    with pytest.raises(ExportRefused, match="replaced"):
        export(fitted, tmp_path / "letters", "new")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["bundle", "letters"]


def test_what_cannot_be_written_is_refused(fitted: Fit, tmp_path: Path):
    """A target in a file, weights that are no numbers, a label that cannot be sent."""
    parts = {k: replace(getattr(fitted, k), materials=("a,b", "c", "d")) for k in ("train", "held")}
    (tmp_path / "file").write_text("")
    for fit, where, error, why in (
        (fitted, "file/bundle", ExportRefused, "bundle"),
        (replace(fitted, weights=without_numbers(fitted)), "bundle", ExportRefused, "pytorch"),
        (replace(fitted, **parts), "bundle", BundleError, "'a,b'"),
    ):
        with pytest.raises(error, match=why):
            export(fit, tmp_path / where)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_default_bundle_is_what_the_box_needs():
    """The skin's format and tubes, at most 128 KB; names unseen placements."""
    it = box(bundle.DEFAULT)
    assert it.self_test() <= bundle.GOLDEN_TOLERANCE
    assert (it.bundle.format, it.bundle.manifest.labels) == (skin.FORMAT, skin.MATERIALS)
    assert sum(f.stat().st_size for f in bundle.DEFAULT.iterdir()) <= 128_000
    unseen = sets.load("sim:T-REAL:1900:3")
    assert np.mean(bundle_score.labels_of(it, unseen)[0] == unseen.labels) > 0.9
    assert json.loads(it.bundle.manifest.json())["figures"]["held-out position"]["low"] > 0.9


@pytest.mark.thorough  # exports every reference
@pytest.mark.filterwarnings("error")
def test_references_are_what_they_are_called(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """The paper's number of parameters, six logits, no log."""
    paper_cnn = Later("palpate_studies.peers.paper_cnn")
    whole = paper_cnn.random_paper_cnn(skin.FORMAT, 6, np.random.default_rng(0))
    assert cost.weights(whole) == 15_891_910
    references.write(tmp_path / "new")
    assert not caplog.records
    sizes = {}
    for path in (tmp_path / "new").iterdir():
        run = session(path.read_bytes())
        assert [(i.name, i.shape, i.type) for i in run.get_inputs()] == [
            ("sweep", [1, 1500, 4, 4], "tensor(uint8)")
        ]
        assert np.isfinite(
            run.run(["logits"], {"sweep": np.full((1, 1500, 4, 4), 7, np.uint8)})[0]
        ).all()
        sizes[path.name] = path.stat().st_size
    for name, int8 in (("fp32.onnx", False), ("paper_int8.onnx", True)):
        nodes = onnx.load(tmp_path / "new" / name).graph.node
        assert ("QuantizeLinear" in {n.op_type for n in nodes}) == int8
    assert cost.macs(onnx.load(tmp_path / "new" / "fp32.onnx")) > 4e6
    assert 15_891_910 < sizes["paper_int8.onnx"] < 1.01 * 15_891_910


def test_the_command_exports_what_fit_wrote(
    fitted: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A line a figure and rule, then size and the next command."""
    fitted.save(tmp_path / "fit.npz")
    args = ["--out", str(tmp_path / "bundle"), "--name", "easy", "--version", "3"]
    args += ["--stranger-cost", "2"]
    assert main(["export", str(tmp_path / "fit.npz"), *args]) == 0
    lines = capsys.readouterr().out.splitlines()
    lines = [line for line in lines if not line.startswith("  ")]  # each fault, each alteration
    ruled = [line for line in lines if line.startswith(tuple(r.what for r in RULES.values()))]
    lines = [line for line in lines if line not in ruled]
    made = bundle.load(tmp_path / "bundle").manifest
    cost = stranger_limits.lines(made.figures)
    assert len(cost) == 2
    assert set(cost) < set(lines)
    assert made.made[stranger_limits.COST] == 2
    assert len(ruled) == len(made.figures[rules.FIGURES])
    lines = [line for line in lines if line not in cost]
    first = ("held-out speed, as", *(f"held-out speed, {how}" for how in ALONE_AND_FUSED))
    rest = ("broken taxels", "clipped counts", "altered sweeps", "int8 against float", "a finger")
    for line, start in zip(
        lines, (*first, *rest, "bundle: ", "to score", "for a page"), strict=True
    ):
        assert line.startswith(start)
    for line, command in zip(lines[-2:], ("score", "report"), strict=True):
        assert f": palpate-train {command} {tmp_path / 'bundle'} --set SET" in line
    assert bundle.load(tmp_path / "bundle").manifest.version == "3"
    assert main(["export", str(tmp_path / "bundle" / "golden.npz"), *args]) == FormatError.exit_code
    assert "golden.npz" in capsys.readouterr().err


@pytest.mark.parametrize("few", [False, True])
def test_the_figures_of_a_bundle_agree(few: bool, tmp_path: Path):
    """The held-out sweeps that are not unknown are as many as the line says, at the limit that is
    exported, whatever was fitted before; sweeps of other things change no shape."""
    fit = recipe.fit(close(40), Run(1), recipe.Settings())
    if few:
        strangers = np.roll(close(40).samples[:2], 1, axis=2)
        fit = finished(replace(fit, strangers=strangers))
        fit.save(tmp_path / "fit.npz")
        fit = Fit.load(tmp_path / "fit.npz")
    made = export(
        replace(fit, about=fit.about | {stranger_limits.COST: 1e-6}), tmp_path / "b", proven=False
    )
    told, held = made.figures[stranger_limits.FIGURES], made.figures["held-out recording"]
    assert held["unknown"] == round((1 - told["balanced"]["answered"][0]) * held["n"])
    assert held["unknown"] < fit.held_out_figures()["held-out recording"]["unknown"]
    assert told.get(NOT_THIS) == (2 if few else None)
    assert made.disturbances


def test_a_bundle_that_names_everything_says_so(
    fitted: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Neither a share of unknown materials nor an `unknown` sweep is promised without the limit."""
    fitted.save(tmp_path / "fit.npz")
    args = ["--out", str(tmp_path / "bundle"), "--name", "easy", "--version", "3"]
    assert main(["export", str(tmp_path / "fit.npz"), *args, "--without", "unknown"]) == 0
    printed, made = capsys.readouterr().out, bundle.load(tmp_path / "bundle").manifest
    assert card.UNLIMITED in printed
    assert "did not teach" not in printed
    assert stranger_limits.FIGURES not in made.figures
    assert made.figures["held-out speed"]["unknown"] == 0
    assert card.UNLIMITED in (tmp_path / "bundle" / card.NAME).read_text()


def test_a_fit_without_a_convolution_is_exported(tmp_path: Path):
    """Nothing is int8: both are equal; a spoilt head is seen."""
    made = recipe.fit(easy(), Run(1), recipe.Settings(size=SIZES["bands"]))
    export(made, tmp_path / "b")
    it = box(tmp_path / "b")
    assert it.self_test() < 1e-6
    assert "QuantizeLinear" not in operators(tmp_path / "b")
    logits = parity.logits(quantized_bundle.graphs(made)[0], made.held.samples)
    assert [it.logits(x).argmax() for x in made.held.samples] == logits.argmax(1).tolist()
    result = it.bundle.manifest.figures["parity"]
    assert (result["agreement"], result["lost"]) == (1, 0)
    assert result["probability_difference"] < 1e-3
    other = export(negated(made), tmp_path / "other")
    assert re.match(r"int8 loses .*record more", other.made["float_because"])


def test_any_method_is_judged_by_the_same_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """An int8 method's figures are in its bundle; beyond a limit it is refused. It has no limits
    that a cost could set."""
    (method,) = methods.find(["palpate-64"])
    _, made = MethodFit.of(method, close(), 1)
    made.save(tmp_path / "fit.npz")
    read = MethodFit.read("fit.npz", sweep_set.read(tmp_path / "fit.npz", "a fit"))
    words = f"export {tmp_path}/fit.npz --out {tmp_path}/b --name a --version 1 --stranger-cost 2"
    assert main(words.split()) == 65
    assert "--stranger-cost 2" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
    manifest = export(read, tmp_path / "b", "close")
    assert manifest.figures["parity"]["total"] == len(made.held)
    assert quantized_bundle.text(manifest).startswith("int8 against float: ")
    monkeypatch.setattr(quantized_bundle, "MOST_MEAN_DIFFERENCE", 0.0)
    with pytest.raises(ExportRefused, match=r"limit 0\.0"):
        export(read, tmp_path / "b", "close")


@pytest.mark.skipif(
    "PALPATE_DATA" not in os.environ, reason="PALPATE_DATA does not name the folder of real sweeps"
)
def test_fabrics_go_the_whole_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Another skin, same commands: over the wire as right as the classifier."""
    path = Path(os.environ["PALPATE_DATA"]) / "fabricslide" / "fabricslide.npz"
    args = f"--set {path} --only direction=0 --only force<=180 --seed 1 --stages 300".split()
    args += (
        f"--split recording:0.7 --rest {tmp_path / 'rest.npz'} --out {tmp_path / 'fit.npz'}"
    ).split()
    assert main(["fit", *args]) == 0
    more = f"--out {tmp_path / 'b'} --name f --version 1"
    assert main(f"export {tmp_path / 'fit.npz'} {more}".split()) == 0
    it, rest = box(tmp_path / "b"), sets.load(str(tmp_path / "rest.npz"))
    assert (it.bundle.format.rows, it.bundle.format.window) == (16, 128)
    assert it.bundle.format.dtype == "int16"
    logits = np.stack([it.logits(counts) for counts in rest.samples])
    result = bundle_score.answers_to(it, rest, logits).figures(
        rest.labels, rest.group("recording"), "unseen"
    )
    assert result["unseen"]["accuracy"] > 0.9
    assert result["unseen, by recording"]["accuracy"] > 0.9
    demo = f"demo --sim replay:{tmp_path / 'rest.npz'} --virtual --sweeps {len(rest)}"
    chosen = ["--set", f"classifier.bundle={tmp_path / 'b'}"]
    assert palpate([*demo.split(), *chosen]) == 0
    out = capsys.readouterr().out
    right, total = (int(n) for n in re.search(r"all sweeps +(\d+) / (\d+)", out).groups())
    assert total == result["unseen"]["n"] == len(rest)
    assert right / total == pytest.approx(result["unseen"]["accuracy"], abs=0.01)
    assert "frames lost     0 of" in out


def test_a_fit_does_not_see_offsets(tmp_path: Path):
    """Without groups to judge loads by, it cannot distinguish materials by their offset."""
    whole = easy(seed=3)
    del whole.groups["speed"]
    rng = np.random.default_rng(4)
    labels = rng.permutation(whole.labels)
    level = (
        whole.samples.mean(axis=1, keepdims=True)
        - np.array([60, 100, 140])[labels][:, None, None, None]
    )
    offset = replace(whole, samples=(whole.samples - level).round().astype(np.uint8), labels=labels)
    try:
        made = with_stages(offset, steps=20)
        manifest = export(made, tmp_path / "b")
    except ExportRefused:  # what was never learnt may not survive int8 either
        return
    assert manifest.figures["held-out recording"]["accuracy"] < 0.6


def test_display_names_are_in_manifest_and_card(packed: Path):
    """Only those of the set's materials; the labels stay."""
    manifest = bundle.load(packed).manifest
    assert manifest.labels == ("low", "middle", "high")
    assert manifest.displays == {"low": "tief, 低い"}
    assert '{"low": "tief, 低い"}' in (packed / "card.md").read_text("utf-8")
