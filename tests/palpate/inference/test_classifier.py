"""Bundle and classifier: altered files are refused with the reason, and fusion follows the paper
and Bayes."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle, Early
from palpate.bundle.manifest import SCHEMA
from palpate.core.errors import BundleError
from palpate.core.types import Frames, Status, Sweep, SweepFormat
from palpate.inference import session
from palpate.inference.classifier import Classifier, fuse, softmax
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle


def sweep_of(taxels: np.ndarray, **more) -> Sweep:
    """A sweep with this window."""
    n = np.arange(len(taxels))
    return Sweep(1, 0, 0, Status.OK, Frames(n, n, taxels), **more)


def test_softmax_is_equation_10():
    """The formula as printed, and no overflow."""
    z = np.array([1.0, 2.0, -3.0])
    assert softmax(z) == pytest.approx(np.exp(z) / np.exp(z).sum())
    assert softmax(np.array([1e4, 0.0])).tolist() == [1.0, 0.0]


def test_product_is_bayes():
    """Two sweeps: the product of probabilities, normalized."""
    a, b = np.array([0.6, 0.3, 0.1]), np.array([0.2, 0.7, 0.1])
    assert fuse([a, b], "product") == pytest.approx(a * b / (a * b).sum())


def test_no_sweep_can_veto():
    """A sweep with probability 1 does not outweigh three that disagree."""
    sure, other = np.array([1.0, 0.0]), np.array([1e-5, 1 - 1e-5])
    assert fuse([sure, other, other, other], "product").argmax() == 1


def test_vote_is_the_papers():
    """The most frequent label wins, and the first of equally frequent labels: with two sweeps the
    first decides."""
    a, b, c = np.eye(3) * 0.8 + 0.1
    assert fuse([b, a], "vote").argmax() == 1
    assert fuse([a, b, b], "vote").argmax() == 1
    assert fuse([a, b, c], "vote").argmax() == 0
    assert fuse([c, b, b, c], "vote").argmax() == 2


def test_golden_sweeps_pass(default_bundle: Bundle):
    """This machine runs the default bundle as it was exported."""
    assert Classifier(default_bundle, VirtualClock()).self_test() < bundle.GOLDEN_TOLERANCE


def test_golden_sweeps_can_fail(default_bundle: Bundle):
    """Logits that differ from the model's are detected."""
    other = replace(default_bundle, golden_logits=-default_bundle.golden_logits)
    with pytest.raises(BundleError, match="get another label"):
        Classifier(other, VirtualClock()).self_test()


def test_verdict_carries_what_is_known(default_bundle: Bundle):
    """A classified sweep has label, probability, margin, fused and bundle id. Probabilities add up
    to one."""
    clock = VirtualClock()
    v = Classifier(default_bundle, clock)(sweep_of(default_bundle.golden[0], lost=1))
    assert v.status in (Status.OK, Status.UNSURE)
    assert v.label == default_bundle.manifest.labels[v.scores.argmax()]
    assert v.scores.sum() == pytest.approx(1)
    assert v.probability == v.scores.max()
    assert v.margin == pytest.approx(np.diff(np.sort(v.scores))[-1])
    assert (v.fused, v.lost, v.bundle) == (1, 1, default_bundle.id)


def test_below_the_threshold_is_unsure(default_bundle: Bundle):
    """The label is still reported, but not as `ok`."""
    strict = replace(
        default_bundle.manifest, thresholds=replace(default_bundle.manifest.thresholds, unsure=1.1)
    )
    v = Classifier(replace(default_bundle, manifest=strict), VirtualClock())(
        sweep_of(default_bundle.golden[0])
    )
    assert v.status is Status.UNSURE
    assert v.label


@pytest.mark.parametrize("status", [s for s in Status if not s.classified])
def test_refused_sweeps_keep_their_status(default_bundle: Bundle, status: Status):
    """A sweep with another status than ok is not classified."""
    sweep = replace(sweep_of(default_bundle.golden[0]), status=status)
    v = Classifier(default_bundle, VirtualClock())(sweep)
    assert (v.status, v.label, v.fused, len(v.scores)) == (status, "", 0, 0)


