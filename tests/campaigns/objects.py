"""Counts wrong answers with NEW OBJECT forgotten, and with NEW OBJECT before each object.

`python -m tests.campaigns objects` prints a table for each of several rules by which an object ends
by itself (docs/decisions/0006). All rules get the same simulated sweeps of the packaged bundle: in
place, displaced, attached a row further (T-HARD), and with noise. Takes a minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference import classifier
from palpate.inference.classifier import Classifier, Touched
from palpate.inference.objects import contradicts
from palpate.signal.contact import Displacement
from palpate.sim import skin
from palpate.sim.rig import VirtualClock

Scores = NDArray[np.float64]
Pool = dict[tuple[int, str], list[Verdict]]
"""Verdicts on single sweeps, by number of the attachment and material."""
ATTACHMENTS, EACH, ORDERED = 8, 9, 240
PERIOD_NS, SLIDE_NS = 10_000_000_000, 3_000_000_000


@dataclass(frozen=True)
class Condition:
    """Sweeps of a set in a world, with the skin moved by dx_mm and the noise multiplied."""

    name: str
    world: skin.World = skin.LEVEL_BLIND
    set: skin.SetName = "T-REAL"
    dx_mm: float = 0.0
    noise: float = 1.0

    def pool(self, alone: Classifier, seed: int) -> Pool:
        """The box's answers to EACH sweeps of each material at each attachment."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        world = replace(self.world, noise_counts=self.noise * self.world.noise_counts)
        sets = (skin.placements(self.set, seed + i) for i in range(ATTACHMENTS))
        places = [place for some in sets for place in some][:ATTACHMENTS]
        n = np.arange(skin.FORMAT.window)
        found: Pool = {}
        for at, place in enumerate(places):
            moved = replace(place, dx_mm=place.dx_mm + self.dx_mm)
            for material in skin.MATERIALS:
                windows = (skin.window(material, moved, rng, world) for _ in range(EACH))
                found[at, material] = [
                    alone(Sweep(1, 0, 0, Status.OK, Frames(n, n, window))) for window in windows
                ]
        return found


CONDITIONS = (
    Condition("in place"),
    Condition("2 mm displaced", dx_mm=2),
    Condition("3 mm displaced", dx_mm=3),
    Condition("T-HARD", set="T-HARD"),
    Condition("noise x 4", noise=4),
    Condition("noise x 6, 2 mm", noise=6, dx_mm=2),
    Condition("hardness, T-HARD", skin.WORLD, "T-HARD"),
    Condition("hardness, 2 mm", skin.WORLD, dx_mm=2),
)


@dataclass(frozen=True)
class Rule:
    """A rule by which an object ends. ends: whether a sweep contradicts the fused sweeps, as
    `objects.contradicts`."""

    name: str
    conflict: str = "new"
    max_sweeps: int = 5
    ends: Callable[[Scores, Scores], bool] = contradicts


def both_sure(least: float) -> Callable[[Scores, Scores], bool]:
    """The rule that both name a label with this probability, and not the same."""
    return lambda own, fused: bool(
        min(own.max(), fused.max()) >= least and own.argmax() != fused.argmax()
    )


RULES = (
    Rule("NEW OBJECT alone", "fuse", 0),
    Rule("5 sweeps", ends=lambda own, fused: False),
    Rule("both sure, 0.5", ends=both_sure(0.5)),
    Rule("both sure, 0.9", ends=both_sure(0.9)),
    Rule("same label < 0.1", ends=lambda own, fused: bool(own @ fused < 0.1)),
    Rule("Bayes factor 30", ends=lambda own, fused: bool(len(own) * (own @ fused) < 1 / 30)),
    Rule("Bayes factor 10"),
    Rule("the same, refuse", "refuse"),
)


def forgotten(pool: Pool, rng: Generator) -> Iterator[list[tuple[str, Verdict, int]]]:
    """Three sequences of 240 sweeps of object 1: materials in turn, in random order, in runs of 2
    to 4. The skin is attached anew after every 30 sweeps."""
    names = skin.MATERIALS
    runs = [m for m in rng.choice(names, ORDERED) for _ in range(rng.integers(2, 5))]
    for order in ([*names] * (ORDERED // 6), rng.choice(names, ORDERED), runs[:ORDERED]):
        at = (i // 30 % ATTACHMENTS for i in range(ORDERED))
        yield [
            (str(name), pool[k, str(name)][rng.integers(EACH)], 1)
            for k, name in zip(at, order, strict=True)
        ]


def signalled(pool: Pool, rng: Generator) -> list[tuple[str, Verdict, int]]:
    """All sweeps in objects of three of one material and attachment, twice."""
    found = []
    for _ in range(2):
        for (_, name), verdicts in pool.items():
            for i, k in enumerate(rng.permutation(EACH)):
                found.append(
                    (name, verdicts[k], 1 + len(found) // 3 if i % 3 == 0 else found[-1][2])
                )
    return found


def answers(
    rule: Rule, model: bundle.Bundle, given: Sequence[tuple[str, Verdict, int]]
) -> list[str]:
    """The label of each answer, "" unless its status is ok."""
    it = Classifier(model, VirtualClock(), max_sweeps=rule.max_sweeps, conflict=rule.conflict)
    named = []
    with patch.object(classifier, "contradicts", rule.ends):
        for n, (_, own, object) in enumerate(given, 1):
            times = n * PERIOD_NS, n * PERIOD_NS + SLIDE_NS
            sweep = Sweep(n, *times, Status.OK, Frames.empty(model.format), object=object)
            moved = Displacement(text=own.displacement)
            v = own if not len(own.own) else it.conclude(sweep, own.own, Touched(moved))
            named.append(v.label if v.status is Status.OK else "")
    return named


def counts(rule: Rule, model: bundle.Bundle, pool: Pool, seed: int) -> list[int]:
    """Answers that are wrong though the sweep alone is right, of each sequence of `forgotten`; then
    wrong and right answers of `signalled`, and of these wrong and right ones to the third sweep."""
    rng = np.random.default_rng(seed)
    found = []
    for given in forgotten(pool, rng):
        pairs = zip(given, answers(rule, model, given), strict=True)
        found.append(
            sum(
                v.label == name != label != "" and v.status is Status.OK
                for (name, v, _), label in pairs
            )
        )
    given = signalled(pool, rng)
    labels = answers(rule, model, given)
    for some in (slice(None), slice(2, None, 3)):
        pairs = [(name, label) for (name, _, _), label in zip(given, labels, strict=True)][some]
        found += [sum(label not in ("", name) for name, label in pairs)]
        found += [sum(label == name for name, label in pairs)]
    return found


def main() -> None:
    """Print the counts for each condition and rule, and their sums."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.objects", description=__doc__)
    parser.add_argument("--seed", type=int, default=900)
    seed = parser.parse_args().seed
    model = bundle.load(bundle.DEFAULT)
    alone = Classifier(model, VirtualClock())
    sums = {rule.name: np.zeros(7, np.int64) for rule in RULES}
    print(
        f"{'condition':17} {'rule':17} forgotten: in turn, random, runs (of {ORDERED}); "
        "signalled: wrong, right answers, of third sweeps"
    )
    for condition in CONDITIONS:
        pool = condition.pool(alone, seed)
        for rule in RULES:
            found = counts(rule, model, pool, seed)
            sums[rule.name] += found
            print(f"{condition.name:17} {rule.name:17}", *(f"{n:5}" for n in found), flush=True)
    for name, found in sums.items():
        print(f"{'all':17} {name:17}", *(f"{n:5}" for n in found))


if __name__ == "__main__":
    main()
