"""Bundle and classifier: altered files are refused; fusion follows the paper and Bayes."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpate.answer import features, slide
from palpate.answer.early import Early
from palpate.answer.objects import Evidence, softmax
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep, SweepFormat
from palpate.inference.classifier import Classifier
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle
from tests.factories.toy_bundle import sweep_of, told

WITH_EARLY = (*toy_bundle.OUTPUTS, "early")
THIRD_ENROLLED = {"arrays": toy_bundle.means(sweeps=np.array([0, 0, 5])), "labels": 2}


def box(of: Bundle, **rule: Any) -> Classifier:
    return Classifier(of, VirtualClock(), replace(UNTIL_NEW_OBJECT, **rule))


@pytest.fixture
def toy(tmp_path: Path) -> Bundle:
    """The toy bundle."""
    return toy_bundle.load(tmp_path / "toy")


def edit(folder: Path, name: str = "", data: bytes = b"", **changes: Any) -> Path:
    """Change fields of a manifest, and a file with the hash of it in the manifest."""
    path = folder / bundle.MANIFEST
    content = json.loads(path.read_text()) | changes
    if name:
        (folder / name).write_bytes(data)
        content["files"][name] = bundle.file_entry(data)
    path.write_text(json.dumps(content))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the default bundle, to be damaged."""
    return Path(shutil.copytree(bundle.DEFAULT, tmp_path / "bundle"))


def test_a_rehearsal_leaves_no_trace(default_bundle):
    """Sweeps of one object get the same verdicts whether answers are rehearsed between them."""
    plain, rehearsed = (Classifier(default_bundle, VirtualClock()) for _ in range(2))
    for number, golden in enumerate(default_bundle.golden[:4], 1):
        given = replace(sweep_of(golden), id=number, object=1)
        rehearsed.rehearse()
        now, want = rehearsed(given), plain(given)
        for name in ("status", "label", "probability", "fused", "after", "detail"):
            assert getattr(now, name) == getattr(want, name)
        np.testing.assert_array_equal(now.scores, want.scores)


def test_an_unknown_golden_sweep_is_none_that_came_before(default_bundle):
    """Neither its rehearsal nor the check of refusals makes it a sweep that a person saw."""
    both = default_bundle.golden[:2].astype(np.float64).mean(axis=0).astype(np.uint8)
    it = Classifier(replace(default_bundle, golden=both[None]), VirtualClock())
    it.rehearse()
    assert it.refusals() == [Status.UNKNOWN]
    details = [it(replace(sweep_of(both), id=number)).detail for number in (1, 2)]
    assert ["as sweep" in detail for detail in details] == [False, True]
    assert details[1].endswith("as sweep 1")


@pytest.fixture
def toy_folder(tmp_path: Path) -> Path:
    """The folder of a toy bundle, to be damaged."""
    return toy_bundle.put(tmp_path / "spoiled", toy_bundle.files())


def fuse(scores, fusion):
    """The probabilities of sweeps of one object, one after the other."""
    first, *others = scores
    evidence = Evidence.of(first, fusion)
    for own in others:
        evidence = Evidence.of(own, fusion, evidence)
    return evidence.probabilities


def test_fusion_is_the_papers_and_bayes():
    """Equation 10, product, vote; one certain sweep does not outweigh three."""
    z = np.array([1.0, 2.0, -3.0])
    assert softmax(z) == pytest.approx(np.exp(z) / np.exp(z).sum())
    assert softmax(np.array([1e4, 0.0])).tolist() == [1.0, 0.0]
    a, b = np.array([0.6, 0.3, 0.1]), np.array([0.2, 0.7, 0.1])
    assert fuse([a, b], "product") == pytest.approx(a * b / (a * b).sum())
    sure, other = np.array([1.0, 0.0]), np.array([1e-5, 1 - 1e-5])
    assert fuse([sure, other, other, other], "product").argmax() == 1
    label = np.eye(3) * 0.8 + 0.1
    votes = {(1, 0): 1, (0, 1, 1): 1, (0, 1, 2): 0, (2, 1, 1, 2): 2}
    assert {v: int(fuse(list(label[list(v)]), "vote").argmax()) for v in votes} == votes


