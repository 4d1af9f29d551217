"""The sizes of the recipe, from the spectrum alone to everything.

A size limits the content of a model. Held-out groups choose within this limit, so a model may be
smaller than its size.
"""

from __future__ import annotations

from dataclasses import dataclass

from palpate_train.models.recipe import relations


@dataclass(frozen=True)
class ModelSize:
    """The views of a size; every size has the spectrum.

    about: its content in words. filters: most filters of each kind; scales: most scales of the
    relations; None for no limit. distribution, stages, loads, slow: whether they may join.
    """

    about: str = "all views"
    filters: int | None = None
    scales: int | None = None
    distribution: bool = True
    stages: bool = True
    loads: bool = True
    slow: bool = True


SIZES = {
    "bands": ModelSize("the spectrum", 0, 0, False, False, slow=False),
    "pairs": ModelSize(
        "the spectrum and relations of few scales", 0, relations.SHORT, False, False, slow=False
    ),
    "64": ModelSize(
        "64 filters of each kind, the spectrum and relations of few scales",
        64,
        relations.SHORT,
        False,
        False,
        slow=False,
    ),
    "stages": ModelSize(
        "the spectrum, relations of few scales and trained stages",
        0,
        relations.SHORT,
        False,
        slow=False,
    ),
    "256": ModelSize("256 filters of each kind and all views in closed form", 256, stages=False),
}
"""By name."""
UNLIMITED = ModelSize()
"""Without a size a model may contain everything."""
