"""What of a model some of its outputs need. In: the bytes of a model that onnx_check has accepted,
names of outputs. Out: the bytes of a model with these outputs alone.

onnxruntime computes every node of a graph, whichever outputs are requested. Fields are copied as
they stand in the file or left out, so that nothing runs that was not checked.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from appliance.bundle.onnx_check import reader
from appliance.bundle.onnx_check.reader import Message
from appliance.core.errors import BundleError

GRAPH = 7
"""Number of the field `graph` of a model; all others are copied."""
HELD = {1: "node", 5: "initializer", 12: "output", 13: "value_info"}
"""By number: the fields of a graph of which some are left out."""


def prune(model: bytes, outputs: Collection[str]) -> bytes:
    """`model` without the outputs that are not in `outputs`, and without the nodes and constants
    that only they need.

    It is returned as it is where it has no others. Raises BundleError where it does not give one of
    them, or is no ONNX file.
    """
    graph = reader.read(model).graph
    given = {output.name for output in graph.output} if graph else set()
    if missing := set(outputs) - given:
        raise BundleError(
            f"the model gives {sorted(given)}, not {sorted(missing)}; export the bundle again"
        )
    if given == set(outputs):
        return model
    needed = _needed(graph.node, outputs)
    names = {
        "node": [node.output for node in graph.node],
        **{
            field: [[one.name] for one in getattr(graph, field)]
            for field in ("initializer", "value_info")
        },
        "output": [[output.name] if output.name in outputs else [] for output in graph.output],
    }
    pruned = bytearray()
    for number, whole, content in reader.fields(model):
        pruned += (
            _field(GRAPH, _without(model[content], names, needed))
            if number == GRAPH
            else model[whole]
        )
    return bytes(pruned)


def _needed(nodes: Iterable[Message], outputs: Collection[str]) -> set[str]:
    """Names of the values that `outputs` are computed from, and their own. Nodes stand in the order
    of computing."""
    needed = set(outputs)
    for node in reversed(list(nodes)):
        if needed.intersection(node.output):
            needed.update(node.input, node.output)
    return needed


def _without(graph: bytes, names: dict[str, list[list[str]]], needed: set[str]) -> bytes:
    """`graph` without the fields of HELD that name nothing of `needed`. names: of each of them, in
    the file's order."""
    left = {field: iter(of) for field, of in names.items()}
    kept = bytearray()
    for number, whole, _ in reader.fields(graph):
        if number not in HELD or needed.intersection(next(left[HELD[number]])):
            kept += graph[whole]
    return bytes(kept)


def _field(number: int, content: bytes) -> bytes:
    """A field that holds `content` behind its length, as protobuf writes it."""
    size, length = len(content), bytearray()
    while size > 127:
        length.append(size & 127 | 128)
        size >>= 7
    return bytes([number << 3 | reader.BYTES, *length, size]) + content