def of_features(weights: np.ndarray) -> dict[str, bytes]:
    """The files of the default bundle with another model: input L [1, n] times weights [n, 6]."""
    onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["features", "W"], ["logits"])],
        "g",
        [onnx.helper.make_tensor_value_info("features", 1, [1, len(weights)])],
        [onnx.helper.make_tensor_value_info("logits", 1, [1, 6])],
        [onnx.numpy_helper.from_array(weights.astype(np.float32), "W")],
    )
    made = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9
    )
    files = bundle.files(bundle.DEFAULT) | {bundle.MODEL: made.SerializeToString()}
    entries = {name: bundle.file_entry(files[name]) for name in (bundle.MODEL, bundle.GOLDEN)}
    manifest = bundle.Manifest.parse(files[bundle.MANIFEST])
    return files | {
        bundle.MANIFEST: replace(
            manifest, input="L", early=None, known=None, displacement=None, files=entries
        ).json()
    }


def test_features_go_through_the_same_runtime():
    """A bundle with input L gets features, not raw counts: a linear model gives the same logits as
    numpy."""
    from palpate.signal import features

    weights = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    made = bundle.from_files(of_features(weights), "here")
    want = features.compute("L", made.golden[0], 750.0) @ weights
    assert Classifier(made, VirtualClock()).logits(made.golden[0]) == pytest.approx(want, rel=1e-5)


def test_as_many_features_as_the_manifest_computes():
    """A model of four features is refused, since input L has three."""
    with pytest.raises(
        BundleError, match=r"takes float32 \[1, 4\], the manifest has float32 \[1, 3\]"
    ):
        bundle.from_files(of_features(np.ones((4, 6))), "here")


def copy(tmp_path: Path) -> Path:
    """A copy of the default bundle, to be damaged."""
    return Path(shutil.copytree(bundle.DEFAULT, tmp_path / "bundle"))


def edit(folder: Path, **changes) -> None:
    """Change fields of a manifest."""
    path = folder / bundle.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_default_bundle_is_small():
    """All files of the committed bundle together stay within 128 KB."""
    assert sum(f.stat().st_size for f in bundle.DEFAULT.iterdir()) <= 128_000


@pytest.mark.parametrize("name", [bundle.MODEL, bundle.GOLDEN])
def test_altered_and_missing_files_are_named(tmp_path: Path, name: str):
    """One flipped byte, or no file: the file is named."""
    folder = copy(tmp_path)
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    with pytest.raises(BundleError, match="was altered") as e:
        bundle.load(folder)
    assert name in str(e.value)
    (folder / name).unlink()
    with pytest.raises(BundleError, match="cannot be read") as e:
        bundle.load(folder)
    assert name in str(e.value)


@pytest.mark.parametrize(
    ("changes", "hint"),
    [
        ({"schema": 99}, "schema 99 is unknown"),
        ({"input": "M"}, "input 'M' is unknown"),
        ({"labels": ["one"]}, "at least two"),
        ({"labels": ["a,b", "c"]}, "label 'a,b' cannot be sent"),
        ({"labels": ["a", 3]}, "label 3 cannot be sent"),
        ({"files": {}, "early": None, "known": None, "moved": None}, "does not name model.onnx"),
        ({"format": {"rows": 4}}, "manifest cannot be read"),
        ({"extra": 1}, "extra"),
        (
            {"unloaded": [1.0, 2.0]},
            "gives 2 counts of the unloaded skin, its frames have 16; export",
        ),
        ({"unloaded": 16}, "manifest cannot be read"),
        ({"unloaded": ["1"] * 16}, "manifest cannot be read"),
        (
            {
                "thresholds": {"contact": None, "full_scale": 255.0},
                "place": {"pitch_mm": 4.0, "rows_mm": [1.0], "cols_mm": [1.0], "limit_mm": 1.0},
            },
            "`place` without `thresholds.contact`",
        ),
        ({"labels": ["a", "b"], "sliding": None}, "logits"),
    ],
)
def test_broken_manifests_are_named(tmp_path: Path, changes: dict, hint: str):
    """Unknown schema, input, key; labels that cannot be sent; files that are not named; labels that
    do not fit."""
    folder = copy(tmp_path)
    edit(folder, **changes)
    with pytest.raises(BundleError, match=hint):
        bundle.load(folder)


def test_a_bundle_may_know_the_unloaded_skin(tmp_path: Path):
    """The box uses it as its first tare. Without it the manifest has no such key."""
    folder = copy(tmp_path)
    before = bundle.load(folder)
    assert Classifier(before, VirtualClock()).tare.tolist() == np.zeros((4, 4)).tolist()
    assert before.manifest.json() == (folder / bundle.MANIFEST).read_bytes()
    assert b"unloaded" not in before.manifest.json()
    level = [float(i) for i in range(16)]
    edit(folder, unloaded=level)
    after = bundle.load(folder)
    assert Classifier(after, VirtualClock()).tare.tolist() == np.reshape(level, (4, 4)).tolist()
    assert bundle.Manifest.parse(after.manifest.json()) == after.manifest


