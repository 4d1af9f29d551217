"""Packing all precisions of a method, and the only way to time, size and weigh a model."""

from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate_studies import precisions
from palpate_train.export import measure
from tests.factories.loud_model import loud, sweeps


def test_every_form_is_a_bundle_of_its_own_and_made_once(tmp_path: Path):
    """Both precisions answer as the model in the box; a second time nothing is trained."""
    calls: list[int] = []
    for _ in range(2):
        made = precisions.packed(loud(calls), sweeps(), 3, tmp_path / "kept")
    assert calls == [3]
    assert [(one.form, one.precision) for one in made] == [("", "float"), ("int8", "int8")]
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
def test_a_bundle_is_measured_in_a_process_of_its_own(tmp_path: Path):
    """Costs of a real bundle: resident memory of Python with numpy and onnxruntime."""
    made = precisions.packed(loud([]), sweeps(), 1, tmp_path / "kept")
    (found, _) = measure.measure_all([one.folder for one in made], sweeps().samples, 2)
    assert 15 < found.mb < 150
    assert 0 < found.ms <= found.ms_p99
    assert found.kb > 1


@pytest.mark.slow
def test_what_does_not_run_by_itself_is_named(tmp_path: Path):
    """A bundle that was altered on disk is refused with its name and reason."""
    one, _ = precisions.packed(loud([]), sweeps(), 1, tmp_path / "kept")
    (one.folder / "model.onnx").write_bytes(b"no model")
    with pytest.raises(measure.BundleError, match="process"):
        measure.memory(one.folder, sweeps().samples)
