"""A file of an unfinished training, from which it goes on with the same bits after an interruption.

The file holds the state after some step. It is written whole or not at all, and a file that cannot
be read is ignored.
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

from palpate.core.storage import put

EVERY_S, WRITING = 10.0, 0.003
"""Seconds between two files of an unfinished training, and the largest share of the time for
writing them: the paper's CNN has files of 250 MB, which take half a second."""


class Stateful(Protocol):
    """The state of a network, an optimizer or a schedule."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that training changes."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Restore the state that `state_dict` gave."""
        ...


class Checkpoint:
    """The state of a training: its parts, its random generators and (iteration, cost) of the
    finished steps. path: None to keep nothing."""

    def __init__(
        self, path: Path | None, parts: Mapping[str, Stateful], generators: Sequence[Generator]
    ) -> None:
        self._path, self._parts, self._generators = path, parts, generators
        self._next = time.monotonic() + wait(0.0)

    def load(self) -> list[tuple[int, float]]:
        """Restore all parts and generators from the file and return the cost so far; [] without a
        file."""
        kept = self._read()
        if kept is None:
            return []
        for name, part in self._parts.items():
            part.load_state_dict(kept[name])
        for generator, state in zip(self._generators, kept["generators"], strict=True):
            generator.set_state(state)
        return [(int(step), float(loss)) for step, loss in kept["cost"]]

    def _read(self) -> dict[str, Any] | None:
        """The content of the file; None if it is missing or cannot be read."""
        if self._path is None:
            return None
        try:
            kept: dict[str, Any] = torch.load(self._path, map_location="cpu", weights_only=True)
        except (OSError, EOFError, ValueError, RuntimeError, pickle.UnpicklingError):
            return None
        return kept

    def save(self, cost: list[tuple[int, float]]) -> None:
        """Write the state if the last file is old enough. cost: of every finished step. Raises
        OSError."""
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
    """Seconds until the next file, if the last took `took` seconds to write."""
    return max(EVERY_S, took / WRITING)


def default_generators(device: str) -> tuple[Generator, ...]:
    """The generators of PyTorch from which dropout is drawn on `device`."""
    on_gpu = (
        (torch.cuda.default_generators[torch.cuda.current_device()],) if device == "cuda" else ()
    )
    return torch.default_generator, *on_gpu
