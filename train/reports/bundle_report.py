"""The report on one bundle, a page to hand to a colleague. In: the figures of bundle_experiment, the sweeps. Out: HTML.

Nothing is computed here but shares of counts, and the spectrograms of the sweeps that are shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import spectrogram

from train.data.sets import Dataset
from train.reports import formatting, html, plots, provenance, sweep_plot
from train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    SMALL,
    WHITE,
    WIDTH,
    add_axes,
    set_ticks,
    single_axes,
    to_svg,
    write,
)

Array = NDArray[Any]
Json = Mapping[str, Any]
MOST_IN_MATRIX = 12
"""Labels up to which the confusion matrix can be read on a phone; with more there is the table alone."""
MOST_SHOWN = 6
"""Materials of which a sweep is shown."""
LEAST_FRAMES = 64
"""Of a window, for a spectrogram."""
RANGE_DB = 50
"""Of power that a spectrogram shows, below the largest."""
SHADES = LinearSegmentedColormap.from_list("power", [WHITE, ACCENT, BLACK])
MATERIALS = [
    "material",
    "sweeps",
    "named rightly",
    "right where named",
    "unsure",
    "unknown",
    "refused",
    "taken for",
]
CORRUPTIONS = ["what goes wrong", "five points are lost at", "at the largest tried", "rightly", "wrongly", "not named"]


def page(figures: Json, sweeps: Dataset) -> str:
    """The page (HTML)."""
    matrix = figures["labels"] if len(figures["labels"]) <= MOST_IN_MATRIX else []
    pictures = {"calibration": html.picture(calibration(figures["calibration"]))}
    if matrix:
        pictures["confusion"] = html.picture(confusion(figures))
    shown = _examples(sweeps)
    if sweeps.format.window >= LEAST_FRAMES:
        pictures["spectrograms"] = html.picture(spectrograms(sweeps, shown))
    return html.render(
        "bundle.html.j2", header=provenance.of(figures), f=figures, pictures=pictures, range_db=RANGE_DB,
        right=[figures["named_rightly"]["right"] / figures["named_rightly"]["total"], *figures["named_rightly"]["interval"]],
        statuses=sorted(figures["statuses"].items(), key=lambda item: -item[1]),
        material_head=MATERIALS, materials=[_material(row) for row in figures["materials"]],
        corruption_head=CORRUPTIONS, corruptions=[_corruption(row) for row in figures["corruptions"]],
        foreign=[[name, sum(given.values()), given.get("(unknown)", 0)] for name, given in figures["not_in_the_bundle"].items()],
        held_out=[[name, formatting.estimate([of[k] for k in ("accuracy", "low", "high")]), of["n"]]
                  for name, of in figures["figures"].items() if "accuracy" in of],
        signals=[html.picture(sweep_plot.draw(sweep_plot.of_set(sweeps, i), plain=False)) for i in shown],
    )  # fmt: skip


def _material(row: Json) -> list[str]:
    wrong = "{} ({})".format(*row["taken_for"]) if row["taken_for"] else ""
    shares = [formatting.estimate(row[k]) if row[k] else "–" for k in ("recall", "precision")]
    return [row["name"], str(row["sweeps"]), *shares, *(str(row[k]) for k in ("unsure", "unknown", "refused")), wrong]


def _corruption(row: Json) -> list[str]:
    """One thing that goes wrong, and what becomes of the sweeps at its largest severity."""
    most, right, wrong = row["severities"][-1], row["right"][-1], row["wrong"][-1]
    falls = "–" if row["falls"] is None else f"{row['falls']:.2g} {row['unit']}"
    shares = [formatting.percent(n / row["total"], 0) for n in (right, wrong, row["total"] - right - wrong)]
    return [f"{row['name']}: {row['about']}", falls, f"{most:g} {row['unit']}", *shares]


def _examples(sweeps: Dataset) -> list[int]:
    """A sweep of each of the first materials: the middle one of its own."""
    labels = np.unique(sweeps.labels)[:MOST_SHOWN]
    return [int(own[len(own) // 2]) for label in labels if len(own := np.flatnonzero(sweeps.labels == label))]


def confusion(figures: Json) -> str:
    """Which label the sweeps of each material get, those that get one: rows the truth."""
    names = figures["labels"]
    counts = [[figures["answers"].get(of, {}).get(named, 0) for named in names] for of in names]
    return plots.confusion(np.array(counts), names, "materials by the labels that they get")


def calibration(found: Json) -> str:
    """Predicted probability against the share right; a larger dot is of more sweeps."""
    figure, axes = single_axes(3.0, left=0.14, right=0.97, top=0.15, bottom=0.5)
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.2)
    said, right = [b["said"] for b in found["bins"]], [b["right"] for b in found["bins"]]
    sizes = [6 + 60 * (b["n"] / found["n"]) ** 0.5 for b in found["bins"]]
    axes.plot(said, right, color=ACCENT, linewidth=1.4)
    axes.scatter(said, right, sizes, color=ACCENT, zorder=3)
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.grid(color=FAINT, linewidth=0.6)
    for axis in (axes.xaxis, axes.yaxis):
        set_ticks(axis, [0, 0.25, 0.5, 0.75, 1], percent=True)
    axes.set_xlabel("predicted probability", color=GREY, size=SMALL)
    axes.set_ylabel("share right", color=GREY, size=SMALL)
    return to_svg(figure, "share right against the predicted probability")


def spectrograms(sweeps: Dataset, shown: list[int]) -> str:
    """Power over time and frequency, the mean of all taxels, of each sweep that is shown; all on one scale in decibels."""
    frames, rate = sweeps.format.window, sweeps.rate_hz
    powers = []
    for i in shown:
        taxels = sweeps.samples[i].reshape(frames, -1).astype(np.float64)
        hz, s, power = spectrogram(taxels, rate, nperseg=min(frames // 4, 128), axis=0, detrend="constant")
        powers.append(10 * np.log10(power.mean(axis=1) + 1e-9))
    top = max(p.max() for p in powers)
    figure = Figure((WIDTH, 0.95 * len(shown) + 0.45))
    high = figure.get_figheight()
    for row, (i, power) in enumerate(zip(shown, powers, strict=True)):
        axes = add_axes(figure, 0.3, 0.97, 1 - (0.1 + 0.95 * row) / high, 1 - (0.87 + 0.95 * row) / high)
        ends = (s[0], s[-1], hz[0], hz[-1])
        axes.imshow(power, origin="lower", aspect="auto", cmap=SHADES, vmin=top - RANGE_DB, vmax=top, extent=ends)
        name = sweeps.materials[sweeps.labels[i]].replace(" ", "\n")
        write(axes, -0.14, 0.5, name, ha="right", xycoords="axes fraction", parse_math=False)
        set_ticks(axes.yaxis, [0, np.floor(hz[-1])])
        times = np.linspace(0, frames / sweeps.rate_hz, 5)
        set_ticks(axes.xaxis, times[(times >= s[0]) & (times <= s[-1])], bare=row < len(shown) - 1)
    axes.set_xlabel("seconds to the right, Hz upwards", color=GREY, size=SMALL)
    return to_svg(figure, "power over time and frequency, a sweep of each material")
