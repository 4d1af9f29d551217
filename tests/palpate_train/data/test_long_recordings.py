"""Means of float32 counts over many frames, which float32 alone would get wrong by 600."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from palpate.answer import features
from palpate.answer.slide import vibration
from palpate.answer.unloaded import UnloadedSkin
from palpate.answer.window import Window
from palpate.core.clock import SystemClock
from palpate.core.types import SweepFormat
from palpate.sweeps.sweep_check import SweepCheck
from palpate_train.data.augment import texture_scale
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.junk import Slides
from palpate_train.data.sets import Dataset
from palpate_train.data.transforms import log_powers
from palpate_train.onnx_tools.graph_builder import GraphBuilder, centred, run

FRAMES = 1_350_000
"""Half an hour at 750 Hz."""
COUNTS = (50_000 + np.random.default_rng(0).normal(size=(FRAMES, 2, 2))).astype(np.float32)
EXACT = COUNTS.astype(np.float64)
WINDOW = 8_800
SWEEPS = Dataset(COUNTS[: 4 * WINDOW].reshape(4, WINDOW, 2, 2), np.arange(4) % 2, ("a", "b"), 750.0)
LEFT = SWEEPS.without_means().samples.astype(np.float64)
OFFSET = np.float32(50_000)
SLIDES = Slides(COUNTS[None], COUNTS[None], np.zeros((2, 2)), 750.0, np.random.default_rng(0))


def graph_means() -> np.ndarray:
    """Mean of each taxel after the graph has subtracted it."""
    g, format = GraphBuilder(), SweepFormat(2, 2, 750.0, WINDOW, "float32")
    model = g.model(format, centred(g, format)[0], format.channels, WINDOW)
    return run(model, SWEEPS.samples).mean(axis=2, dtype=np.float64)


def tared() -> SweepCheck:
    """A recording that takes a tare."""
    return SweepCheck(SweepFormat(2, 2, 750.0, WINDOW, "float32"), SystemClock())


CASES: dict[str, tuple[Callable[[], Any], Any, float]] = {
    "unloaded level": (lambda: UnloadedSkin.measured(COUNTS).level, EXACT.mean(axis=0), 1e-6),
    "unloaded noise": (lambda: UnloadedSkin.measured(COUNTS).noise, EXACT.std(axis=0), 1e-6),
    "tare": (lambda: float(tared().set_tare(COUNTS).split()[1]), EXACT.mean(axis=0).max(), 0.06),
    "tare, 16 bits": (
        lambda: float(tared().set_tare(np.rint(COUNTS).astype(np.uint16)).split()[1]),
        EXACT.mean(axis=0).max(),
        0.06,
    ),
    "window": (lambda: Window(COUNTS[:WINDOW]).mean, EXACT[:WINDOW].mean(axis=0).ravel(), 1e-3),
    "features": (lambda: features.means(features.series_of(COUNTS)), EXACT.mean(0).ravel(), 1e-6),
    "vibration": (
        lambda: vibration(COUNTS[:WINDOW], np.zeros((2, 2)), 1),
        np.log(np.sqrt(EXACT[:WINDOW].var(axis=0).mean()) / EXACT[:WINDOW].mean()),
        1e-4,
    ),
    "without means": (lambda: LEFT.mean(axis=1), 0, 1e-3),
    "scale": (lambda: texture_scale(SWEEPS.samples), 1 / LEFT.std(), 1e-4),
    "deviation": (lambda: EvaluationSweeps.of(SWEEPS).rms, LEFT.std(), 1e-4),
    "powers": (lambda: log_powers(SWEEPS.samples), log_powers(SWEEPS.samples - OFFSET), 1e-6),
    "junk's load": (lambda: SLIDES.load[0, 0], EXACT.mean(axis=0), 4e-3),
    "junk's noise": (lambda: SLIDES.deviation[0, 0], EXACT.std(axis=0), 1e-4),
    "graph": (graph_means, 0, 0.5),
}
"""What is computed, the value, and its largest error in counts."""


@pytest.mark.parametrize("name", CASES)
def test_no_mean_drifts_with_the_number_of_frames(name: str):
    """At 50,000 counts with a deviation of 1."""
    compute, want, error = CASES[name]
    np.testing.assert_allclose(compute(), want, rtol=0, atol=error)
