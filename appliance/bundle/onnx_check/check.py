"""The room of the graph: what the box demands of a model before onnxruntime may open it. In: the bytes of an ONNX file
and the bundle's manifest. Out: nothing, or BundleError naming node, tensor and value.

The file is parsed here and each node is followed by its shapes: allowed operators only, one input and the outputs of the
manifest, every size a constant, and caps on each tensor, on all memory and on all work. So a model can be wrong, but it
can neither read beside its arrays, nor fill the box's memory, nor keep it busy without end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, prod
from typing import TYPE_CHECKING, Any

import numpy as np

from appliance.bundle.onnx_check import messages, operators, reader
from appliance.bundle.onnx_check.operators import OPERATORS
from appliance.bundle.onnx_check.shapes import KINDS, MOST_RANK, PLACE, Call, Out, Value, need
from appliance.core.errors import BundleError

if TYPE_CHECKING:
    from appliance.bundle.manifest import Manifest

VERSIONS = {"": range(17, 19), "ai.onnx.ml": range(3, 4), "com.microsoft": range(1, 2)}
"""Of the operators of each domain: what train/ writes, and the next, by which the operators here differ little."""
FORMATS = range(8, 10)
"""Of the file (IR version), likewise."""
NOTES = ("onnx.infer", "onnx.quant.pre_process")
"""What onnxruntime's quantization writes about a model."""
MOST_NODES, MOST_CONSTANTS = 1000, 2000
"""Three times MiniRocket's, the longest of our own; onnxruntime takes a kilobyte or two for each."""
MOST_TENSOR = 64 << 20
"""Bytes of one tensor. The largest of our own are the weights of the paper's CNN in int8, 63 MB once they are floats."""
MOST_MEMORY = 160 << 20
"""Bytes of all of a model by the account of `_Bill`. Our own largest: the paper's CNN in int8 151 MB, MiniRocket 93 MB.
onnxruntime never took more than this account, and 9 MB for itself; so the box stays below 256 MB whatever it is given."""
COPIES = 3
"""Of a constant in memory: in the parsed file, as a tensor, and laid out for the processor."""
MOST_WORK = 2_000_000_000
"""Products, and TOUCH for every number read or written: seconds on a small board. At 1500 frames of 16 taxels MiniRocket
needs 0.96e9, the paper's CNN in int8 0.88e9."""
TOUCH = 8
"""Products that take as long as reading or writing a number, in the slowest operators."""
MOST_LETTERS = 400
"""Of what is wrong: names and lists come from the file."""
CONSTANTS = ("float32", "uint8", "int8", "int32", "int64")
"""Types of constants; the others only come in by the sweep, or out of a comparison."""
OUTPUTS = {"logits": 2, "early": 3, "embedding": 2}
"""Dimensions of what a model may give."""


@dataclass(slots=True)
class _Bill:
    """What a model costs. bytes: of the file, COPIES of each constant and of what comes of constants alone, all that a
    sweep moves, as if nothing were ever given back, and the largest workspace of a node. work: see MOST_WORK."""

    bytes: int
    work: int = 0
    room: int = 0

    def add(self, name: str, call: Call, made: list[Value]) -> None:
        """One node more."""
        products, room = operators.work(name, call, made[0].shape)
        self.work += products + TOUCH * sum(prod(v.shape) for v in (*call.inputs, *made))
        self.room = max(self.room, room)
        self.bytes += sum(_bytes(v) * (1 if v.moved or name == "DequantizeLinear" else COPIES) for v in made)
        total = self.bytes + self.room
        need(total <= MOST_MEMORY, f"up to here it needs {total} bytes of memory (limit {MOST_MEMORY})")
        need(self.work <= MOST_WORK, f"up to here it needs {self.work} products (limit {MOST_WORK})")


