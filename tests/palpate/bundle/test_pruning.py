"""Pruning: the remaining outputs keep their bits, and nodes for other outputs are removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.bundle.onnx_check import check, reader
from palpate.bundle.pruning import prune
from palpate.core.errors import BundleError
from palpate.inference.session import run, session
from tests.factories import toy_bundle

ALL = ("logits", "early", "embedding")


def names(model: bytes, field: str) -> list[str]:
    """Names of the graph's fields of one kind."""
    return [one.name for one in getattr(reader.read(model).graph, field)]


@pytest.mark.parametrize(
    "outputs", [("logits",), ("logits", "embedding"), ("early",), ("embedding",)]
)
def test_outputs_keep_their_bits(default_bundle, outputs):
    """Each output of the pruned model equals that of the whole model bit for bit."""
    whole, pruned = (
        session(default_bundle.model),
        session(prune(default_bundle.model, set(outputs))),
    )
    assert [o.name for o in pruned.get_outputs()] == [name for name in ALL if name in outputs]
    noise = np.random.default_rng(0).integers(
        0, 256, (5, *default_bundle.golden.shape[1:]), np.uint8
    )
    for window in (*default_bundle.golden, *noise):
        want, have = (run(of, outputs, {"sweep": window[None]}) for of in (whole, pruned))
        assert [a.tobytes() for a in have] == [a.tobytes() for a in want]


def test_what_only_early_heads_need_is_gone(default_bundle):
    """Exactly the nodes and constants that the outputs need are left."""
    pruned = prune(default_bundle.model, {"logits", "embedding"})
    graph = reader.read(pruned).graph
    needed = {name for node in graph.node for name in node.input} | set(names(pruned, "output"))
    assert all(needed.intersection(node.output) for node in graph.node)
    assert {tensor.name for tensor in graph.initializer} <= needed
    given, kept = (
        {name for node in reader.read(of).graph.node for name in node.output}
        for of in (default_bundle.model, pruned)
    )
    assert {"early", "head.steps"} <= given - kept
    assert len(names(pruned, "initializer")) < len(names(default_bundle.model, "initializer"))
    assert {"logits", "embedding"} <= kept
    assert len(pruned) < 0.95 * len(default_bundle.model)


def test_a_pruned_model_passes_the_check_and_a_plain_one_stays(default_bundle):
    """As the model of a bundle without early heads; without other outputs no byte changes."""
    model = toy_bundle.model(("logits", "embedding"))
    assert "early" in [name for node in reader.read(model).graph.node for name in node.output]
    assert prune(model, {"embedding", "logits"}) is model
    pruned = prune(default_bundle.model, {"logits", "embedding"})
    manifest = default_bundle.manifest
    check.check(pruned, replace(manifest, early=None))
    with pytest.raises(BundleError, match="manifest"):
        check.check(pruned, manifest)


def test_declarations_of_what_is_gone_are_gone():
    """Values of remaining nodes stay; a missing output and other bytes are refused."""
    onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
    inferred = onnx.shape_inference.infer_shapes(
        onnx.load_from_string(toy_bundle.model(ALL))
    ).SerializeToString()
    assert {"row", "mean"} <= set(names(inferred, "value_info"))
    pruned = prune(inferred, {"embedding"})
    assert set(names(pruned, "value_info")) == {"float", "mean", "taxels"}
    onnx.checker.check_model(onnx.load_from_string(pruned), full_check=True)
    with pytest.raises(BundleError, match="early"):
        prune(toy_bundle.model(), {"logits", "early"})
    with pytest.raises(BundleError, match=r"\['logits'\]"):
        prune(b"", {"logits"})
    with pytest.raises(BundleError, match="bundle"):
        prune(b"nonsense", {"logits"})
