"""From a lesson to a bundle: the fit of `palpate-train fit`, and the export with all its
checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.bundle import Manifest
from palpate.core.errors import FormatError
from palpate.core.provenance import commit
from palpate_train.data.progress import StepTimes, Tell
from palpate_train.data.run import Run
from palpate_train.export import quantized_bundle
from palpate_train.models.recipe import recipe
from palpate_train.teach.lesson import Lesson

NAME = "taught"
"""Name of a bundle that a box has taught itself."""
LEAST = 3
"""Fewest sweeps of each material: two to learn from, and one to judge by."""
SHARES = {"features": 0.06, "heads": 0.14, "bundle": 0.8}
"""Share of the time that each step takes, measured with 216 sweeps."""


def teach(lesson: Lesson, out: Path, version: str, about: dict[str, Any], tell: Tell) -> Manifest:
    """Fit a model to the lesson and write its bundle to `out`, whole or not at all. about: who
    teaches and when, for the manifest.

    Raises FormatError if there are too few sweeps or materials, or if chance would classify them as
    well, and ExportRefused if a check of the bundle fails.
    """
    sweeps, times = lesson.sweeps, StepTimes(SHARES, tell)
    counts = np.bincount(sweeps.labels)
    if few := [name for name, n in zip(sweeps.materials, counts, strict=True) if n < LEAST]:
        raise FormatError(
            f"{few[0]!r} has {counts[sweeps.materials.index(few[0])]} sweeps; record {LEAST} or "
            "more of each material, or forget it"
        )
    sweeps.require_materials()
    settings = recipe.Settings(displaced=False, strangers=lesson.strangers)
    setup = recipe.Setup.of(sweeps, Run(0), settings)
    times.begin("features")
    _ = setup.fixed  # computed here, for the time of this step
    times.begin("heads")
    fit = recipe.fit_size(setup, setup.settings.size)
    _check_useful(fit.about["validation"], counts, sweeps.materials)
    held = dict(zip(sweeps.materials, counts.tolist(), strict=True))
    fit = replace(fit, about=fit.about | {"taught": about | {"sweeps": held}})
    times.begin("bundle")
    return quantized_bundle.export(fit, out, NAME, version, commit())


def _check_useful(validation: dict[str, Any], counts: NDArray[Any], names: Sequence[str]) -> None:
    """Raises FormatError if the most frequent material, given always, is right as often."""
    chance = counts.max() / counts.sum()
    if validation["accuracy"] <= chance:
        raise FormatError(
            f"{', '.join(names[:3])} cannot be told apart: {100 * validation['accuracy']:.0f} % of "
            f"left-out sweeps are classified correctly, by chance {100 * chance:.0f} %; slide "
            "differently (faster, harder, longer), or teach them as one material"
        )
