"""How far a recording has got. In: material and position of each stored sweep. Out: what is still
missing, in words."""

from __future__ import annotations

from collections import Counter
from itertools import product

MOST_SHOWN = 6
"""Most pairs of material and position that a line names."""


class RecordingProgress:
    """Counts sweeps per material and position; `target`: how many of each are wanted.

    A model learns a material from the positions at which it was recorded, so that each material is
    wanted at every position that any of them has.
    """

    def __init__(self, target: int) -> None:
        self.target = target
        self._count: Counter[tuple[str, str]] = Counter()

    def add(self, material: str, position: str, sweeps: int = 1) -> None:
        """Count a sweep that was stored, or with -1 one that was removed. Without a material it is
        of no use yet."""
        if material:
            self._count[material, position] += sweeps

    @property
    def counts(self) -> list[tuple[str, str, int]]:
        """Material, position and number of stored sweeps of each pair that has any, in order."""
        return [(*pair, number) for pair, number in sorted((+self._count).items())]

    def line(self, material: str, position: str) -> str:
        """What there is of this pair, and what is missing of all: "wood at 2: 3 of 10; missing:
        wood at 2: 7"."""
        if not material:
            return "no material, so it cannot be trained on; name it with MATERIAL or --material"
        return (
            f"{_name(material, position)}: {self._count[material, position]} "
            f"of {self.target}; {self.missing()}"
        )

    def missing(self) -> str:
        """What is still missing, as far as materials and positions are known."""
        held = +self._count
        materials, positions = (
            (sorted(set(names)) for names in zip(*held, strict=True)) if held else ((), ())
        )
        lacking = [
            f"{_name(*pair)}: {self.target - held[pair]}"
            for pair in product(materials, positions)
            if held[pair] < self.target
        ]
        more = len(lacking) - MOST_SHOWN
        if lacking:
            return f"missing: {', '.join(lacking[:MOST_SHOWN])}" + f" and {more} more" * (more > 0)
        if len(materials) < 2:
            return "missing: another material, since a model tells at least two apart"
        return (
            f"nothing is missing of {len(materials)} materials at {len(positions)} "
            f"position{'s'[: len(positions) > 1]}"
        )


def _name(material: str, position: str) -> str:
    return f"{material} at {position}" if position else material
