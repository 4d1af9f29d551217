"""Fits with trained stages that take a second, whatever held-out sweeps ask for."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe import choice, recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.sizes import SIZES


@contextmanager
def joining() -> Iterator[None]:
    """Fits here train stages for any number of sweeps and any accuracy, and keep them."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("LEAST_SWEEPS", 1), ("LEAST_EACH", 1), ("ENOUGH", 1.01)):
            patch.setattr(recipe, name, value)
        patch.setattr(choice.PairedDifference, "worse", property(lambda _: False))
        yield


def with_stages(sweeps: Dataset, steps: int = 40) -> Fit:
    """A fit of trained stages and the spectrum, of seed 1."""
    with joining():
        return recipe.fit(sweeps, Run(1), recipe.Settings(steps=steps, size=SIZES["stages"]))
