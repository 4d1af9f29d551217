"""The answers of a bundle while taxels are broken, with and without bridging, as a table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Frames, Status, Sweep
from palpate.inference.classifier import Classifier
from palpate_train.evaluate.corruptions import TAXEL_FAULTS, find
from palpate_train.evaluate.evaluation_sweeps import EvaluationSweeps
from palpate_train.export.bundle_stress import answers

SHOWN = ("rightly", "wrongly", "unsure", "unknown", "refused")
RUNS = 2000
"""Classifications of a sweep that are timed in turns with and without bridging."""


def _boxes(bundle: Bundle) -> dict[str, Classifier]:
    """The classifier without and with the bundle's bridging."""
    without = replace(bundle, manifest=replace(bundle.manifest, bridging=None))
    return {
        name: Classifier(used, SystemClock())
        for name, used in (("refused", without), ("bridged", bundle))
    }


def table(bundle: Bundle, test: EvaluationSweeps, seed: int) -> Iterator[str]:
    """A line for each fault and number of broken taxels, at random places in each sweep, as in the
    study `stress`: the network alone, and the answers of the box without and with bridging."""
    boxes = _boxes(bundle)
    yield f"{test.sweeps.source}: {len(test.sweeps)} sweeps, bundle {bundle.id}"
    yield f"{'':16} network | without bridging: {', '.join(SHOWN)} | with bridging: the same"
    for corruption in find(tuple(TAXEL_FAULTS)):
        for number in corruption.severities[1:]:
            broken = corruption.apply(test, number, seed)
            sweeps = replace(test.sweeps, samples=broken)
            counts = {name: answers(box, sweeps) for name, box in boxes.items()}
            network = int(counts["bridged"]["network"].sum())
            shown = " | ".join(
                " ".join(f"{int(given[answer].sum()):4}" for answer in SHOWN)
                for given in counts.values()
            )
            yield f"{corruption.name:6} {number:g} taxels  {network:7} | {shown}"


def times(bundle: Bundle) -> str:
    """The median time of a sound sweep from its window to its verdict, without and with bridging,
    in turns; and with a dead taxel."""
    boxes = _boxes(bundle)
    sound, dead = bundle.golden[0], bundle.golden[0].copy()
    dead[:, 0, 0] = 0
    calls: dict[str, Callable[[], Any]] = {
        "without": lambda: boxes["refused"](_sweep(bundle, sound)),
        "with": lambda: boxes["bridged"](_sweep(bundle, sound)),
        "with a dead taxel": lambda: boxes["bridged"](_sweep(bundle, dead)),
        "network": lambda: boxes["bridged"].logits(sound),
    }
    taken: dict[str, list[int]] = {name: [] for name in calls}
    for _ in range(RUNS):
        for name, call in calls.items():
            begin_ns = time.perf_counter_ns()
            call()
            taken[name].append(time.perf_counter_ns() - begin_ns)
    parts = ", ".join(f"{name} {median(ns) / 1e6:.3f} ms" for name, ns in taken.items())
    return f"median of {RUNS} classifications in turns: {parts}"


def _sweep(bundle: Bundle, taxels: NDArray[Any]) -> Sweep:
    n = np.arange(len(taxels))
    return Sweep(1, 0, 0, Status.OK, Frames(n, n, taxels))
