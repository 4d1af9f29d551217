"""The address space of the OPC UA server: the standard's nodes that a box needs.

The library would build all 6,200, with types for alarms, roles, PubSub and others. Here are those
with low numbers, which the first edition of the standard had, and the limits of a request. That
takes 40 MiB and three seconds less (measured with asyncua 2.1.0).
"""

from __future__ import annotations

import gc
from collections.abc import Iterable
from contextlib import suppress
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

import asyncua
from asyncua.server.internal_server import InternalServer

NUMBERS = (range(4000), range(11564, 11576), range(11702, 11715), range(12165, 12169))
"""Numbers of the nodes: of the first edition; of the type and the object OperationLimits."""
PARTS = Path(asyncua.__file__).parent / "server" / "standard_address_space"


class SmallServer(InternalServer):  # type: ignore[misc]
    """A server of the library without most of the standard's types."""

    async def load_standard_address_space(self, shelf_file: Path | None = None) -> None:
        """Called by the library."""
        wanted, service = _Wanted(), self.node_mgt_service
        # each by itself: the package would load all of them, and keep them
        for path in sorted(PARTS.glob("standard_address_space_services_*.py")):
            part = ModuleType(path.stem)
            SourceFileLoader(path.stem, str(path)).exec_module(part)
            getattr(part, f"create_{path.stem.replace('services', 'Services')}")(wanted)
        nodes, before = wanted.nodes, -1
        while before != len(nodes):  # until only those whose parent or type is left out are left
            before, nodes = len(nodes), [*service.try_add_nodes(nodes, check=False)]
        list(service.try_add_references(wanted.references))
        del wanted, nodes
        gc.collect()
        with suppress(ImportError, OSError, AttributeError):  # another C library than glibc
            import ctypes

            ctypes.CDLL(None).malloc_trim(0)


class _Wanted:
    """Keeps the wanted nodes and the references between them; nodes can come before their
    parents."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.references: list[Any] = []

    def add_nodes(self, nodes: Iterable[Any]) -> None:
        """Called by the library's lists."""
        self.nodes += [node for node in nodes if _wanted(node.RequestedNewNodeId)]

    def add_references(self, references: Iterable[Any]) -> None:
        """Called by the library's lists."""
        both = (r for r in references if _wanted(r.SourceNodeId) and _wanted(r.TargetNodeId))
        self.references += both


def _wanted(node: Any) -> bool:
    return any(node.Identifier in numbers for numbers in NUMBERS)
