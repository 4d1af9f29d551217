"""Random models that the box's check accepts, as tests of onnxruntime itself.

They have random operators on random tensors, as far as the rules of the check allow.
"""

from __future__ import annotations

from math import prod
from random import Random
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from palpate.bundle.onnx_check import operators
from palpate.bundle.onnx_check.operators import OPERATORS
from palpate.bundle.onnx_check.shapes import INDEX, Call, Value
from palpate.core.errors import BundleError
from palpate.core.types import SweepFormat

FORMAT = SweepFormat(2, 2, 100.0, 24, "uint8")
SIZES = (1, 1, 1, 2, 2, 3, 4, 6, 8, 24, 96)
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 3.0, 1e-39, 1e38, -1e38, 255.0, float("inf"), float("nan"))
TRIES = 20
MOST_NUMBERS = 50_000
"""Most numbers of one tensor. The campaign is about kinds of graphs, not about large tensors."""


class Sprout:
    """A graph under construction."""

    def __init__(self, rng: Random) -> None:
        self.rng, self.nodes, self.constants = rng, [], []
        self.known = {
            "sweep": Value(
                "uint8", (1, FORMAT.window, FORMAT.rows, FORMAT.cols), depends_on_sweep=True
            )
        }

    def constant(self, kind: str, shape: tuple[int, ...]) -> str:
        """A new constant of random numbers."""
        rng, n = self.rng, prod(shape)
        if kind == "float32":
            usual = rng.choice((rng.choice(FLOATS), rng.uniform(-2, 2)))
            values = [
                usual if rng.random() < 0.8 else rng.choice((*FLOATS, rng.uniform(-9, 9)))
                for _ in range(n)
            ]
        else:
            low = 0 if kind == "uint8" else -3
            values = [
                rng.choice((0, 1, 2, rng.randint(low, 8), rng.choice(SIZES))) for _ in range(n)
            ]
        name = f"c{len(self.constants)}"
        array = np.array(values, kind).reshape(shape)
        self.constants.append(numpy_helper.from_array(array, name))
        self.known[name] = Value(kind, shape, array)
        return name

    def shape(self, like: tuple[int, ...] = ()) -> tuple[int, ...]:
        """Random sizes, or the sizes of `like`, possibly with one of them changed."""
        rng = self.rng
        if like and rng.random() < 0.7:
            found = list(like)
            if rng.random() < 0.5:
                found[rng.randrange(len(found))] = rng.choice((1, *found))
            return tuple(found[rng.choice((0, 0, -1, -2)) :])
        return tuple(rng.choice(SIZES) for _ in range(rng.randint(0, 4)))

    def input(self, kinds: tuple[str, ...], like: tuple[int, ...]) -> str:
        """An existing value, most often a recent one, or a new constant."""
        there = [name for name, value in self.known.items() if value.kind in kinds]
        if there and self.rng.random() < 0.6:
            return there[-1 - min(int(self.rng.expovariate(0.5)), len(there) - 1)]
        made = [kind for kind in kinds if kind in ("float32", "uint8", "int8", "int32", "int64")]
        if not made:
            return self.rng.choice(there) if there else ""
        kind = self.rng.choice(made)
        if kind == "int64" and self.rng.random() < 0.8:  # values that decide sizes
            return self.constant(
                kind, self.rng.choice(((), (1,), (1,), (1,), (2,), (len(like) or 1,)))
            )
        shape = self.shape(like)
        return self.constant(kind, shape if prod(shape) <= 4096 else ())

    def setting(self, name: str, code: int, first: Value) -> Any:
        """A random value for an attribute of a node."""
        rng, rank = self.rng, max(len(first.shape) - 2, 1)
        texts = {
            "reduction": "add",
            "metric": "euclidean",
            "post_transform": "NONE",
            "kernel_type": "RBF",
        }
        if name == "value":
            return helper.make_tensor("v", 1, [1], [rng.choice(FLOATS)])
        if code == operators.TEXT:
            return texts[name]
        if code == operators.FLOAT:
            return rng.uniform(-2, 2)
        if code == operators.FLOATS:
            return [rng.uniform(-2, 2) for _ in range(rng.choice((1, 3, *first.shape[-1:])))]
        if code == operators.INT:
            return rng.choice((1, 2, 7)) if name == "to" else rng.choice((0, 1, 1, 2, -1, 3))
        if name == "perm":
            return rng.sample(range(len(first.shape)), len(first.shape))
        if name == "axes":
            return rng.sample(range(-1, rank + 2), rng.randint(1, 2))
        return [rng.choice((0, 1, 1, 2, 3)) for _ in range(rank * (2 if name == "pads" else 1))]

    def grow(self) -> bool:
        """Add a node of an operator whose rule accepts random inputs within a few tries."""
        chosen = self.rng.choice(list(OPERATORS))
        return any(self.tried(*chosen) for _ in range(TRIES))

    def tried(self, domain: str, op: str) -> bool:
        """Try to add a node of this operator with random inputs. Returns whether its rule accepted
        it.
        """
        operator = OPERATORS[domain, op]
        names: list[str] = []
        most = (
            operator.least
            if "axes" in operator.settings
            else min(operator.most, operator.least + 2)
        )
        for i in range(self.rng.randint(operator.least, most)):
            like = self.known[names[0]].shape if names and names[0] else ()
            names.append(self.input(operator.kinds[min(i, len(operator.kinds) - 1)], like))
        if "" in names:
            return False
        inputs = [self.known[name] for name in names]
        given = {
            k: self.setting(k, code, inputs[0])
            for k, code in operator.settings.items()
            if self.rng.random() < 0.7
        }
        return self.add(domain, op, names, {k: v for k, v in given.items() if v != []})

    def add(self, domain: str, op: str, names: list[str], given: dict[str, Any]) -> bool:
        """Add a node if its rule accepts it."""
        inputs = [self.known[name] for name in names]
        settings = {k: v.encode() if isinstance(v, str) else v for k, v in given.items()}
        if "value" in settings:
            settings["value"] = Value("float32", (1,))
        try:
            outs = OPERATORS[domain, op].rule(Call(inputs, settings))
        except BundleError:
            return False
        outs = outs if isinstance(outs, list) else [outs]
        if any(
            min(shape, default=1) < 1 or prod(shape) > MOST_NUMBERS or len(shape) > 8
            for _, shape in outs
        ):
            return False
        made = [f"t{len(self.nodes)}_{i}" for i in range(len(outs))]
        self.nodes.append(helper.make_node(op, names, made, domain=domain, **given))
        depends = any(x.depends_on_sweep for x in inputs)
        for name, (kind, shape) in zip(made, outs, strict=True):
            self.known[name] = Value(
                "int64" if kind == INDEX else kind, shape, None, depends, kind == INDEX
            )
        return True

    def model(self) -> bytes:
        """The finished model: the graph, and two logits from it."""
        ends = [
            name
            for name, value in self.known.items()
            if value.depends_on_sweep and value.kind == "float32"
        ][-6:]
        flat = self.constant("int64", (1,))
        self.constants[-1].CopyFrom(numpy_helper.from_array(np.array([1, -1]), flat))
        for i, name in enumerate(ends):
            self.nodes.append(helper.make_node("Reshape", [name, flat], [f"flat{i}"]))
        self.nodes.append(
            helper.make_node("Concat", [f"flat{i}" for i in range(len(ends))], ["all"], axis=1)
        )
        for name in "Max", "Min":
            self.nodes.append(helper.make_node(f"Reduce{name}", ["all"], [name], axes=[1]))
        self.nodes.append(helper.make_node("Concat", ["Max", "Min"], ["logits"], axis=1))
        value = helper.make_tensor_value_info
        graph = helper.make_graph(
            self.nodes,
            "grown",
            [value("sweep", onnx.TensorProto.UINT8, self.known["sweep"].shape)],
            [value("logits", onnx.TensorProto.FLOAT, [1, 2])],
            self.constants,
        )
        used = {name for node in self.nodes for name in node.input}
        del graph.initializer[:]
        graph.initializer.extend(c for c in self.constants if c.name in used)
        opsets = [
            helper.make_opsetid(*pair)
            for pair in (("", 17), ("ai.onnx.ml", 3), ("com.microsoft", 1))
        ]
        return bytes(
            helper.make_model(graph, opset_imports=opsets, ir_version=8).SerializeToString()
        )


def grown(rng: Random) -> bytes:
    """A model of up to fifty random operators."""
    sprout = Sprout(rng)
    sprout.add("", "Cast", ["sweep"], {"to": 1})
    wanted = rng.randint(2, 50)
    for _ in range(wanted):
        sprout.grow()
    return sprout.model()
