"""Every tick label of every picture shows the value at the position of its tick."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter

from palpate.core.types import SweepFormat
from palpate_studies import (
    development_report,
    overview_plot,
    paper_report,
    stress_report,
    uncertainty_report,
)
from palpate_train.reports import bundle_report, plot_style, selection_plots, sweep_plot
from tests.factories import choice_data, development_data, stress_data
from tests.factories.study_pages import committed


def image() -> str:
    """A sweep of a skin with too many taxels for a plot of each."""
    form = SweepFormat(12, 12, 50.0, 40, "float32")
    counts = np.random.default_rng(0).random((40, 12, 12), np.float32)
    return sweep_plot.draw(
        sweep_plot.ShownSweep(
            counts, np.arange(40) / 50, form, "", (), "seconds", None, np.empty(0, int)
        )
    )


PICTURES: dict[str, Callable[[], Any]] = {
    "paper": lambda: paper_report.render(committed("paper")),
    "certainty": lambda: uncertainty_report.render(committed("certainty")),
    "stress": lambda: stress_report.render(stress_data.figures()),
    "choice": lambda: selection_plots.sizes(choice_data.choice()["rungs"], "pairs", 0.9, "sizes"),
    "less": lambda: selection_plots.reductions(choice_data.choice()["less"], "less"),
    "sweep": lambda: sweep_plot.draw(sweep_plot.load("sim:T-REAL:1001:1", 3)),
    "image": image,
    "development": lambda: development_report.render(development_data.figures()),
    "bundle": lambda: bundle_report.calibration(
        {"n": 9, "bins": [{"said": 0.6, "right": 0.5, "n": 4}, {"said": 0.9, "right": 1.0, "n": 5}]}
    ),
    "curve of a bundle": lambda: bundle_report.curve(
        [{"each": n, "share": 0.5, "low": 0.4, "high": 0.6} for n in (5, 10, 37.5)]
    ),
    "confusion of a bundle": lambda: bundle_report.confusion(
        {"labels": ["a", "b"], "answers": {"a": {"a": 3, "b": 1}}}
    ),
    "overview": lambda: overview_plot.draw("paper"),
}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Collects each figure that becomes an SVG."""
    found: list[Figure] = []
    save = Figure.savefig

    def saved(figure: Figure, *args: Any, **options: Any) -> None:
        save(figure, *args, **options)
        found.append(figure)

    monkeypatch.setattr(Figure, "savefig", saved)
    return found


def axes_of(figure: Figure) -> Iterator[Axis]:
    """All axes that show ticks."""
    for axes in figure.axes:
        if axes.axison:
            yield from (axes.xaxis, axes.yaxis)


def wrong_labels(axis: Axis) -> list[tuple[float, str]]:
    """Ticks (position, label) whose label is another number than their position.

    The last label has a unit. A label is correct to five significant digits, which is far less than
    half of its last place.
    """
    ticks = [(tick.get_loc(), tick.label1.get_text()) for tick in axis.get_major_ticks()]
    shown = [(at, label) for at, label in ticks if label]
    unit = shown[-1][1].partition(" ")[2] if shown else ""
    factor = 100 if unit.startswith("%") else 1e-3 if unit == "k" else 1
    return [
        (at, label)
        for at, label in shown
        if float(label.partition(" ")[0].replace("−", "-"))
        != pytest.approx(factor * at, rel=1e-5, abs=1e-12)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_labels_are_where_they_say(name: str, drawn: list[Figure]):
    """The labels of an axis with values are those of its ticks. Only names may be another text."""
    PICTURES[name]()
    assert drawn
    named = 0
    for figure in drawn:
        for axis in axes_of(figure):
            if isinstance(axis.get_major_formatter(), FixedFormatter):
                named += 1
            else:
                assert wrong_labels(axis) == []
    assert (named > 0) == (name in ("less", "image"))


@pytest.mark.parametrize(
    ("ticks", "labels"),
    [
        ((0.9, 0.925, 0.95, 0.975, 1.0), ["90", "92.5", "95", "97.5", "100 %"]),
        ((0.0, 1 / 3, 0.7000000001), ["0", "33.3333", "70 %"]),
        ((-0.5, 0.987), ["−50", "98.7 %"]),
    ],
)
def test_ticks_have_as_many_decimals_as_they_need(ticks: tuple[float, ...], labels: list[str]):
    """No label is rounded to the places of another."""
    figure, axes = plot_style.single_axes(2, 0.1, 0.9, 0.1, 0.1)
    axes.set_xlim(-1, 1)
    plot_style.set_ticks(axes.xaxis, ticks, percent=True)
    plot_style.set_ticks(axes.yaxis, [1e-5, 12_500], "ms")
    plot_style.to_svg(figure, "ticks")
    assert [label.get_text() for label in axes.get_xticklabels()] == labels
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0.00001", "12500 ms"]
    assert wrong_labels(axes.xaxis) == []