def test_golden_sweeps_are_compared(default_bundle):
    """This machine runs the default bundle as it was exported; other logits are refused."""
    assert box(default_bundle).self_test() < bundle.GOLDEN_TOLERANCE
    with pytest.raises(BundleError, match=r"\[\]"):
        box(replace(default_bundle, golden_logits=0.1 * default_bundle.golden_logits)).self_test()
    for label in (0, -1):
        logits = default_bundle.golden_logits.copy()
        logits[:, label] = logits.max() + 9
        with pytest.raises(BundleError, match=r"\[\d"):
            box(replace(default_bundle, golden_logits=logits)).self_test()


def test_a_machine_that_computes_the_checks_otherwise_is_refused(default_bundle, monkeypatch):
    """The network is right, and numpy finds no slide, as under a processor whose products of
    float32 matrices are wrong: said by the self test, unless export refused the sweep just so. The
    stream's tare and broken taxels do not count."""
    it = box(default_bundle)
    it.tare = it.tare + 200.0
    assert it.self_test() < bundle.GOLDEN_TOLERANCE
    monkeypatch.setattr(slide, "vibration", lambda *given: np.full(slide.PARTS, -99.0))
    with pytest.raises(BundleError, match="no-slide"):
        it.self_test()
    assert it.self_test(checks=False) < bundle.GOLDEN_TOLERANCE
    refused = (Status.NO_SLIDE,) * len(default_bundle.golden)
    assert box(replace(default_bundle, golden_refusals=refused)).self_test() < 1
    with pytest.raises(BundleError, match="no-slide"):
        box(
            replace(default_bundle, golden_refusals=(Status.STUCK_TAXEL, Status.NO_SLIDE))
        ).self_test()


def test_verdict_carries_what_is_known(default_bundle):
    """All fields; below the threshold the label is reported, but not as ok."""
    sweep = replace(sweep_of(default_bundle.golden[0], lost=1), complete_ns=1000)
    v = box(default_bundle)(sweep)
    assert v.latency_ns == v.time_ns - 1000
    assert v.status in (Status.OK, Status.UNSURE)
    assert v.label == default_bundle.manifest.labels[v.scores.argmax()]
    assert v.scores.sum() == pytest.approx(1)
    assert v.probability == v.scores.max()
    assert v.margin == pytest.approx(np.diff(np.sort(v.scores))[-1])
    assert (v.fused, v.lost, v.bundle) == (1, 1, default_bundle.id)
    m = default_bundle.manifest
    strict = replace(m, thresholds=replace(m.thresholds, unsure=1.1))
    unsure = box(replace(default_bundle, manifest=strict))(sweep)
    assert (unsure.status, unsure.label) == (Status.UNSURE, v.label)


@pytest.mark.parametrize("status", [s for s in Status if not s.classified])
def test_refused_sweeps_keep_their_status(default_bundle, status):
    """A sweep with another status than ok is not classified."""
    v = box(default_bundle)(replace(sweep_of(default_bundle.golden[0]), status=status))
    assert (v.status, v.label, v.fused, len(v.scores)) == (status, "", 0, 0)


