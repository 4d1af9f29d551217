"""A page to leaf through a set. In: the sweeps to show. Out: one HTML file, a picture of each, the
arrow keys turn it.

A page is no larger than about MOST_BYTES, so that a browser opens it at once; of larger sets sweeps
from all over it are shown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from appliance.core.errors import FormatError
from train.data.progress import Progress
from train.reports import html, sweep_plot
from train.reports.sweep_plot import SweepSource

MOST, MOST_BYTES = 100, 20_000_000
"""Of a page: sweeps where none are named, and bytes of their pictures."""


def chosen(found: SweepSource, numbers: range | None) -> list[int]:
    """The numbers of the sweeps that a page shows: those named by `numbers`, else MOST at most from
    all over the set.

    Raises FormatError where the set has no such sweeps, or where more are named than a page holds.
    """
    if not found.count:
        raise FormatError(
            f"{found.name} holds no sweep that could be shown; palpate-train sets describe says why"
        )
    held = max(1, MOST_BYTES // len(sweep_plot.draw(found.get(0), plain=False)))
    if numbers is None:
        return [round(at) for at in np.linspace(0, found.count - 1, min(found.count, MOST, held))]
    if numbers.stop > found.count:
        raise FormatError(
            f"--number {numbers.start}-{numbers.stop - 1}: {found.name} holds sweeps 0 to "
            f"{found.count - 1}; name some of them"
        )
    if len(numbers) > held:
        raise FormatError(
            f"--number {numbers.start}-{numbers.stop - 1} are {len(numbers)} sweeps; a "
            f"page holds {held} of this skin: name fewer"
        )
    return list(numbers)


def page(found: SweepSource, numbers: Sequence[int], log: Callable[[str], None]) -> str:
    """The page (HTML) of the sweeps `numbers`. log: receives the progress."""
    shown, progress = [], Progress(len(numbers), log)
    for number in numbers:
        sweep = found.get(number)
        shown.append((number, sweep.title, html.picture(sweep_plot.draw(sweep, plain=False))))
        progress(f"sweep {number} drawn")
    return html.render("sweeps.html.j2", name=found.name, count=found.count, sweeps=shown)
