"""Removes outputs from a model that onnx_check has accepted, with all nodes that only they need.

onnxruntime computes every node of a graph, whichever outputs are requested. Each field of the file
is either copied unchanged or left out, so nothing runs that was not checked.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from palpate.bundle.onnx_check import reader
from palpate.bundle.onnx_check.reader import Message
from palpate.core.errors import BundleError

GRAPH = 7
"""Number of the field `graph` of a model; all others are copied."""
HELD = {1: "node", 5: "initializer", 12: "output", 13: "value_info"}
"""Fields of a graph that may be left out, by number."""


def prune(model: bytes, outputs: Collection[str]) -> bytes:
    """`model` with the outputs `outputs` alone, and with the nodes and constants that they need.

    A model without other outputs is returned unchanged. Raises BundleError if an output is missing
    or `model` is not an ONNX file.
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
    """Names of `outputs` and of the values from which they are computed. nodes: in the order of
    computing."""
    needed = set(outputs)
    for node in reversed(list(nodes)):
        if needed.intersection(node.output):
            needed.update(node.input, node.output)
    return needed


def _without(graph: bytes, names: dict[str, list[list[str]]], needed: set[str]) -> bytes:
    """`graph` without the fields of HELD that have no name in `needed`. names: the names of each
    field, in the file's order."""
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