def test_features_go_through_the_same_runtime():
    """Input L gets three features, as by numpy; of four it is refused."""

    def of_features(weights: np.ndarray) -> dict[str, bytes]:
        """Files of the default bundle with another model: input L [1, n] times weights [n, 6]."""
        onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
        graph = onnx.helper.make_graph(
            [onnx.helper.make_node("MatMul", ["features", "W"], ["logits"])],
            "g",
            [onnx.helper.make_tensor_value_info("features", 1, [1, len(weights)])],
            [onnx.helper.make_tensor_value_info("logits", 1, [1, 6])],
            [onnx.numpy_helper.from_array(weights.astype(np.float32), "W")],
        )
        opset = [onnx.helper.make_opsetid("", 18)]
        made = onnx.helper.make_model(graph, opset_imports=opset, ir_version=9)
        files = bundle.files(bundle.DEFAULT) | {bundle.MODEL: made.SerializeToString()}
        entries = {name: bundle.file_entry(files[name]) for name in (bundle.MODEL, bundle.GOLDEN)}
        without = {"early": None, "known": None, "displacement": None}
        manifest = bundle.Manifest.parse(files[bundle.MANIFEST])
        manifest = replace(manifest, input="L", files=entries, **without)
        return files | {bundle.MANIFEST: manifest.json()}

    weights = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    made = bundle.from_files(of_features(weights), "here")
    want = features.compute("L", made.golden[0], 750.0) @ weights
    assert box(made).logits(made.golden[0]) == pytest.approx(want, rel=1e-5)
    with pytest.raises(BundleError, match=r"\[1, 4\], .*\[1, 3\]"):
        bundle.from_files(of_features(np.ones((4, 6))), "here")


def test_default_bundle_is_small():
    """All files of the committed bundle together stay within 128 KB."""
    assert sum(f.stat().st_size for f in bundle.DEFAULT.iterdir()) <= 128_000


@pytest.mark.parametrize("name", [bundle.MODEL, bundle.GOLDEN])
def test_altered_and_missing_files_are_named(folder, name):
    """One flipped byte, or no file."""
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    with pytest.raises(BundleError, match=f"{name} was altered"):
        bundle.load(folder)
    (folder / name).unlink()
    with pytest.raises(BundleError, match=name):
        bundle.load(folder)


UNREAD = "manifest cannot be read"
CONTACT = {"pitch_mm": 1.0, "rows_mm": [0.5], "cols_mm": [0.5], "limit_mm": 0.1}
NO_CONTACT = {"contact": None, "full_scale": 255.0}


@pytest.mark.parametrize(
    ("changes", "hint"),
    [
        ({"schema": 99}, "schema 99"),
        ({"input": "M"}, "input 'M'"),
        ({"labels": ["one"]}, "at least two"),
        ({"labels": ["a,b", "c"]}, "label 'a,b'"),
        ({"labels": ["a", 3]}, "label 3 "),
        ({"files": {}, "early": None, "known": None, "displacement": None}, "name model.onnx"),
        ({"format": {"rows": 4}}, UNREAD),
        ({"extra": 1}, "extra"),
        ({"unloaded": [1.0, 2.0]}, "2 counts .* have 16"),
        ({"unloaded": 16}, UNREAD),
        ({"unloaded": ["1"] * 16}, UNREAD),
        ({"thresholds": NO_CONTACT, "contact": CONTACT}, "`contact` without"),
        ({"labels": ["a", "b"], "sliding": None}, "logits"),
    ],
)
def test_broken_manifests_are_named(folder, changes, hint):
    """Schema, input, key, labels, files, and labels that do not fit."""
    with pytest.raises(BundleError, match=hint):
        bundle.load(edit(folder, **changes))


def test_a_bundle_may_know_the_unloaded_skin(folder):
    """The box uses it as its first tare. Without it the first tare is 0."""
    before = bundle.load(folder)
    assert not box(before).tare.any()
    assert before.manifest.json() == (folder / bundle.MANIFEST).read_bytes()
    level = [float(i) for i in range(16)]
    after = bundle.load(edit(folder, unloaded=level))
    assert box(after).tare.tolist() == np.reshape(level, (4, 4)).tolist()
    assert bundle.Manifest.parse(after.manifest.json()) == after.manifest


