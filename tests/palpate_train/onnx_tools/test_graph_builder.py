"""Joined graphs: nodes that both have in common occur once, and each output keeps its bits."""

import numpy as np
import pytest

pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
import onnx

from palpate.bundle.pruning import prune
from palpate.core.types import SweepFormat
from palpate_train.onnx_tools.graph_builder import GraphBuilder, joined, run, run_output, slim

FORMAT = SweepFormat(2, 2, 100.0, 20, "uint8")


def made(output: str, by: float) -> onnx.ModelProto:
    """The sums of the two loudest taxels' counts, which all such graphs share, times `by`."""
    g = GraphBuilder()
    x = g("Cast", g("Reshape", "sweep", g.constant([1, 20, 4], "int64")), to=1)
    axis, same = (g.constant([1], "int64") for _ in range(2))  # a constant that occurs twice
    x = g("ReduceSum", x, axis, keepdims=1)
    sums = g("Reshape", g("ReduceSum", x, same, keepdims=1), g.constant([1, 4], "int64"))
    g.nodes.append(onnx.helper.make_node("TopK", [sums, g.constant([2], "int64")], ["most", "who"]))
    return g.model(
        FORMAT, g("Mul", g("Mul", "most", g.constant(by)), g.constant(3.0), output=output), 2
    )


def drawn() -> np.ndarray:
    """Five windows."""
    return np.random.default_rng(0).integers(0, 256, (5, 20, 2, 2), np.uint8)


def test_joined_graphs_share_nodes_and_keep_their_bits():
    """Six nodes once; each output equals its own graph's, the first is unchanged alone."""
    both = joined(made("a", 0.5), made("b", 0.25))
    names = "reshape0 cast1 reducesum2 reducesum3 reshape4  mul6 a mul6.b b"
    assert " ".join(node.name for node in both.graph.node) == names
    assert [node.output[:] for node in both.graph.node][5] == ["most", "who"]
    assert len(both.graph.initializer) == len(made("a", 0.5).graph.initializer) + 1
    assert [output.name for output in both.graph.output] == ["a", "b"]
    one, other = made("a", 0.5), made("b", 0.25)
    both = joined(one, other)
    for name, have in zip("ab", [run_output(both, name, drawn()) for name in "ab"], strict=True):
        np.testing.assert_array_equal(have, run({"a": one, "b": other}[name], drawn()))
    assert prune(both.SerializeToString(), {"a"}) == one.SerializeToString()
    alone = onnx.load_from_string(prune(both.SerializeToString(), {"b"}))
    assert len(alone.graph.node) == len(other.graph.node)
    np.testing.assert_array_equal(run(alone, drawn()), run(other, drawn()))


def test_constants_are_told_apart_by_type_and_shape():
    """Equal bytes of another type or shape are another constant."""

    def shaped(output: str, shape: list[int], dtype: str) -> onnx.ModelProto:
        g = GraphBuilder()
        x = g("Cast", g("Reshape", "sweep", g.constant([80], "int64")), to=1)
        ones = g("Cast", g.constant(np.zeros(shape), dtype), to=1)
        return g.model(
            FORMAT, g("Reshape", g("Add", x, ones), g.constant([1, 80], "int64"), output=output), 80
        )

    both = joined(shaped("a", [80], "uint8"), shaped("b", [1, 80], "uint8"))
    assert len(both.graph.initializer) == 4
    assert len(joined(both, shaped("c", [80], "int8")).graph.initializer) == 5


def test_a_slim_model_gives_the_same_bits_in_fewer_bytes():
    """Equal constants once, short names; inputs, outputs and multiplying nodes stay."""
    g = GraphBuilder()
    x = g("Cast", g("Reshape", "sweep", g.constant([1, 20, 4], "int64")), to=1)
    y = g("MatMul", x, g.constant(np.arange(12).reshape(4, 3)))
    y = g("Add", g("Mul", y, g.constant(0.5)), g.constant(0.5))
    model = g.model(FORMAT, g("Reshape", y, g.constant([1, 60], "int64"), output="logits"), 60)
    small = slim(model)
    np.testing.assert_array_equal(run(small, drawn()), run(model, drawn()))
    assert len(small.SerializeToString()) < 0.9 * len(model.SerializeToString())
    assert len(small.graph.initializer) == len(model.graph.initializer) - 1
    names = {name for node in small.graph.node for name in node.output}
    assert {"matmul2", "logits"} <= names
    assert max(map(len, names - {"matmul2", "logits"})) == 1
    assert slim(small) == small


def test_slim_keeps_optional_inputs_empty_and_second_outputs_apart():
    """A joined graph with a node that has two outputs; each output keeps its bits."""
    both = joined(made("a", 0.5), made("b", 0.25))
    small = slim(both)
    for name in ("a", "b"):
        one, other = (prune(m.SerializeToString(), (name,)) for m in (both, small))
        loaded = [onnx.load_from_string(content) for content in (one, other)]
        np.testing.assert_array_equal(run(loaded[0], drawn()), run(loaded[1], drawn()))
