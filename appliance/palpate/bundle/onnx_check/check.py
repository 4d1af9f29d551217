"""Decides whether a model may be tried: a list of operators, caps of sizes, and inputs and outputs
as the manifest has them. A BundleError gives the node, tensor and value.

A model that passes needs the same memory and time for every sweep, or onnxruntime refuses it. How
much that is, its trial shows in a limited process (deployment/sandbox.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, prod
from typing import Any

import numpy as np

from palpate.bundle.manifest import MOST_BYTES, Manifest
from palpate.bundle.onnx_check import operators, reader
from palpate.bundle.onnx_check.operators import INDEX, KINDS, OPERATORS, SAME, need
from palpate.bundle.onnx_check.reader import Message
from palpate.core.errors import BundleError

VERSIONS = {"": range(17, 19), "ai.onnx.ml": range(3, 4), "com.microsoft": range(1, 2)}
"""Versions of the operators of each domain: the version that palpate-train writes, and the next,
whose operators hardly differ."""
FORMATS = range(8, 10)
"""Versions of the file (IR version), likewise."""
NOTES = ("onnx.infer", "onnx.quant.pre_process")
"""Metadata that onnxruntime's quantization writes into a model."""
MOST_FILE = MOST_TENSOR = MOST_BYTES
MOST_NODES, MOST_CONSTANTS = 1000, 2000
"""Largest numbers of nodes and constants: three times the numbers of MiniRocket, our largest
graph. onnxruntime takes a kilobyte or two for each."""
MOST_RANK = 8
"""Most dimensions of a tensor; tensors of our models have up to five."""
MOST_INT8 = 64
"""Largest weight in int8. With unsigned values, two products of a larger one overflow 16 bits on
an x86 with AVX2 and without VNNI, and -128 gives wrong sums on Arm (onnxruntime 1.31.1, 1.32.0)."""
MOST_LETTERS = 400
"""Longest error text in a message; its names and lists come from the file."""
KEEP_INDEX = ("Reshape", "Flatten")
"""Operators whose result of an INDEX is an INDEX."""
Shape = tuple[int, ...]
ShapePattern = Sequence[int | None]
"""A shape; None means any number."""
CONSTANTS = ("float32", "uint8", "int8", "int16", "int32", "int64")
"""Types of constants. Values of other types only come from the sweep or from a comparison."""


@dataclass(frozen=True, slots=True)
class Value:
    """A tensor. kind: type, of KINDS, or INDEX. varies: whether it depends on the sweep. constant:
    in the file."""

    kind: str
    varies: bool = False
    constant: Message | None = None


def check(
    model: bytes,
    manifest: Manifest,
    features: int | None = None,
    enrolled: int = 0,
    rank: int | None = None,
) -> None:
    """Raises BundleError if `model` must not be tried in a bundle with this manifest.

    features: number of features of the input if it is not raw counts. enrolled: number of labels
    that the model does not have. rank: length of the embedding. None means any number above 0.
    """
    try:
        need(len(model) <= MOST_FILE, f"it has {len(model)} bytes (limit {MOST_FILE})")
        read = reader.read(model)
        _versions(read)
        need(read.graph is not None, "it has no graph")
        _takes(read.graph, manifest, features)
        _gives(read.graph, _followed(read.graph), manifest, enrolled, rank)
    except BundleError as e:
        raise BundleError(
            f"the model must not be opened: {str(e)[:MOST_LETTERS]}; export the bundle again"
        ) from e


def _versions(read: Message) -> None:
    """Raises BundleError for other versions of the file or its operators, and for other domains."""
    need(read.ir_version in FORMATS, f"IR version {read.ir_version} is none of {list(FORMATS)}")
    domains = [opset.domain for opset in read.opset_import]
    need(
        len(domains) == len(set(domains)) and "" in domains,
        f"domains {domains} must be '' and others, each once",
    )
    for opset in read.opset_import:
        known = VERSIONS.get(opset.domain, range(0))
        need(
            opset.version in known,
            f"domain {opset.domain[:80]!r}, version {opset.version}: not in {list(known)}",
        )
    for note in read.metadata_props:
        need(note.key in NOTES, f"metadata {note.key[:80]!r} is none of {', '.join(NOTES)}")