def test_what_is_no_bundle_is_refused(tmp_path, folder, default_bundle):
    """No or bad manifest, pickles, another format, no model."""
    with pytest.raises(BundleError, match="bundle"):
        bundle.load(tmp_path)
    (tmp_path / bundle.MANIFEST).write_text("{")
    with pytest.raises(BundleError, match=UNREAD):
        bundle.load(tmp_path)
    pickled = toy_bundle.npz(samples=np.array([object()]), logits=np.zeros((1, 6)))
    with pytest.raises(BundleError, match="npz"):
        bundle.load(edit(folder, bundle.GOLDEN, pickled))
    format = json.loads((folder / bundle.MANIFEST).read_text())["format"] | {"rows": 2}
    golden = (bundle.DEFAULT / bundle.GOLDEN).read_bytes()
    with pytest.raises(BundleError, match="format"):
        bundle.load(edit(folder, bundle.GOLDEN, golden, format=format))
    with pytest.raises(BundleError, match="refuses"):
        box(replace(default_bundle, model=default_bundle.model.replace(b"Gemm", b"Gemn")))


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
@pytest.mark.parametrize("axes", [1, 3])
def test_golden_sweeps_are_packed_without_loss(dtype, axes):
    """Even where changes wrap; smooth sweeps need less space."""
    format = SweepFormat(2, 3, 100.0, 50, dtype, axes)
    rng = np.random.default_rng(1)
    any_bits = rng.integers(0, 256, (2, 50, *format.shape, format.numpy_type.itemsize), np.uint8)
    samples = any_bits.view(format.numpy_type)[..., 0]
    samples[0] = np.cumsum(rng.integers(-2, 3, samples[0].shape), axis=0).astype(format.numpy_type)
    logits = rng.normal(size=(2, 4)).astype(np.float32)
    manifest = SimpleNamespace(format=format, labels=("a", "b", "c", "d"))
    told = (Status.OK, Status.NO_CONTACT)
    got, answers, refusals = bundle._golden(bundle.golden_file(samples, logits, told), manifest)
    assert refusals == told
    for wrong in (("\x1b[2J", "ok"), ("ok", "", "ok"), ("ok", "ok", "unsure")):
        with pytest.raises(BundleError, match="refusals"):
            bundle._golden(bundle.golden_file(samples, logits, wrong), manifest)
    assert (got.tobytes(), got.dtype) == (samples.tobytes(), format.numpy_type)
    assert answers.tolist() == logits.tolist()
    smooth, plain = np.repeat(samples[:1], 2, axis=0), io.BytesIO()
    np.savez_compressed(plain, samples=smooth, logits=logits)
    assert len(bundle.golden_file(smooth, logits)) < len(plain.getvalue())


@pytest.mark.parametrize(
    ("shape", "hint"),
    [
        *((n, "not fit the format") for n in ((1, 2, 20, 2, 2), (2, 2, 19, 2, 2), (2, 2), ())),
        ((2, 0, 20, 2, 2), "holds no sweeps"),
        (None, "cannot be read"),
    ],
)
def test_golden_sweeps_of_another_shape_are_refused(shape, hint):
    """Too few bytes or frames, no changes, no sweeps, or logits alone."""
    manifest = SimpleNamespace(format=SweepFormat(2, 2, 100.0, 20, "int16"), labels=("a", "b"))
    more = {} if shape is None else {"changes": np.zeros(shape, np.uint8)}
    with pytest.raises(BundleError, match=hint):
        bundle._golden(toy_bundle.npz(logits=np.zeros((2, 2)), **more), manifest)


def test_optional_rules_may_be_missing(folder):
    """A bundle without rules has none."""
    old = json.loads((folder / bundle.MANIFEST).read_text())
    for name in ("early", "known", "contact", "displacement", "runtime", "counter"):
        old.pop(name, None)
    del old["files"][bundle.MEANS]
    (folder / bundle.MANIFEST).write_text(json.dumps(old))
    read = bundle.load(folder)
    assert (read.manifest.early, read.manifest.known) == (None, None)
    assert (read.classes, read.enrolled) == (None, {})


EARLY = {"least": [0.9, 0.8, 2.0], "agree": 2}
LIMITS = asdict(toy_bundle.LIMITS)
KNOWN = {"strict": 4.0, "balanced": 9.0, "loose": 16.0, "temperature": 2.0}
DISPLACEMENT = {"limit": 4.0, "temperature": 3.0, "unsure": 0.75}


def displaced(**changes: Any) -> dict[str, Any]:
    """The keys of a manifest with a rule for displaced contacts."""
    return {"displacement": DISPLACEMENT | changes, "contact": CONTACT}


