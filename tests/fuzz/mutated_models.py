"""The project's own models, and random changes of them.

There are two kinds of change. Changes of bytes mostly break the file. Changes of fields leave a
readable file, which reaches the rules of the operators.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from random import Random
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from palpate.bundle import bundle
from palpate.bundle.bundle import Manifest, Thresholds
from palpate.bundle.onnx_check.operators import OPERATORS
from palpate.core.errors import FormatError

NUMBERS = (
    *(0, 1, -1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 64, 255, 256, 1500, 10_000, 65_535, 65_536, 10**6),
    *(2**31 - 1, -(2**31), 2**31, 2**32, 2**40, 2**62, 2**63 - 1, -(2**63)),
)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-39, 1e-45, 1e38, -1e38, np.inf, -np.inf, np.nan)
CHANGES = (1, 1, 1, 2, 3)
"""Numbers of changes; each entry is equally likely."""
QUICK = ("L-knn", "L-svm", "st-hmp", "palpate-64")
"""Methods that train in a second. Together they have all operators but GRU and MaxPool."""


@dataclass(frozen=True)
class Own:
    """A model that `palpate-train` writes, and its manifest."""

    name: str
    model: bytes
    manifest: Manifest


def own_default() -> Own:
    """The default bundle's model."""
    default = bundle.load(bundle.DEFAULT)
    return Own("default", default.model, default.manifest)


def own_models(names: tuple[str, ...] = ()) -> list[Own]:
    """The default bundle's model and those of these methods (all), trained for a moment."""
    from palpate_train.models import methods
    from tests.factories.sweep_sets import tones

    sweeps, found = tones(), [own_default()]
    for name, method in methods.every(methods.Effort(0.02)).items():
        if method.input in bundle.INPUTS and name in (names or methods.every()):
            given = methods.model_inputs(method.input, sweeps)
            try:
                model = method.train(sweeps, given, 1).graph().SerializeToString()
            except FormatError:  # a peer that runs only in its own library
                continue
            given = (sweeps.format, method.input, sweeps.materials, Thresholds(1, 255), {})
            found.append(Own(name, model, Manifest(name, "1", *given)))
    return found


def mutated(model: bytes, rng: Random, other: bytes) -> bytes:
    """`model` with one to three changes. other: a model to take pieces from."""
    if rng.random() < 0.4:
        for _ in range(rng.choice(CHANGES)):
            model = rng.choice(BYTES)(model, rng, other)
        return model
    made, piece = onnx.load_from_string(model), onnx.load_from_string(other)
    for _ in range(rng.choice(CHANGES)):
        with suppress(ValueError, TypeError, IndexError):  # no such field, or no such number
            rng.choice(FIELDS)(made.graph, rng, piece.graph)
    if rng.random() < 0.05:
        made.opset_import[0].version = rng.choice((1, 7, 12, 13, 16, 18, 19, 21, 99))
    return bytes(made.SerializeToString())


