"""The results of the study `alignment` as tables in Markdown: the answers of the box."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from palpate_studies import markdown
from palpate_train.reports.formatting import estimate

Json = dict[str, Any]
# fmt: off
HEAD = ("skin moved", "answered correctly", "wrong label", "`unsure`", "`unknown`", "marked",
    "wrong and not marked")
SHOWN = {
    "rows": ((0.0, "not at all"), (1.0, "1 mm towards row 4"), (2.0, "2 mm"), (3.0, "3 mm"),
        (4.0, "4 mm, one row"), (5.0, "5 mm"), (-4.0, "4 mm towards row 1")),
    "columns": ((-4.0, "4 mm towards column 1"), (4.0, "4 mm towards column 4")),
}
# fmt: on
"""Displacements in mm that have a line."""


def table(result: Json) -> str:
    """A line for each displacement of SHOWN and for T-HARD, with 95 % intervals, under a caption
    with bundle, sets and commit."""
    rows = [("T-HARD, a row ahead and all else anew", result["T-HARD"]), *_moved(result)]
    caption = (
        f"Bundle {result['bundle']}, "
        f"commit {result['commit']}, {result['machine']}: {result['T-HARD']['n']} sweeps of "
        f"{result['T-HARD']['set']} at {result['T-HARD']['attachments']} attachments; "
        f"all other lines {result['other positions']['n']} "
        f"of {result['other positions']['set']} at {result['other positions']['attachments']}, "
        "moved. Per cent [95 %], else sweeps."
    )
    return markdown.table(HEAD, (_cells(*row) for row in rows), caption)


def _moved(result: Json) -> Iterator[tuple[str, Json]]:
    for direction, shown in SHOWN.items():
        points: Sequence[Json] = result["moved"][direction]
        for mm, text in shown:
            yield from ((text, point) for point in points if point["mm"] == mm)


def _cells(text: str, point: Json) -> tuple[object, ...]:
    return (
        text,
        estimate(point["accuracy"]),
        estimate(point["wrong_share"]),
        point["unsure"],
        point["unknown"],
        estimate(point["moved"], 0),
        point["wrong_unflagged"],
    )