@pytest.mark.parametrize(
    ("changes", "hint"),
    [
        ({"early": EARLY | {"least": []}}, "early.least "),
        *(
            ({"early": EARLY | {"least": [0.5, n]}}, "number above 0")
            for n in (0.0, -1, float("nan"), True, "0.5")
        ),
        *(({"early": EARLY | {"agree": n}}, f"agree {n} ") for n in (0, 1.0, True, 4)),
        *(
            ({"thresholds": LIMITS | {name: value}}, name)
            for name, value in (
                *(("contact", -1.0), ("full_scale", 0.0), ("saturated", -0.1), ("saturated", 1.5)),
                *(("dead_taxels", -1), ("dead_taxels", 4), ("unsure", -0.5)),
            )
        ),
        ({"early": EARLY | {"least": 0.5}}, "early.least 0.5"),
        ({"early": {"least": [0.9]}}, "agree"),
        ({"early": {"agree": 1}}, "least"),
        ({"early": [0.9]}, UNREAD),
        ({"early": EARLY | {"extra": 1}}, "extra"),
        ({"early": EARLY, "input": "L"}, "needs the whole window"),
        ({"known": KNOWN | {"strict": 0}}, "known.strict 0 "),
        ({"known": KNOWN | {"loose": float("inf")}}, "known.loose inf "),
        ({"known": KNOWN | {"strict": 9.5}}, "must not fall"),
        ({"known": KNOWN | {"temperature": -1.0}}, "known.temperature -1.0 "),
        ({"known": KNOWN | {"temperature": None}}, "known.temperature None "),
        ({"known": {"balanced": 9.0}}, "temperature"),
        ({"known": None}, "both `known` and"),
        *(({"schema": n}, f"schema {n} ") for n in (0, 2, 1.0, True)),
        ({"displacement": DISPLACEMENT}, "`displacement` without"),
        ({"moved": DISPLACEMENT}, "moved"),
        (displaced(limit=0), "displacement.limit 0 "),
        (displaced(temperature=-1), "temperature -1 "),
        (displaced(unsure="0.5"), "unsure"),
        (displaced() | {"displacement": {"limit": 4.0}}, "temperature"),
        (displaced(), "npz cannot be read"),
    ],
)
def test_broken_early_and_known_are_named(toy_folder, changes, hint):
    """Out of range, missing or unknown fields, one without its means.npz."""
    with pytest.raises(BundleError, match=hint):
        bundle.load(edit(toy_folder, **changes))


@pytest.mark.parametrize(
    ("arrays", "hint"),
    [
        ({"means": toy_bundle.MEANS[:2]}, "means float32 "),
        ({"means": toy_bundle.MEANS[:, :0]}, "means float32 "),
        ({"means": toy_bundle.MEANS[0]}, "means float32 "),
        ({"means": toy_bundle.MEANS.astype(float)}, "means float64"),
        ({"means": toy_bundle.MEANS * np.float32("nan")}, "means that are not"),
        ({"bias": np.zeros(2, np.float32)}, "bias float32 "),
        ({"bias": np.float32([0, np.inf, 0])}, "bias that are not"),
        ({"spread": np.ones(3)}, "spread float64"),
        ({"spread": np.float32([1, 1])}, "spread float32 "),
        ({"spread": np.float32([1, 1, 0])}, "spread .* above 0"),
        ({"shapes": np.ones((3, 1, 1))}, "shapes float64"),
        ({"shapes": np.ones((2, 1, 1), np.float16)}, "shapes float16 .2, 1, 1."),
        ({"shapes": np.ones((3, 1, 2), np.float16)}, "shapes float16 .3, 1, 2."),
        ({"shapes": np.ones((3, 3, 3), np.float16)}, "shapes float16 .3, 3, 3."),
        ({"shapes": np.full((3, 1, 1), np.inf, np.float16)}, "shapes that are not"),
        ({"displaced_turn": np.eye(3, dtype=np.float32)}, "displaced_turn float32 .3"),
        ({"displaced_means": toy_bundle.MEANS[:2]}, "displaced_means float32 .2"),
        ({"sweeps": np.zeros(3, np.int32)}, "sweeps int32"),
        *(({"sweeps": np.array(n)}, "come first") for n in ([0, 0, -1], [0, 5, 0], [5, 0, 0])),
        ({"sweeps": np.array([5, 5, 5])}, "come first"),
        ({"bias": None}, "npz cannot be read"),
        ({"bias": np.array([object()] * 3)}, "npz cannot be read"),
    ],
)
def test_broken_means_are_named(toy_folder, arrays, hint):
    """Wrong number of labels, wrong types, NaN, wrong order, pickled objects."""
    more = toy_bundle.displaced_arrays() if "displaced" in str([*arrays]) else {}
    given = toy_bundle.means(**(more | arrays))
    data = toy_bundle.npz(**{k: v for k, v in given.items() if v is not None})
    with pytest.raises(BundleError, match=hint):
        bundle.load(edit(toy_folder, bundle.MEANS, data))


