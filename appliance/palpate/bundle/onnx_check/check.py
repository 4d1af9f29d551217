"""Decides whether onnxruntime may open a model; a BundleError gives the node, tensor and value.

A model that passes can neither read beside its arrays nor take more memory or time than the caps
below. The shape of every value is computed node by node, and every size is a constant of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, prod
from typing import TYPE_CHECKING, Any

import numpy as np

from palpate.bundle.onnx_check import operators, reader
from palpate.bundle.onnx_check.operators import OPERATORS
from palpate.bundle.onnx_check.reader import Message
from palpate.bundle.onnx_check.shapes import (
    INDEX,
    KINDS,
    MOST_RANK,
    Call,
    Out,
    Shape,
    Value,
    need,
)
from palpate.core.errors import BundleError

if TYPE_CHECKING:
    from palpate.bundle.manifest import Manifest

VERSIONS = {"": range(17, 19), "ai.onnx.ml": range(3, 4), "com.microsoft": range(1, 2)}
"""Versions of the operators of each domain: the version that train/ writes, and the next, whose
operators hardly differ."""
FORMATS = range(8, 10)
"""Versions of the file (IR version), likewise."""
NOTES = ("onnx.infer", "onnx.quant.pre_process")
"""Metadata that onnxruntime's quantization writes into a model."""
MOST_NODES, MOST_CONSTANTS = 1000, 2000
"""Largest numbers of nodes and constants: three times those of MiniRocket, our largest graph.
onnxruntime takes a kilobyte or two for each."""
MOST_TENSOR = 64 << 20
"""Bytes of one tensor. Our largest are the weights of the paper's CNN in int8, 63 MB after
conversion to floats."""
MOST_MEMORY = 160 << 20
"""Bytes of a whole model as `_Cost` counts them. Our largest: the paper's CNN in int8 151 MB,
MiniRocket 93 MB. onnxruntime never took more than this count and 9 MB for itself, so the service
stays below its MemoryMax of 256 MB."""
COPIES = 3
"""Copies of a constant in memory: in the parsed file, as a tensor, and laid out for the
processor."""
MOST_WORK = 2_000_000_000
"""Largest number of products, plus TOUCH for every number read or written: seconds on a small
board. At 1500 frames of 16 taxels MiniRocket needs 0.96e9, the paper's CNN in int8 0.88e9."""
TOUCH = 8
"""Number of products that take as long as reading or writing one number in the slowest
operators."""
MOST_LETTERS = 400
"""Longest error text in a message; its names and lists come from the file."""
ShapePattern = Sequence[int | None]
"""A shape; None means any number."""
CONSTANTS = ("float32", "uint8", "int8", "int16", "int32", "int64")
"""Types of constants. Values of other types only come from the sweep or from a comparison."""


@dataclass(slots=True)
class _Cost:
    """Memory and work of a model.

    bytes: the file, COPIES of each constant and of each value computed from constants alone, and
    all values computed from the sweep, as if no memory were reused. workspace: the largest
    workspace of a node, in bytes. work: see MOST_WORK.
    """

    bytes: int
    work: int = 0
    workspace: int = 0

    def add(self, name: str, call: Call, made: list[Value]) -> None:
        """Add one node. Raises BundleError beyond a cap."""
        products, workspace = operators.work(name, call, made[0].shape)
        self.work += products + TOUCH * sum(prod(v.shape) for v in (*call.inputs, *made))
        self.workspace = max(self.workspace, workspace)
        self.bytes += sum(
            _bytes(v) * (1 if v.depends_on_sweep or name == "DequantizeLinear" else COPIES)
            for v in made
        )
        total = self.bytes + self.workspace
        need(
            total <= MOST_MEMORY,
            f"up to here it needs {total} bytes of memory (limit {MOST_MEMORY})",
        )
        need(
            self.work <= MOST_WORK, f"up to here it needs {self.work} products (limit {MOST_WORK})"
        )


