"""Harmful models by name: each as bytes, with a regular expression that its refusal must match.

They ask for unlimited memory or time, for files beside the model or for foreign code, or they are
not models (hostile_bytes.py). onnx makes some of them. It refuses to write the others, so they are
made byte by byte. All declare the sweep of `hostile_bytes.FORMAT` as their input.
"""

from __future__ import annotations

import numpy as np
from onnx import TensorProto, helper

from tests.factories.hostile_bytes import (
    FORMAT,
    OPSETS,
    SWEEP,
    TRIED,
    Models,
    broken,
    declared,
    info,
    misfits,
    model,
    node,
    part,
)

MILLION = 10**6
GIANT = 1_500_000_000
"""Floats that the model of 152 bytes asks for: 6 GB."""


def tiny() -> bytes:
    """A model of at most 152 bytes that asks for 6 GB with one ConstantOfShape."""
    graph = part(1, part(1, b"n") + part(2, b"logits") + part(4, b"ConstantOfShape"))
    graph += part(5, part(1, 1) + part(2, TensorProto.INT64) + part(7, GIANT) + part(8, b"n"))
    graph += part(11, declared(b"sweep", TensorProto.UINT8, SWEEP)) + part(
        12, declared(b"logits", 1, [GIANT])
    )
    return part(1, 8) + part(7, graph) + part(8, part(1, b"") + part(2, 17))


def every() -> dict[str, tuple[bytes, str]]:
    """All harmful models by name: bytes, and a regular expression for the message."""
    found: dict[str, tuple[bytes, str]] = {
        "152 bytes for 6 GB": (tiny(), r"6000000000 bytes \(limit")
    }
    for kind in (outside, foreign, endless, giant, busy, crooked, dangerous, misfits, broken):
        for name, made, words in kind():
            assert name not in found
            found[name] = made if isinstance(made, bytes) else made.SerializeToString(), words
    return found


