"""The room of ONNX messages. In: what a reader found. Out: the same with names: the fields that a bundle's model may have.

ONNX is protobuf: numbered fields in messages in messages. No message here holds one of its own kind, so nothing nests
without end. What is not here is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Kind = str | type | list[type]
"""What a field holds: numbers, a name, bytes, a message; a list of one type where it may come again and again."""


def of(number: int, kind: Kind) -> dict[str, Any]:
    """The number of a field, and what it holds."""
    return {"number": number, "kind": kind}


@dataclass(frozen=True, slots=True)
class Tensor:
    """A constant. dims, data_type: shape and code of its type. Its numbers stand in one of the other fields."""

    dims: list[int] = field(default_factory=list, metadata=of(1, "ints"))
    data_type: int = field(default=0, metadata=of(2, "code"))
    floats: NDArray[Any] | None = field(default=None, metadata=of(4, "floats"))
    int32s: list[int] = field(default_factory=list, metadata=of(5, "ints"))
    int64s: list[int] = field(default_factory=list, metadata=of(7, "ints"))
    name: str = field(default="", metadata=of(8, "text"))
    raw: memoryview = field(default=memoryview(b""), metadata=of(9, "raw"))


@dataclass(frozen=True, slots=True)
class Attribute:
    """A setting of a node. type: code of the one field that holds it."""

    name: str = field(default="", metadata=of(1, "text"))
    f: float | None = field(default=None, metadata=of(2, "float"))
    i: int | None = field(default=None, metadata=of(3, "signed"))
    s: memoryview | None = field(default=None, metadata=of(4, "bytes"))
    t: Tensor | None = field(default=None, metadata=of(5, Tensor))
    floats: NDArray[Any] | None = field(default=None, metadata=of(7, "floats"))
    ints: list[int] = field(default_factory=list, metadata=of(8, "ints"))
    type: int = field(default=0, metadata=of(20, "code"))


@dataclass(frozen=True, slots=True)
class Node:
    """One operator at work."""

    input: list[str] = field(default_factory=list, metadata=of(1, "texts"))
    output: list[str] = field(default_factory=list, metadata=of(2, "texts"))
    name: str = field(default="", metadata=of(3, "text"))
    op_type: str = field(default="", metadata=of(4, "text"))
    attribute: list[Attribute] = field(default_factory=list, metadata=of(5, [Attribute]))
    domain: str = field(default="", metadata=of(7, "text"))


@dataclass(frozen=True, slots=True)
class Dimension:
    """A size; None where it has none."""

    dim_value: int | None = field(default=None, metadata=of(1, "signed"))


@dataclass(frozen=True, slots=True)
class Shape:
    """Sizes."""

    dim: list[Dimension] = field(default_factory=list, metadata=of(1, [Dimension]))


@dataclass(frozen=True, slots=True)
class TensorType:
    """Code of a type, and a shape."""

    elem_type: int = field(default=0, metadata=of(1, "code"))
    shape: Shape | None = field(default=None, metadata=of(2, Shape))


@dataclass(frozen=True, slots=True)
class Type:
    """The one kind of type that a value may have."""

    tensor_type: TensorType | None = field(default=None, metadata=of(1, TensorType))


@dataclass(frozen=True, slots=True)
class Declared:
    """A name with its type: an input, an output, or what an exporter noted of something between."""

    name: str = field(default="", metadata=of(1, "text"))
    type: Type | None = field(default=None, metadata=of(2, Type))


@dataclass(frozen=True, slots=True)
class Entry:
    """What an exporter noted of the model."""

    key: str = field(default="", metadata=of(1, "text"))
    value: str = field(default="", metadata=of(2, "text"))


@dataclass(frozen=True, slots=True)
class Graph:
    """Operators in their order, with the constants that they need."""

    node: list[Node] = field(default_factory=list, metadata=of(1, [Node]))
    name: str = field(default="", metadata=of(2, "text"))
    initializer: list[Tensor] = field(default_factory=list, metadata=of(5, [Tensor]))
    input: list[Declared] = field(default_factory=list, metadata=of(11, [Declared]))
    output: list[Declared] = field(default_factory=list, metadata=of(12, [Declared]))
    value_info: list[Declared] = field(default_factory=list, metadata=of(13, [Declared]))


@dataclass(frozen=True, slots=True)
class Opset:
    """The version of the operators of a domain."""

    domain: str = field(default="", metadata=of(1, "text"))
    version: int = field(default=0, metadata=of(2, "code"))


@dataclass(frozen=True, slots=True)
class Model:
    """All of a file."""

    ir_version: int = field(default=0, metadata=of(1, "code"))
    producer_name: str = field(default="", metadata=of(2, "text"))
    producer_version: str = field(default="", metadata=of(3, "text"))
    graph: Graph | None = field(default=None, metadata=of(7, Graph))
    opset_import: list[Opset] = field(default_factory=list, metadata=of(8, [Opset]))
    metadata_props: list[Entry] = field(default_factory=list, metadata=of(14, [Entry]))


REFUSED: dict[tuple[type, int], str] = {
    (Model, 20): "training_info",
    (Model, 25): "functions",
    (Graph, 15): "sparse_initializer",
    (Attribute, 6): "a graph in the graph",
    (Attribute, 9): "texts",
    (Attribute, 10): "tensors",
    (Attribute, 11): "graphs in the graph",
    (Attribute, 22): "a sparse tensor",
    (Tensor, 6): "texts",
    (Tensor, 10): "numbers of 64 bits",
    (Tensor, 13): "external_data",
    (Tensor, 14): "data_location",
    (Dimension, 2): "a name instead of a number",
    (Type, 4): "a sequence",
    (Type, 5): "a map",
    (Type, 8): "a sparse tensor",
    (Type, 9): "an optional type",
}
"""What is worth a word where it is refused; all other fields are told by their number."""
