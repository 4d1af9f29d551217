"""The address space of the OPC UA server: of the standard's nodes those that a box needs.

The library would build all 6,200, with types for alarms, roles, PubSub and others. Here are those
with low numbers, which the first edition of the standard had, and the limits of a request. That
takes 40 MiB and three seconds less (measured with asyncua 2.1.0).
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
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
        nodes = _Wanted(self.node_mgt_service)
        # each by itself: the package would load all of them, and keep them
        for path in sorted(PARTS.glob("standard_address_space_services_*.py")):
            spec = spec_from_file_location(path.stem, path)
            assert spec
            assert spec.loader
            part = module_from_spec(spec)
            spec.loader.exec_module(part)
            getattr(part, f"create_{path.stem.replace('services', 'Services')}")(nodes)
        nodes.end()
        gc.collect()
        with suppress(OSError, AttributeError):  # another C library than glibc
            ctypes.CDLL(None).malloc_trim(0)


class _Wanted:
    """Adds the wanted nodes and the references between them. Nodes can come before their parents:
    the rest is tried again at the end, and a node whose parent or type is left out is left out."""

    def __init__(self, service: Any) -> None:
        self._service = service
        self._nodes: list[Any] = []
        self._references: list[Any] = []

    def add_nodes(self, nodes: Iterable[Any]) -> None:
        """Called by the library's lists."""
        wanted = [node for node in nodes if _wanted(node.RequestedNewNodeId)]
        self._nodes += self._service.try_add_nodes(wanted, check=False)

    def add_references(self, references: Iterable[Any]) -> None:
        """Called by the library's lists."""
        both = (r for r in references if _wanted(r.SourceNodeId) and _wanted(r.TargetNodeId))
        self._references += self._service.try_add_references(both)

    def end(self) -> None:
        """Add what waits for nodes that came later."""
        before = -1
        while before != len(self._nodes):
            before = len(self._nodes)
            self._nodes = [*self._service.try_add_nodes(self._nodes, check=False)]
        list(self._service.try_add_references(self._references))


def _wanted(node: Any) -> bool:
    return any(node.Identifier in numbers for numbers in NUMBERS)