def test_early_heads_and_enrolled_labels_exclude_each_other(toy_folder):
    """A head that was not trained on a label cannot give it."""
    data = toy_bundle.npz(**THIRD_ENROLLED["arrays"])
    with pytest.raises(BundleError, match="enrolled"):
        bundle.load(edit(toy_folder, bundle.MEANS, data, early=EARLY))


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"nonsense", toy_bundle.npy(np.arange(3))])
def test_means_that_are_no_npz(toy_folder, data):
    """The error names the file, for any content."""
    with pytest.raises(BundleError, match=r"means\.npz"):
        bundle.load(edit(toy_folder, bundle.MEANS, data))
    (toy_folder / bundle.MEANS).write_bytes(b"other")
    with pytest.raises(BundleError, match=r"means\.npz"):
        bundle.load(toy_folder)


@pytest.mark.parametrize(
    ("more", "fine"),
    [
        ({"known": None, "outputs": ("logits",)}, True),
        ({"known": None, "outputs": WITH_EARLY}, True),
        ({"outputs": WITH_EARLY, "early": Early((0.9,) * 3, 1)}, True),
        (THIRD_ENROLLED, True),
        ({"outputs": ("logits",)}, False),  # known without embedding
        ({"early": Early((0.9,) * 3, 1)}, False),  # no early
        ({"outputs": WITH_EARLY, "early": Early((0.9,) * 2, 1)}, False),  # another D
        ({"known": None, "outputs": ("embedding",)}, False),  # no logits
        ({"known": None, "outputs": ("logits", "more")}, False),
        ({"known": None, "outputs": ("logits",), "labels": 2}, False),  # another K
        ({"arrays": toy_bundle.means(means=np.eye(3, 5, dtype=np.float32))}, False),  # another r
        ({"arrays": THIRD_ENROLLED["arrays"]}, False),  # K0 = 2, the model knows 3
    ],
)
def test_outputs_of_the_model_are_those_of_the_manifest(tmp_path, more, fine):
    """Required outputs exist, existing ones fit, unknown ones are refused."""
    refused = pytest.raises(BundleError, match="opened")
    with contextlib.nullcontext() if fine else refused:
        assert toy_bundle.load(tmp_path / "toy", **more).model


def test_a_far_sweep_is_unknown(toy):
    """Beyond 3 deviations: no label, no scores; a fault of the window comes first."""
    it = box(toy)
    assert it(toy_bundle.sweep(-3, 0)).label == "a"
    assert it(toy_bundle.sweep(9, 0)).label == "b"
    for v in (it(toy_bundle.sweep(6, 6)), it(toy_bundle.sweep(-3, -0.5))):
        assert (v.status, v.label, v.probability, v.margin) == (Status.UNKNOWN, "", 0, 0)
        assert (v.fused, len(v.scores)) == (0, 0)
    assert re.search(r" 9\.25 from a.* 9$", v.detail)
    assert it(sweep_of(np.zeros((20, 2, 2), np.int16))).status is Status.NO_CONTACT