def test_no_bundle(tmp_path: Path):
    """A folder without a manifest, and a manifest that is not JSON."""
    with pytest.raises(BundleError, match="no bundle at"):
        bundle.load(tmp_path)
    (tmp_path / bundle.MANIFEST).write_text("{")
    with pytest.raises(BundleError, match="manifest cannot be read"):
        bundle.load(tmp_path)


def test_golden_sweeps_of_another_format(tmp_path: Path):
    """Golden sweeps that do not fit the manifest's format are refused before the model is
    opened."""
    folder = copy(tmp_path)
    manifest = json.loads((folder / bundle.MANIFEST).read_text())
    edit(folder, format=manifest["format"] | {"rows": 2})
    with pytest.raises(BundleError, match="do not fit the format"):
        bundle.load(folder)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
@pytest.mark.parametrize("axes", [1, 3])
def test_golden_sweeps_are_packed_without_loss(dtype: str, axes: int):
    """Every value of every type is the same after unpacking, even if changes wrap. Smooth sweeps
    need less space."""
    format = SweepFormat(2, 3, 100.0, 50, dtype, axes)
    rng = np.random.default_rng(1)
    any_bits = rng.integers(0, 256, (2, 50, *format.shape, format.numpy_type.itemsize), np.uint8)
    samples = any_bits.view(format.numpy_type)[..., 0]
    samples[0] = np.cumsum(rng.integers(-2, 3, samples[0].shape), axis=0).astype(format.numpy_type)
    logits = rng.normal(size=(2, 4)).astype(np.float32)
    manifest = SimpleNamespace(format=format, labels=("a", "b", "c", "d"))
    got, answers = bundle._golden(bundle.golden_file(samples, logits), manifest)
    assert got.tobytes() == samples.tobytes()
    assert got.dtype == format.numpy_type
    assert answers.tolist() == logits.tolist()
    smooth = np.repeat(samples[:1], 2, axis=0)
    plain = io.BytesIO()
    np.savez_compressed(plain, samples=smooth, logits=logits)
    assert len(bundle.golden_file(smooth, logits)) < len(plain.getvalue())


@pytest.mark.parametrize("shape", [(1, 2, 20, 2, 2), (2, 2, 19, 2, 2), (2, 2), ()])
def test_golden_changes_of_another_shape(shape: tuple[int, ...]):
    """Changes with too few bytes or frames, or with none, are refused in one line."""
    manifest = SimpleNamespace(format=SweepFormat(2, 2, 100.0, 20, "int16"), labels=("a", "b"))
    packed = io.BytesIO()
    np.savez_compressed(packed, changes=np.zeros(shape, np.uint8), logits=np.zeros((2, 2)))
    with pytest.raises(BundleError, match="do not fit the format"):
        bundle._golden(packed.getvalue(), manifest)


def test_a_golden_file_without_sweeps():
    """Logits without golden sweeps are refused."""
    packed = io.BytesIO()
    np.savez_compressed(packed, logits=np.zeros((2, 2)))
    with pytest.raises(BundleError, match="holds no sweeps; export the bundle again"):
        bundle._golden(
            packed.getvalue(),
            SimpleNamespace(format=SweepFormat(2, 2, 100.0, 20, "int16"), labels=("a",)),
        )


def test_pickles_are_not_opened(tmp_path: Path):
    """Golden sweeps that hold Python objects are refused, not unpickled."""
    folder = copy(tmp_path)
    np.savez(folder / bundle.GOLDEN, samples=np.array([object()]), logits=np.zeros((1, 6)))
    manifest = json.loads((folder / bundle.MANIFEST).read_text())
    entry = bundle.file_entry((folder / bundle.GOLDEN).read_bytes())
    edit(folder, files=manifest["files"] | {bundle.GOLDEN: entry})
    with pytest.raises(BundleError, match=r"golden\.npz cannot be read"):
        bundle.load(folder)


def test_a_model_that_is_none(default_bundle: Bundle):
    """A model that the bundle's check accepted and onnxruntime cannot open."""
    with pytest.raises(BundleError, match="refuses the model"):
        Classifier(
            replace(default_bundle, model=default_bundle.model.replace(b"Gemm", b"Gemn")),
            VirtualClock(),
        )


EARLY = {"least": [0.9, 0.8, 2.0], "agree": 2}
KNOWN = {"limit": 9.0, "temperature": 2.0}
DISPLACEMENT = {"limit": 4.0, "temperature": 3.0, "unsure": 0.75}
CONTACT = {"pitch_mm": 1.0, "rows_mm": [0.5], "cols_mm": [0.5], "limit_mm": 0.1}