def check(
    model: bytes,
    manifest: Manifest,
    features: int | None = None,
    enrolled: int = 0,
    rank: int | None = None,
) -> int:
    """Upper bound of the bytes of memory that `model` needs, counted as for MOST_MEMORY.

    Raises BundleError if the box must not run `model` in a bundle with this manifest. Inputs and
    outputs are checked here alone.

    features: number of features of the input if it is not raw counts. enrolled: number of labels
    that the model does not have. rank: length of the embedding. None means any number above 0.
    """
    try:
        need(len(model) <= MOST_MEMORY, f"it has {len(model)} bytes (limit {MOST_MEMORY})")
        read = reader.read(model)
        _versions(read)
        need(read.graph is not None, "it has no graph")
        _takes(read.graph, manifest, features)
        known, cost = _followed(read.graph, len(model))
        for declared in (*read.graph.value_info, *read.graph.output):
            _agree(declared, known)
        _gives([declared.name for declared in read.graph.output], known, manifest, enrolled, rank)
    except BundleError as e:
        raise BundleError(
            f"the model must not be opened: {str(e)[:MOST_LETTERS]}; export the bundle again"
        ) from e
    return cost.bytes + cost.workspace


def _bytes(value: Value) -> int:
    return prod(value.shape) * np.dtype(value.kind).itemsize


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
    fits = kind == want and _fits(shape, pattern)
    need(fits, f"it takes {kind} {list(shape)}, the manifest has {want} {list(pattern)}")


def _followed(graph: Message, size: int) -> tuple[dict[str, Value], _Cost]:
    """All values of the graph by name (input, constants, outputs of nodes), and its cost. size:
    bytes of the file."""
    for what, have, most in (
        ("nodes", graph.node, MOST_NODES),
        ("constants", graph.initializer, MOST_CONSTANTS),
    ):
        need(len(have) <= most, f"it has {len(have)} {what} (limit {most})")
    (declared,) = graph.input
    known = {
        declared.name: _bounded(declared.name, Value(*_declared(declared), depends_on_sweep=True))
    }
    for tensor in graph.initializer:
        need(tensor.name not in known, f"{tensor.name[:80]!r} is there twice")
        known[tensor.name] = _constant(tensor, tensor.name[:80])
    cost = _Cost(size + COPIES * sum(_bytes(v) for v in known.values()))
    for number, node in enumerate(graph.node):
        try:
            _follow(node, known, cost)
        except BundleError as e:
            raise BundleError(
                f"node {number} {node.name[:80]!r} ({node.op_type[:80]!r}): {e}"
            ) from e
    return known, cost


def _fits(shape: Shape, pattern: ShapePattern) -> bool:
    return len(shape) == len(pattern) and all(
        want in (None, n) for n, want in zip(shape, pattern, strict=True)
    )


def _constant(tensor: Message, name: str) -> Value:
    """The Value of a constant; its numbers are not copied from the file where that is possible."""
    kind = KINDS.get(tensor.data_type, "")
    need(
        kind in CONSTANTS,
        f"constant {name!r} is of type {kind or tensor.data_type}, none of {', '.join(CONSTANTS)}",
    )
    value = _bounded(name, Value(kind, tuple(tensor.dims)))
    field = {"float32": "float_data", "int64": "int64_data"}.get(kind, "int32_data")
    numbers = {
        "float_data": tensor.float_data,
        "int32_data": tensor.int32_data,
        "int64_data": tensor.int64_data,
    }
    filled = [f for f, held in numbers.items() if held is not None and len(held)]
    need(set(filled) <= {field}, f"constant {name!r} has numbers of another type")
    need(not (filled and tensor.raw_data), f"constant {name!r} has its numbers twice")
    if not filled:
        raw = tensor.raw_data or b""
        need(
            len(raw) == _bytes(value),
            f"constant {name!r} has {len(raw)} bytes, not {_bytes(value)}",
        )
        return replace(
            value, numbers=np.frombuffer(raw, np.dtype(kind).newbyteorder("<")).reshape(value.shape)
        )
    typed: Any = numbers[field]
    need(
        len(typed) == prod(value.shape),
        f"constant {name!r} has {len(typed)} numbers, not {prod(value.shape)}",
    )
    if kind != "float32":
        limits = np.iinfo(kind)
        fits = limits.min <= min(typed) and max(typed) <= limits.max
        need(fits, f"constant {name!r} has a number that is not {kind}")
    return replace(value, numbers=np.asarray(typed, kind).reshape(value.shape))


