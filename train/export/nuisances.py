"""Measures how altered sweeps move the embedding of a bundle, and lets these changes count little
in its check of unknown materials.

Copies of training sweeps are altered as in a test of robustness: hum, noise, gain, speed, lost
frames, fewer bits, displacement. Copies of held-out sweeps judge; see calibration.nuisances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle import arrays
from appliance.bundle.bundle import file_entry
from appliance.bundle.manifest import MANIFEST, MEANS, Manifest
from appliance.core.clock import SystemClock
from appliance.core.errors import FormatError
from appliance.core.storage import put_all
from appliance.inference.classifier import Classifier
from appliance.inference.novelty import shaped_distances
from train.calibration import novelty
from train.calibration.nuisances import AlteredSweeps, NuisanceRule, Scatters, choose
from train.data.sets import Dataset, digest
from train.evaluation.corruptions import TAXEL_FAULTS, Corruption, applicable
from train.evaluation.evaluation_sweeps import EvaluationSweeps
from train.export.bridging import measurable
from train.models.recipe.calibrate import CalibrationInputs

Array = NDArray[Any]
Embed = Callable[[Array], Array]
"""Raw counts [n, T, R, C] -> features [n, F], or these -> embeddings [n, r]."""
Space = tuple[Embed, Array]
"""An embedding of features, and the class means [K, r] in it."""
FIGURES = "altered sweeps"
"""Key of the figures in a manifest."""
COPIES = 360
"""Largest number of copies of each kind; of judged sweeps there are as many at most."""
SEVERITIES = 6
"""Number of severities of a kind, at equal distances up to the largest."""


@dataclass(frozen=True)
class Widened:
    """Shapes of materials that alterations have widened. shapes: float16 [K, r, r] of each
    embedding that was given. limit: of known materials, for these shapes. rule: gave both.
    training: features of the training sweeps and of their altered copies. figures: for the
    manifest."""

    shapes: tuple[NDArray[np.float16], ...]
    limit: float
    rule: NuisanceRule
    training: AlteredSweeps
    figures: dict[str, Any]


def measure(
    features: Embed, train: Dataset, held_out: Dataset, judge: Space, *others: Space, seed: int = 0
) -> Widened | None:
    """The widened shapes in the embedding `judge`, best one that has not seen `held_out`, and in
    others, by the rule that `judge` finds; None if it finds none. features: of raw counts, which
    the embeddings take."""
    held = altered(features, held_out, seed + 1).seen_by(judge[0])
    training, scatters = altered(features, train, seed), []
    for embed, means in (judge, *others):
        scatters.append(Scatters.of(training.seen_by(embed), means.astype(np.float64)))
    rule = choose(scatters[0], held, judge[1].astype(np.float64))
    if rule is None:
        return None
    shapes = tuple(map(rule.shapes, scatters))
    return Widened(shapes, rule.limit, rule, training, _figures(rule, held))


def limit_of_conditions(found: Widened, given: CalibrationInputs) -> float:
    """The limit for widened shapes, from sweeps judged by embeddings and shapes that did not see
    their value of a condition; all conditions count."""
    every, trained = [], len(found.training.labels)
    for values in given.conditions.values():
        distances = np.full(len(given.labels), np.nan)
        for seen, judging, embedding, present in novelty.cross_fitted(
            given.whole, given.labels, values, given.judged, given.fixed
        ):
            means = embedding.means.astype(np.float64)
            training = found.training.take(seen[:trained], present).seen_by(embedding)
            shapes = found.rule.shapes(Scatters.of(training, means)).astype(np.float64)
            away = embedding(given.whole[judging])[:, None] - means
            distances[judging] = shaped_distances(away, shapes).min(axis=1)
        every.append(distances)
    return novelty.limit(np.concatenate(every))


def altered(features: Embed, sweeps: Dataset, seed: int) -> AlteredSweeps:
    """The features of `sweeps` and of copies with each fault of CORRUPTIONS that can be applied
    to recorded counts. Broken taxels are left out, because the box bridges them."""
    every, rng = EvaluationSweeps(sweeps), np.random.default_rng(seed)
    copies = {}
    for corruption in applicable(every):
        if corruption.name not in TAXEL_FAULTS:
            source = rng.permutation(len(sweeps))[:COPIES]
            copies[corruption.name] = features(_copies(corruption, every, source, seed)), source
    return AlteredSweeps(features(sweeps.samples), sweeps.labels, copies)


def _copies(corruption: Corruption, every: EvaluationSweeps, source: Array, seed: int) -> Array:
    """Copies of the sweeps `source` (numbers [M]), a part of them at each severity."""
    most, copies = corruption.severities[-1], []
    for step, part in enumerate(np.array_split(source, SEVERITIES), start=1):
        if len(part):
            some = EvaluationSweeps(every.sweeps.take(part))
            vars(some).update(deviation=every.deviation, rms=every.rms, load=every.load)
            copies.append(corruption.apply(some, min(most, most * step / SEVERITIES), seed))
    return np.concatenate(copies)


def _figures(rule: NuisanceRule, held: AlteredSweeps) -> dict[str, Any]:
    before, after = rule.passed
    return {
        "sweeps": len(held.labels),
        "left out": [round(before, 4), round(after, 4)],
        "kept": {kind: [round(share, 4) for share in shares] for kind, shares in rule.kept.items()},
        "weights": dict(rule.weights),
    }


def text(figures: Mapping[str, Any]) -> str:
    """The figures of a manifest in words."""
    found = figures.get(FIGURES)
    if not found:
        return (
            "altered sweeps: not measured, so hum, noise or another gain look like a new material"
        )
    before, after = (np.mean([shares[i] for shares in found["kept"].values()]) for i in range(2))
    lines = [
        f"altered sweeps: {100 * after:.1f} % count as a known material, before {100 * before:.1f} "
        f"%; of materials that are left out {100 * found['left out'][1]:.1f} %, before "
        f"{100 * found['left out'][0]:.1f} %"
    ]
    for kind, (was, now) in found["kept"].items():
        lines.append(f"  {kind}: {100 * now:.1f} %, before {100 * was:.1f} %")
    return "\n".join(lines)


def write(folder: Path, trained_on: Dataset, fresh: Dataset) -> Manifest:
    """Widen the shapes of the bundle in `folder`, and write them into its class means and its
    manifest; the model stays as it is.

    trained_on: its training sweeps. fresh: sweeps that it has not seen. Raises FormatError as
    bridging.measurable, if the bundle does not detect unknown materials, or if the fresh sweeps are
    too few to find a rule.
    """
    measurable(folder, trained_on)
    loaded = measurable(folder, fresh)
    classes, known = loaded.classes, loaded.manifest.known
    if classes is None or known is None:
        raise FormatError(
            f"bundle {loaded.id} does not detect unknown materials; export it from a fit"
        )
    box = Classifier(loaded, SystemClock())

    def embed(samples: Array) -> Array:
        return np.stack([box.embedding(sweep) for sweep in samples]).astype(np.float64)

    found = measure(embed, trained_on, fresh, (lambda z: z, classes.means))
    if found is None:
        raise FormatError(
            f"{fresh.source} does not show how altered sweeps differ from other materials; name a "
            "larger set"
        )
    means = arrays.packed(**replace(classes, shapes=found.shapes[0]).arrays())
    named = {"trained on": trained_on.source, "set": fresh.source, "digest": digest(fresh)}
    manifest = replace(
        loaded.manifest,
        known=replace(known, limit=found.limit),
        files=loaded.manifest.files | {MEANS: file_entry(means)},
        figures=loaded.manifest.figures | {FIGURES: found.figures | named},
    )
    put_all({folder / MEANS: means, folder / MANIFEST: manifest.json()})
    return manifest