def check(model: bytes, manifest: Manifest) -> None:
    """Raises BundleError where `model` is not an ONNX file that the box may run as the model of a bundle like this."""
    try:
        need(len(model) <= MOST_MEMORY, f"it has {len(model)} bytes (limit {MOST_MEMORY})")
        read = reader.read(model)
        _versions(read)
        graph = read.graph or messages.Graph()
        for what, have, most in ("nodes", graph.node, MOST_NODES), ("constants", graph.initializer, MOST_CONSTANTS):
            need(len(have) <= most, f"it has {len(have)} {what} (limit {most})")
        known = _given(graph, manifest)
        bill = _Bill(len(model) + COPIES * sum(_bytes(v) for v in known.values()))
        for number, node in enumerate(graph.node):
            try:
                _follow(node, known, bill)
            except BundleError as e:
                what = f"node {number} {node.name[:80]!r} ({node.op_type[:80]!r})"
                raise BundleError(f"{what}: {e}") from e
        for declared in graph.output:
            need(declared.name in known, f"no node gives the output {declared.name[:80]!r}")
        for declared in (*graph.value_info, *graph.output):
            _agree(declared, known)
        _outputs([declared.name for declared in graph.output], known, manifest)
    except BundleError as e:
        raise BundleError(f"the model must not be opened: {str(e)[:MOST_LETTERS]}; export the bundle again") from e


def _bytes(value: Value) -> int:
    return prod(value.shape) * np.dtype(value.kind).itemsize


def _versions(read: messages.Model) -> None:
    """The versions of file and operators, and nothing of another domain."""
    need(read.ir_version in FORMATS, f"IR version {read.ir_version} is none of {list(FORMATS)}")
    domains = [opset.domain for opset in read.opset_import]
    need(len(domains) == len(set(domains)) and "" in domains, f"domains {domains} must be '' and others, each once")
    for opset in read.opset_import:
        known = VERSIONS.get(opset.domain, range(0))
        need(opset.version in known, f"domain {opset.domain[:80]!r}, version {opset.version}: not in {list(known)}")
    for note in read.metadata_props:
        need(note.key in NOTES, f"metadata {note.key[:80]!r} is none of {', '.join(NOTES)}")


def _given(graph: messages.Graph, manifest: Manifest) -> dict[str, Value]:
    """What is there before the first node, by name: the input and the constants."""
    need(len(graph.input) == 1, f"it has {len(graph.input)} inputs instead of one")
    (declared,) = graph.input
    kind, shape = _declared(declared)
    f = manifest.format
    raw = manifest.input == "raw"
    want = (f.dtype, (1, f.window, f.rows, f.cols)) if raw else ("float32", (1, shape[-1] if shape else 0))
    need((kind, shape) == want, f"it takes {kind} {list(shape)}, the manifest has {want[0]} {list(want[1])}")
    known = {declared.name: _bounded(declared.name, Value(kind, shape, moved=True))}
    for tensor in graph.initializer:
        need(tensor.name not in known, f"{tensor.name[:80]!r} is there twice")
        known[tensor.name] = _constant(tensor, tensor.name[:80])
    return known


def _constant(tensor: messages.Tensor, name: str) -> Value:
    """A constant, whose numbers stay in the file."""
    kind = KINDS.get(tensor.data_type, "")
    need(kind in CONSTANTS, f"constant {name!r} is of type {kind or tensor.data_type}, none of {', '.join(CONSTANTS)}")
    value = _bounded(name, Value(kind, tuple(tensor.dims)))
    fields: dict[str, Any] = {"float32": tensor.floats, "int64": tensor.int64s}
    typed = fields.get(kind, tensor.int32s)
    others = [f for f in (tensor.floats, tensor.int32s, tensor.int64s) if f is not typed]
    need(not any(f is not None and len(f) for f in others), f"constant {name!r} has numbers of another type")
    here = typed is not None and len(typed) > 0
    need(not (here and tensor.raw), f"constant {name!r} has its numbers twice")
    if not here:
        need(len(tensor.raw) == _bytes(value), f"constant {name!r} has {len(tensor.raw)} bytes, not {_bytes(value)}")
        return replace(value, numbers=np.frombuffer(tensor.raw, np.dtype(kind).newbyteorder("<")).reshape(value.shape))
    need(len(typed) == prod(value.shape), f"constant {name!r} has {len(typed)} numbers, not {prod(value.shape)}")
    if kind != "float32":
        ends = np.iinfo(kind)
        need(ends.min <= min(typed) and max(typed) <= ends.max, f"constant {name!r} has a number that is no {kind}")
    return replace(value, numbers=np.asarray(typed, kind).reshape(value.shape))


