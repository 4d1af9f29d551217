"""Measures how many broken taxels a bundle tolerates if the box bridges them.

The limits of a noisy and of a silent taxel are learned from sound sweeps, and how the loads of
taxels move together. The box bridges a broken taxel by its direct neighbours. It uses the loads
instead if the true material is then more probable at the worst place. Then taxels are broken at
their worst places, one more at a time, and the box answers the held-out sweeps. The manifest gets
the largest number at which it classifies about as many as with a sound skin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.slide import PARTS
from palpate.answer.taxels import Bridging, Comparison, LoadModes, places
from palpate.answer.window import Window
from palpate.bundle.bundle import Bundle
from palpate.bundle.manifest import Manifest
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError
from palpate.core.types import Status, digitized
from palpate.inference.classifier import Classifier
from palpate.inference.session import ModelRunner
from palpate_train.answer.rule import Rule
from palpate_train.data.corruptions import CORRUPTIONS, TAXEL_FAULTS
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.metrics import bundle_score, tolerances

Array = NDArray[Any]
FIGURES = "broken taxels"
"""Key of the figures in a manifest."""
SILENT = ("dead", "stuck")
"""Faults that the box refuses where it does not bridge them. A noisy taxel that it does not bridge
costs what it costs without bridging, so it does not decide the number."""
MOST = 8
"""Largest number of broken taxels that is tried, and at most a quarter of all."""
CANDIDATES = 32
"""Taxels among which the worst places are searched: those with the strongest signal. Few
sweeps would find more of them by chance, so there are MOST, or as many as sweeps."""
SEARCHED, JUDGED = 40, 240
"""Number of sweeps that find the worst places, and that judge the answers there."""
LARGE = 100_000
"""Number of counts of a window from which on fewer sweeps search, and fewer places: with 80 taxels
and 8,800 frames the search took minutes."""
MODES, MOST_VALUES = 2, 256
"""Number of modes of loads, and the largest number of values of a frame for which they are learned:
a manifest holds three numbers for each."""
GAIN = 0.02
"""Probability of the true material at the worst place by which loads have to be better than
neighbours, on the mean; neighbours need no training, so they hold for any attachment."""
LOST, WRONG = 0.1, 0.01
"""Accepted loss of accuracy, and accepted rise of wrong answers, as shares; one sweep is always
accepted."""
CLIPPED, LOST_CLIPPED = "clipped", 0.02
"""Key of the figures of clipped sweeps, and their accepted loss of accuracy."""


@dataclass(frozen=True)
class Tolerance:
    """The broken and the clipped taxels that a bundle tolerates. bridging: for the manifest.
    saturated: largest share of counts at full scale; None if no more than usual. figures: counts
    of right and wrong answers by fault and number, for its figures."""

    bridging: Bridging
    saturated: float | None
    figures: dict[str, Any]

    def written(self, manifest: Manifest) -> Manifest:
        """`manifest` with all of it."""
        saturated = max(manifest.thresholds.saturated, self.saturated or 0.0)
        limits = replace(manifest.thresholds, saturated=saturated)
        figures = manifest.figures | {FIGURES: self.figures}
        return replace(manifest, bridging=self.bridging, thresholds=limits, figures=figures)


def measure(bundle: Bundle, sound: Dataset, held_out: Dataset, seed: int = 0) -> Tolerance | None:
    """The broken taxels that `bundle` tolerates; None if sound sweeps would be refused. sound:
    sweeps of a sound skin, from which the limits are learned. held_out: sweeps that judge, best by
    a bundle that did not see them."""
    rows, cols = bundle.format.rows, bundle.format.cols
    limits = learned(sound)
    trial = replace(limits, taxels=rows * cols - 1, row=True, column=True)
    test = EvaluationSweeps.of(held_out, JUDGED, seed)
    bench = _better(bundle, trial, load_modes(sound), test, seed)
    limits = replace(limits, loads=bench.loads)
    figures: dict[str, Any] = {"sweeps": len(test.sweeps), "sound": bench.clean}
    taxels = 0
    for mask in _worst_places(bench, min(MOST, rows * cols // 4)):
        holds, figures[_count(mask)] = bench.judged(mask)
        if not holds:
            break
        taxels += 1
    lines: dict[str, bool] = {}
    for name, count, others in (("row", rows, cols), ("column", cols, rows)):
        lines[name] = False
        if min(count, others) > 1:
            mask, _ = bench.worst(_lines(rows, cols, name))
            lines[name], figures[f"one {name}"] = bench.judged(mask)
    row, column = lines["row"], lines["column"]
    limits = replace(limits, taxels=taxels, row=row, column=column)
    found = bench.by(limits)
    if not bench.near(found.clean[0], found.clean[1], LOST):  # a taxel is always at full scale
        return None
    saturated, figures[CLIPPED] = found.clipped()
    return Tolerance(limits, saturated, figures)


def _better(
    bundle: Bundle, rule: Bridging, loads: LoadModes | None, test: EvaluationSweeps, seed: int
) -> _Bench:
    """With `loads` where the worst single taxel then leaves the true material more probable than
    with neighbours, by GAIN; else without."""
    sample = EvaluationSweeps.of(test.sweeps, _searched(SEARCHED, test), seed)
    near = _Bench(bundle, rule, test, sample, seed)
    if loads is None:
        return near
    told = near.by(replace(rule, loads=loads))
    single = [*map(_with(np.zeros(near.signal.shape, bool)), near.places())]
    worst, likely = near.worst(single)
    enough = likely + GAIN * len(sample.sweeps)
    # that place first: most often it shows that loads are not better
    better = told.worst([worst])[1] > enough and told.worst(single)[1] > enough
    return told if better else near


def load_modes(sound: Dataset) -> LoadModes | None:
    """How the loads of taxels move together in sweeps of a sound skin; None for large skins, and
    for sweeps that do not show it."""
    loads = sound.samples.mean(axis=1, dtype=np.float64).reshape(len(sound), -1)
    if not MODES + 1 < loads.shape[1] <= MOST_VALUES or len(loads) <= MODES + 1:
        return None
    away = loads - loads.mean(axis=0)
    variances, axes = np.linalg.eigh(away.T @ away / len(away))
    rest = float(variances[:-MODES].mean())
    modes = np.sqrt(variances[-MODES:] - rest) * axes[:, -MODES:]
    try:
        return LoadModes(_short(loads.mean(axis=0)), tuple(map(_short, modes.T)), *_short([rest]))
    except BundleError:  # no noise, or counts beyond those that a manifest holds
        return None


def _short(values: Iterable[float]) -> tuple[float, ...]:
    """With five digits, as the manifest holds them."""
    return tuple(float(f"{value:.5g}") for value in values)


def learned(sound: Dataset) -> Bridging:
    """The limits of noisy and silent taxels from sound sweeps, with no broken taxel allowed."""
    grid = sound.format.rows, sound.format.cols
    # a sound taxel may be constant in the tenth from which the box answers earliest
    near, own, tenths = [], [], []
    for window in sound.samples:
        compared = Comparison.of(Window(window), grid)
        near.append(compared.around)
        own.append(compared.noise)
        tenth = window[: max(2, len(window) // PARTS)]
        tenths.append(Comparison.of(Window(tenth), grid))
    around, noise = np.array(near), np.array(own)
    heard = np.isfinite(around) & (around > 0)
    if not heard.any():  # every window is constant
        return Bridging(0, False, False, tolerances.CLEAR, 1.0, True)
    quietest = float(around[heard].min())
    ratio = float((noise / np.maximum(around, quietest))[heard].max())
    still = any(bool((tenth.still & tenth.lively(quietest)).any()) for tenth in tenths)
    return Bridging(0, False, False, tolerances.CLEAR * max(1.0, ratio), quietest, still)


class _Bench:
    """Breaks taxels of test sweeps and counts the answers of the box, which bridges by `rule` and
    accepts all counts at full scale. It measures no disturbances, which would take a quarter of the
    time: the sweeps have none but the faults.

    clean: [right, wrong] of the sound sweeps. sample: the sweeps that search worst places.
    """

    def __init__(
        self,
        bundle: Bundle,
        rule: Bridging,
        test: EvaluationSweeps,
        sample: EvaluationSweeps,
        seed: int,
        model: ModelRunner | None = None,
    ) -> None:
        limits = replace(bundle.manifest.thresholds, saturated=1.0)
        manifest = replace(bundle.manifest, bridging=rule, thresholds=limits, disturbances=None)
        bundle = replace(bundle, manifest=manifest)
        self._box = Classifier(bundle, SystemClock(), slides=False, model=model)
        self._test, self._sample, self._seed = test, sample, seed
        self._counted = dict[tuple[int, str, bytes], list[Any]]()
        self.signal = test.deviation.reshape(*test.deviation.shape[:2], -1).sum(axis=2)

    def by(self, rule: Bridging) -> _Bench:
        """The same with another rule."""
        given = self._test, self._sample, self._seed, self._box.model_runner
        return _Bench(self._box.bundle, rule, *given)

    @property
    def loads(self) -> LoadModes | None:
        """The loads by which the box bridges."""
        rule = self._box.bundle.manifest.bridging
        return rule.loads if rule else None

    @cached_property
    def clean(self) -> list[int]:
        return self._counts(self._test.sweeps)[:2]

    def places(self) -> list[int]:
        """Numbers of the taxels that are tried: those with the strongest signal."""
        tried = min(_searched(CANDIDATES, self._test), max(MOST, len(self._test.sweeps)))
        strongest: list[int] = np.argsort(-self.signal, axis=None)[:tried].tolist()
        return strongest

    def worst(self, masks: Iterable[Array]) -> tuple[Array, float]:
        """The mask [R, C] whose taxels, dead, leave the true materials the least probability, and
        its sum over the sample."""
        found = ((mask, float(self._with("dead", mask, self._sample)[2])) for mask in masks)
        return min(found, key=lambda one: one[1])

    def judged(self, mask: Array) -> tuple[bool, dict[str, Any]]:
        """Whether the box answers as with a sound skin while the taxels of `mask` [R, C] are dead
        or stuck, and [right, wrong] by fault with the places."""
        counts = {fault: self._with(fault, mask, self._test)[:2] for fault in TAXEL_FAULTS}
        return self._holds(counts), counts | {"at": places(mask)}

    def clipped(self) -> tuple[float | None, dict[str, Any]]:
        """The share of counts at full scale up to which the box answers as without clipping, and
        [right, wrong] by severity; None if it never does."""
        limit, figures = None, {}
        clipping = next(corruption for corruption in CORRUPTIONS if corruption.name == "saturation")
        for severity in clipping.severities[1:]:
            samples = clipping.apply(self._test, severity, self._seed)
            right, wrong, _ = self._counts(replace(self._test.sweeps, samples=samples))
            figures[f"{severity:g}"] = [right, wrong]
            if not self.near(right, wrong, LOST_CLIPPED):
                break
            checks = (self._box.taxels.repaired(one, self._box.tare)[1] for one in samples)
            limit = max(found.full for found in checks)
        return limit, figures

    def near(self, right: int, wrong: int, lost: float) -> bool:
        """Whether counts differ from the counts of sound sweeps by at most the share `lost` of
        right answers and WRONG of wrong ones."""
        n, (clean, clean_wrong) = len(self._test.sweeps), self.clean
        return right >= clean - max(1, lost * n) and wrong <= clean_wrong + max(1, WRONG * n)

    def _holds(self, counts: Mapping[str, list[int]]) -> bool:
        return all(self.near(counts[fault][0], counts[fault][1], LOST) for fault in SILENT)

    def _with(self, fault: str, mask: Array, test: EvaluationSweeps) -> list[Any]:
        """The `_counts` with a fault, computed once: single taxels are searched twice, and of few
        sweeps all search and judge."""
        key = len(test.sweeps), fault, mask.tobytes()
        if key not in self._counted:
            self._counted[key] = self._counts(self._broken(fault, mask, test))
        return self._counted[key]

    def _broken(self, fault: str, mask: Array, test: EvaluationSweeps) -> Dataset:
        samples, rng = test.sweeps.samples, np.random.default_rng([self._seed, *fault.encode()])
        chosen = mask.reshape(1, 1, *mask.shape, *(1,) * (samples.ndim - 4))
        broken = TAXEL_FAULTS[fault](samples.astype(np.float32), chosen, rng, self._test)
        return replace(test.sweeps, samples=digitized(broken, samples.dtype))

    def _counts(self, sweeps: Dataset) -> list[Any]:
        """Right and wrong answers with status ok, and the sum of the probabilities of the true
        materials."""
        right, wrong, likely = 0, 0, 0.0
        for i, verdict in bundle_score.verdicts(self._box, sweeps):
            truth = int(sweeps.labels[i])
            named = verdict.label == sweeps.materials[truth]
            right += verdict.status is Status.OK and named
            wrong += verdict.status is Status.OK and not named
            likely += float(verdict.scores[truth]) if len(verdict.scores) else 0.0
        return [right, wrong, likely]


def _worst_places(bench: _Bench, most: int) -> Iterable[Array]:
    """Masks [R, C] of one broken taxel, two, and so on: to the worst places so far the worst other
    one is added."""
    mask = np.zeros(bench.signal.shape, bool)
    for _ in range(most):
        left = [at for at in bench.places() if not mask.flat[at]]
        mask, _ = bench.worst(map(_with(mask), left))
        yield mask


def _searched(most: int, test: EvaluationSweeps) -> int:
    """How many of `most` sweeps or places are searched, fewer for LARGE windows."""
    share = min(1.0, LARGE / int(test.sweeps.samples[0].size))
    return max(MOST, round(most * share))


def _count(mask: Array) -> str:
    n = int(mask.sum())
    return f"{n} taxel{'s' * (n > 1)}"


def _with(mask: Array) -> Callable[[int], Array]:
    """Adds the taxel with a number to a copy of `mask` [R, C]."""

    def added(at: int) -> Array:
        more = mask.copy()
        more.flat[at] = True
        return more

    return added


def _lines(rows: int, cols: int, name: str) -> Iterable[Array]:
    """A mask [R, C] for each row, or for each column."""
    for at in range(rows if name == "row" else cols):
        mask = np.zeros((rows, cols), bool)
        mask[at if name == "row" else slice(None), at if name == "column" else slice(None)] = True
        yield mask


def text(manifest: Manifest) -> str:
    """The broken taxels that a bundle tolerates, with the answers at the worst places, in words."""
    if silent := manifest.thresholds.dead_taxels:
        return f"broken taxels: up to {silent} without a signal are accepted, as in the recordings"
    if manifest.bridging is None:
        unknown = "" if FIGURES in manifest.figures else "not measured, so "
        return f"broken taxels: {unknown}the box refuses them"
    lines = [f"broken taxels: {manifest.bridging.text} bridged"]
    figures = manifest.figures.get(FIGURES, {})
    if figures:
        right, wrong = figures["sound"]
        lines.append(
            f"  sound skin: {right} of {figures['sweeps']} classified correctly, {wrong} wrongly"
        )
    for name, counts in figures.items():
        if isinstance(counts, dict) and name != CLIPPED:
            answers = "; ".join(
                f"{fault} {counts[fault][0]} correct, {counts[fault][1]} wrong"
                for fault in TAXEL_FAULTS
            )
            lines.append(f"  {name} ({counts['at']}): {answers}")
    if CLIPPED in figures:
        lines.append(
            f"clipped counts: answered up to {100 * manifest.thresholds.saturated:.1f} % at full "
            "scale"
        )
    return "\n".join(lines)


def without(bundle: Bundle) -> Bundle:
    """The bundle that bridges no broken taxel: it refuses them."""
    return replace(bundle, manifest=replace(bundle.manifest, bridging=None))


RULES = {"taxels": Rule("bridging of broken taxels", without)}
