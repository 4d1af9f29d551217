"""An unfinished training in a file. In: all that it changes. Out: after an interruption the same
training, bit for bit.

The file holds the state after some step. It is written whole or not at all; one that cannot be read
counts as none.
"""

from __future__ import annotations

import io
import pickle
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Generator

from appliance.core.storage import put

EVERY_S, WRITING = 10.0, 0.003
"""How often an unfinished training is written, and the share of the time that writing may take: the
paper's CNN takes 250 MB and half a second each time."""


class Stateful(Protocol):
    """A network, an optimizer, a schedule."""

    def state_dict(self) -> dict[str, Any]:
        """All that changes in training."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Take back what `state_dict` gave."""
        ...


class Checkpoint:
    """The state of a training: its parts, its random generators and (iteration, cost) of the steps
    done.

    path None: kept nowhere.
    """

    def __init__(
        self, path: Path | None, parts: Mapping[str, Stateful], generators: Sequence[Generator]
    ) -> None:
        self._path, self._parts, self._generators = path, parts, generators
        self._next = time.monotonic() + wait(0.0)

    def load(self) -> list[tuple[int, float]]:
        """Bring all parts and generators to the state in the file, and give the cost so far; []
        where there is none."""
        kept = self._read()
        if kept is None:
            return []
        for name, part in self._parts.items():
            part.load_state_dict(kept[name])
        for generator, state in zip(self._generators, kept["generators"], strict=True):
            generator.set_state(state)
        return [(int(step), float(loss)) for step, loss in kept["cost"]]

    def _read(self) -> dict[str, Any] | None:
        """What `save` wrote; None where the file is missing or cannot be read."""
        if self._path is None:
            return None
        try:
            kept: dict[str, Any] = torch.load(self._path, map_location="cpu", weights_only=True)
        except (OSError, EOFError, ValueError, RuntimeError, pickle.UnpicklingError):
            return None
        return kept

    def save(self, cost: list[tuple[int, float]]) -> None:
        """Write the state, where the last time was long enough ago. cost: of every step done.
        Raises OSError."""
        if self._path is None or (start := time.monotonic()) < self._next:
            return
        packed = io.BytesIO()
        states: dict[str, Any] = {name: part.state_dict() for name, part in self._parts.items()}
        torch.save(
            states | {"generators": [g.get_state() for g in self._generators], "cost": cost}, packed
        )
        put(self._path, packed.getvalue(), parents=True)
        self._next = (end := time.monotonic()) + wait(end - start)


def wait(took: float) -> float:
    """Seconds until it is written again, where writing `took` so long."""
    return max(EVERY_S, took / WRITING)


def default_generators(device: str) -> tuple[Generator, ...]:
    """PyTorch's own generators, from which dropout is drawn on `device`."""
    on_gpu = (
        (torch.cuda.default_generators[torch.cuda.current_device()],) if device == "cuda" else ()
    )
    return torch.default_generator, *on_gpu