def spoiled(tmp_path: Path, arrays: dict[str, np.ndarray] | None = None, **changes) -> Path:
    """A toy bundle with another manifest or another means.npz."""
    folder = toy_bundle.put(tmp_path / "toy", toy_bundle.files())
    if arrays is not None:
        (folder / bundle.MEANS).write_bytes(toy_bundle.npz(**arrays))
        files = json.loads((folder / bundle.MANIFEST).read_text())["files"]
        changes["files"] = files | {
            bundle.MEANS: bundle.file_entry((folder / bundle.MEANS).read_bytes())
        }
    edit(folder, **changes)
    return folder


def test_a_bundle_of_schema_1_is_still_read(tmp_path: Path, default_bundle: Bundle):
    """It does not have the new fields. A manifest that is written now is read again unchanged."""
    folder = copy(tmp_path)
    old = json.loads((folder / bundle.MANIFEST).read_text())
    (folder / bundle.MANIFEST).write_text(
        json.dumps(
            {
                k: v
                for k, v in old.items()
                if k not in ("early", "known", "place", "moved", "runtime", "counter")
            }
            | {"schema": 1, "files": {k: v for k, v in old["files"].items() if k != bundle.MEANS}}
        )
    )
    read = bundle.load(folder)
    assert (read.manifest.early, read.manifest.known, read.classes, read.enrolled) == (
        None,
        None,
        None,
        {},
    )
    new = toy_bundle.load(
        tmp_path / "toy", early=Early((0.9, 0.8, 2.0), 2), outputs=(*toy_bundle.OUTPUTS, "early")
    )
    assert new.manifest.schema == SCHEMA
    assert bundle.Manifest.parse(new.manifest.json()) == new.manifest
    assert new.manifest.early == Early((0.9, 0.8, 2.0), 2)
    assert new.manifest.known == toy_bundle.KNOWN
    assert new.classes is not None
    assert new.classes.means.tolist() == toy_bundle.MEANS.tolist()
    arrays = {k: v for k, v in toy_bundle.means().items() if k != "spread"}
    plain = toy_bundle.load(tmp_path / "plain", arrays=arrays).classes
    assert plain is not None
    assert plain.spread.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("changes", "hint"),
    [
        ({"early": EARLY | {"least": []}}, "one for each step"),
        ({"early": EARLY | {"least": [0.5, 0.0]}}, "numbers above 0"),
        ({"early": EARLY | {"least": [0.5, -1]}}, "numbers above 0"),
        ({"early": EARLY | {"least": [0.5, float("nan")]}}, "numbers above 0"),
        ({"early": EARLY | {"least": [0.5, True]}}, "numbers above 0"),
        ({"early": EARLY | {"least": [0.5, "0.5"]}}, "numbers above 0"),
        ({"early": EARLY | {"least": 0.5}}, "manifest cannot be read"),
        ({"early": EARLY | {"agree": 0}}, "from 1 on"),
        ({"early": EARLY | {"agree": 1.0}}, "from 1 on"),
        ({"early": EARLY | {"agree": True}}, "from 1 on"),
        ({"early": {"least": [0.9]}}, "agree"),
        ({"early": {"agree": 1}}, "least"),
        ({"early": [0.9]}, "manifest cannot be read"),
        ({"early": EARLY | {"extra": 1}}, "extra"),
        ({"early": EARLY, "input": "L"}, "needs the whole window"),
        ({"known": KNOWN | {"limit": 0}}, "known.limit 0 must"),
        ({"known": KNOWN | {"limit": float("inf")}}, "known.limit inf must"),
        ({"known": KNOWN | {"temperature": -1.0}}, "known.temperature -1.0 must"),
        ({"known": KNOWN | {"temperature": None}}, "known.temperature None must"),
        ({"known": {"limit": 9.0}}, "temperature"),
        ({"known": None}, "both `known` and means.npz"),
        ({"schema": 1}, "schema 1 has no"),
        ({"moved": DISPLACEMENT}, "`moved` without `known` and `place`"),
        ({"displacement": DISPLACEMENT, "place": CONTACT}, r"\['displacement'\] is none of"),
        ({"contact": CONTACT}, r"\['contact'\] is none of"),
        ({"moved": DISPLACEMENT | {"limit": 0}, "place": CONTACT}, "moved.limit 0 must"),
        (
            {"moved": DISPLACEMENT | {"temperature": -1}, "place": CONTACT},
            "moved.temperature -1 must",
        ),
        ({"moved": DISPLACEMENT | {"unsure": "0.5"}, "place": CONTACT}, "unsure"),
        ({"moved": {"limit": 4.0}, "place": CONTACT}, "temperature"),
        ({"moved": DISPLACEMENT, "place": CONTACT, "schema": 3}, "schema 3 has no `moved`"),
        ({"moved": DISPLACEMENT, "place": CONTACT}, "means.npz cannot be read"),
    ],
)
def test_broken_early_and_known_are_named(tmp_path: Path, changes: dict, hint: str):
    """Numbers out of range, fields that are missing or unknown, `known` without means.npz and the
    reverse."""
    with pytest.raises(BundleError, match=hint):
        bundle.load(spoiled(tmp_path, **changes))


