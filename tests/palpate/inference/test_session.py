"""The model runner: one session for outputs that are requested together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.bundle.onnx_check import reader
from palpate.core.errors import BundleError, FormatError, ModelError
from palpate.core.types import Status
from palpate.inference import session
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.inference.session import ModelRunner
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

EARLY = Early((0.9,) * 3, 1)
OUTPUTS = ("logits", "early", "embedding")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The outputs of each model that onnxruntime opens."""
    seen: list[list[str]] = []
    real = session.session

    def watched(model: bytes) -> object:
        seen.append([output.name for output in reader.read(model).graph.output])
        return real(model)

    monkeypatch.setattr(session, "session", watched)
    return seen


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ({"early": EARLY, "outputs": OUTPUTS}, ["logits", "embedding"]),
        ({"known": None, "outputs": OUTPUTS}, ["logits"]),
        ({}, ["logits", "embedding"]),
        (
            {"arrays": toy_bundle.means(sweeps=np.array([0, 0, 5])), "labels": 2},
            ["logits", "embedding"],
        ),
    ],
)
def test_a_classifier_opens_what_its_answers_need(tmp_path, opened, more, wanted):
    """Self-test and sweep run on one session, whatever else the model gives."""
    it = Classifier(toy_bundle.load(tmp_path / "toy", **more), VirtualClock())
    it.self_test()
    assert it(toy_bundle.sweep(1, 0)).label == "a"
    assert opened == [wanted]


def test_early_heads_have_a_session_and_missing_outputs_none(tmp_path, opened):
    """Opened once, before the first sweep; an output is refused when it is requested."""
    it = Classifier(toy_bundle.load(tmp_path / "toy", early=EARLY, outputs=OUTPUTS), VirtualClock())
    EarlyExit(it)
    assert opened == [["logits", "embedding"], ["early"]]
    it.outputs(toy_bundle.window(1, 0), "early")
    EarlyExit(it)
    assert len(opened) == 2
    it = ModelRunner(toy_bundle.model(), "logits")
    with pytest.raises(BundleError, match=r"\['early'\]"):
        it(("early",), toy_bundle.window(0, 0))
    (logits,) = it(("logits",), toy_bundle.window(0, 0))
    assert logits.shape == (3,)


def test_answers_are_the_same_with_early_heads_and_without(default_bundle):
    """Golden sweeps and noise, bit for bit."""
    plain, early = (
        Classifier(default_bundle, VirtualClock()),
        Classifier(default_bundle, VirtualClock()),
    )
    EarlyExit(early)
    whole = session.session(default_bundle.model)
    noise = np.random.default_rng(1).integers(
        0, 256, (3, *default_bundle.golden.shape[1:]), np.uint8
    )
    for window in (*default_bundle.golden, *noise):
        want = dict(zip(OUTPUTS, session.run(whole, OUTPUTS, {"sweep": window[None]}), strict=True))
        assert early.outputs(window, "early")[0].tobytes() == want["early"].tobytes()
        for it in (plain, early):
            assert it.logits(window).tobytes() == want["logits"].tobytes()
            assert it.outputs(window, "embedding")[0].tobytes() == want["embedding"].tobytes()


FORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "highest byte first": lambda x: x.astype(x.dtype.newbyteorder(">")),
    "by columns": np.asfortranarray,
    "of a larger array": lambda x: np.repeat(x, 2, axis=0)[::2],
    "backwards": lambda x: x[::-1].copy()[::-1],
    "read only": lambda x: np.frombuffer(x.tobytes(), x.dtype).reshape(x.shape),
    "nothing masked": np.ma.masked_array,
}


@pytest.mark.parametrize("kind", ["int16", "uint16", "float32"])
@pytest.mark.parametrize("form", FORMS)
def test_counts_are_the_same_however_they_lie_in_memory(kind, form):
    """onnxruntime would take the bytes as they lie. Masked numbers are refused."""
    format = replace(toy_bundle.FORMAT, dtype=kind)
    it = ModelRunner(toy_bundle.model(format=format), "logits")
    counts = toy_bundle.window(3, 1, format)
    (want,), (found,) = (it(("logits",), x) for x in (counts, FORMS[form](counts)))
    assert found.tobytes() == want.tobytes()
    with pytest.raises(FormatError, match="masked"):
        it(("logits",), np.ma.masked_less(counts, counts.max()))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_count_that_is_no_number_is_refused(tmp_path, value):
    """In a whole sweep and in an unfinished one: QuantizeLinear makes the lowest count of NaN."""
    format = replace(toy_bundle.FORMAT, dtype="float32")
    made = toy_bundle.load(tmp_path / "toy", early=EARLY, outputs=OUTPUTS, format=format)
    it = Classifier(made, VirtualClock())
    broken = toy_bundle.sweep(1, 0, format=format)
    broken.frames.taxels[3, 1, 1] = value
    with np.errstate(invalid="ignore"):
        verdict = it(broken)
        early = EarlyExit(it).judged(replace(broken, share=0.5))
    assert (verdict.status, verdict.label) == (Status.DEAD_TAXEL, "")
    assert early.status is Status.DEAD_TAXEL


def test_a_session_leaves_the_core_to_the_skin(monkeypatch):
    """One thread that does not spin, no arena of memory, and errors alone in the log."""
    given = []
    monkeypatch.setattr(
        session.ort, "InferenceSession", lambda model, options, providers: given.append(options)
    )
    session.session(b"")
    (options,) = given
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"
    assert (options.log_severity_level, options.enable_cpu_mem_arena) == (3, False)


@pytest.mark.parametrize("does", ["open", "run"])
def test_what_onnxruntime_says_is_cut(monkeypatch, does):
    """The message has its first 200 characters."""

    def refuse(*given: object, **options: object) -> None:
        raise RuntimeError("~" * 1000)

    monkeypatch.setattr(session.ort, "InferenceSession", refuse)
    with pytest.raises(BundleError if does == "open" else ModelError) as e:
        session.session(b"") if does == "open" else session.run(mock.Mock(run=refuse), [], {})
    assert str(e.value).count("~") == 200
