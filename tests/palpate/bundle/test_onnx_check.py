"""The check of the graph: our own models pass, hostile models are refused with the reason, and
accepted models do no harm."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.factories import toy_bundle

pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
import numpy as np

from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest, Thresholds
from palpate.bundle.onnx_check import check, reader
from palpate.core.errors import BundleError
from palpate.inference.session import session
from tests.campaigns import hostile_fuzz
from tests.factories import hostile_models as hostile
from tests.factories import mutated_models
from tests.factories.grown_models import FORMAT, grown

HOSTILE = hostile.every()
MANIFEST = Manifest("hostile", "1", FORMAT, "raw", ("a", "b"), Thresholds(1, 255), {})


@pytest.fixture(scope="module")
def owns() -> list[mutated_models.Own]:
    """Models of `palpate-train`, which together have all allowed operators except GRU and
    MaxPool."""
    return mutated_models.own_models(mutated_models.QUICK)


@pytest.fixture(scope="module")
def default() -> mutated_models.Own:
    """The model of the default bundle alone: nothing is trained for it."""
    return mutated_models.own_default()


@pytest.mark.slow
def test_our_own_models_pass(owns: list[mutated_models.Own]):
    """The default bundle's model, models of all kinds of methods, and a graph of opset 18."""
    for own in owns:
        check.check(own.model, own.manifest)
    small = replace(MANIFEST, format=toy_bundle.FORMAT, labels=("a", "b", "c"))
    check.check(toy_bundle.model(), small)


def test_a_harmless_model_of_the_hostile_kind_passes():
    """The graph around the hostile nodes is sound, so models are refused because of these nodes."""
    check.check(hostile.model([hostile.node("Relu", ["x"], ["y"])]).SerializeToString(), MANIFEST)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_model_is_refused(name: str):
    """The error is one printable line that says why and what to try, and comes within a second."""
    data, words = HOSTILE[name]
    with pytest.raises(BundleError, match=words) as refused:
        check.check(data, MANIFEST)
    message = str(refused.value)
    assert message.isprintable()
    assert message.endswith("export the bundle again")
    assert len(message) < 600


def in_child(work: Callable[[], Any], more: int) -> tuple[Any, float]:
    """The result or error of `work` in a fork that may use `more` bytes, and the largest additional
    memory in MB."""

    def child(end: Any) -> None:
        size = hostile_fuzz.memory("VmSize") * 1024 + more
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        Path("/proc/self/clear_refs").write_text("5")
        before = hostile_fuzz.memory("VmRSS")
        try:
            told = work()
        except Exception as e:  # onnxruntime's own classes cannot travel
            told = str(e)
        end.send((told, (hostile_fuzz.memory("VmHWM") - before) / 1024))

    near, far = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=child, args=(far,))
    process.start()
    far.close()
    try:
        assert near.poll(30), "the child hangs"
        return near.recv()
    finally:
        process.kill()
        process.join()


def test_152_bytes_would_take_6_gigabytes():
    """Without the check onnxruntime opens the model, and 5.5 GB are not enough for its first
    sweep."""
    model = hostile.tiny()
    assert len(model) <= 152
    told, _ = in_child(lambda: hostile_fuzz.run(session(model), Random(1)), 5_500_000_000)
    assert "ConstantOfShape" in told
    assert "bad_alloc" in told
    told, most_mb = in_child(lambda: check.check(model, MANIFEST), 1 << 30)
    assert "6000000000 bytes (limit" in told
    assert most_mb < 2


@pytest.mark.slow
def test_a_file_that_ends_anywhere_is_refused(default: mutated_models.Own):
    """The default bundle's model, cut off at every byte."""
    for end in range(len(default.model)):
        with pytest.raises(BundleError):
            check.check(default.model[:end], default.manifest)


