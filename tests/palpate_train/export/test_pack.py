"""Every method becomes a bundle that the appliance runs with the answers of the desktop."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate.cli.main import main as palpate
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError, FormatError
from palpate.inference.classifier import Classifier
from palpate_train.cli.main import main
from palpate_train.data.sets import Dataset
from palpate_train.export import contents, pack
from palpate_train.metrics import bundle_score
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from tests.factories.costly import OF_LIBRARIES, WITH_GRAPH, quick_first
from tests.factories.sweep_sets import tones

pytestmark = pytest.mark.slow

HARDLY = methods.Effort(0.1)


def method_of(name: str) -> methods.Method:
    (method,) = methods.find([name], HARDLY)
    return method


def trained(name: str, sweeps: Dataset) -> contents.Content:
    """The content of a bundle of this method."""
    return contents.content_of(MethodFit.of(method_of(name), sweeps, 1)[1])


@pytest.mark.parametrize("name", quick_first(WITH_GRAPH))
def test_the_box_answers_as_the_desktop(name: str, tmp_path: Path):
    """It passes its golden sweeps; each held-out sweep gets the model's label."""
    content = trained(name, tones())
    manifest = pack.pack(content, tmp_path / "b", "any", "1", "0123abcd")
    method = method_of(name)
    assert manifest.input == method.input
    assert manifest.made["method"] == name
    assert manifest.speeds is None
    assert "distance" in manifest.made["speeds_unknown_because"]
    it = Classifier(bundle.load(tmp_path / "b"), SystemClock())
    assert it.self_test() < 0.02
    model = method.train(content.train, methods.model_inputs(method.input, content.train), 1)
    want = model.logits(methods.model_inputs(method.input, content.held_out)).argmax(1)
    assert (bundle_score.labels_of(it, content.held_out)[0] == want).all()


@pytest.mark.parametrize("name", OF_LIBRARIES)
def test_what_the_box_cannot_run_is_refused(name: str):
    """Before anything is trained, with the method and its features or library."""
    method = method_of(name)
    why = f"looks at the features '{method.input}' of prior work"
    if method.library:
        why = f"runs in {method.library} alone and has no graph"
    with pytest.raises(FormatError, match=f"'{name}' {why}"):
        MethodFit.of(method, tones(), 1)


def test_the_command_packs_what_the_box_plays(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`fit --method`, `export`, `palpate check` and a demo: paper's features, an SVM."""
    folder, fit = str(tmp_path / "h"), str(tmp_path / "h.npz")
    given = ["--set", "sim:T-LAB:1001:12", "--seed", "1", "--out", fit]
    assert main(["fit", "--method", "H-svm", *given]) == 0
    assert main(["export", fit, "--out", folder, "--name", "h", "--version", "2"]) == 0
    assert "bundle: h 2," in capsys.readouterr().out
    manifest = bundle.load(tmp_path / "h").manifest
    assert manifest.input == "H"
    assert manifest.speeds
    assert 28 < manifest.speeds.least_mm_s < 30 < manifest.speeds.most_mm_s < 32
    assert "speeds_unknown_because" not in manifest.made
    chosen = ["--sim", "skin", "--virtual", "--set", f"classifier.bundle={folder}"]
    assert palpate(["check", *chosen]) == 0
    assert palpate(["demo", *chosen, "--sweeps", "2"]) == 0


def test_golden_sweeps_are_rounded():
    """To COARSEST usual changes: smaller, and probabilities stay near."""
    content = trained("L-gauss", tones())
    rng = np.random.default_rng(1)
    noisy = content.train.samples + rng.normal(0, 0.3, content.train.samples.shape)
    train = replace(content.train, samples=noisy.astype(np.float32))
    content = replace(content, train=train)
    logits = contents.run(content.model, contents.model_inputs(content.input, train))
    golden = contents.golden_sweeps(train, logits, logits)
    data = contents.golden_file(content, golden)
    assert len(data) < 0.4 * len(bundle.golden_file(golden.samples, logits[:2]))
    arrays = SimpleNamespace(format=train.format, labels=train.materials)
    samples, stored, _ = bundle._golden(data, arrays)
    usual = np.median(np.abs(np.diff(golden.samples, axis=1)))
    assert 0 < np.abs(samples - golden.samples).max() <= usual * contents.COARSEST / 2
    again = contents.run(
        content.model, contents.model_inputs(content.input, replace(golden, samples=samples))
    )
    assert np.array_equal(stored, again.astype(np.float32))
    assert stored.argmax(1).tolist() == golden.labels.tolist()
    exact = contents.run(content.model, contents.model_inputs(content.input, golden))
    assert np.abs(softmax(stored) - softmax(exact)).max() <= contents.NEAR


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
def test_rounded_sweeps_keep_their_type(dtype: str):
    """Each is coarser, within the type; whole steps of 2 or more; constants stay."""
    rng = np.random.default_rng(1)
    top = 255 if dtype == "float32" else np.iinfo(dtype).max
    samples = (top - rng.integers(0, 40, (2, 50, 3, 3))).astype(dtype)
    made = list(contents._rounded(samples))
    assert {rounded.dtype for rounded in made} == {samples.dtype}
    away = [float(np.abs(rounded.astype(np.float64) - samples).max()) for rounded in made]
    assert away == sorted(away, reverse=True)
    assert away[-1] > 0
    assert list(contents._rounded(np.full_like(samples, 7))) == []


def test_a_method_that_never_names_a_material_is_no_bundle(tmp_path: Path):
    """It is refused, and nothing is left behind."""
    noise = tones(noise=0.0)
    content = trained("L-gauss", noise)
    content.train.samples[content.train.labels == 0] = 0
    with pytest.raises(BundleError, match="'a'"):
        pack.pack(content, tmp_path / "b", "any", "1", "")
    logits = np.eye(3)[(content.train.labels + 1) % 3]
    content.train.samples[content.train.labels == 0, 0] = 1
    with pytest.raises(BundleError, match="'a'"):
        contents.golden_sweeps(content.train, logits, logits)
    few = (
        np.flatnonzero(content.train.labels > 0).tolist()
        + np.flatnonzero(content.train.labels == 0)[:2].tolist()
    )
    with pytest.raises(BundleError, match="there are 2"):
        contents.golden_sweeps(content.train.take(np.array(few)), logits[few], logits[few])
    assert not (tmp_path / "b").exists()
    assert np.isin(content.held_out.labels, [0, 1, 2]).all()