@pytest.mark.parametrize(
    ("strangers", "known"), [("strict", 1), ("balanced", 2), ("loose", 3), (None, 2)]
)
def test_the_box_chooses_a_limit(toy: Bundle, strangers: str | None, known: int):
    """A looser limit knows more; without a choice it is balanced."""
    three = replace(toy_bundle.KNOWN, strict=4.0, loose=16.0)
    made = replace(toy, manifest=replace(toy.manifest, known=three))
    it = box(made, **{"strangers": strangers} if strangers else {})
    far = [toy_bundle.sweep(x, 0) for x in (-1.5, -2.9, -3.9, -4.1)]
    assert sum(it(sweep).status is not Status.UNKNOWN for sweep in far) == known
    assert it.rule["strangers"] == (strangers or "balanced")


def test_an_unknown_sweep_does_not_count_for_its_object(toy):
    """The object's other sweeps are kept unchanged."""
    it = box(toy)
    one = it(toy_bundle.sweep(2.9, 0, object=1))
    assert it(toy_bundle.sweep(30, 30, object=1)).status is Status.UNKNOWN
    two = it(toy_bundle.sweep(2.9, 0, object=1))
    assert (one.fused, two.fused) == (1, 2)
    assert two.scores == pytest.approx(fuse([one.scores, one.scores], "product"))


def test_a_model_that_gives_no_number_is_unknown(tmp_path):
    """No label, no NaN; the object's other sweeps are unaffected."""
    format = replace(toy_bundle.FORMAT, dtype="float32")
    made = toy_bundle.files(format=format, outputs=("logits",), known=None, scale=1e28)
    manifest = bundle.Manifest.parse(made[bundle.MANIFEST])
    limits = replace(manifest.thresholds, full_scale=3e38)
    made[bundle.MANIFEST] = replace(manifest, thresholds=limits).json()
    it = box(bundle.load(toy_bundle.put(tmp_path / "toy", made)))
    far = toy_bundle.sweep(0, 0, object=1, format=format)
    far.frames.taxels[::2, 0, :] = 9e11
    with np.errstate(invalid="ignore"):
        v = it(far)
    assert (v.status, v.label, v.probability) == (Status.UNKNOWN, "", 0)
    assert v.detail.endswith("no number")
    assert it(toy_bundle.sweep(0, 0, object=1, format=format)).fused == 1


def borderline(**more: Any) -> Sweep:
    return toy_bundle.sweep(2.8, -1, **more)


def test_sweeps_are_requested_until_the_probability_suffices(toy):
    """After n sweeps the odds are to the power n."""
    # Probability of "a" in a borderline sweep: .65, since two labels count
    p = 1 / (1 + np.exp(-0.6))
    it = box(toy, min_probability=0.85, max_sweeps=5)
    given = [it(borderline(object=1)) for _ in range(4)]
    assert [v.status for v in given] == [Status.UNSURE] * 2 + [Status.OK] * 2
    assert [(v.label, v.fused) for v in given] == [("a", n) for n in (1, 2, 3, 4)]
    odds = (p / (1 - p)) ** np.arange(1, 5)
    assert [v.probability for v in given] == pytest.approx(odds / (1 + odds), abs=2e-3)
    assert it(borderline(object=2)).status is Status.UNSURE


def test_at_the_limit_the_answer_is_final(toy):
    """Undecided, with its label; a robot that continues may get ok."""
    it = box(toy, min_probability=0.85, max_sweeps=2)
    given = [it(borderline(object=1)) for _ in range(3)]
    assert [v.status for v in given] == [Status.UNSURE, Status.UNDECIDED, Status.OK]
    assert given[1].label == "a"
    assert 0.7 < given[1].probability < 0.85
    against = it(toy_bundle.sweep(3.2, -1, object=1))
    assert (against.status, against.fused) == (Status.UNDECIDED, 4)


@pytest.mark.parametrize(("object", "fusion"), [(0, "product"), (1, "none")])
def test_sweeps_that_stand_alone_never_reach_the_limit(toy, object, fusion):
    """Without objects or fusion; a limit of one is final."""
    for limit, status in ((2, Status.UNSURE), (1, Status.UNDECIDED)):
        it = box(toy, fuse=fusion, min_probability=0.85, max_sweeps=limit)
        assert [it(borderline(object=object)).status for _ in range(3)] == [status] * 3