@pytest.mark.parametrize(
    ("arrays", "hint"),
    [
        (toy_bundle.means(means=toy_bundle.MEANS[:2]), "means float32 "),
        (toy_bundle.means(means=toy_bundle.MEANS[:, :0]), "means float32 "),
        (toy_bundle.means(means=toy_bundle.MEANS[0]), "means float32 "),
        (toy_bundle.means(means=toy_bundle.MEANS.astype(float)), "means float64"),
        (toy_bundle.means(means=toy_bundle.MEANS * np.float32("nan")), "means that are not finite"),
        (toy_bundle.means(bias=np.zeros(2, np.float32)), "bias float32 "),
        (toy_bundle.means(bias=np.float32([0, np.inf, 0])), "bias that are not finite"),
        (toy_bundle.means(spread=np.ones(3)), "spread float64"),
        (toy_bundle.means(spread=np.float32([1, 1])), "spread float32 "),
        (toy_bundle.means(spread=np.float32([1, 1, 0])), "spread .* must be above 0"),
        (toy_bundle.means(shapes=np.ones((3, 1, 1))), "shapes float64"),
        (toy_bundle.means(shapes=np.ones((2, 1, 1), np.float16)), "shapes float16 .2, 1, 1."),
        (toy_bundle.means(shapes=np.ones((3, 1, 2), np.float16)), "shapes float16 .3, 1, 2."),
        (toy_bundle.means(shapes=np.ones((3, 3, 3), np.float16)), "shapes float16 .3, 3, 3."),
        (
            toy_bundle.means(shapes=np.full((3, 1, 1), np.inf, np.float16)),
            "shapes that are not finite",
        ),
        (
            toy_bundle.means(
                **toy_bundle.displaced_arrays() | {"moved_turn": np.eye(3, dtype=np.float32)}
            ),
            "moved_turn float32 .3",
        ),
        (
            toy_bundle.means(
                **toy_bundle.displaced_arrays() | {"moved_means": toy_bundle.MEANS[:2]}
            ),
            "moved_means float32 .2",
        ),
        (toy_bundle.means(sweeps=np.zeros(3, np.int32)), "sweeps int32"),
        (toy_bundle.means(sweeps=np.array([0, 0, -1])), "trained labels .0. come first"),
        (toy_bundle.means(sweeps=np.array([0, 5, 0])), "trained labels .0. come first"),
        (toy_bundle.means(sweeps=np.array([5, 0, 0])), "trained labels .0. come first"),
        (toy_bundle.means(sweeps=np.array([5, 5, 5])), "trained labels .0. come first"),
        ({k: v for k, v in toy_bundle.means().items() if k != "bias"}, "means.npz cannot be read"),
        (toy_bundle.means(bias=np.array([object()] * 3)), "means.npz cannot be read"),
    ],
)
def test_broken_means_are_named(tmp_path: Path, arrays: dict, hint: str):
    """Wrong number of labels, wrong types, NaN, wrong order, pickled objects."""
    with pytest.raises(BundleError, match=hint):
        bundle.load(spoiled(tmp_path, arrays))


def test_early_heads_and_enrolled_labels_exclude_each_other(tmp_path: Path):
    """A head that was not trained on a label cannot give it."""
    with pytest.raises(BundleError, match="do not know the enrolled labels"):
        bundle.load(spoiled(tmp_path, toy_bundle.means(sweeps=np.array([0, 0, 5])), early=EARLY))


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"nonsense", toy_bundle.npy(np.arange(3))])
def test_means_that_are_no_npz(tmp_path: Path, data: bytes):
    """The error names the file, for any content."""
    folder = spoiled(tmp_path)
    (folder / bundle.MEANS).write_bytes(data)
    files = json.loads((folder / bundle.MANIFEST).read_text())["files"]
    edit(folder, files=files | {bundle.MEANS: bundle.file_entry(data)})
    with pytest.raises(BundleError, match=r"means\.npz cannot be read"):
        bundle.load(folder)
    (folder / bundle.MEANS).write_bytes(b"other")
    with pytest.raises(BundleError, match=r"means\.npz was altered"):
        bundle.load(folder)


