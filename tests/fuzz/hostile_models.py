"""Harmful models by name: each as bytes, with a regular expression that its refusal must match.

They ask for unlimited memory or time, for files beside the model or for foreign code, or they are
not models. onnx makes some of them. It refuses to write the others, so they are made byte by byte.
All declare the sweep of FORMAT as their input.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import AttributeProto, TensorProto, helper, numpy_helper

from palpate.core.types import SweepFormat

FORMAT = SweepFormat(2, 2, 100.0, 24, "uint8")
"""Of the sweep that all hostile models declare as their input."""
TRIED = ""
"""In place of words: the check lets the model pass, and its trial refuses it."""
Models = Mapping[str, tuple[onnx.ModelProto | bytes, str]]
node, info = helper.make_node, helper.make_tensor_value_info
SWEEP = [1, FORMAT.window, FORMAT.rows, FORMAT.cols]
OPSETS = (("", 17), ("ai.onnx.ml", 3), ("com.microsoft", 1))
FLOATS = node("Cast", ["sweep"], ["x"], to=TensorProto.FLOAT)
MILLION = 10**6
GIANT = 1_500_000_000
"""Floats that the model of 152 bytes asks for: 6 GB."""


def model(
    nodes: Sequence[onnx.NodeProto],
    constants: Mapping[str, Any] = {},
    last: str = "y",
    opsets: Any = OPSETS,
) -> onnx.ModelProto:
    """A model of these nodes from `sweep` as `x`; the largest of `last`, twice, is `logits`."""
    ends = [
        node("Reshape", [last, "flat"], ["row"]),
        node("ReduceMax", ["row"], ["most"], axes=[1]),
        node("Concat", ["most", "most"], ["logits"], axis=1),
    ]
    held = {"flat": [1, -1]} | constants
    tensors = [
        v if isinstance(v, TensorProto) else numpy_helper.from_array(np.array(v), k)
        for k, v in held.items()
    ]
    into, out = info("sweep", TensorProto.UINT8, SWEEP), info("logits", 1, [1, 2])
    graph = helper.make_graph([FLOATS, *nodes, *ends], "hostile", [into], [out], tensors)
    versions = [helper.make_opsetid(*o) for o in opsets]
    return helper.make_model(graph, opset_imports=versions, ir_version=8)


def one(kind: str, inputs: str = "x", held: Mapping[str, Any] = {}, **how: Any) -> onnx.ModelProto:
    """A model of one node. inputs: names with spaces between them. held: constants."""
    return model([node(kind, inputs.split(), ["y"], **how)], held)


def changed(made: onnx.ModelProto, change: Callable[[onnx.ModelProto], object]) -> onnx.ModelProto:
    """The model after a change."""
    change(made)
    return made


def number(n: int) -> bytes:
    """Encode a varint."""
    n %= 1 << 64
    return (bytes([n & 127 | 128]) + number(n >> 7)) if n > 127 else bytes([n])


def part(field: int, content: bytes | int) -> bytes:
    """A field of a message: bytes with their length, or a number."""
    if isinstance(content, int):
        return number(field << 3) + number(content)
    return number(field << 3 | 2) + number(len(content)) + content


def tiny() -> bytes:
    """A model of at most 152 bytes that asks for 6 GB with one ConstantOfShape."""

    def declared(name: bytes, kind: int, sizes: Sequence[int]) -> bytes:
        shape = b"".join(part(1, part(1, size)) for size in sizes)
        return part(1, name) + part(2, part(1, part(1, kind) + part(2, shape)))

    graph = part(1, part(1, b"n") + part(2, b"logits") + part(4, b"ConstantOfShape"))
    graph += part(5, part(1, 1) + part(2, TensorProto.INT64) + part(7, GIANT) + part(8, b"n"))
    graph += part(11, declared(b"sweep", TensorProto.UINT8, SWEEP))
    graph += part(12, declared(b"logits", 1, [GIANT]))
    return part(1, 8) + part(7, graph) + part(8, part(1, b"") + part(2, 17))


def every() -> dict[str, tuple[bytes, str]]:
    """All harmful models by name: bytes, and a regular expression for the message."""
    kinds = (outside, foreign, endless, giant, busy, crooked, dangerous, machines)
    tables: list[Models] = [kind() for kind in (*kinds, misfits, shapes, broken)]
    found: dict[str, tuple[bytes, str]] = {"152 bytes for 6 GB": (tiny(), r"6000000000 bytes \(")}
    for name, (made, words) in (entry for table in tables for entry in table.items()):
        assert name not in found
        found[name] = made if isinstance(made, bytes) else made.SerializeToString(), words
    return found


def outside() -> Models:
    """Models with weights in files beside the model, or anywhere."""
    found: dict[str, tuple[onnx.ModelProto, str]] = {}
    for how, place in {"beside": "weights.bin", "without a place": ""}.items():
        tensor = TensorProto(name="w", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
        if place:
            tensor.external_data.add(key="location", value=place)
        words = "tensor: field 13" if place else "tensor: field 14"
        found[f"external data {how}"] = one("Add", "x w", {"w": tensor}), words
    return found


def foreign() -> Models:
    """Models with foreign code: unknown operators and domains, functions, training."""
    evil, relu = [node("Add", ["x", "x"], ["y"], domain="evil")], [node("Relu", ["x"], ["y"])]
    function = helper.make_function("e", "F", ["a"], ["b"], [node("Relu", ["a"], ["b"])], [])
    setting = {"key": "ort_config", "value": "{}"}
    return {
        "custom domain": (model(evil, opsets=(*OPSETS, ("evil", 1))), "domain 'evil'"),
        "custom domain, not declared": (model(evil), "operator of domain 'evil'"),
        "custom operator": (one("Frobnicate"), "'Frobnicate'.*no such"),
        "old operators": (model(relu, opsets=[("", 7)]), "domain '', version 7"),
        "operators twice": (model(relu, opsets=[("", 17), ("", 18)]), "each once"),
        "function": (
            changed(model(relu), lambda m: m.functions.append(function)),
            "model: field",
        ),
        "settings for onnxruntime": (
            changed(model(relu), lambda m: m.metadata_props.add(**setting)),
            "metadata 'ort_config'",
        ),
    }


def endless() -> Models:
    """Models with control flow."""
    true = helper.make_tensor("go", TensorProto.BOOL, [], [True])
    goes_on, inside = node("Identity", ["c"], ["d"]), "attribute: field 6"
    i, c, d = info("i", 7, []), info("c", 9, []), info("d", 9, [])
    body = helper.make_graph([goes_on], "body", [i, c], [d])
    for_ever = [node("Loop", ["", "go"], ["y"], body=body)]
    return {
        "loop without end": (model(for_ever, {"go": true}), inside),
        "scan": (one("Scan", body=body, num_scan_inputs=1), inside),
        "loop without a body": (model([node("Loop", ["", "go"], ["y"])]), "no such operator"),
    }


def giant() -> Models:
    """Models with huge tensors, by every operator whose result size is a number in the model."""
    column, same = np.zeros((MILLION // 10, 1), np.float32), "not depend on the sweep"
    fill = {"value": helper.make_tensor("one", 1, [1], [1.0])}
    ends = {"a": np.int64(0), "b": np.int64(2**31 - 1), "c": np.int64(1)}
    range_of = [node("Range", ["a", "b", "c"], ["r"]), node("Cast", ["r"], ["y"], to=1)]
    outer = {"c": column, "r": column.T}
    near = {"domain": "com.microsoft", "metric": b"euclidean"}
    wide = [node("Concat", [f"x{i}"] * 2, [f"x{i + 1}"], axis=0) for i in range(40)]
    doubled = model([node("Identity", ["x"], ["x0"]), *wide], last="x40")
    found: dict[str, tuple[onnx.ModelProto, str]] = {
        "Expand": (one("Expand", "x n", {"n": [MILLION, *SWEEP]}), TRIED),
        "Range": (model(range_of, ends), same),
        "Range without end": (one("Range", "a b a", ends), "int64, not float32"),
        "outer product": (one("MatMul", "c r", outer), same),
        "distances": (one("CDist", "c c", {"c": column}, **near), same),
        "doubled forty times": (doubled, TRIED),
        "pads": (one("Conv", "x w", {"w": kernel()}, pads=[2**40] * 4), "pads"),
    }
    found["ConstantOfShape"] = one("ConstantOfShape", "n", {"n": [2**62, 2**62]}, **fill), same
    sizes = {"beyond 63 bits": [2**32, 2**32], "negative": [-1, -4], "empty": [0], "nine": [1] * 9}
    for name, dims in sizes.items():
        data = bytes(4 * abs(int(np.prod(dims))))
        held = {"w": TensorProto(name="w", data_type=1, dims=dims, raw_data=data)}
        found[f"constant of sizes {name}"] = one("Add", "x w", held), "'w'"
    return found


def kernel() -> np.ndarray:
    """The weights of a convolution over the sweep."""
    return np.ones((1, FORMAT.window, 1, 1), np.float32)


def busy() -> Models:
    """Models with endless work in little memory."""
    held = {"w": np.zeros((4000, 4000), np.float32), "n": [2000, 4000]}
    cascade = [
        node("ReduceMean", ["x"], ["s"], axes=[1, 2, 3], keepdims=0),
        node("Expand", ["s", "n"], ["m0"]),
        *(node("MatMul", [f"m{i}", "w"], [f"m{i + 1}"]) for i in range(200)),
    ]
    relus = [node("Relu", ["x"], [f"y{i}"]) for i in range(10_000)]
    empty = part(1, 8) + part(7, part(1, b"") * MILLION)
    return {
        "cascade of products": (model(cascade, held, "m200"), TRIED),
        "10,000 nodes": (model(relus, last="y0"), "(nodes|values)"),
        "3,000 constants": (one("Relu", "x", {f"c{i}": 1 for i in range(3000)}), "constants"),
        "a million empty nodes": (empty, "more than 50000 values"),
        "100,000 inputs": (model([node("Concat", ["x"] * 100_000, ["y"], axis=0)]), "values"),
    }


def crooked() -> Models:
    """Invalid graphs."""
    circle = [node("Add", ["x", "b"], ["a"]), node("Relu", ["a"], ["b"])]
    both = [node("Relu", ["x"], ["y"]), node("Abs", ["x"], ["y"])]
    twice = one("Relu", "x", {"w": [1]})
    twice.graph.initializer.add().CopyFrom(twice.graph.initializer[0])
    sparse = changed(one("Relu"), lambda m: m.graph.sparse_initializer.add())
    empty = changed(one("Relu"), lambda m: m.graph.ClearField("node"))
    return {
        "circle": (model(circle, last="b"), "before it gives 'b'"),
        "undefined": (one("Add", "x nothing"), "'nothing'"),
        "made twice": (model(both), "'y' is made twice"),
        "made over the sweep": (model([node("Relu", ["x"], ["sweep"])], last="x"), "made twice"),
        "no outputs": (model([node("Relu", ["x"], [])], last="x"), "0 outputs"),
        "constant twice": (twice, "is there twice"),
        "sparse constant": (sparse, "graph: field 15"),
        "no nodes": (empty, "the output 'logits'"),
        "nothing": (b"", "IR version 0"),
    }


def dangerous() -> Models:
    """Models that divide by zero, read beside an array, or size by the sweep."""

    def integers(kind: str, inputs: str, held: Mapping[str, Any] = {}, **how: Any) -> Any:
        """The node between casts of the sweep to integers and back."""
        middle = node(kind, inputs.split(), ["j"], **how)
        ends = node("Cast", ["x"], ["i"], to=7), node("Cast", ["j"], ["y"], to=1)
        return model([ends[0], middle, ends[1]], held)

    top, size = node("TopK", ["x", "k"], ["y", "at"]), node("Cast", ["x"], ["k"], to=7)
    found: dict[str, tuple[onnx.ModelProto, str]] = {
        "rest of 0": (integers("Mod", "i d", {"d": [0]}), "divisors"),
        "rest of -1": (integers("Mod", "i d", {"d": [-1]}), "divisors"),
        "rest of a sweep": (integers("Mod", "i i"), "not a constant"),
        "quotient of integers": (integers("Div", "i d", {"d": [0]}), "int64, not float32"),
        "k of all": (model([top], {"k": [3]}), TRIED),
        "k of a sweep": (model([size, top]), "not a constant"),
        "shape of a sweep": (
            model([size, node("Reshape", ["x", "k"], ["y"])]),
            "not a constant",
        ),
        "place beyond": (one("Gather", "x n", {"n": [1]}), TRIED),
    }
    wrong = {"strides": [0, 0], "dilations": [0, 1], "pads": [-1, 0, 0, 0], "group": 0}
    for name, value in wrong.items():
        made = one("Conv", "x w", {"w": kernel()}, **{name: value})
        found[f"convolution with {name} {value}"] = made, name
    return found


def machines() -> Models:
    """Support vector machines with tables that do not fit together."""
    right = {
        "classlabels_ints": [0, 1],
        "vectors_per_class": [1, 1],
        "coefficients": [1.0, 1.0],
        "rho": [0.0],
        "kernel_params": [1.0, 0.0, 3.0],
        "support_vectors": [1.0] * 192,
        "kernel_type": "RBF",
        "post_transform": "NONE",
    }
    wrong = {
        "support_vectors": [1.0],
        "coefficients": [1.0],
        "rho": [0.0] * 9,
        "vectors_per_class": [2**40, 1],
        "classlabels_ints": [0],
        "kernel_params": [1.0],
        "kernel_type": "POLY",
    }
    found = {}
    for name, value in wrong.items():
        how = {"domain": "ai.onnx.ml"} | right | {name: value}
        nodes = [
            node("Reshape", ["x", "flat"], ["f"]),
            node("SVMClassifier", ["f"], ["l", "y"], **how),
        ]
        found[f"machine with other {name}"] = model(nodes), "SVMClassifier"
    return found


def misfits() -> Models:
    """Models whose types or settings are foreign."""

    def setting(change: Callable[[Any], object]) -> onnx.ModelProto:
        """A model after a change of the node that has a setting."""
        return changed(one("LogSoftmax", axis=1), lambda m: change(m.graph.node[1].attribute))

    def weight(n: int) -> dict[str, Any]:
        """Numbers in int8 with their step and zero, as quantization writes them."""
        return {"w": np.int8([[0, n]]), "s": np.float32(0.1), "z": np.int8(0)}

    texts = helper.make_tensor("w", TensorProto.STRING, [1], [b"a"])
    off = TensorProto(name="w", data_type=1, dims=[4], float_data=[1.0, 2.0])
    short = TensorProto(name="w", data_type=1, dims=[4], raw_data=bytes(4))
    weights = {"w": np.ones((96, 2), np.float32)}
    of_type = setting(lambda a: setattr(a[0], "type", AttributeProto.FLOAT))
    return {
        "texts": (one("Add", "x w", {"w": texts}), "tensor: field 6"),
        "64 bits": (one("Add", "x w", {"w": np.ones(1)}), "type 11"),
        "cast to texts": (one("Cast", to=8), "type 8"),
        "too few floats": (one("Add", "x w", {"w": off}), TRIED),
        "too few numbers": (one("Add", "x w", {"w": short}), TRIED),
        "old file": (changed(one("Relu"), lambda m: setattr(m, "ir_version", 3)), "version 3"),
        **{
            f"a weight of {n}": (one("DequantizeLinear", "w s z", weight(n)), f"{n}.*seven bits")
            for n in (-128, -65, 65)
        },
        "setting of another type": (of_type, "setting 'axis'"),
        "setting of two types": (setting(lambda a: setattr(a[0], "f", 1.0)), "as its type has it"),
        "setting twice": (setting(lambda a: a.add().CopyFrom(a[0])), "'axis' is set twice"),
        "setting without end": (one("Gemm", "x w", weights, alpha=float("inf")), "alpha = inf"),
        "an input too many": (one("Relu", "x x"), "it has 2 inputs"),
    }


def shapes() -> Models:
    """Models whose inputs or outputs differ from the manifest."""

    def input_(change: Callable[[Any], object]) -> onnx.ModelProto:
        return changed(one("Relu"), lambda m: change(m.graph.input[0].type))

    def graph(change: Callable[[Any], object]) -> onnx.ModelProto:
        return changed(one("Relu"), lambda m: change(m.graph))

    def logits(g: Any) -> None:
        g.output[0].type.tensor_type.shape.dim[1].dim_value = 3

    named = input_(lambda t: setattr(t.tensor_type.shape.dim[0], "dim_param", "n"))
    fewer = input_(lambda t: t.tensor_type.shape.dim.pop(0))
    no_size = input_(lambda t: t.tensor_type.shape.dim[0].Clear())
    listed = input_(lambda t: setattr(t.sequence_type.elem_type.tensor_type, "elem_type", 1))
    return {
        "named size": (named, "dimension: field 2"),
        "other sweep": (fewer, "the manifest has uint8"),
        "two inputs": (graph(lambda g: g.input.append(info("more", 1, [1]))), "2 inputs"),
        "other logits than declared": (graph(logits), r"\[1, 3\] instead of"),
        "another output": (graph(lambda g: g.output.append(info("x", 1, SWEEP))), "allows logits"),
        "sequence": (listed, "type: field 4"),
        "no type": (input_(lambda t: t.Clear()), "no type and shape"),
        "no size": (no_size, "must be a number"),
    }


def broken() -> Models:
    """Files that are not protobuf, or that two readers understand differently."""
    good = one("Relu").SerializeToString()
    second = part(7, one("Abs").graph.SerializeToString())
    group = good[:2] + number(2 << 3 | 3) + number(2 << 3 | 4) + good[2:]
    long = part(1, 8) + number(7 << 3 | 2) + b"\xff" * 9 + b"\x01"
    half = part(7, part(1, part(5, number(2 << 3 | 5) + b"\0")))
    deep = b""
    for _ in range(1000):  # a graph in an attribute of a node of a graph, and so on
        deep = part(1, part(5, part(6, deep)))
    return {
        "two graphs": (good + second, "graph is there twice"),
        "text behind it": (good + b"palpate", "field"),
        "a group": (group, "wire type 3"),
        "wire type 7": (number(1 << 3 | 7) + good, "wire type 7"),
        "a number that ends early": (b"\x08", "a number is cut off"),
        "a length without end": (long, "bytes are announced"),
        "a number without end": (part(1, 8) + b"\xff" * 100, "more bytes than it"),
        "a number in two bytes": (b"\x08\x88\x00" + good[2:], "more bytes than it"),
        "a float that ends early": (half, "a number is cut off"),
        "floats that are none": (part(7, part(5, part(4, b"\0" * 5))), "5 bytes are no"),
        "a version of 64 bits": (part(1, 8 + 2**32) + good[2:], "not a code or version"),
        "a thousand deep": (part(7, deep), "attribute: field 6"),
        "brackets": (b"[" * 5000, "model: field 11"),
        "a name of no letters": (good.replace(b"Relu", b"\xff\xfe\xfd\xfc"), "UTF-8"),
    }
