"""Measures whether bands over f/v, beside bands over f, help the recipe name materials.

A texture is a pattern in space; its frequencies f are proportional to the speed v of the slide.
`python -m tests.campaigns speed-bands` prints the tables of docs/decisions/0004: simulated slides
at speeds outside of training, with the true and with the measured speed, and FabricSlide with a
force, a speed, a direction or a repetition left out, if PALPATE_DATA names its folder. Trained
stages join with `--steps 600`. Takes an hour with FabricSlide, or two with stages.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.signal.slide import SlideMeter
from palpate.sim import skin
from palpate_train.calibration.heads import HeadData, HeadPart
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import Fold, InnerPart, Protocol
from palpate_train.models.methods import no_log
from palpate_train.models.recipe import choice, recipe, stage_heads
from palpate_train.models.recipe.choice import HeldOutScores, ScoredPlan
from palpate_train.models.recipe.recipe import Settings, Setup

Array = NDArray[Any]
BANDS = 12
QUIET = 1e-4
"""Added to a band's power before its logarithm, as in the recipe's spectrum."""
CHUNK = 200
"""Number of sweeps whose spectra are in memory at a time."""
FABRIC_HZ, SIMULATED_HZ = (0.4, 17.0), (1.0, 60.0)
"""Bands at the mean speed: from one and a half periods in a window to the fastest pattern."""
NOMINAL_MM_S = 30.0
POSITIONS, SEEDS = 6, (1, 2, 3)
SEVEN = ("direction=0", "force<=180")
FOUR = ("material=BeigeCotton,BrownCotton,Canvas,Linen",)
FABRICS = (
    ("7 fabrics", SEVEN, ("force", "speed", "rep")),
    ("4 fabrics", FOUR, ("direction", "force", "speed")),
)
SLOW, MIDDLE, FAST = (0.5, 0.75, 1.0), (1.0, 1.5, 2.0), (2.0, 3.0)
SIMULATED: tuple[
    tuple[str, tuple[str, ...], skin.SetName, tuple[float, ...], tuple[float, ...]], ...
] = (
    ("level-blind", (), "T-REAL", SLOW, FAST),
    ("level-blind", (), "T-REAL", MIDDLE, (0.5,)),
    ("level-blind", (), "T-REAL", (0.5, 0.75, 1.5, 2.0), (1.0,)),
    ("level-blind", ("vibration",), "T-REAL", SLOW, FAST),
    ("", (), "T-REAL", SLOW, FAST),
    ("", (), "T-HARD", SLOW, FAST),
)
"""World, effects that are off, set of the tested attachments, speeds in training and in the test,
relative to NOMINAL_MM_S."""
ROWS = ("without", "beside", "in each", "asked for", "in each, unknown speed")
"""Heads without bands over f/v; with them as a discriminant of their own; in each discriminant; as
held-out groups ask for; the third at the mean speed, as if the speed of a tested sweep were
unknown."""


@dataclass(frozen=True)
class SpeedTrial:
    """Sweeps with their speeds, to be split. speeds: float [N], NaN where unknown, in any unit.
    hz: lowest and highest edge of the bands at the mean speed of training."""

    name: str
    sweeps: Dataset
    folds: Sequence[Fold]
    speeds: Array
    hz: tuple[float, float]


def log_bands(x: Array, rate_hz: float, ratio: Array, hz: tuple[float, float]) -> Array:
    """Signals [N, T, M] -> log power [N, BANDS * M] in bands of f / v, float32. ratio: speed [N]
    relative to the mean speed, at which the bands reach from hz[0] to hz[1]."""
    edges = np.geomspace(*hz, BANDS + 1)
    parts = [slice(i, i + CHUNK) for i in range(0, len(x), CHUNK)]
    density = np.concatenate([_bands_of(x[p], rate_hz, edges * ratio[p, None]) for p in parts])
    # per octave, so that a pattern has the same power at any speed
    logarithm: Array = np.log(density * ratio[:, None, None] + QUIET)
    return logarithm.reshape(len(x), -1).astype(np.float32)


def _bands_of(x: Array, rate_hz: float, edges: Array) -> Array:
    """Signals [N, T, M] -> power per bin [N, BANDS, M] between the edges [N, BANDS + 1] in Hz of
    each sweep. A band outside of the spectrum has the power of the outermost band inside."""
    frames = x.shape[1]
    window = np.hanning(frames + 2)[1:-1, None]
    window = (window / np.sqrt((window**2).sum())).astype(np.float32)
    spectrum = np.fft.rfft((x - x.mean(axis=1, keepdims=True)) * window, 2 * frames, axis=1)
    power = np.abs(spectrum).astype(np.float32) ** 2
    step = rate_hz / (2 * frames)
    total = np.pad(power.cumsum(axis=1), ((0, 0), (1, 0), (0, 0)))  # up to a bin's lower edge
    wide = edges[:, 1:] / edges[:, :-1]
    lower = np.clip(edges[:, :-1], 1.5 * step, rate_hz / 2 / wide)
    upper = np.maximum(lower * wide, lower + step)

    def up_to(frequency: Array) -> Array:
        at = np.clip(frequency / step + 0.5, 0, total.shape[1] - 1.001)
        left = at.astype(int)[..., None]
        below, above = (np.take_along_axis(total, left + n, 1) for n in (0, 1))
        between: Array = below + (at[..., None] - left) * (above - below)
        return between

    mean: Array = (up_to(upper) - up_to(lower)) / ((upper - lower) / step)[..., None]
    return mean


def signals(sweeps: Dataset, scale: float) -> Array:
    """Float32 [N, T, M] of a set, with a deviation of about 1."""
    flat = sweeps.samples.reshape(len(sweeps), sweeps.format.window, -1)
    return flat.astype(np.float32) * np.float32(scale)


class SpatialFold:
    """One fold of a trial, with the features of the recipe and bands over f/v.

    Sweeps of an unknown speed are answered by the heads without these bands; heads with them are
    fitted without such sweeps.
    """

    def __init__(self, trial: SpeedTrial, fold: Fold, steps: int, seed: int) -> None:
        self.trial, (train, test) = trial, fold
        self.train, self.test = trial.sweeps.take(train), trial.sweeps.take(test)
        settings = Settings(steps=steps, calibrate=False)
        self.setup = Setup.of(self.train, seed, settings, no_log)
        self.fixed = self.setup.fixed
        ratio = trial.speeds / np.exp(np.nanmean(np.log(trial.speeds[train])))
        self.known, self.told = np.isfinite(ratio[train]), np.isfinite(ratio[test])
        ratio = np.where(np.isfinite(ratio), ratio, 1.0)
        self.own = self._bands(self.train, ratio[train])
        self.copied = np.concatenate([self._bands(c, ratio[train]) for c in self.setup.copies])
        self.of_test = self._bands(self.test, ratio[test])

    def right(self) -> dict[str, Array]:
        """Bool [n], whether answers to tested sweeps are right, for each of ROWS. Trained stages
        are beside all others where they are not worse."""
        data, tested = self._joined(self.fixed.data), self.fixed.trunk.features(self.test)
        plans = self._plans(data)
        if self.setup.may_train(self.setup.settings.size):
            data, tested, plans = self._with_stages(data, tested, plans)
        at_speed, at_mean = (
            np.hstack([tested, bands])
            for bands in (self.of_test, self._bands(self.test, np.ones(len(self.test))))
        )
        usual = self._answers(plans[ROWS[0]], data, at_speed)
        seen, found = data.take(self.known), {ROWS[0]: usual}
        for name in ROWS[1:-1]:
            answers = self._answers(plans[name], seen, at_speed)
            found[name] = np.where(self.told, answers, usual)
        found[ROWS[-1]] = self._answers(plans[ROWS[2]], seen, at_mean)
        return {name: answers == self.test.labels for name, answers in found.items()}

    def _answers(self, scored: ScoredPlan, data: HeadData, tested: Array) -> Array:
        """Numbers of materials [n] for features [n, F]."""
        weight, bias = scored.plan.fit(data, len(self.train.materials))
        answers: Array = (tested @ weight.T + bias).argmax(axis=1)
        return answers

    def _bands(self, sweeps: Dataset, ratio: Array) -> Array:
        x = signals(sweeps, self.fixed.trunk.scale)
        return log_bands(x, sweeps.rate_hz, ratio, self.trial.hz)

    def _joined(self, data: HeadData) -> HeadData:
        """The features of the training sweeps and copies, bands over f/v last."""
        features, copied = (data.features, self.own), (data.copied, self.copied)
        return replace(data, features=np.hstack(features), copied=np.hstack(copied))

    def _plans(self, data: HeadData) -> dict[str, ScoredPlan]:
        """The heads without bands over f/v, with them in both forms, and those that held-out
        groups ask for by the rule of the relations."""
        usual = self.setup.scores(self.fixed.data, self.setup.parts)
        base = choice.choose(usual, recipe.candidates(self.fixed, self.setup), no_log)
        scores, parts = self._scores(data, self.setup.parts), base.plan.parts
        before = self.fixed.data.features.shape[1]
        bands = tuple(range(before, before + self.own.shape[1]))
        beside = (*parts, HeadPart(bands, parts[0].copies))
        in_each = [replace(part, columns=part.columns + bands) for part in parts]
        forms = [scores.score(heads) for heads in (beside, in_each)]
        best = min(forms, key=scores.loss)
        asked = best if scores.helps(best, scores.score(parts)) else base
        return dict(zip(ROWS[:-1], (base, *forms, asked), strict=True))

    def _scores(self, data: HeadData, parts: Sequence[InnerPart]) -> HeldOutScores:
        """The scores on the held-out sweeps whose speed is known."""
        seen = [InnerPart(part.group, part.out[self.known]) for part in parts]
        given = [data.take(self.known)] * len(parts)
        return HeldOutScores(given, seen, len(self.train.materials))

    def _with_stages(
        self, data: HeadData, tested: Array, plans: dict[str, ScoredPlan]
    ) -> tuple[HeadData, Array, dict[str, ScoredPlan]]:
        """All three with the features of trained stages, which come first, and their
        discriminant."""
        trunk, responses = self.setup.stages
        data = responses.beside(data)
        scores = self._scores(data, [self.setup.judging])
        chosen = {}
        for name, plan in plans.items():
            beside = stage_heads.beside(plan.plan)
            joined, without = scores.score(beside), scores.score(beside[1:])
            chosen[name] = without if scores.worse(joined, without) else joined
        return data, np.hstack([trunk.features(self.test), tested]), chosen


def simulated(
    seed: int, world: str, off: Sequence[str], test: skin.SetName, speeds: Sequence[Sequence[float]]
) -> Dataset:
    """A sweep of each material at POSITIONS attachments and each of the speeds in training, and at
    others at each of the speeds of the test. Group `speed` is in um/s; `split` is 1 for the
    test."""
    physics = replace(skin.WORLDS[world], off=frozenset(off))
    samples, rows = [], []
    for half, name in enumerate(("T-REAL", test)):
        found = (skin.placements(name, 10 * seed + half + 2 * i) for i in range(POSITIONS))
        places = [place for some in found for place in some][:POSITIONS]
        for speed, (at, place), label in product(
            speeds[half], enumerate(places), range(len(skin.MATERIALS))
        ):
            um_s = round(1000 * NOMINAL_MM_S * speed)
            rng = np.random.default_rng([seed, half, um_s, at, label])
            slid = replace(physics, speed=speed)
            samples.append(skin.window(skin.MATERIALS[label], place, rng, slid))
            rows.append((label, at + half * POSITIONS, um_s, half))
    labels, position, speed_um_s, split = np.array(rows).T
    groups = {"position": position, "speed": speed_um_s, "split": split}
    format = skin.FORMAT
    return Dataset(np.stack(samples), labels, skin.MATERIALS, format.rate_hz, groups, "simulated")


def simulated_trials(seed: int) -> Iterator[list[SpeedTrial]]:
    """For each of SIMULATED the trials of one seed: with the true and with the measured speed."""
    meter = SlideMeter(skin.FORMAT, skin.PITCH_MM)
    for world, off, test, slow, fast in SIMULATED:
        sweeps = simulated(seed, world, off, test, (slow, fast))
        folds = Protocol("split:split=0->1").folds(sweeps, seed)
        measured = [meter(window).speed_mm_s or np.nan for window in sweeps.samples]
        named = world or "hardness", *(f"no {effect}" for effect in off), test
        name = f"{', '.join(named)}, {slow} to {fast}"
        yield [
            SpeedTrial(f"{name}, {kind} speed", sweeps, folds, np.array(speeds), SIMULATED_HZ)
            for kind, speeds in (("true", sweeps.group("speed") / 1000), ("measured", measured))
        ]


def fabric_trials(data: Path, seed: int) -> Iterator[SpeedTrial]:
    """FabricSlide with one group left out, without means."""
    whole = sets.load(str(data / "fabricslide" / "fabricslide.npz"))
    for name, only, groups in FABRICS:
        sweeps = whole.select(only)
        for group in groups:
            folds = Protocol(f"leave:{group}").folds(sweeps, seed)
            speeds = sweeps.group("speed").astype(float)
            stripped = sweeps.without_means()
            yield SpeedTrial(f"{name}, a {group} out", stripped, folds, speeds, FABRIC_HZ)


def show(name: str, right: dict[str, list[Array]], clusters: Sequence[Array]) -> None:
    """Print the accuracy of each row, and its difference from the first with a standard error over
    clusters, such as recordings."""
    cluster = np.unique(np.concatenate(clusters), return_inverse=True)[1]
    first = np.concatenate(right[ROWS[0]])
    for row, parts in right.items():
        answers = np.concatenate(parts)
        by = 100 * np.bincount(cluster, answers.astype(float) - first)
        error = np.sqrt(len(by) / (len(by) - 1) * ((by - by.mean()) ** 2).sum()) / len(first)
        print(
            f"{name:66} {row:22} {100 * answers.mean():5.1f} % of {len(answers)}, "
            f"{by.sum() / len(first):+5.2f} +- {error:.2f}",
            flush=True,
        )


def measure(trials: Sequence[SpeedTrial], steps: int, seed: int) -> None:
    """Print the accuracy of each fold, and the rows of all trials, which have one name."""
    right: dict[str, list[Array]] = {row: [] for row in ROWS}
    clusters: list[Array] = []
    for number, trial in enumerate(trials):
        for index, fold in enumerate(trial.folds):
            done = SpatialFold(trial, fold, steps, seed)
            answers = done.right()
            shares = (f"{row} {100 * answers[row].mean():.1f}" for row in ROWS)
            print(f"  fold {index}, {len(done.test)} sweeps: {', '.join(shares)} %", flush=True)
            for row in ROWS:
                right[row].append(answers[row])
            clusters.append(done.test.group("recording") + (number << 20))
    show(trials[0].name, right, clusters)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.speed_bands", description=__doc__
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=0, help="of trained stages; 0 for none")
    args = parser.parse_args()
    for same in zip(*map(simulated_trials, SEEDS), strict=True):
        for trials in zip(*same, strict=True):
            measure(trials, args.steps, args.seed)
    if data := os.environ.get("PALPATE_DATA"):
        for trial in fabric_trials(Path(data), args.seed):
            measure([trial], args.steps, args.seed)


if __name__ == "__main__":
    main()
