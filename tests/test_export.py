"""The room of export: what the graphs hold, what a bundle must pass before it leaves, what is refused and why."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from test_sets import easy

from appliance import bundle
from appliance.__main__ import main as palpate
from appliance.classifier import Classifier, session, softmax
from appliance.clock import SystemClock
from appliance.errors import BundleError, FormatError
from appliance.sim import skin
from appliance.sweep import SweepFormat
from train import compact, export, fit, graphs, networks, pack, sets
from train.__main__ import main
from train.compact import Compact
from train.fit import Fit, Recipe
from train.pack import ExportRefused

OPS = {"Reshape", "Cast", "ConstantOfShape", "Gemm", "Transpose", "Conv", "Relu", "ReduceMean", "Concat", "Add", "Log"}


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit on the easy set, two sweeps to a recording."""
    return fit.fit(easy(pieces=2), 1, Recipe(steps=40))


@pytest.fixture(scope="module")
def packed(fitted: Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its bundle."""
    target = tmp_path_factory.mktemp("export") / "bundle"
    export.export(fitted, target, "easy", "1", "0123abcd")
    return target


def box(folder: Path) -> Classifier:
    """The classifier as the box makes it."""
    return Classifier(bundle.load(folder), SystemClock())


def shapes(model: onnx.ModelProto) -> list[list[int]]:
    """Every inferred shape of the graph."""
    graph = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    return [
        [d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*graph.input, *graph.value_info, *graph.output)
    ]


def negated(fitted: Fit) -> Fit:
    """A fit whose head says the opposite."""
    return replace(fitted, weights=fitted.weights | {"head.weight": -fitted.weights["head.weight"]})


@pytest.mark.parametrize("dtype", graphs.TENSOR)
def test_the_float_graph_is_the_network(dtype: str):
    """For each digit type: PyTorch's logits, fixed shapes, the expected nodes, the sensor's own digits going in."""
    form = SweepFormat(3, 2, 100.0, 128, dtype)
    torch.manual_seed(0)
    model = Compact(form, 3, 0.1, norm=False)
    weights = {k: v.numpy() for k, v in model.state_dict().items()}
    graph = graphs.with_head(compact.trunk(form, 0.1, weights), weights["head.weight"], weights["head.bias"])
    digits = np.random.default_rng(0).integers(0, 200, (5, 128, 3, 2)).astype(dtype)
    with torch.no_grad():
        want = model(torch.from_numpy(digits.astype(np.float32))).numpy()
    np.testing.assert_allclose(graphs.run(graph, digits), want, atol=1e-4)
    assert {n.op_type for n in graph.graph.node} == OPS
    assert all(size > 0 for shape in shapes(graph) for size in shape)
    (given,) = graph.graph.input
    assert (given.name, given.type.tensor_type.elem_type) == ("sweep", graphs.TENSOR[dtype])
    assert [d.dim_value for d in given.type.tensor_type.shape.dim] == [1, 128, 3, 2]


def test_the_int8_graph_computes_its_convolutions_in_int8(packed: Path):
    """Weights of seven bits, one scale a channel; every convolution between quantizers; nothing else new; 1 x K out."""
    model = onnx.load(packed / bundle.MODEL)
    ops = [n.op_type for n in model.graph.node]
    assert set(ops) == (OPS - {"Relu"}) | {"QuantizeLinear", "DequantizeLinear"}
    maker = {name: n for n in model.graph.node for name in n.output}
    values = {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}
    convs = [n for n in model.graph.node if n.op_type == "Conv"]
    assert len(convs) == 3
    for conv in convs:
        assert [maker[name].op_type for name in conv.input] == ["DequantizeLinear"] * 3
        weight, scale = (values[name] for name in maker[conv.input[1]].input[:2])
        assert weight.dtype == np.int8
        assert 60 <= np.abs(weight.astype(int)).max() <= 64
        assert scale.shape == (compact.CHANNELS,)
        assert [n.op_type for n in model.graph.node if conv.output[0] in n.input] == ["QuantizeLinear"]
    assert all(size > 0 for shape in shapes(model) for size in shape)
    run = session(model.SerializeToString())
    assert [(i.name, i.shape, i.type) for i in run.get_inputs()] == [("sweep", [1, 64, 2, 2], "tensor(uint8)")]
    assert [(o.name, o.shape, o.type) for o in run.get_outputs()] == [("logits", [1, 3], "tensor(float)")]


def test_quantizing_leaves_its_model_alone(fitted: Fit):
    """onnxruntime empties the model that it is given; ours still runs."""
    trunk = compact.trunk(fitted.train.format, fitted.scale, fitted.weights)
    before = trunk.SerializeToString()
    export.quantize(trunk, fitted.train.samples[:4])
    assert trunk.SerializeToString() == before


def test_a_bundle_passes_its_own_tests(fitted: Fit, packed: Path):
    """Golden sweeps of two materials, figures of what was held out, thresholds from training, all files small."""
    it = box(packed)
    assert it.self_test() < 1e-6
    manifest = it.bundle.manifest
    assert it.bundle.golden_logits.argmax(1).tolist() == [0, 2]
    held = manifest.figures["held-out recording"]
    assert held["n"] == len(fitted.held)
    assert held["accuracy"] == pytest.approx(np.mean(pack.score(it, fitted.held) == fitted.held.labels), abs=1e-4)
    assert manifest.figures["held-out recording, by recording"]["n"] == len(fitted.held) / 2
    assert manifest.figures["parity"]["agreement"] >= export.LEAST_AGREEMENT
    weakest = fitted.train.samples.mean(axis=1).max(axis=(1, 2)).min()
    assert manifest.thresholds.contact == pytest.approx(0.1 * weakest)
    assert manifest.thresholds.full_scale == 255
    assert (manifest.labels, manifest.made["commit"], manifest.made["seed"]) == (
        ("low", "middle", "high"),
        "0123abcd",
        1,
    )
    assert np.mean(pack.score(it, easy(seed=5)) == easy(seed=5).labels) > 0.9


def test_the_same_fit_gives_the_same_bytes(fitted: Fit, packed: Path, tmp_path: Path):
    """Every file, the zip of golden sweeps included."""
    export.export(fitted, tmp_path / "again", "easy", "1", "0123abcd")
    for file in (bundle.MANIFEST, bundle.MODEL, bundle.GOLDEN):
        assert (tmp_path / "again" / file).read_bytes() == (packed / file).read_bytes(), file
    assert [f.name for f in tmp_path.iterdir()] == ["again"]


def test_scores_are_fused_by_recording(packed: Path):
    """Each window gets the label of its recording's product, also where the last one differs; -1 what the box refuses."""
    it, s = box(packed), easy(10, pieces=5, seed=7)
    s.samples[3] = 0
    s.samples[9] = s.samples[29]
    alone, fused = pack.score(it, s), pack.score(it, s, fused=True)
    assert np.flatnonzero(alone < 0).tolist() == [3]
    assert alone[9] != fused[9]
    p = softmax(np.stack([it.logits(x) for x in s.samples]))
    for recording in np.unique(s.groups["recording"]):
        member = s.groups["recording"] == recording
        assert set(fused[member]) == {np.log(p[member & (alone >= 0)]).sum(0).argmax()}


def test_a_head_that_says_otherwise_is_refused(fitted: Fit, tmp_path: Path):
    """int8 with its refitted head disagrees with a spoilt float head; the numbers are named, nothing is left."""
    with pytest.raises(ExportRefused, match=r"int8 agrees with float on 0\.\d+ of the held-out sweeps \(limit 0\.95\)"):
        export.export(negated(fitted), tmp_path / "bundle", "easy", "1", "")
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_no_numbers_are_refused(fitted: Fit, tmp_path: Path):
    """A difference of nan is beyond every limit."""
    spoilt = fitted.weights | {"head.bias": fitted.weights["head.bias"] * np.nan}
    with pytest.raises(ExportRefused, match="differs from pytorch by nan"):
        export.export(replace(fitted, weights=spoilt), tmp_path / "bundle", "easy", "1", "")


def test_absurd_calibration_is_refused(fitted: Fit, tmp_path: Path):
    """Ranges and head found on noise that is no sweep at all."""
    noise = np.random.default_rng(0).integers(0, 256, fitted.train.samples.shape).astype(np.uint8)
    with pytest.raises(ExportRefused, match="int8 agrees"):
        export.export(replace(fitted, train=replace(fitted.train, samples=noise)), tmp_path / "bundle", "easy", "1", "")


def test_a_box_that_would_refuse_is_no_box(fitted: Fit, tmp_path: Path):
    """A full scale that the sweeps pass: they count as saturated, which export tells instead of the robot."""
    with pytest.raises(ExportRefused, match=r"the box would refuse \d+ of \d+ held-out sweeps"):
        export.export(fitted, tmp_path / "bundle", "easy", "1", "", full_scale=60)


def test_the_box_must_say_what_export_saw(fitted: Fit, packed: Path):
    """Other labels from the box than from the int8 model are refused, with how many."""
    logits = np.stack([box(packed).logits(x) for x in fitted.held.samples])
    assert "held-out" in pack.judge(packed, fitted.held, logits, "held-out")
    logits[:2] = -logits[:2]
    with pytest.raises(ExportRefused, match="labels 2 of 24 held-out sweeps otherwise"):
        pack.judge(packed, fitted.held, logits, "held-out")


def test_a_material_never_recognised_is_refused(fitted: Fit):
    """There is no golden sweep of it."""
    with pytest.raises(ExportRefused, match="no training sweep of 'high' is recognised"):
        pack.golden_sweeps(fitted.train, np.tile(np.float32([1, 0, 0]), (len(fitted.train), 1)))


def test_a_bundle_is_replaced_whole_or_not_at_all(fitted: Fit, packed: Path, tmp_path: Path):
    """A refused export leaves the old bundle; a good one takes its place, stray files gone; other folders are safe."""
    target = tmp_path / "bundle"
    export.export(fitted, target, "old", "1", "")
    (target / "stray").write_text("left over")
    before = (target / bundle.MANIFEST).read_bytes()
    with pytest.raises(ExportRefused):
        export.export(negated(fitted), target, "new", "2", "")
    assert (target / bundle.MANIFEST).read_bytes() == before
    export.export(fitted, target, "new", "2", "")
    assert bundle.load(target).manifest.name == "new"
    assert sorted(f.name for f in target.iterdir()) == sorted([bundle.MANIFEST, bundle.MODEL, bundle.GOLDEN])
    (tmp_path / "letters").mkdir()
    with pytest.raises(ExportRefused, match="is no bundle and will not be replaced"):
        export.export(fitted, tmp_path / "letters", "new", "2", "")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["bundle", "letters"]


def test_a_target_that_cannot_be_written_is_named(fitted: Fit, tmp_path: Path):
    """A file where a folder should be."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportRefused, match="the bundle cannot be written to"):
        export.export(fitted, tmp_path / "file" / "bundle", "easy", "1", "")


def test_a_label_that_cannot_be_sent_is_refused(fitted: Fit, tmp_path: Path):
    """The manifest's own check speaks before anything is written."""
    named = replace(fitted, **{k: replace(getattr(fitted, k), materials=("a,b", "c", "d")) for k in ("train", "held")})
    with pytest.raises(BundleError, match="label 'a,b' cannot be sent"):
        export.export(named, tmp_path / "bundle", "easy", "1", "")
    assert list(tmp_path.iterdir()) == []


def test_the_default_bundle_is_what_the_box_needs():
    """The skin's format and tubes, under 64 KB, golden sweeps as exported, placements that it never saw."""
    it = box(bundle.DEFAULT)
    assert it.self_test() <= bundle.GOLDEN_TOLERANCE
    assert (it.bundle.format, it.bundle.manifest.labels) == (skin.FORMAT, skin.MATERIALS)
    assert sum(f.stat().st_size for f in bundle.DEFAULT.iterdir()) < 64 * 1024
    unseen = sets.load("sim:T-REAL:1900:3")
    assert np.mean(pack.score(it, unseen) == unseen.labels) > 0.9
    assert json.loads(it.bundle.manifest.json())["figures"]["held-out position"]["low"] > 0.9


def test_yardsticks_are_what_they_are_called(tmp_path: Path):
    """The paper's CNN has the paper's number of parameters; both take the skin's sweeps and give six logits."""
    whole = networks.paper_cnn(skin.FORMAT, 6, np.random.default_rng(0))
    assert graphs.weight_count(whole) == 15_891_910
    assert main(["yardsticks", "--out", str(tmp_path / "new")]) == 0
    sizes = {}
    for path in (tmp_path / "new").iterdir():
        run = session(path.read_bytes())
        assert [(i.name, i.shape, i.type) for i in run.get_inputs()] == [("sweep", [1, 1500, 4, 4], "tensor(uint8)")]
        assert np.isfinite(run.run(["logits"], {"sweep": np.full((1, 1500, 4, 4), 7, np.uint8)})[0]).all()
        sizes[path.name] = path.stat().st_size
    assert sizes["fp32.onnx"] > 4 * 19_110
    assert 15_891_910 < sizes["paper_int8.onnx"] < 1.01 * 15_891_910


def test_the_command_exports_what_fit_wrote(fitted: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One line a figure, the size at the end; a fit that is none has a FormatError's exit code."""
    fitted.save(tmp_path / "fit.npz")
    args = ["--out", str(tmp_path / "bundle"), "--name", "easy", "--version", "3"]
    assert main(["export", str(tmp_path / "fit.npz"), *args]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "held-out recording",
        "held-out recording, by recording",
        "bundle",
    ]
    assert bundle.load(tmp_path / "bundle").manifest.version == "3"
    assert main(["export", str(tmp_path / "bundle" / "golden.npz"), *args]) == FormatError.exit_code
    assert "golden.npz: not a fit" in capsys.readouterr().err


@pytest.mark.skipif("PALPATE_DATA" not in os.environ, reason="PALPATE_DATA does not name the folder of real sweeps")
def test_fabrics_go_the_whole_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Another skin (int16, 16 x 1, 35.6 Hz, 128 frames) by the same commands; unseen recordings over the USB
    wire into sentences, NEW OBJECT before each recording: as many right as the classifier by itself has."""
    path = Path(os.environ["PALPATE_DATA"]) / "fabricslide" / "fabricslide.npz"
    args = ["--set", str(path), "--only", "direction=0", "--only", "force<=180", "--seed", "1", "--steps", "300"]
    args += ["--split", "recording:0.7", "--rest", str(tmp_path / "rest.npz"), "--out", str(tmp_path / "fit.npz")]
    assert main(["fit", *args]) == 0
    assert (
        main(["export", str(tmp_path / "fit.npz"), "--out", str(tmp_path / "b"), "--name", "f", "--version", "1"]) == 0
    )
    it, rest = box(tmp_path / "b"), sets.load(str(tmp_path / "rest.npz"))
    assert (it.bundle.format.dtype, it.bundle.format.rows, it.bundle.format.window) == ("int16", 16, 128)
    told = pack.figures(it, rest, "unseen")
    assert told["unseen"]["accuracy"] > 0.9
    assert told["unseen, by recording"]["accuracy"] > 0.95
    sentences = ["demo", "--sim", f"replay:{tmp_path / 'rest.npz'}", "--virtual", "--sweeps", str(len(rest))]
    assert palpate([*sentences, "--set", f"classifier.bundle={tmp_path / 'b'}"]) == 0
    out = capsys.readouterr().out
    right, total = (int(n) for n in re.search(r"all objects +(\d+) / (\d+)", out).groups())
    assert total == told["unseen, by recording"]["n"]
    assert right / total == pytest.approx(told["unseen, by recording"]["accuracy"], abs=0.01)
    assert "frames lost     0 of" in out


@pytest.mark.parametrize("keep", [True, False])
def test_means_are_seen_only_where_they_are_kept(keep: bool, tmp_path: Path):
    """Materials that differ in nothing but their offset: told apart by a head that sees means, hidden from one that does not."""
    whole = easy(seed=3)
    rng = np.random.default_rng(4)
    labels = rng.permutation(whole.labels)
    level = whole.samples.mean(axis=1, keepdims=True) - np.array([60, 100, 140])[labels][:, None, None, None]
    offset = replace(whole, samples=(whole.samples - level).round().astype(np.uint8), labels=labels)
    try:
        manifest = export.export(
            fit.fit(offset, 1, Recipe(steps=20, keep_means=keep)), tmp_path / "b", "offset", "1", "0123abcd"
        )
    except ExportRefused:  # what was never learnt may not survive int8 either
        assert not keep
        return
    accuracy = manifest.figures["held-out recording"]["accuracy"]
    assert accuracy > 0.95 if keep else accuracy < 0.6