@pytest.mark.parametrize(
    ("more", "fine"),
    [
        ({"known": None, "outputs": ("logits",)}, True),
        ({"known": None, "outputs": ("logits", "embedding", "early")}, True),
        ({"outputs": ("logits", "embedding", "early"), "early": Early((0.9,) * 3, 1)}, True),
        ({"outputs": ("logits",)}, False),  # known without embedding
        ({"early": Early((0.9,) * 3, 1)}, False),  # no early
        (
            {"outputs": ("logits", "embedding", "early"), "early": Early((0.9,) * 2, 1)},
            False,
        ),  # another D
        ({"known": None, "outputs": ("embedding",)}, False),  # no logits
        ({"known": None, "outputs": ("logits", "more")}, False),
        ({"known": None, "outputs": ("logits",), "labels": 2}, False),  # another K
        ({"arrays": toy_bundle.means(means=np.eye(3, 5, dtype=np.float32))}, False),  # another r
        (
            {"arrays": toy_bundle.means(sweeps=np.array([0, 0, 5]))},
            False,
        ),  # K0 = 2, the model knows 3
        ({"arrays": toy_bundle.means(sweeps=np.array([0, 0, 5])), "labels": 2}, True),
    ],
)
def test_outputs_of_the_model_are_those_of_the_manifest(tmp_path: Path, more: dict, fine: bool):
    """Required outputs exist, existing ones fit, unknown ones are refused."""
    refused = pytest.raises(BundleError, match="must not be opened")
    with contextlib.nullcontext() if fine else refused:
        toy_bundle.load(tmp_path / "toy", **more)


def test_a_far_sweep_is_unknown(tmp_path: Path):
    """The squared distance to the nearest mean is compared with the limit: up to 3 deviations a
    sweep is known, beyond it has no label and no scores."""
    it = Classifier(toy_bundle.load(tmp_path / "toy"), VirtualClock())
    assert it(toy_bundle.sweep(-3, 0)).label == "a"
    v = it(toy_bundle.sweep(-3, -0.5))
    assert (v.status, v.label, v.probability, v.margin, v.fused, len(v.scores)) == (
        Status.UNKNOWN,
        "",
        0,
        0,
        0,
        0,
    )
    assert v.detail == "squared distance 9.25 from a, limit 9"
    assert it(toy_bundle.sweep(6, 6)).status is Status.UNKNOWN
    assert it(toy_bundle.sweep(9, 0)).label == "b"


def test_a_faulty_window_is_not_unknown(tmp_path: Path):
    """A fault of the window has precedence."""
    it = Classifier(toy_bundle.load(tmp_path / "toy"), VirtualClock())
    assert it(sweep_of(np.zeros((20, 2, 2), np.int16))).status is Status.NO_CONTACT


def test_an_unknown_sweep_does_not_count_for_its_object(tmp_path: Path):
    """The object's other sweeps are kept unchanged."""
    it = Classifier(toy_bundle.load(tmp_path / "toy"), VirtualClock())
    one = it(toy_bundle.sweep(2.9, 0, object=1))
    assert it(toy_bundle.sweep(30, 30, object=1)).status is Status.UNKNOWN
    two = it(toy_bundle.sweep(2.9, 0, object=1))
    assert (one.fused, two.fused) == (1, 2)
    assert two.scores == pytest.approx(fuse([one.scores, one.scores], "product"))


def test_a_model_that_gives_no_number_is_unknown(tmp_path: Path):
    """Weights that overflow with large float32 counts: no label, no NaN, and the object's other
    sweeps are unaffected."""
    format = replace(toy_bundle.FORMAT, dtype="float32")
    made = toy_bundle.files(format=format, outputs=("logits",), known=None, scale=1e28)
    limits = replace(bundle.Manifest.parse(made[bundle.MANIFEST]).thresholds, full_scale=3e38)
    made[bundle.MANIFEST] = replace(
        bundle.Manifest.parse(made[bundle.MANIFEST]), thresholds=limits
    ).json()
    it = Classifier(bundle.load(toy_bundle.put(tmp_path / "toy", made)), VirtualClock())
    far = toy_bundle.sweep(0, 0, object=1, format=format)
    far.frames.taxels[::2, 0, :] = 9e11
    with np.errstate(invalid="ignore"):
        v = it(far)
    assert (v.status, v.label, v.probability, v.detail) == (
        Status.UNKNOWN,
        "",
        0,
        "the model gives no number",
    )
    assert it(toy_bundle.sweep(0, 0, object=1, format=format)).fused == 1