def test_sure_is_the_bundles_where_none_is_given(toy):
    """0 stands for thresholds.unsure; without a limit nothing is ever undecided."""
    assert box(toy).settings.min_probability == toy_bundle.LIMITS.unsure
    assert box(toy)(borderline()).status is Status.OK
    it = box(toy, min_probability=1.1)
    assert {it(borderline(object=1)).status for _ in range(20)} == {Status.UNSURE}


def test_what_is_not_ok_need_not_count(toy):
    """An early answer that would not be ok is not given, and the object's state is unchanged."""
    it = box(toy, min_probability=0.85)
    assert it(borderline(object=1)).share == 1
    for object in (1, 2):
        half = replace(toy_bundle.sweep(0, 0, object=object), share=0.5)
        found = it.unfinished(half, told(it, np.array([0.6, 0.4, 0.0])))
        assert found.status is Status.UNSURE
    assert it(borderline(object=1)).fused == 2
    half = replace(toy_bundle.sweep(0, 0, object=1), share=0.5)
    v = it.verdict(it.unfinished(half, told(it, np.array([0.9, 0.1, 0.0]))))
    assert (v.status, v.label, v.fused, v.share) == (Status.OK, "a", 3, 0.5)
    assert it(borderline(object=1)).fused == 4


def test_an_enrolled_label_changes_all_logits(tmp_path):
    """(means . z + bias) / temperature, its spread wider by 1 + 1 / n."""
    bias = np.float32([0, -18, -18 + 2 / 4])
    arrays = toy_bundle.means(bias=bias, sweeps=np.array([0, 0, 2]))
    it = box(toy_bundle.load(tmp_path / "toy", arrays=arrays, labels=2))
    z = np.array([1.0, 2.0])
    have = it.logits(toy_bundle.window(*z)).astype(float)
    assert have - have[0] == pytest.approx((toy_bundle.MEANS @ z + bias - bias[0]) / 2, abs=1e-4)
    assert it.self_test() < 1e-5
    assert it(toy_bundle.sweep(0, 6)).label == "c"
    # c lies 1.5 times as far as its sweeps say: 13.5 counts 9, as b's 9
    assert it(toy_bundle.sweep(0, 6 + 3.6)).label == "c"
    assert it(toy_bundle.sweep(0, 6 + 3.7)).status is Status.UNKNOWN
    wide = arrays | {"spread": np.float32([1, 1, 4])}
    it = box(toy_bundle.load(tmp_path / "wide", arrays=wide, labels=2))
    assert it(toy_bundle.sweep(0, 6 + 7.3)).label == "c"
    assert it(toy_bundle.sweep(0, 6 + 7.4)).status is Status.UNKNOWN
    assert it(toy_bundle.sweep(9.1, 0)).status is Status.UNKNOWN


@pytest.mark.parametrize(
    "arrays",
    [
        {"means": toy_bundle.MEANS[[1, 0, 2]], "bias": np.float32([-18, 0, -18])},
        {"bias": np.float32([0, 30, -18])},
    ],
)
def test_means_of_another_training_are_found(toy_folder, arrays):
    """Class means that give a golden sweep another label than the model's logits are refused."""
    data = toy_bundle.npz(**toy_bundle.means(**arrays))
    it = box(bundle.load(edit(toy_folder, bundle.MEANS, data)))
    with pytest.raises(BundleError, match="golden"):
        it.self_test()


def test_of_equal_probabilities_the_first_label_is_reported(default_bundle):
    """Like argmax, the same label as at export."""
    scores = np.array([0.0, 0.4, 0.0, 0.4, 0.1, 0.1])
    it = box(default_bundle)
    verdict = it.verdict(it.judged(sweep_of(default_bundle.golden[0]), told(it, scores)))
    assert (verdict.label, verdict.margin) == (default_bundle.manifest.labels[1], 0.0)
