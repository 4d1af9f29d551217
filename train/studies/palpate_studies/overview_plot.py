"""Draws the README's picture: finger, signal and answer of one simulated sweep (SVG)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch, Rectangle
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.core.types import Verdict
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate_train.data import sets
from palpate_train.metrics import bundle_score
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    add_axes,
    to_svg,
    write,
)

WIDE, HIGH = 10.0, 3.5
SEED = 7
"""Seed of the simulated world. The packaged bundle was not trained on it."""
SHOWN_S = 0.4
"""Seconds of the middle of the sweep that are drawn."""


def draw(material: str, seed: int = SEED) -> str:
    """Three panels from left to right: the finger on a tube of `material`, the signal of its
    taxels, the verdict.

    The sweep is simulated, from a skin position that the bundle was not trained on. Raises
    FormatError for a material that is not simulated.
    """
    sweeps = sets.load(f"sim:T-REAL/level-blind:{seed}")
    if material not in sweeps.materials:
        raise FormatError(
            f"material {material!r} is not simulated; use one of {', '.join(sweeps.materials)}"
        )
    one = sweeps.take(np.flatnonzero(sweeps.labels == sweeps.materials.index(material))[:1])
    samples, loaded = one.samples[0], bundle.load(bundle.DEFAULT)
    ((_, verdict),) = bundle_score.verdicts(Classifier(loaded, SystemClock()), one)
    figure = Figure((WIDE, HIGH))
    page = add_axes(figure, 0, 1, 1, 0)
    page.set(xlim=(0, WIDE), ylim=(0, HIGH))
    page.set_axis_off()
    for x, title in (
        (0.25, "1  The finger slides"),
        (3.55, "2  The skin sends 16 signals"),
        (7.0, "3  The box answers"),
    ):
        write(page, x, HIGH - 0.3, title, BLACK, MEDIUM + 2, ha="left", weight="bold")
    _finger(page, samples)
    _signal(add_axes(figure, 0.355, 0.665, 0.80, 0.17), samples)
    _answer(page, verdict, loaded.manifest.labels)
    about = (
        f"A finger slides along a tube of {material}; the signal of 16 taxels; "
        f"the box answers {verdict.label}"
    )
    return to_svg(figure, about + " (simulated)", plain=True)


def _finger(page: Axes, samples: NDArray[Any]) -> None:
    """Tube, finger, and the skin's taxels, darker where the sweep pressed more."""
    page.add_patch(
        FancyBboxPatch(
            (0.2, 0.62), 2.9, 0.62, boxstyle="round,pad=0,rounding_size=0.12", fc=FAINT, ec="none"
        )
    )
    page.add_patch(Ellipse((3.02, 0.93), 0.22, 0.62, fc=GREY, ec="none"))
    page.add_patch(
        FancyBboxPatch(
            (1.05, 1.24),
            1.1,
            1.55,
            boxstyle="round,pad=0,rounding_size=0.5",
            fc="#f3e3d3",
            ec=GREY,
            lw=1.5,
        )
    )
    mean = samples.mean(axis=0)
    shade = (mean - mean.min()) / max(float(np.ptp(mean)), 1.0)
    side = 0.2
    for row, column in np.ndindex(*shade.shape):
        at = (1.2 + column * side, 1.42 + (shade.shape[0] - 1 - row) * side)
        alpha = 0.15 + 0.85 * float(shade[row, column])
        taxel = Rectangle(at, side * 0.88, side * 0.88, fc=ACCENT, alpha=alpha, ec="none")
        page.add_patch(taxel)
    page.add_patch(
        FancyArrowPatch(
            (0.55, 0.38), (2.65, 0.38), arrowstyle="-|>", mutation_scale=14, color=BLACK, lw=1.5
        )
    )
    write(page, 1.6, 0.16, "two seconds along a tube", GREY, SMALL)


def _signal(axes: Axes, samples: NDArray[Any]) -> None:
    """Each taxel's change about its mean over the middle of the sweep, one above the other."""
    count = round(SHOWN_S * skin.FORMAT.rate_hz)
    first = (len(samples) - count) // 2
    lines = samples[first : first + count].reshape(count, -1).astype(float)
    lines -= lines.mean(axis=0)
    step = 4.5 * lines.std()
    time_s = np.arange(count) / skin.FORMAT.rate_hz
    for i, line in enumerate(lines.T):
        axes.plot(time_s, line - i * step, color=ACCENT, linewidth=0.6)
    axes.set(xlim=(0, SHOWN_S), ylim=(-lines.shape[1] * step, step))
    axes.set_xticks([])
    axes.set_yticks([])
    write(
        axes,
        SHOWN_S / 2,
        -lines.shape[1] * step * 1.13,
        f"{SHOWN_S:g} s of raw counts at {skin.FORMAT.rate_hz:g} Hz (simulated)",
        GREY,
        SMALL,
    )


def _answer(page: Axes, verdict: Verdict, labels: tuple[str, ...]) -> None:
    """The label in large letters, the probability of every label as a bar."""
    left, width = 7.0, 1.35
    write(page, left, 2.62, verdict.label, ACCENT, MEDIUM + 9, ha="left", weight="bold")
    order = sorted(zip(labels, verdict.scores, strict=True), key=lambda pair: -pair[1])
    for i, (label, probability) in enumerate(order):
        y = 2.1 - 0.27 * i
        write(page, left, y, label, BLACK if i == 0 else GREY, SMALL, ha="left")
        for long, shade in ((width, FAINT), (width * float(probability), ACCENT)):
            bar = Rectangle((left + 1.05, y - 0.07), long, 0.14, fc=shade, ec="none")
            page.add_patch(bar)
        share, shade = f"{100 * probability:.1f} %", BLACK if i == 0 else GREY
        write(page, left + 1.05 + width + 0.08, y, share, shade, SMALL, ha="left")
    write(page, left, 0.3, "on a serial line and on GPIO lines", GREY, SMALL, ha="left")