def _bounded(name: str, value: Value) -> Value:
    """`value`. Raises BundleError if it has no name or a size that is not allowed."""
    need(
        name != "" and len(value.shape) <= MOST_RANK,
        f"{name[:80]!r} has {len(value.shape)} dimensions or no name",
    )
    need(
        all(n > 0 for n in value.shape),
        f"{name[:80]!r} has the shape {list(value.shape)}, which holds nothing",
    )
    size = _bytes(value)
    need(
        size <= MOST_TENSOR,
        f"{name[:80]!r} of {list(value.shape)} has {size} bytes (limit {MOST_TENSOR})",
    )
    return value


def _follow(node: Message, known: dict[str, Value], cost: _Cost) -> None:
    """Adds the outputs of a node to `known`, and its memory and work to `cost`."""
    operator = OPERATORS.get((node.domain, node.op_type))
    if operator is None:
        raise BundleError(f"there is no such operator of domain {node.domain[:80]!r} for a bundle")
    need(operator.least <= len(node.input) <= operator.most, f"it has {len(node.input)} inputs")
    for name in node.input:
        need(name in known, f"no node before it gives {name[:80]!r}")
    inputs = [known[name] for name in node.input]
    for i, x in enumerate(inputs):
        allowed = operator.kinds[min(i, len(operator.kinds) - 1)]
        need(x.kind in allowed, f"input {i + 1} is of type {x.kind}, not {' or '.join(allowed)}")
    call = Call(inputs, _settings(node, operator.settings))
    given = operator.rule(call)
    outs: list[Out] = given if isinstance(given, list) else [given]
    need(len(node.output) == len(outs), f"it has {len(node.output)} outputs instead of {len(outs)}")
    depends = any(x.depends_on_sweep for x in inputs)
    made = [
        Value("int64" if kind == INDEX else kind, shape, None, depends, kind == INDEX)
        for kind, shape in outs
    ]
    for name, value in zip(node.output, made, strict=True):
        need(name not in known, f"{name[:80]!r} is made twice")
        known[name] = _bounded(name, value)
    cost.add(node.op_type, call, made)


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
            found[a.name] = _constant(a.t, name)
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
    return KINDS[held.elem_type], tuple(sizes)


def _agree(declared: Message, known: dict[str, Value]) -> None:
    """Raises BundleError if the declared type or shape of a value differs from the computed one.
    Quantization leaves declarations of values that no longer exist."""
    if declared.name in known:
        (kind, shape), have = _declared(declared), known[declared.name]
        need(
            (kind, shape) == (have.kind, have.shape),
            f"{declared.name[:80]!r} is declared as {kind} {list(shape)} and is {have.kind} "
            f"{list(have.shape)}",
        )


def _gives(
    names: list[str], known: dict[str, Value], manifest: Manifest, enrolled: int, rank: int | None
) -> None:
    """Raises BundleError unless the outputs are all that the manifest needs, and every output is
    allowed and has the right shape."""
    early, labels = manifest.early, len(manifest.labels)
    trained = labels - enrolled
    patterns: dict[str, ShapePattern] = {
        "logits": (1, trained),
        "early": (1, len(early.least) if early else None, trained),
        "early_embedding": (1, len(early.least) if early else None, rank),
        "embedding": (1, rank),
    }
    needed = (
        {"logits"}
        | ({"early"} if early else set())
        | ({"early_embedding"} if early and early.limits else set())
        | ({"embedding"} if manifest.known else set())
    )
    asked = f"the manifest needs {', '.join(sorted(needed))} and allows {', '.join(patterns)}"
    need(
        len(names) == len(set(names)) and needed <= set(names) <= patterns.keys(),
        f"it gives {names[:9]}; {asked}",
    )
    for name in names:
        need(name in known, f"no node gives the output {name!r}")
        have, axes = known[name], len(patterns[name])
        need(
            have.kind == "float32"
            and have.depends_on_sweep
            and have.shape[:1] == (1,)
            and len(have.shape) == axes,
            f"{name} is {have.kind} {list(have.shape)}, not float32 with {axes} dimensions, the "
            "first 1",
        )
    classes = known["logits"].shape[1]
    new = f", {enrolled} of them enrolled" if enrolled else ""
    need(
        1 < classes == trained,
        f"it tells {classes} materials apart, the manifest has {labels} labels{new}",
    )
    for name in names:
        shape, pattern = known[name].shape, patterns[name]
        need(_fits(shape, pattern), f"{name} is {list(shape)} instead of {list(pattern)}")