def test_a_link_and_a_file_beside_the_model_are_never_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A model with external data in a file or a symlink is refused before anything is opened."""
    (tmp_path / "secret").write_bytes(bytes(16))
    (tmp_path / "weights.bin").symlink_to(tmp_path / "secret")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BundleError, match="external_data"):
        check.check(HOSTILE["external data beside"][0], MANIFEST)


def heavy(kind: str) -> bytes:
    """A model that needs nearly the largest allowed memory because of one operator."""
    node, model = hostile.node, hostile.model
    start = [
        node("ReduceMean", ["x"], ["s"], axes=[1, 2, 3], keepdims=0),
        node("Expand", ["s", "n"], ["m"]),
    ]
    if kind == "MatMul":
        weights = np.ones((4000, 2000), np.float32)
        return model(
            [*start, node("MatMul", ["m", "w"], ["y"])], {"n": [1, 4000], "w": weights}
        ).SerializeToString()
    if kind == "TopK":
        count = {"n": [1, 4_000_000], "k": [4_000_000]}
        return model([*start, node("TopK", ["m", "k"], ["y", "at"])], count).SerializeToString()
    if kind == "ConstantOfShape":
        one = hostile.helper.make_tensor("one", 1, [1], [1.0])
        made = [
            node("ConstantOfShape", ["c"], ["o"], value=one),
            node("Sin", ["o"], ["i"]),
            node("Mul", ["i", "s"], ["y"]),
        ]
        return model([start[0], *made], {"c": [4_000_000]}).SerializeToString()
    pooled = node("MaxPool", ["m"], ["y"], kernel_shape=[2], strides=[1])
    return model([*start, pooled], {"n": [1, 1, 8_000_000]}).SerializeToString()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["MatMul", "TopK", "ConstantOfShape", "MaxPool"])
def test_what_passes_takes_no_more_than_was_counted(kind: str):
    """The memory that the check computes is above that of onnxruntime, and both are below 256
    MB."""
    model = heavy(kind)
    check.check(model, MANIFEST)

    def opened() -> str:
        hostile_fuzz.run(session(model), Random(1))
        return "ran"

    told, most_mb = in_child(opened, 512 << 20)
    assert told == "ran"
    assert most_mb < (check.MOST_MEMORY >> 20) + 16


@pytest.mark.parametrize(
    "limit", ["MOST_MEMORY", "MOST_WORK", "MOST_NODES", "MOST_CONSTANTS", "MOST_TENSOR"]
)
def test_every_cap_caps(limit: str, default: mutated_models.Own, monkeypatch: pytest.MonkeyPatch):
    """Our own model is refused if a cap is lower than its needs."""
    monkeypatch.setattr(check, limit, 20)
    with pytest.raises(BundleError, match="limit 20"):
        check.check(default.model, default.manifest)


def test_a_file_that_is_too_large_is_not_read(monkeypatch: pytest.MonkeyPatch):
    """The file is refused because of its size alone."""
    monkeypatch.setattr(check, "MOST_MEMORY", 99)
    with pytest.raises(BundleError, match=r"it has 100 bytes \(limit 99\)"):
        check.check(bytes(100), MANIFEST)


def test_values_are_counted(default: mutated_models.Own, monkeypatch: pytest.MonkeyPatch):
    """Only a limited number of values is read one by one."""
    monkeypatch.setattr(reader, "MOST_VALUES", 100)
    with pytest.raises(BundleError, match="more than 100 values"):
        check.check(default.model, default.manifest)


def test_the_manifest_decides_what_goes_in_and_comes_out():
    """A skin of another size or type, too few labels, heads that are missing or too many."""
    model, manifest = bundle.load(bundle.DEFAULT).model, bundle.load(bundle.DEFAULT).manifest
    other = {
        "takes uint8": {"format": replace(manifest.format, dtype="int16")},
        r"the manifest has uint8 \[1, 1400": {"format": replace(manifest.format, window=1400)},
        "5 labels": {"labels": manifest.labels[:5]},
        r"early is \[1, 9, 6\] instead of \[1, 3, 6\]": {"early": bundle.Early((0.9,) * 3, 1)},
        "the manifest has float32": {"input": "L", "early": None},
    }
    for words, change in other.items():
        with pytest.raises(BundleError, match=words):
            check.check(model, replace(manifest, **change))
    sound = hostile.model([hostile.node("Relu", ["x"], ["y"])]).SerializeToString()
    with pytest.raises(BundleError, match="the manifest needs early, logits"):
        check.check(sound, replace(MANIFEST, early=bundle.Early((0.9,), 1)))


def test_enrolled_labels_and_means_decide_as_well():
    """The model has all labels except the enrolled labels, and its embedding fits means.npz."""
    toy, manifest = (
        toy_bundle.model(),
        replace(MANIFEST, format=toy_bundle.FORMAT, labels=("a", "b", "c", "d")),
    )
    check.check(toy, manifest, enrolled=1, rank=2)
    with pytest.raises(BundleError, match="3 materials apart, the manifest has 4 labels;"):
        check.check(toy, manifest)
    with pytest.raises(BundleError, match="4 labels, 2 of them enrolled"):
        check.check(toy, manifest, enrolled=2)
    with pytest.raises(BundleError, match=r"embedding is \[1, 2\] instead of \[1, 5\]"):
        check.check(toy, manifest, enrolled=1, rank=5)


@pytest.mark.parametrize("field", [b"\x0a\x00", b"\x2a\x00"], ids=["nodes", "constants"])
def test_a_parse_takes_no_memory_before_it_is_counted(field: bytes):
    """20 MB of empty messages, which need 1 GB in protobuf, are refused after MOST_VALUES of
    them."""
    model = (
        hostile.part(1, 8)
        + hostile.part(7, field * 10_000_000)
        + hostile.part(8, hostile.part(2, 17))
    )
    raised, most_mb = in_child(lambda: check.check(model, MANIFEST), 1 << 30)
    assert "more than 50000 values" in raised
    assert most_mb < 16


@pytest.mark.slow
def test_grown_models_pass_and_run():
    """Random operators in any order that the rules allow: onnxruntime opens and runs most of the
    models."""
    ran = 0
    for seed in range(20):
        model = grown(Random(seed))
        check.check(model, MANIFEST)
        told = hostile_fuzz.tried(
            model, replace(hostile_fuzz.GROWING, manifest=MANIFEST), Random(seed)
        )
        ran += told["outcome"] == "ran"
    assert ran >= 10


@pytest.mark.slow
@pytest.mark.thorough  # a sample of the campaign hostile
def test_fuzzed_models_neither_hang_nor_kill(owns: list[mutated_models.Own]):
    """150 models of the campaign run in children with limited memory and time. Enough of them reach
    onnxruntime."""
    record = hostile_fuzz.fresh(3)
    for told in hostile_fuzz.Fuzz(owns, 3).results(0, 150):
        hostile_fuzz.note(record, told)
    assert record["done"] == 150
    assert record["finds"] == []
    assert record["outcomes"]["ran"] >= 20


@pytest.mark.slow
@pytest.mark.thorough  # a sample of the campaign hostile
def test_fuzzed_enrolments_are_refused_or_answer(
    owns: list[mutated_models.Own], monkeypatch: pytest.MonkeyPatch
):
    """A hundred enrolments of the campaign: no enrolment gives a label without a probability, and
    some of them give labels."""
    monkeypatch.setattr(hostile_fuzz, "ENROLLED", 1.0)
    record = hostile_fuzz.fresh(4)
    for told in hostile_fuzz.Fuzz(owns, 4).results(0, 100):
        hostile_fuzz.note(record, told)
    assert record["finds"] == []
    assert record["outcomes"]["refused"] >= 50
    assert record["outcomes"]["ran"] >= 5


@pytest.mark.slow
@pytest.mark.parametrize("how", ["dies", "hangs", "swells"])
def test_the_campaign_would_tell(
    how: str, owns: list[mutated_models.Own], monkeypatch: pytest.MonkeyPatch
):
    """A child that dies, hangs or takes too much memory is reported with its number, and the next
    model is tried."""

    def run(opened: Any, rng: Random) -> None:
        if how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "hangs":
            signal.pause()
        np.ones(400 << 20, np.uint8)

    monkeypatch.setattr(hostile_fuzz, "run", run)
    if how == "hangs":  # the others end by themselves, a busy machine in its own time
        monkeypatch.setattr(hostile_fuzz, "DEADLINE_S", 0.5)
    fuzz = hostile_fuzz.Fuzz(owns, 1)
    monkeypatch.setattr(
        hostile_fuzz.Fuzz, "model", lambda self, number: (owns[0].model, owns[0], Random(1))
    )
    told = list(fuzz.results(7, 2))
    wanted = {"dies": "died (-9)", "hangs": "hung", "swells": "no memory"}[how]
    assert [(t["number"], t["outcome"]) for t in told] == [(7, wanted), (8, wanted)]
