"""A page to leaf through a set: one HTML file with a picture of each sweep, turned with the arrow
keys.

A page has at most about MOST_BYTES, so that a browser opens it at once. For a larger set it shows
sweeps spread over the whole set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.progress import Progress
from palpate_train.reports import html, sweep_plot
from palpate_train.reports.sweep_plot import SweepSource

MOST, MOST_BYTES = 100, 20_000_000
"""Largest number of sweeps on a page if none are named, and largest size of their pictures in
bytes."""


def chosen(found: SweepSource, numbers: range | None) -> list[int]:
    """The numbers of the sweeps on a page: those in `numbers`, otherwise at most MOST, spread over
    the set.

    Raises FormatError if the set has no such sweeps, or if `numbers` are more than a page holds.
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
