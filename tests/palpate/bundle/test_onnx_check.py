"""The check of a model and its trial: ours pass, hostile ones are refused or do no harm."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.factories import toy_bundle

pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")

from palpate.answer.early import Early
from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest, Thresholds
from palpate.bundle.onnx_check import check, reader
from palpate.core.errors import BundleError
from palpate.deployment.sandbox import run_limited
from palpate.inference.session import try_all
from tests.campaigns import hostile_fuzz
from tests.fuzz import hostile_models as hostile
from tests.fuzz import mutated_models

HOSTILE = hostile.every()
MANIFEST = Manifest("hostile", "1", hostile.FORMAT, "raw", ("a", "b"), Thresholds(1, 255), {})
SOUND = hostile.model([hostile.node("Relu", ["x"], ["y"])]).SerializeToString()


@pytest.fixture(scope="module")
def owns() -> list[mutated_models.Own]:
    """Our models, which together have all allowed operators except GRU and MaxPool."""
    return mutated_models.own_models(mutated_models.QUICK)


@pytest.fixture(scope="module")
def default() -> mutated_models.Own:
    """The model of the default bundle alone: nothing is trained for it."""
    return mutated_models.own_default()


@pytest.mark.slow
def test_our_own_models_pass(owns):
    """The default bundle's model, models of all kinds of methods, and a graph of opset 18."""
    for own in owns:
        check.check(own.model, own.manifest)
        run_limited(lambda model=own.model: hostile_fuzz.trial(model))
    small = replace(MANIFEST, format=toy_bundle.FORMAT, labels=("a", "b", "c"))
    check.check(toy_bundle.model(), small)


@pytest.mark.parametrize("name", [name for name, (_, words) in HOSTILE.items() if words])
def test_a_hostile_model_is_refused(name):
    """The error is one printable line that says why and what to try."""
    data, words = HOSTILE[name]
    with pytest.raises(BundleError, match=words) as refused:
        check.check(data, MANIFEST)
    message = str(refused.value)
    assert message.isprintable()
    assert message.endswith("export the bundle again")
    assert len(message) < 600


@pytest.mark.parametrize("name", [name for name, (_, words) in HOSTILE.items() if not words])
@pytest.mark.slow
def test_what_is_too_large_or_too_slow_fails_its_trial(name, monkeypatch):
    """Models that the check lets pass: the kernel and the clock end their trial."""
    monkeypatch.setattr("palpate.deployment.sandbox.PROCESSOR_S", 2)
    check.check(HOSTILE[name][0], MANIFEST)
    with pytest.raises(BundleError):
        run_limited(lambda: hostile_fuzz.trial(HOSTILE[name][0]))


@pytest.mark.slow
def test_a_file_that_ends_anywhere_is_refused(default):
    """The default bundle's model, cut off at every byte."""
    for end in range(len(default.model)):
        with pytest.raises(BundleError):
            check.check(default.model[:end], default.manifest)


def test_a_link_and_a_file_beside_the_model_are_never_followed(tmp_path, monkeypatch):
    """A model with external data in a file or a symlink is refused before anything is opened."""
    (tmp_path / "secret").write_bytes(bytes(16))
    (tmp_path / "weights.bin").symlink_to(tmp_path / "secret")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BundleError, match="field 13"):
        check.check(HOSTILE["external data beside"][0], MANIFEST)


@pytest.mark.parametrize(
    ("module", "limit"),
    [
        (check, "MOST_FILE"),
        (check, "MOST_NODES"),
        (check, "MOST_CONSTANTS"),
        (check, "MOST_TENSOR"),
        (reader, "MOST_VALUES"),
    ],
)
def test_every_cap_caps(module, limit, default, monkeypatch):
    """Our own model is refused if a cap is lower than its needs."""
    monkeypatch.setattr(module, limit, 20)
    with pytest.raises(BundleError, match=r"\b20\b"):
        check.check(default.model, default.manifest)


def test_the_manifest_decides_what_goes_in_and_comes_out():
    """A skin of another size or type, too few labels, heads that are missing or too many."""
    model, manifest = bundle.load(bundle.DEFAULT).model, bundle.load(bundle.DEFAULT).manifest
    other = {
        "takes uint8": {"format": replace(manifest.format, dtype="int16")},
        r"the manifest has uint8 \[1, 1400": {"format": replace(manifest.format, window=1400)},
        "5 labels": {"labels": manifest.labels[:5]},
        r"early is \[1, 9, 6\]": {"early": Early((0.9,) * 3, 1)},
        "the manifest has float32": {"input": "L", "early": None},
    }
    for words, change in other.items():
        with pytest.raises(BundleError, match=words):
            check.check(model, replace(manifest, **change))
    with pytest.raises(BundleError, match="logits"):
        check.check(SOUND, replace(MANIFEST, early=Early((0.9,), 1)))


def test_enrolled_labels_and_means_decide_as_well():
    """The model has all labels except the enrolled labels, and its embedding fits means.npz."""
    toy, manifest = (
        toy_bundle.model(),
        replace(MANIFEST, format=toy_bundle.FORMAT, labels=("a", "b", "c", "d")),
    )
    check.check(toy, manifest, enrolled=1, rank=2)
    for words, enrolled, rank in (
        ("4 labels$", 0, 2),
        ("4 labels, 2 of them", 2, 2),
        (r"embedding is \[1, 2\]", 1, 5),
    ):
        with pytest.raises(BundleError, match=words.replace("$", ";")):
            check.check(toy, manifest, enrolled=enrolled, rank=rank)


def test_a_harmless_model_passes_and_one_that_lies_fails_its_trial():
    """The graph around hostile nodes is sound; the trial sees real outputs."""
    one = bundle.load(bundle.DEFAULT)
    try_all(one)
    early = replace(one.manifest.early, least=(0.9,) * 3, limits=(1.0,) * 3)
    with pytest.raises(BundleError, match="instead"):
        try_all(replace(one, manifest=replace(one.manifest, early=early)))
    check.check(SOUND, MANIFEST)
    run_limited(lambda: hostile_fuzz.trial(SOUND))