def flip(data: bytes, rng: Random, other: bytes) -> bytes:
    """Flip up to eight bits."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def splice(data: bytes, rng: Random, other: bytes) -> bytes:
    """Replace a piece by a piece of this or the other model."""
    source = rng.choice((data, other))
    at, to = rng.randrange(len(data)), rng.randrange(len(source))
    return data[:at] + source[to : to + rng.randint(1, 64)] + data[at + rng.randint(0, 64) :]


def numbered(data: bytes, rng: Random, other: bytes) -> bytes:
    """Replace a byte by a number of several bytes."""
    at, value = rng.randrange(len(data)), rng.choice(NUMBERS) % 2**64
    varint = bytearray()
    while value > 127:
        varint.append(value & 127 | 128)
        value >>= 7
    return data[:at] + bytes([*varint, value]) + data[at + 1 :]


def short(data: bytes, rng: Random, other: bytes) -> bytes:
    """Cut off the end."""
    return data[: max(rng.randrange(len(data)), 1)]


Graph = onnx.GraphProto
BYTES: tuple[Callable[[bytes, Random, bytes], bytes], ...]
BYTES = (flip, flip, flip, splice, numbered, short)


def setting(graph: Graph, rng: Random, other: Graph) -> None:
    """Change a number in an attribute of a node."""
    attribute = rng.choice([a for node in graph.node for a in node.attribute])
    if attribute.type == onnx.AttributeProto.INT:
        attribute.i = rng.choice(NUMBERS)
    elif attribute.type == onnx.AttributeProto.FLOAT:
        attribute.f = rng.choice(FLOATS)
    elif attribute.type == onnx.AttributeProto.STRING:
        words = b"", b"NONE", b"SOFTMAX", b"mul", b"POLY", b"RBF", b"sqeuclidean"
        attribute.s = rng.choice(words)
    else:
        values = attribute.ints if attribute.type == onnx.AttributeProto.INTS else attribute.floats
        number = rng.choice(NUMBERS) if values is attribute.ints else rng.choice(FLOATS)
        _listed(values, number, rng)


def _listed(values: Any, number: Any, rng: Random) -> None:
    """The list with one number changed, added or removed."""
    how = rng.random()
    if how < 0.7:
        values[rng.randrange(len(values))] = number
    elif how < 0.85:
        values.append(number)
    else:
        del values[rng.randrange(len(values))]


def settings(graph: Graph, rng: Random, other: Graph) -> None:
    """Remove an attribute of a node, or add an attribute of another node."""
    node = rng.choice(graph.node)
    if node.attribute and rng.random() < 0.5:
        del node.attribute[rng.randrange(len(node.attribute))]
    else:
        node.attribute.append(rng.choice([a for node in other.node for a in node.attribute]))


def operator(graph: Graph, rng: Random, other: Graph) -> None:
    """Change the operator of a node."""
    node = rng.choice(graph.node)
    node.domain, node.op_type = rng.choice(list(OPERATORS))


def names(graph: Graph) -> list[str]:
    """The names of all possible inputs of a node."""
    return [v.name for v in (*graph.input, *graph.initializer)] + [
        name for node in graph.node for name in node.output
    ]


def wiring(graph: Graph, rng: Random, other: Graph) -> None:
    """Change, add or remove an input of a node."""
    _listed(rng.choice(graph.node).input, rng.choice(names(graph)), rng)


def nodes(graph: Graph, rng: Random, other: Graph) -> None:
    """Remove, duplicate or move a node, or copy one from the other model."""
    at = rng.randrange(len(graph.node))
    held = onnx.NodeProto()
    held.CopyFrom(rng.choice((graph.node[at], rng.choice(other.node))))
    if rng.random() < 0.3:
        del graph.node[at]
    if rng.random() < 0.7:
        graph.node.insert(rng.randrange(len(graph.node) + 1), held)


def between(graph: Graph, rng: Random, other: Graph) -> None:
    """Insert a node of any operator between two nodes, with the attributes of a similar node."""
    at = rng.randrange(len(graph.node))
    target = graph.node[at]
    slot = rng.randrange(len(target.input))
    domain, op = rng.choice(list(OPERATORS))
    like = [node for node in (*graph.node, *other.node) if node.op_type == op]
    held = onnx.NodeProto()
    if like:
        held.CopyFrom(rng.choice(like))
    del held.input[:], held.output[:]
    extra = rng.randrange(3)
    held.input.extend([target.input[slot], *(rng.choice(names(graph)) for _ in range(extra))])
    held.op_type, held.domain, held.name = op, domain, "between"
    held.output.extend(["between", "beside"] if op in ("TopK", "SVMClassifier") else ["between"])
    target.input[slot] = "between"
    graph.node.insert(at, held)


def constant(graph: Graph, rng: Random, other: Graph) -> None:
    """Change a number of a constant, half of the time of a constant that may decide a size."""
    sizes = [c for c in graph.initializer if c.data_type == onnx.TensorProto.INT64]
    held = rng.choice(sizes if sizes and rng.random() < 0.5 else graph.initializer)
    values = numpy_helper.to_array(held).copy()
    if values.dtype.kind == "f":
        values.flat[rng.randrange(values.size)] = rng.choice(FLOATS)
    else:
        ends = np.iinfo(values.dtype)
        fits = [n for n in NUMBERS if ends.min <= n <= ends.max]
        values.flat[rng.randrange(values.size)] = rng.choice(fits)
    held.CopyFrom(numpy_helper.from_array(values, held.name))


def form(graph: Graph, rng: Random, other: Graph) -> None:
    """Change a constant's shape or type, half of the time together with its data."""
    held = rng.choice(graph.initializer)
    values, name = numpy_helper.to_array(held), held.name
    shape, kind = list(values.shape), values.dtype
    if rng.random() < 0.6:
        sizes = [n for n in NUMBERS if n >= 0] if rng.random() < 0.5 else (1, 2, 3, 4, 6)
        _listed(shape, rng.choice(sizes), rng)
    else:
        kind = np.dtype(rng.choice(("f4", "i1", "u1", "i2", "i4", "i8", "f8", "?")))
    if rng.random() < 0.7 and np.prod(shape, dtype=object) < 10**6:
        held.CopyFrom(numpy_helper.from_array(np.resize(values, shape).astype(kind), name))
    else:
        del held.dims[:]
        held.dims.extend(shape)
        held.data_type = helper.np_dtype_to_tensor_dtype(kind)


def exchanged(graph: Graph, rng: Random, other: Graph) -> None:
    """Give a constant the content of another."""
    held, source = rng.choice(graph.initializer), rng.choice((graph, other))
    name = held.name
    held.CopyFrom(rng.choice(source.initializer))
    held.name = name


def ends(graph: Graph, rng: Random, other: Graph) -> None:
    """Change the declared inputs or outputs of the model."""
    value = rng.choice((*graph.input, *graph.output))
    held = value.type.tensor_type
    if rng.random() < 0.2:
        held.elem_type = rng.randint(0, 17)
    elif rng.random() < 0.2:
        value.name = rng.choice(names(graph))
    else:
        rng.choice(held.shape.dim).dim_value = rng.choice(NUMBERS)


FIELDS: tuple[Callable[[Graph, Random, Graph], None], ...] = (
    *(setting, setting, settings, operator, wiring, nodes, between, between, between, constant),
    *(constant, constant, form, form, exchanged, exchanged, ends),
)
