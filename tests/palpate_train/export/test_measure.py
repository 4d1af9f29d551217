"""Packing all precisions of a method, and the only way to time, size and weigh a model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate_studies import precisions
from palpate_studies.peers import minirocket
from palpate_train.export import measure
from tests.factories.loud_model import loud, sweeps


def test_every_form_is_a_bundle_of_its_own_and_made_once(tmp_path: Path):
    """Both precisions load in the box's classifier and answer as the model; the second time nothing
    is trained."""
    calls: list[int] = []
    for _ in range(2):
        made = precisions.packed(loud(calls), sweeps(), 3, tmp_path / "kept")
    assert calls == [3]
    assert [(one.form, one.precision, one.runtime) for one in made] == [
        ("", "float", "onnx"),
        ("int8", "int8", "onnx"),
    ]
    for one in made:
        box = Classifier(bundle.load(one.folder), SystemClock())
        known = sweeps()
        assert [box.logits(counts).argmax() for counts in known.samples] == known.labels.tolist()
        assert (
            measure.sizes(one.folder)[0]
            == (one.folder / "model.onnx").stat().st_size
            < measure.sizes(one.folder)[1]
        )


def test_all_take_turns():
    """Every round begins with another model; the first sweep of each turn is not counted."""
    order: list[str] = []
    calls = {name: (lambda counts, name=name: order.append(name)) for name in "abc"}
    took = measure.timed(calls, np.zeros((5, 1)), rounds=3, block=2)
    assert "".join(order) == "aaabbbccc" + "bbbcccaaa" + "cccaaabbb"
    assert {name: (len(ms), bool((ms > 0).all())) for name, ms in took.items()} == dict.fromkeys(
        "abc", (6, True)
    )


@pytest.mark.slow
def test_a_bundle_is_measured_in_a_process_that_has_nothing_of_the_desktop(tmp_path: Path):
    """Costs of a real bundle: resident memory of Python with numpy and onnxruntime."""
    made = precisions.packed(loud([]), sweeps(), 1, tmp_path / "kept")
    (found, _) = measure.measure_all([one.folder for one in made], sweeps().samples, 2)
    assert found.foreign == ()
    assert 15 < found.rss_mib < 150
    assert 0 < found.ms_p50 <= found.ms_p99
    assert found.model_kb < found.bundle_kb


@pytest.mark.slow
def test_what_does_not_run_by_itself_is_named(tmp_path: Path):
    """A bundle that was altered on disk is refused with its name and reason."""
    one, _ = precisions.packed(loud([]), sweeps(), 1, tmp_path / "kept")
    (one.folder / "model.onnx").write_bytes(b"no model")
    with pytest.raises(measure.BundleError, match="not run in a process of"):
        measure.memory(one.folder, sweeps().samples)


@pytest.mark.slow
def test_torch_runs_what_was_trained(tmp_path: Path):
    """The network as TorchScript gives its own logits."""

    class TwoCounts(torch.nn.Module):
        def forward(self, counts: torch.Tensor) -> torch.Tensor:
            return counts.flatten(1).float()[:, :2]

    @dataclass
    class TwoCountsModel:
        network: torch.nn.Module

    precisions._save_torch(TwoCountsModel(TwoCounts()), sweeps(), 1, tmp_path)
    counts = sweeps().samples[3]
    assert measure.load(tmp_path)(counts).tolist() == counts.ravel()[:2].tolist()


@pytest.mark.slow
def test_aeon_runs_what_was_trained(tmp_path: Path):
    """aeon's transform with the head that was trained on our graph gives the graph's logits."""
    pytest.importorskip("aeon")
    known = sweeps()
    state = np.random.get_state()[1].copy()
    model = minirocket.train(known, known.samples, 1)
    precisions._save_aeon(model, known, 1, tmp_path)
    answer = measure.load(tmp_path)
    assert answer(known.samples[1]) == pytest.approx(model.logits(known.samples[1:2])[0], abs=0.05)
    assert (np.random.get_state()[1] == state).all()