def _bounded(name: str, value: Value) -> Value:
    """A tensor of a size that may be."""
    need(name != "" and len(value.shape) <= MOST_RANK, f"{name[:80]!r} has {len(value.shape)} dimensions or no name")
    need(all(n > 0 for n in value.shape), f"{name[:80]!r} has the shape {list(value.shape)}, which holds nothing")
    need(
        _bytes(value) <= MOST_TENSOR,
        f"{name[:80]!r} of {list(value.shape)} has {_bytes(value)} bytes (limit {MOST_TENSOR})",
    )
    return value


def _follow(node: messages.Node, known: dict[str, Value], bill: _Bill) -> None:
    """What a node gives is known then, and paid."""
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
    moved = any(x.moved for x in inputs)
    made = [Value("int64" if kind == PLACE else kind, shape, None, moved, kind == PLACE) for kind, shape in outs]
    for name, value in zip(node.output, made, strict=True):
        need(name not in known, f"{name[:80]!r} is made twice")
        known[name] = _bounded(name, value)
    bill.add(node.op_type, call, made)


def _settings(node: messages.Node, allowed: Mapping[str, int]) -> dict[str, Any]:
    """A node's settings by name, each of the type that it must have."""
    found: dict[str, Any] = {}
    for a in node.attribute:
        name, code = a.name[:80], a.type
        need(a.name not in found, f"{name!r} is set twice")
        need(code == allowed.get(a.name), f"setting {name!r} of type {code} is none that it may have")
        there: dict[int, Any] = {operators.FLOAT: a.f, operators.INT: a.i, operators.TEXT: a.s, operators.TENSOR: a.t,
                                 operators.FLOATS: a.floats, operators.INTS: a.ints or None}  # fmt: skip
        need([c for c, value in there.items() if value is not None] == [code], f"{name!r} is not as its type has it")
        need(code != operators.FLOAT or isfinite(a.f or 0), f"{name} = {a.f}")
        found[a.name] = there[code]
        if code == operators.TEXT:
            found[a.name] = bytes(there[code])
        if code == operators.TENSOR:
            found[a.name] = _constant(there[code], name)
    return found


def _declared(declared: messages.Declared) -> tuple[str, tuple[int, ...]]:
    """Type and shape of a value as the file names them."""
    held = declared.type.tensor_type if declared.type else None
    if held is None or held.shape is None or held.elem_type not in KINDS:
        raise BundleError(f"{declared.name[:80]!r} has no type and shape of a tensor")
    sizes = [d.dim_value for d in held.shape.dim]
    if None in sizes:
        raise BundleError(f"{declared.name[:80]!r} has the shape {sizes}; every size must be a number")
    return KINDS[held.elem_type], tuple(n for n in sizes if n is not None)


def _agree(declared: messages.Declared, known: dict[str, Value]) -> None:
    """What the file says of a value is what comes of its nodes; quantization leaves notes on values that are gone."""
    if declared.name in known:
        (kind, shape), have = _declared(declared), known[declared.name]
        what = f"{declared.name[:80]!r} is declared as {kind} {list(shape)} and is {have.kind} {list(have.shape)}"
        need((kind, shape) == (have.kind, have.shape), what)


def _outputs(names: list[str], known: dict[str, Value], manifest: Manifest) -> None:
    """The outputs that the manifest needs, and no other than may be."""
    needed = {"logits"} | ({"early"} if manifest.early else set()) | ({"embedding"} if manifest.known else set())
    asked = f"the manifest needs {', '.join(sorted(needed))} and allows {', '.join(OUTPUTS)}"
    need(len(names) == len(set(names)) and needed <= set(names) <= OUTPUTS.keys(), f"it gives {names[:9]}; {asked}")
    for name in names:
        have, form = known[name], OUTPUTS[name]
        need(have.kind == "float32" and have.moved and have.shape[:1] == (1,) and len(have.shape) == form,
             f"{name} is {have.kind} {list(have.shape)}, not float32 with {form} dimensions, the first 1")  # fmt: skip
    classes, labels = known["logits"].shape[1], len(manifest.labels)
    need(1 < classes <= labels, f"it tells {classes} materials apart, the manifest has {labels} labels")
    if "early" in names:
        steps = len(manifest.early.least) if manifest.early else known["early"].shape[1]
        said, want = known["early"].shape, (1, steps, classes)
        need(said == want, f"early is {list(said)} instead of {list(want)}")
