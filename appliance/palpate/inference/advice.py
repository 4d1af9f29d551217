"""Sentences about the knowledge of a box that is taught, by sweeps that were left out.

They are the same for a model that the box fits (palpate_train.teach) and for materials taught into
a delivered bundle (teaching/into.py).
"""

from __future__ import annotations

ENOUGH = 0.9
"""Lower end of the interval of the accuracy from which on more sweeps are not asked for."""
SURE = 0.9
"""Least probability of another material at which a sweep may be mislabelled."""
RIGHT = 0.6
"""Least share of the other sweeps of its material that are named rightly then, and of the sweeps of
the other material. If materials are often confused, a single sweep says nothing about its label."""
MORE = 3
"""Number of further sweeps that an advice names."""


def suspicion(number: int, material: str, looks_like: str) -> str:
    """Of the sweep with this number among those of its material."""
    return f"sweep {number} of {material} looks like {looks_like}"


def first(suspicions: list[str], low: float) -> str:
    """The advice if a sweep may be mislabelled, or if the sweeps are enough; "" else.

    low: lower end of the interval of the accuracy.
    """
    if suspicions:
        return f"look at it first: {suspicions[0]}; discard it if that is so"
    if low >= ENOUGH:
        return (
            f"enough: at least {100 * low:.0f} % of such sweeps are named rightly "
            "(with 97.5 % certainty)"
        )
    return ""


def more(material: str) -> str:
    """The advice for the material that is confused most."""
    return f"{MORE} more of {material}, from another place"