def _takes(graph: Message, manifest: Manifest, features: int | None) -> None:
    """Raises BundleError unless the only input is the input of the manifest."""
    need(len(graph.input) == 1, f"it has {len(graph.input)} inputs instead of one")
    kind, shape = _declared(graph.input[0])
    f = manifest.format
    want, pattern = (
        (f.dtype, (1, f.window, *f.shape))
        if manifest.input == "raw"
        else ("float32", (1, features))
    )
    need(
        kind == want and fits(shape, pattern),
        f"it takes {kind} {list(shape)}, the manifest has {want} {list(pattern)}",
    )


def _followed(graph: Message) -> dict[str, Value]:
    """All values of the graph by name: input, constants, outputs of nodes."""
    for what, have, most in (
        ("nodes", graph.node, MOST_NODES),
        ("constants", graph.initializer, MOST_CONSTANTS),
    ):
        need(len(have) <= most, f"it has {len(have)} {what} (limit {most})")
    (declared,) = graph.input
    known = {declared.name: Value(_declared(declared)[0], varies=True)}
    for tensor in graph.initializer:
        need(tensor.name not in known, f"{tensor.name[:80]!r} is there twice")
        known[tensor.name] = _constant(tensor, tensor.name[:80])
    for number, node in enumerate(graph.node):
        try:
            _follow(node, known)
        except BundleError as e:
            raise BundleError(
                f"node {number} {node.name[:80]!r} ({node.op_type[:80]!r}): {e}"
            ) from e
    return known


def fits(shape: Sequence[int], pattern: ShapePattern) -> bool:
    """Whether a shape is that of a pattern."""
    return len(shape) == len(pattern) and all(
        want in (None, n) for n, want in zip(shape, pattern, strict=True)
    )


def _constant(tensor: Message, name: str) -> Value:
    """A constant. onnxruntime compares its numbers with its sizes."""
    kind = KINDS.get(tensor.data_type, "")
    need(
        kind in CONSTANTS,
        f"constant {name!r} is of type {kind or tensor.data_type}, none of {', '.join(CONSTANTS)}",
    )
    _bounded(name, kind, tuple(tensor.dims))
    if kind == "int8":
        raw, listed = np.frombuffer(tensor.raw_data or b"", np.int8), tensor.int32_data or ()
        least = min(int(raw.min(initial=0)), *listed, 0)
        most = max(int(raw.max(initial=0)), *listed, 0)
        need(
            -MOST_INT8 <= least <= most <= MOST_INT8,
            f"weights {name!r} are {least} to {most}, beyond {MOST_INT8} (seven bits), with which "
            "processors compute different sums",
        )
    return Value(kind, constant=tensor)


def _bounded(name: str, kind: str, shape: Shape) -> None:
    """Raises BundleError if a tensor has no name or a size that is not allowed."""
    need(
        name != "" and len(shape) <= MOST_RANK,
        f"{name[:80]!r} has {len(shape)} dimensions or no name",
    )
    need(
        all(n > 0 for n in shape),
        f"{name[:80]!r} has the shape {list(shape)}, which holds nothing",
    )
    size = prod(shape) * np.dtype(kind).itemsize
    need(
        size <= MOST_TENSOR,
        f"{name[:80]!r} of {list(shape)} has {size} bytes (limit {MOST_TENSOR})",
    )


def _follow(node: Message, known: dict[str, Value]) -> None:
    """Adds the outputs of a node to `known`."""
    operator = OPERATORS.get((node.domain, node.op_type))
    if operator is None:
        raise BundleError(f"there is no such operator of domain {node.domain[:80]!r} for a bundle")
    need(operator.least <= len(node.input) <= operator.most, f"it has {len(node.input)} inputs")
    need(
        len(node.output) == len(operator.gives),
        f"it has {len(node.output)} outputs instead of {len(operator.gives)}",
    )
    for name in node.input:
        need(name in known, f"no node before it gives {name[:80]!r}")
    inputs = [known[name] for name in node.input]
    for i, x in enumerate(inputs):
        allowed = operator.kinds[min(i, len(operator.kinds) - 1)]
        need(x.kind in allowed, f"input {i + 1} is of type {x.kind}, not {' or '.join(allowed)}")
        decides = i >= operator.fixed
        need(not (decides and x.varies), f"input {i + 1} decides a size, but is not a constant")
    given = _settings(node, operator.settings)
    operators.check_settings(node.op_type, given)
    if node.op_type == "Mod":
        _check_divisors(inputs[1])
    varies = any(x.varies for x in inputs)
    for name, kind in zip(node.output, operator.gives, strict=True):
        need(name != "" and name not in known, f"{name[:80]!r} is made twice, or has no name")
        if node.op_type == "Cast":
            need(given.get("to") in KINDS, f"it casts to type {given.get('to')}")
            kind = KINDS[given["to"]]
        if kind == SAME:
            kind = inputs[0].kind
            kind = "int64" if kind == INDEX and node.op_type not in KEEP_INDEX else kind
        known[name] = Value(kind, varies)