def borderline(**more) -> tuple[Sweep, float]:
    """A sweep that is "a" with a probability of 1 / (1 + exp(-.6)) = .65 (two labels count), and
    this probability."""
    return toy_bundle.sweep(2.8, -1, **more), 1 / (1 + np.exp(-0.6))


def test_sweeps_are_requested_until_the_probability_suffices(tmp_path: Path):
    """Unsure, unsure, ok: after n sweeps the odds are the odds of one sweep to the power n. A
    further sweep is fused, too."""
    it = Classifier(
        toy_bundle.load(tmp_path / "toy"), VirtualClock(), min_probability=0.85, max_sweeps=5
    )
    given = [it(borderline(object=1)[0]) for _ in range(4)]
    p = borderline()[1]
    assert [v.status for v in given] == [Status.UNSURE, Status.UNSURE, Status.OK, Status.OK]
    assert [v.fused for v in given] == [1, 2, 3, 4]
    for v in given:
        assert v.label == "a"
        odds = (p / (1 - p)) ** v.fused
        assert v.probability == pytest.approx(odds / (1 + odds), abs=2e-3)
    assert it(borderline(object=2)[0]).status is Status.UNSURE


def test_at_the_limit_the_answer_is_final(tmp_path: Path):
    """The answer is undecided, with label and probability. A robot that continues is answered by
    the same rule, and may get ok."""
    it = Classifier(
        toy_bundle.load(tmp_path / "toy"), VirtualClock(), min_probability=0.85, max_sweeps=2
    )
    given = [it(borderline(object=1)[0]) for _ in range(3)]
    assert [v.status for v in given] == [Status.UNSURE, Status.UNDECIDED, Status.OK]
    assert given[1].label == "a"
    assert 0.7 < given[1].probability < 0.85
    against = it(replace(toy_bundle.sweep(3.2, -1), object=1))
    assert (against.status, against.fused) == (Status.UNDECIDED, 4)


@pytest.mark.parametrize("more", [{"object": 0}, {"object": 1, "fusion": "none"}])
def test_sweeps_that_stand_alone_never_reach_the_limit(tmp_path: Path, more: dict):
    """Without NEW OBJECT, or without fusion, each sweep is answered alone. A limit of one makes the
    answer final."""
    fusion = more.pop("fusion", "product")
    it = Classifier(
        toy_bundle.load(tmp_path / "toy"),
        VirtualClock(),
        fusion,
        min_probability=0.85,
        max_sweeps=2,
    )
    assert [it(borderline(**more)[0]).status for _ in range(3)] == [Status.UNSURE] * 3
    it = Classifier(it.bundle, VirtualClock(), fusion, min_probability=0.85, max_sweeps=1)
    assert [it(borderline(**more)[0]).status for _ in range(3)] == [Status.UNDECIDED] * 3


def test_sure_is_the_bundles_where_none_is_given(tmp_path: Path):
    """0 stands for thresholds.unsure; without a limit nothing is ever undecided."""
    it = Classifier(toy_bundle.load(tmp_path / "toy"), VirtualClock())
    assert it.min_probability == toy_bundle.LIMITS.unsure
    assert it(borderline()[0]).status is Status.OK
    it = Classifier(it.bundle, VirtualClock(), min_probability=1.1)
    assert {it(borderline(object=1)[0]).status for _ in range(20)} == {Status.UNSURE}


def test_what_is_not_ok_need_not_count(tmp_path: Path):
    """An early answer that would not be ok is not given, and the object's state is unchanged."""
    it = Classifier(toy_bundle.load(tmp_path / "toy"), VirtualClock(), min_probability=0.85)
    first = it(borderline(object=1)[0])
    for object in (1, 2):
        half = replace(toy_bundle.sweep(0, 0), object=object, share=0.5)
        assert it.conclude_if_ok(half, np.array([0.6, 0.4, 0.0])) is None
    assert it(borderline(object=1)[0]).fused == 2
    v = it.conclude_if_ok(
        replace(toy_bundle.sweep(0, 0), object=1, share=0.5), np.array([0.9, 0.1, 0.0])
    )
    assert v is not None
    assert (v.status, v.label, v.fused, v.share) == (Status.OK, "a", 3, 0.5)
    assert it(borderline(object=1)[0]).fused == 4
    assert first.share == 1


