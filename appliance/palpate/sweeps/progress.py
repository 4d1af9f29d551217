"""The progress of a recording, from material and position of each stored sweep."""

from __future__ import annotations

from collections import Counter
from itertools import product

MOST_SHOWN = 6
"""Largest number of pairs of material and position in a line."""


class RecordingProgress:
    """Counts sweeps per material and position. target: wanted number of sweeps of each pair. A
    model learns a material from the positions at which it was recorded. So each material is wanted
    at every position in the recording."""

    def __init__(self, target: int) -> None:
        self.target = target
        self._count: Counter[tuple[str, str]] = Counter()

    def add(self, material: str, position: str, sweeps: int = 1) -> None:
        """Count stored sweeps, -1 for a removed one; none without a material."""
        if material:
            self._count[material, position] += sweeps

    @property
    def counts(self) -> list[tuple[str, str, int]]:
        """Material, position and number of stored sweeps, in order, of each pair with sweeps."""
        return [(*pair, number) for pair, number in sorted((+self._count).items())]

    def line(self, material: str, position: str) -> str:
        """The count of this pair, and all missing sweeps."""
        if not material:
            return "no material, so it cannot be trained on; name it with MATERIAL or --material"
        count = self._count[material, position]
        return f"{_name(material, position)}: {count} of {self.target}; {self.missing()}"

    def missing(self) -> str:
        """The missing sweeps of the known materials and positions, in words."""
        held = +self._count
        materials, positions = (sorted({pair[i] for pair in held}) for i in (0, 1))
        wanted = ((pair, self.target - held[pair]) for pair in product(materials, positions))
        lacking = [f"{_name(*pair)}: {number}" for pair, number in wanted if number > 0]
        more = len(lacking) - MOST_SHOWN
        if lacking:
            return f"missing: {', '.join(lacking[:MOST_SHOWN])}" + f" and {more} more" * (more > 0)
        if len(materials) < 2:
            return "missing: another material, since a model tells at least two apart"
        places = f"{len(positions)} position{'s'[: len(positions) > 1]}"
        return f"nothing is missing of {len(materials)} materials at {places}"


def _name(material: str, position: str) -> str:
    return f"{material} at {position}" if position else material