def _check_divisors(by: Value) -> None:
    """Raises BundleError unless the divisors of Mod are constants of the file above 0."""
    held: Any = by.constant
    need(held is not None, "its divisors are not a constant of the file")
    raw = held.raw_data or b""
    numbers = [*np.frombuffer(raw[: len(raw) // 8 * 8], "<i8").tolist(), *(held.int64_data or ())]
    need(bool(numbers) and min(numbers) > 0, f"its divisors {numbers[:8]} must be above 0")


def _settings(node: Message, allowed: Mapping[str, int]) -> dict[str, Any]:
    """A node's settings by name. Raises BundleError for a setting or a type that is not in
    `allowed`."""
    found: dict[str, Any] = {}
    for a in node.attribute:
        name, code = a.name[:80], a.type
        need(a.name not in found, f"{name!r} is set twice")
        need(
            code == allowed.get(a.name), f"setting {name!r} of type {code} is none that it may have"
        )
        there = {
            operators.FLOAT: a.f,
            operators.INT: a.i,
            operators.TEXT: a.s,
            operators.TENSOR: a.t,
            operators.FLOATS: a.floats,
            operators.INTS: a.ints or None,
        }
        need(
            [c for c, value in there.items() if value is not None] == [code],
            f"{name!r} is not as its type has it",
        )
        need(code != operators.FLOAT or isfinite(a.f), f"{name} = {a.f}")
        found[a.name] = there[code]
        if code == operators.TEXT:
            found[a.name] = bytes(a.s)
        if code == operators.TENSOR:
            need(_constant(a.t, name).kind == "float32", f"{name} must be one float")
    return found


def _declared(declared: Message) -> tuple[str, Shape]:
    """Type and shape of a value as the file declares them."""
    held = declared.type.tensor_type if declared.type else None
    if held is None or held.shape is None or held.elem_type not in KINDS:
        raise BundleError(f"{declared.name[:80]!r} has no type and shape of a tensor")
    sizes = [d.dim_value for d in held.shape.dim]
    need(
        None not in sizes,
        f"{declared.name[:80]!r} has the shape {sizes}; every size must be a number",
    )
    _bounded(declared.name, KINDS[held.elem_type], tuple(sizes))
    return KINDS[held.elem_type], tuple(sizes)


def expected(
    manifest: Manifest, enrolled: int = 0, rank: int | None = None
) -> dict[str, ShapePattern]:
    """The shapes of all outputs that a model may have. Parameters as of `check`."""
    trained = len(manifest.labels) - enrolled
    steps = len(manifest.early.least) if manifest.early else None
    return {
        "logits": (1, trained),
        "early": (1, steps, trained),
        "early_embedding": (1, steps, rank),
        "embedding": (1, rank),
    }


def _gives(
    graph: Message, known: dict[str, Value], manifest: Manifest, enrolled: int, rank: int | None
) -> None:
    """Raises BundleError unless the outputs are all that the manifest needs, and every output is
    allowed and declared with the right shape."""
    early, names = manifest.early, [declared.name for declared in graph.output]
    patterns = expected(manifest, enrolled, rank)
    needed = (
        {"logits"}
        | ({"early"} if early else set())
        | ({"early_embedding"} if early and early.limits else set())
        | ({"embedding"} if manifest.known else set())
    )
    need(
        len(names) == len(set(names)) and needed <= set(names) <= patterns.keys(),
        f"it gives {names[:9]}; the manifest needs {', '.join(sorted(needed))} and allows "
        f"{', '.join(patterns)}",
    )
    for declared in graph.output:
        name, (kind, shape) = declared.name, _declared(declared)
        need(name in known, f"no node gives the output {name!r}")
        have = known[name]
        need(
            have.kind == kind == "float32",
            f"{name} is {have.kind} and declared as {kind}, not float32",
        )
        need(have.varies, f"{name} does not depend on the sweep")
        new = f", {enrolled} of them enrolled" if enrolled else ""
        need(
            fits(shape, patterns[name]) and (name != "logits" or shape[1] > 1),
            f"{name} is {list(shape)} instead of {list(patterns[name])}; the manifest has "
            f"{len(manifest.labels)} labels{new}",
        )
