"""One figure for each question: the tables of the page "Which number to quote"."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from palpate_studies import development_chart, markdown
from palpate_studies.method_names import plain_name
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.reports.formatting import amount, estimate, percent

Json = Mapping[str, Any]
Row = tuple[str, str, str]
"""A question, its figure, and the test."""
HEAD = ("question", "figure, 95 % interval", "test")


def _table(rows: Iterable[Row]) -> str:
    return f"\n{markdown.table(HEAD, rows)}\n"


def recorded(results: Json) -> str:
    """Accuracy on recorded data and time of a sweep, of the default recipe and the packaged one."""
    return _table(_recorded(results))


def _recorded(results: Json) -> Iterator[Row]:
    for panel in development_chart.panels(results):
        for spot in panel.whole:
            if spot.method in (SHIPPED, PACKAGED) and not spot.form:
                test = f"mean of {len(panel.cases)} tests: {panel.kind}"
                yield f"accuracy: {plain_name(spot.method)}", estimate(spot.accuracy), test
    times = results.get("times") or {"entries": (), "format": ""}
    for method, ms in development_chart.quickest(times["entries"]).items():
        if method in (SHIPPED, PACKAGED):
            yield f"time of a sweep: {plain_name(method)}", amount(ms, "ms"), times["format"]


def answered(results: Json) -> str:
    """The packaged bundle's answers on the simulated skin, from the study `alignment`."""
    places = {
        "other positions": "simulated, 36 attachments that training had not seen",
        "T-HARD": "simulated, one row further along and all else anew",
    }
    figures = {"accuracy": "correct answers", "wrong_share": "wrong labels"}
    rows = []
    for place, test in places.items():
        at = results[place]
        for key, what in figures.items():
            rows.append((f"packaged bundle: {what}", estimate(at[key]), f"{test}, n = {at['n']}"))
    return _table(rows)


def trusted(results: Json) -> str:
    """Unknown materials, early answers and calibration, from the study `certainty`."""
    unknown, early = results["unknown"]["mean"], results["early"]
    after, n = results["calibration"]["after"], results["tested"]
    left_out = f"simulated, each material left out in turn, n = {n}"
    other = f"simulated, other skins than in training, n = {n}"
    lost: Sequence[float] = [100 * early[key] for key in ("lost", "lost_low", "lost_high")]
    # fmt: off
    return _table((
        (f"sweeps of untaught materials that get a label, where {percent(unknown['kept'])} of"
            " taught ones get theirs", percent(unknown["false_known"]), left_out),
        ("part of the window until an early answer", percent(early["share"]), other),
        ("accuracy that early answers lose", "{:.1f} points [{:.1f}, {:.1f}]".format(*lost), other),
        ("calibration error of the probability",
            estimate((after["error"], after["low"], after["high"])), other),
    ))
    # fmt: on


TABLES = (
    ("recorded", "development", recorded),
    ("answered", "alignment", answered),
    ("trusted", "certainty", trusted),
)
"""Marker, name of the results, and the function of each table."""