def test_early_logits(tmp_path: Path):
    """One row a step."""
    it = toy_bundle.load(
        tmp_path / "toy", early=Early((0.9,) * 3, 1), outputs=("logits", "early", "embedding")
    )
    rows = Classifier(it, VirtualClock()).early(toy_bundle.window(1, 0))
    assert rows.tolist() == pytest.approx(np.outer([1, 2, 3], [0, -6, -9]), abs=1e-4)


@pytest.mark.parametrize(
    ("more", "asked"),
    [
        ({"known": None, "outputs": ("logits", "embedding", "early")}, ("logits",)),
        ({"outputs": ("logits", "embedding", "early")}, ("logits", "embedding")),
        (
            {"arrays": toy_bundle.means(sweeps=np.array([0, 0, 5])), "labels": 2},
            ("logits", "embedding"),
        ),
    ],
)
def test_only_needed_outputs_are_requested(
    tmp_path: Path, more: dict, asked: tuple[str, ...], monkeypatch
):
    """No unused output is requested from onnxruntime."""
    it = Classifier(toy_bundle.load(tmp_path / "toy", **more), VirtualClock())
    seen = []

    def spied(opened, outputs, given, real=session.run):
        seen.append(outputs)
        return real(opened, outputs, given)

    monkeypatch.setattr(session, "run", spied)
    assert it(toy_bundle.sweep(1, 0)).label == "a"
    assert seen == [asked]


def test_an_enrolled_label_changes_all_logits(tmp_path: Path):
    """The logits are (means . z + bias) / temperature. The nearest label wins, and an enrolled
    label's spread is wider by 1 + 1 / n."""
    bias = np.float32([0, -18, -18 + 2 / 4])
    arrays = toy_bundle.means(bias=bias, sweeps=np.array([0, 0, 2]))
    it = Classifier(toy_bundle.load(tmp_path / "toy", arrays=arrays, labels=2), VirtualClock())
    z = np.array([1.0, 2.0])
    have = it.logits(toy_bundle.window(*z)).astype(float)
    assert have - have[0] == pytest.approx((toy_bundle.MEANS @ z + bias - bias[0]) / 2, abs=1e-4)
    assert it.self_test() < 1e-5
    assert it(toy_bundle.sweep(0, 6)).label == "c"
    # c lies 1.5 times as far as its sweeps say: 13.5 counts 9, as b's 9
    assert it(toy_bundle.sweep(0, 6 + 3.6)).label == "c"
    v = it(toy_bundle.sweep(0, 6 + 3.7))
    assert (v.status, v.detail) == (Status.UNKNOWN, "squared distance 9.127 from c, limit 9")
    wide = toy_bundle.load(
        tmp_path / "wide", arrays=arrays | {"spread": np.float32([1, 1, 4])}, labels=2
    )
    it = Classifier(wide, VirtualClock())
    assert it(toy_bundle.sweep(0, 6 + 7.3)).label == "c"
    assert it(toy_bundle.sweep(0, 6 + 7.4)).status is Status.UNKNOWN
    assert it(toy_bundle.sweep(9.1, 0)).status is Status.UNKNOWN


@pytest.mark.parametrize(
    "arrays",
    [
        toy_bundle.means(means=toy_bundle.MEANS[[1, 0, 2]], bias=np.float32([-18, 0, -18])),
        toy_bundle.means(bias=np.float32([0, 30, -18])),
    ],
)
def test_means_of_another_training_are_found(tmp_path: Path, arrays: dict):
    """Class means that give a golden sweep another label than the model's logits are refused."""
    it = Classifier(bundle.load(spoiled(tmp_path, arrays)), VirtualClock())
    with pytest.raises(
        BundleError, match=r"means\.npz and the model's own logits call a golden sweep"
    ):
        it.self_test()


def test_of_equal_probabilities_the_first_label_is_reported(default_bundle: Bundle):
    """As argmax: equal votes of neighbours, or coarse logits, must give the same label as at
    export."""
    it = Classifier(default_bundle, VirtualClock())
    window = default_bundle.golden[0]
    sweep = Sweep(
        1, 0, 0, Status.OK, Frames(np.arange(len(window)), np.arange(len(window)), window)
    )
    verdict = it.conclude(sweep, np.array([0.0, 0.4, 0.0, 0.4, 0.1, 0.1]))
    assert (verdict.label, verdict.margin) == (default_bundle.manifest.labels[1], 0.0)