def outside() -> Models:
    """Models with weights in files beside the model, or anywhere."""
    for how, place in {
        "above": "../../etc/shadow",
        "absolute": "/etc/shadow",
        "beside": "weights.bin",
    }.items():
        tensor = TensorProto(name="w", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
        tensor.external_data.add(key="location", value=place)
        yield (
            f"external data {how}",
            model([node("Add", ["x", "w"], ["y"])], {"w": tensor}),
            "tensor: external_data",
        )
    tensor = TensorProto(name="w", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
    yield (
        "external data without a place",
        model([node("Add", ["x", "w"], ["y"])], {"w": tensor}),
        "data_location",
    )


def foreign() -> Models:
    """Models with foreign code: unknown operators and domains, functions, training."""
    yield (
        "custom domain",
        model([node("Add", ["x", "x"], ["y"], domain="evil")], opsets=(*OPSETS, ("evil", 1))),
        "domain 'evil'",
    )
    yield (
        "custom domain, not declared",
        model([node("Add", ["x", "x"], ["y"], domain="evil")]),
        "no such operator of domain 'evil'",
    )
    yield (
        "custom operator",
        model([node("Frobnicate", ["x"], ["y"])]),
        "'Frobnicate'.*no such operator",
    )
    yield (
        "other operator of onnxruntime",
        model([node("Gelu", ["x"], ["y"], domain="com.microsoft")]),
        "'Gelu'",
    )
    yield (
        "old operators",
        model([node("Relu", ["x"], ["y"])], opsets=[("", 7)]),
        "domain '', version 7",
    )
    yield (
        "operators twice",
        model([node("Relu", ["x"], ["y"])], opsets=[("", 17), ("", 18)]),
        "each once",
    )
    made = model([node("Relu", ["x"], ["y"])])
    made.functions.append(
        helper.make_function("evil", "F", ["a"], ["b"], [node("Relu", ["a"], ["b"])], [])
    )
    yield "function", made, "model: functions"
    made = model([node("Relu", ["x"], ["y"])])
    made.training_info.add()
    yield "training", made, "training_info"
    made = model([node("Relu", ["x"], ["y"])])
    made.metadata_props.add(key="ort_config", value="{}")
    yield "settings for onnxruntime", made, "metadata 'ort_config'"


def endless() -> Models:
    """Models with control flow."""
    true = helper.make_tensor("go", TensorProto.BOOL, [], [True])
    body = helper.make_graph(
        [node("Identity", ["c"], ["d"])],
        "body",
        [info("i", 7, []), info("c", 9, [])],
        [info("d", 9, [])],
    )
    yield (
        "loop without end",
        model([node("Loop", ["", "go"], ["y"], body=body)], {"go": true}),
        "graph in the graph",
    )
    branch = helper.make_graph([node("Relu", ["x"], ["z"])], "branch", [], [info("z", 1, None)])
    yield (
        "branch",
        model([node("If", ["go"], ["y"], then_branch=branch, else_branch=branch)], {"go": true}),
        "graph in the",
    )
    scan = node("Scan", ["x"], ["y"], body=body, num_scan_inputs=1)
    yield "scan", model([scan]), "graph in the graph"
    counted = [
        node("Reshape", ["x", "flat"], ["all"]),
        node("ReduceMax", ["all"], ["top"], axes=[1], keepdims=0),
        node("Sub", ["top", "rest"], ["over"]),
        node("Relu", ["over"], ["times"]),
        node("Cast", ["times"], ["n"], to=7),
        node("Mul", ["n", "many"], ["all times"]),
        node("Squeeze", ["all times"], ["trips"]),
    ]
    body = helper.make_graph(
        [node("Identity", ["c"], ["d"]), node("Add", ["v", "v"], ["w"])],
        "body",
        [info("i", 7, []), info("c", 9, []), info("v", 1, [1])],
        [info("d", 9, []), info("w", 1, [1])],
    )
    loop = node("Loop", ["trips", "", "top"], ["y"], body=body)
    held = {"rest": np.float32([254]), "many": [2**60]}
    # onnxruntime opens this model and runs golden sweeps. The first sweep with a count of 255 never
    # ends.
    yield "loop that waits for a sweep", model([*counted, loop], held), "graph in the graph"
    yield "loop without a body", model([node("Loop", ["", "go"], ["y"])]), "no such operator"


def giant() -> Models:
    """Models with huge tensors, by every operator whose result size is a number in the model."""
    large, column = [3 * MILLION, 1000], np.zeros((MILLION // 10, 1), np.float32)
    same = "does not depend on the sweep"
    one = helper.make_tensor("one", 1, [1], [1.0])
    yield (
        "ConstantOfShape",
        model([node("ConstantOfShape", ["n"], ["y"], value=one)], {"n": large}),
        same,
    )
    yield (
        "ConstantOfShape beyond 63 bits",
        model([node("ConstantOfShape", ["n"], ["y"], value=one)], {"n": [2**62, 2**62]}),
        same,
    )
    yield (
        "ConstantOfShape of less than nothing",
        model([node("ConstantOfShape", ["n"], ["y"], value=one)], {"n": [-4, -4]}),
        same,
    )
    yield "Expand", model([node("Expand", ["x", "n"], ["y"])], {"n": [MILLION, *SWEEP]}), TRIED
    ends = {"a": np.int64(0), "b": np.int64(2**31 - 1), "c": np.int64(1)}
    yield (
        "Range",
        model([node("Range", ["a", "b", "c"], ["r"]), node("Cast", ["r"], ["y"], to=1)], ends),
        same,
    )
    yield (
        "Range without end",
        model([node("Range", ["a", "b", "a"], ["y"])], ends),
        "int64, not float32",
    )
    yield (
        "outer product",
        model([node("MatMul", ["c", "r"], ["y"])], {"c": column, "r": column.T}),
        same,
    )
    yield "outer sum", model([node("Add", ["c", "r"], ["y"])], {"c": column, "r": column.T}), same
    yes = node("Greater", ["c", "c"], ["b"])
    yield (
        "outer choice",
        model([yes, node("Where", ["b", "c", "r"], ["y"])], {"c": column, "r": column.T}),
        same,
    )
    yield (
        "Gather",
        model(
            [node("Gather", ["c", "i"], ["y"])], {"c": column.T, "i": np.zeros((40, 50), np.int64)}
        ),
        same,
    )
    yield (
        "distances",
        model(
            [node("CDist", ["c", "c"], ["y"], domain="com.microsoft", metric=b"euclidean")],
            {"c": column},
        ),
        same,
    )
    wide = [node("Concat", [f"x{i}"] * 2, [f"x{i + 1}"], axis=0) for i in range(40)]
    yield "doubled forty times", model([node("Identity", ["x"], ["x0"]), *wide], last="x40"), TRIED
    yield (
        "Tile",
        model([node("Tile", ["x", "n"], ["y"])], {"n": [MILLION] * 4}),
        "'Tile'.*no such operator",
    )
    yield (
        "pads",
        model(
            [node("Conv", ["x", "w"], ["y"], pads=[2**40] * 4)],
            {"w": np.ones((1, FORMAT.window, 1, 1), np.float32)},
        ),
        "pads",
    )
    for name, dims in {
        "beyond 63 bits": [2**32, 2**32],
        "negative": [-1, -4],
        "empty": [0],
        "nine": [1] * 9,
    }.items():
        tensor = TensorProto(
            name="w", data_type=1, dims=dims, raw_data=bytes(4 * abs(int(np.prod(dims))))
        )
        yield (
            f"constant of sizes {name}",
            model([node("Add", ["x", "w"], ["y"])], {"w": tensor}),
            "'w'",
        )


def busy() -> Models:
    """Models with endless work in little memory."""
    wide = {"w": np.zeros((4000, 4000), np.float32), "n": [2000, 4000]}
    start = [
        node("ReduceMean", ["x"], ["s"], axes=[1, 2, 3], keepdims=0),
        node("Expand", ["s", "n"], ["m0"]),
    ]
    cascade = [node("MatMul", [f"m{i}", "w"], [f"m{i + 1}"]) for i in range(200)]
    yield "cascade of products", model([*start, *cascade], wide, "m200"), TRIED
    yield (
        "10,000 nodes",
        model([node("Relu", ["x"], [f"y{i}"]) for i in range(10_000)], last="y0"),
        "(nodes|values)",
    )
    many = {f"c{i}": np.float32(1) for i in range(3000)}
    yield "3,000 constants", model([node("Relu", ["x"], ["y"])], many), "constants"
    yield (
        "a million empty nodes",
        part(1, 8) + part(7, part(1, b"") * MILLION),
        "more than 50000 values",
    )
    yield "100,000 inputs", model([node("Concat", ["x"] * 100_000, ["y"], axis=0)]), "values"


def crooked() -> Models:
    """Invalid graphs."""
    yield (
        "circle",
        model([node("Add", ["x", "b"], ["a"]), node("Relu", ["a"], ["b"])], last="b"),
        "no node before it gives 'b'",
    )
    yield (
        "wrong order",
        model([node("Relu", ["a"], ["y"]), node("Relu", ["x"], ["a"])]),
        "no node before it gives 'a'",
    )
    yield "undefined", model([node("Add", ["x", "nothing"], ["y"])]), "'nothing'"
    yield (
        "made twice",
        model([node("Relu", ["x"], ["y"]), node("Abs", ["x"], ["y"])]),
        "'y' is made twice",
    )
    yield (
        "made over the sweep",
        model([node("Relu", ["x"], ["sweep"])], last="x"),
        "'sweep' is made twice",
    )
    yield "left out", model([node("Clip", ["x", "", ""], ["y"])]), "''"
    yield "no outputs", model([node("Relu", ["x"], [])], last="x"), "0 outputs"
    made = model([node("Relu", ["x"], ["y"])], {"w": [1]})
    made.graph.initializer.add().CopyFrom(made.graph.initializer[0])
    yield "constant twice", made, "is there twice"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.sparse_initializer.add()
    yield "sparse constant", made, "sparse_initializer"
    made = model([node("Relu", ["x"], ["y"])])
    del made.graph.node[:]
    yield "no nodes", made, "no node gives the output 'logits'"
    yield "nothing", b"", "IR version 0"


def dangerous() -> Models:
    """Models whose numbers make onnxruntime divide by zero or read beside an array, and models with
    sizes that depend on the sweep.
    """
    ints = [node("Cast", ["x"], ["i"], to=7)]
    back = node("Cast", ["j"], ["y"], to=1)
    for by in ([0], [-1]):
        yield (
            f"rest of {by[0]}",
            model([*ints, node("Mod", ["i", "d"], ["j"]), back], {"d": by}),
            "divisors",
        )
    yield "rest of a sweep", model([*ints, node("Mod", ["i", "i"], ["j"]), back]), "not a constant"
    yield (
        "quotient of integers",
        model([*ints, node("Div", ["i", "d"], ["j"]), back], {"d": [0]}),
        "int64, not float32",
    )
    weights = {"w": np.ones((1, FORMAT.window, 1, 1), np.float32)}
    for setting in (
        {"strides": [0, 0]},
        {"dilations": [0, 1]},
        {"pads": [-1, 0, 0, 0]},
        {"group": 0},
    ):
        name = next(iter(setting))
        yield (
            f"convolution with {setting}",
            model([node("Conv", ["x", "w"], ["y"], **setting)], weights),
            name,
        )
    yield "no kernel", model([node("MaxPool", ["x"], ["y"], kernel_shape=[0, 0])]), "kernel_shape"
    yield "k of all", model([node("TopK", ["x", "k"], ["y", "at"])], {"k": [3]}), TRIED
    yield "k of a sweep", model([*ints, node("TopK", ["x", "i"], ["y", "at"])]), "not a constant"
    yield "shape of a sweep", model([*ints, node("Reshape", ["x", "i"], ["y"])]), "not a constant"
    yield "place beyond", model([node("Gather", ["x", "n"], ["y"])], {"n": [1]}), TRIED
    pick = node("ArrayFeatureExtractor", ["t", "i"], ["j"], domain="ai.onnx.ml")
    yield "places of a sweep", model([*ints, pick, back], {"t": [1, 2]}), "int64, not index"
    tables = {
        "classlabels_ints": [0, 1],
        "vectors_per_class": [1, 1],
        "coefficients": [1.0, 1.0],
        "rho": [0.0],
        "kernel_params": [1.0, 0.0, 3.0],
        "support_vectors": [1.0] * 192,
        "kernel_type": "RBF",
        "post_transform": "NONE",
    }
    row = node("Reshape", ["x", "flat"], ["f"])
    for name, wrong in {
        "support_vectors": [1.0],
        "coefficients": [1.0],
        "rho": [0.0] * 9,
        "vectors_per_class": [2**40, 1],
        "classlabels_ints": [0],
        "kernel_params": [1.0],
        "kernel_type": "POLY",
    }.items():
        svm = node(
            "SVMClassifier", ["f"], ["l", "y"], domain="ai.onnx.ml", **tables | {name: wrong}
        )
        yield f"machine with {name} {wrong}"[:60], model([row, svm]), "SVMClassifier"
