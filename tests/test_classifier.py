"""Bundle and classifier: what is altered is refused, what is refused says why, and fusing is what the paper and Bayes say."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance import bundle
from appliance.bundle import Bundle, Thresholds
from appliance.classifier import Classifier, fuse, inspect, softmax
from appliance.errors import BundleError
from appliance.sim import skin
from appliance.sim.rig import VirtualClock
from appliance.sweep import Frames, Status, Sweep

LIMITS = Thresholds(contact=10, full_scale=255, saturated=0.01)
BARE = np.zeros((4, 4))


def moving(level: float = 80, shape: tuple[int, ...] = (300, 4, 4)) -> np.ndarray:
    """A skin that is loaded everywhere and moves."""
    return np.random.default_rng(0).integers(level - 5, level + 5, shape).astype(np.uint8)


def sweep_of(taxels: np.ndarray, **more) -> Sweep:
    """A sweep with this window."""
    n = np.arange(len(taxels))
    return Sweep(1, 0, 0, Status.OK, Frames(n, n, taxels), **more)


def test_a_sound_window_passes():
    """A loaded skin that moves is fine; so is one whose last row is off the tube."""
    taxels = moving()
    assert inspect(taxels, BARE, LIMITS).status is Status.OK
    taxels[:, 3] = 0
    assert inspect(taxels, BARE, LIMITS).status is Status.OK


@pytest.mark.parametrize(
    ("place", "value", "status", "detail"),
    [
        (np.s_[:, :, :], 0, Status.NO_CONTACT, "0.0 digits"),
        (np.s_[:, 1, 2], 90, Status.STUCK_TAXEL, "taxel 2.3"),
        (np.s_[:, 1, 2], 0, Status.DEAD_TAXEL, "taxel 2.3"),
        (np.s_[:, 0, 0], 0, Status.DEAD_TAXEL, "taxel 1.1"),
        (np.s_[:, 0, 1], 255, Status.SATURATED, "taxel 1.2"),
        (np.s_[:60, 2:, 2:], 255, Status.SATURATED, "taxel 3.3 3.4 4.3 4.4"),
    ],
)
def test_a_spoiled_window_is_named(place, value: int, status: Status, detail: str):
    """Each kind of trouble, and where it is (row.column from 1)."""
    taxels = moving()
    taxels[place] = value
    found = inspect(taxels, BARE, LIMITS)
    assert found.status is status
    assert detail in found.detail


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_taxel_that_gives_no_number_is_dead(value: float):
    """One frame of it is enough, at the edge too, and however many dead ones the bundle bears."""
    taxels = moving().astype(np.float32)
    taxels[150, 0, 3] = value
    found = inspect(taxels, BARE, replace(LIMITS, dead_taxels=3))
    assert (found.status, found.detail) == (Status.DEAD_TAXEL, "taxel 1.4")


def test_a_bundle_that_bears_dead_taxels():
    """As many dead taxels as the bundle allows are let through."""
    taxels = moving()
    taxels[:, 1, 2] = 0
    assert inspect(taxels, BARE, replace(LIMITS, dead_taxels=1)).status is Status.OK


def test_tare_counts():
    """A load is what is above the tare."""
    assert inspect(moving(80), np.full((4, 4), 75.0), LIMITS).status is Status.NO_CONTACT


@given(st.integers(1, 40), st.integers(1, 5), st.integers(1, 5), st.integers(0, 255), st.integers(0, 2**32 - 1))
def test_any_window_gets_a_status(n: int, rows: int, cols: int, spread: int, seed: int):
    """Any digits of any shape, one frame long or constant: a status, never an error."""
    taxels = np.random.default_rng(seed).integers(0, spread + 1, (n, rows, cols)).astype(np.uint8)
    assert inspect(taxels, np.zeros((rows, cols)), LIMITS).status in Status


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
    """A sweep that is sure beyond all measure does not outweigh three that say otherwise."""
    sure, other = np.array([1.0, 0.0]), np.array([1e-5, 1 - 1e-5])
    assert fuse([sure, other, other, other], "product").argmax() == 1


def test_vote_is_the_papers():
    """The most frequent label wins, of equally frequent ones the first: with two sweeps the first always does."""
    a, b, c = np.eye(3) * 0.8 + 0.1
    assert fuse([b, a], "vote").argmax() == 1
    assert fuse([a, b, b], "vote").argmax() == 1
    assert fuse([a, b, c], "vote").argmax() == 0
    assert fuse([c, b, b, c], "vote").argmax() == 2


def test_golden_sweeps_pass(default_bundle: Bundle):
    """This machine runs the default bundle as it was exported."""
    assert Classifier(default_bundle, VirtualClock()).self_test() < bundle.GOLDEN_TOLERANCE


def test_golden_sweeps_can_fail(default_bundle: Bundle):
    """Logits that the model does not give are found."""
    other = replace(default_bundle, golden_logits=-default_bundle.golden_logits)
    with pytest.raises(BundleError, match="get another label"):
        Classifier(other, VirtualClock()).self_test()


def test_verdict_carries_what_is_known(default_bundle: Bundle):
    """Label, probability, margin, fused, bundle id of a classified sweep; probabilities add up to one."""
    clock = VirtualClock()
    v = Classifier(default_bundle, clock)(sweep_of(default_bundle.golden[0], lost=1))
    assert v.status in (Status.OK, Status.UNSURE)
    assert v.label == default_bundle.manifest.labels[v.scores.argmax()]
    assert v.scores.sum() == pytest.approx(1)
    assert v.probability == v.scores.max()
    assert v.margin == pytest.approx(np.diff(np.sort(v.scores))[-1])
    assert (v.fused, v.lost, v.bundle) == (1, 1, default_bundle.id)


def test_below_the_threshold_is_unsure(default_bundle: Bundle):
    """The label is still told, but not as `ok`."""
    strict = replace(default_bundle.manifest, thresholds=replace(default_bundle.manifest.thresholds, unsure=1.1))
    v = Classifier(replace(default_bundle, manifest=strict), VirtualClock())(sweep_of(default_bundle.golden[0]))
    assert v.status is Status.UNSURE
    assert v.label


@pytest.mark.parametrize("status", [s for s in Status if not s.classified])
def test_refused_sweeps_keep_their_status(default_bundle: Bundle, status: Status):
    """What the recorder refused is not classified."""
    sweep = replace(sweep_of(default_bundle.golden[0]), status=status)
    v = Classifier(default_bundle, VirtualClock())(sweep)
    assert (v.status, v.label, v.fused, len(v.scores)) == (status, "", 0, 0)


def test_features_go_through_the_same_runtime(default_bundle: Bundle, tmp_path: Path):
    """A bundle with input L gets features, not digits: a linear model on them gives the logits that numpy gives."""
    onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
    from appliance import features

    weights = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["features", "W"], ["logits"])], "g",
        [onnx.helper.make_tensor_value_info("features", 1, [1, 3])],
        [onnx.helper.make_tensor_value_info("logits", 1, [1, 6])],
        [onnx.numpy_helper.from_array(weights, "W")],
    )  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9)
    manifest = replace(default_bundle.manifest, input="L")
    classifier = Classifier(replace(default_bundle, manifest=manifest, model=model.SerializeToString()), VirtualClock())
    window = default_bundle.golden[0]
    want = features.compute("L", window, 750.0) @ weights
    assert classifier.logits(window) == pytest.approx(want, rel=1e-5)


def copy(tmp_path: Path) -> Path:
    """A copy of the default bundle to be spoiled."""
    return Path(shutil.copytree(bundle.DEFAULT, tmp_path / "bundle"))


def edit(folder: Path, **changes) -> None:
    """Change fields of a manifest."""
    path = folder / bundle.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_default_bundle_is_small():
    """All files of the committed bundle together stay under 64 KB."""
    assert sum(f.stat().st_size for f in bundle.DEFAULT.iterdir()) < 64_000


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
        ({"files": {}}, "does not name model.onnx"),
        ({"format": {"rows": 4}}, "manifest cannot be read"),
        ({"extra": 1}, "extra"),
        ({"labels": ["a", "b"]}, "logits"),
    ],
)
def test_broken_manifests_are_named(tmp_path: Path, changes: dict, hint: str):
    """Unknown schema, input, key; labels that cannot be sent; files that are not named; labels that do not fit."""
    folder = copy(tmp_path)
    edit(folder, **changes)
    with pytest.raises(BundleError, match=hint):
        bundle.load(folder)


def test_no_bundle(tmp_path: Path):
    """A folder without a manifest, and a manifest that is no JSON."""
    with pytest.raises(BundleError, match="no bundle at"):
        bundle.load(tmp_path)
    (tmp_path / bundle.MANIFEST).write_text("{")
    with pytest.raises(BundleError, match="manifest cannot be read"):
        bundle.load(tmp_path)


def test_golden_sweeps_of_another_format(tmp_path: Path):
    """Golden sweeps that do not fit the manifest's format are refused before the model is opened."""
    folder = copy(tmp_path)
    manifest = json.loads((folder / bundle.MANIFEST).read_text())
    edit(folder, format=manifest["format"] | {"rows": 2})
    with pytest.raises(BundleError, match="does not fit the format"):
        bundle.load(folder)


def test_pickles_are_not_opened(tmp_path: Path):
    """Golden sweeps that hold Python objects are refused, not unpickled."""
    folder = copy(tmp_path)
    np.savez(folder / bundle.GOLDEN, samples=np.array([object()]), logits=np.zeros((1, 6)))
    manifest = json.loads((folder / bundle.MANIFEST).read_text())
    entry = bundle.file_entry((folder / bundle.GOLDEN).read_bytes())
    edit(folder, files=manifest["files"] | {bundle.GOLDEN: entry})
    with pytest.raises(BundleError, match=r"golden\.npz cannot be read"):
        bundle.load(folder)


def test_a_model_that_is_none_or_another(default_bundle: Bundle):
    """Bytes that are no model, and a model whose input is not the manifest's."""
    with pytest.raises(BundleError, match="refuses the model"):
        Classifier(replace(default_bundle, model=b"nonsense"), VirtualClock())
    manifest = replace(default_bundle.manifest, format=replace(skin.FORMAT, window=100))
    with pytest.raises(BundleError, match="the manifest asks for"):
        Classifier(replace(default_bundle, manifest=manifest), VirtualClock())
