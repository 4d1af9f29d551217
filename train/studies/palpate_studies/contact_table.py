"""The results of the study `alignment` as tables in Markdown.

They show the answers of the box beside the labels of the network alone, because these differ much
for a displaced contact.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from palpate_train.reports.formatting import estimate, percent

Json = dict[str, Any]
HEAD = (
    "skin moved",
    "answered rightly",
    "wrongly",
    "`unsure`",
    "`unknown`",
    "by label alone, rightly",
    "marked",
    "wrong and not marked",
)
SHOWN = {
    "rows": (
        (0.0, "not at all"),
        (1.0, "1 mm towards row 4"),
        (2.0, "2 mm"),
        (2.5, "2.5 mm"),
        (3.0, "3 mm"),
        (4.0, "4 mm, one row"),
        (5.0, "5 mm"),
        (-2.5, "2.5 mm towards row 1"),
        (-4.0, "4 mm"),
    ),
    "columns": (
        (-2.5, "2.5 mm towards column 1"),
        (-4.0, "4 mm"),
        (2.5, "2.5 mm towards column 4"),
        (4.0, "4 mm"),
    ),
}
"""Displacements in mm that have a line."""


WAYS = {
    "rows, forwards": "towards row 4",
    "rows, backwards": "towards row 1",
    "columns, forwards": "towards column 4",
    "columns, backwards": "towards column 1",
}
ROW_MM = 4.0
"""Pitch of the taxels of the simulated skin, mm."""


def headline(result: Json) -> str:
    """A table of the main questions with their answers."""
    every = [point for points in result["moved"].values() for point in points]
    (still,) = (point for point in result["moved"]["rows"] if point["mm"] == 0)
    off = [point for point in every if abs(point["mm"]) == ROW_MM]
    worst = max(every, key=lambda point: point["wrong_unflagged"])
    kept = [
        f"{round(of['moved'][0] * of['n'])} of {of['n']} {where}"
        for where, of in (
            ("at trained positions", result["trained positions, other sweeps"]),
            ("at others", result["other positions"]),
        )
    ]
    rows = (
        ("question", "answer"),
        ("---", "---"),
        (
            "how many sweeps are named rightly where the skin sits as in training?",
            estimate(still["accuracy"]),
        ),
        ("how many of these are marked by mistake?", ", ".join(kept)),
        (
            "where five points of accuracy are lost, how many sweeps are marked?",
            "; ".join(_losses(result)),
        ),
        (
            "how many sweeps are named wrongly a row of taxels off, marked or not?",
            f"{_span(point['wrong_share'][0] * 100 for point in off)} %, by the direction",
        ),
        (
            "how many are wrong and not marked, at the worst distance?",
            f"{worst['wrong_unflagged']} of {worst['n']}, at {abs(worst['mm']):g} mm",
        ),
        (
            f"what distance is shown where the skin is {ROW_MM:g} mm off?",
            f"{_span(point['told_mm'] for point in off)} mm: too little",
        ),
    )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _losses(result: Json) -> Iterator[str]:
    """For each direction, the displacement that costs five points, and the share of sweeps flagged
    there."""
    for key, way in WAYS.items():
        lost = result[key]["lost_at_mm"]
        yield (
            f"{way} nothing is lost up to 6 mm"
            if lost is None
            else f"{way}, {lost:g} mm: {estimate(result[key]['moved'], 0)}"
        )


def _span(values: Iterable[float]) -> str:
    """The least and the largest of some figures."""
    least, *_, largest = sorted(values)
    return f"{least:.1f} to {largest:.1f}"


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
    lines = [
        f"| {' | '.join(row)} |"
        for row in (HEAD, ("---",) * len(HEAD), *(_cells(*row) for row in rows))
    ]
    return "\n".join([caption, "", *lines])


def sentence(result: Json) -> str:
    """The cost of a displaced contact, in a sentence for the manual. Raises LookupError if a
    displacement was not measured."""
    still, row, far = (
        {point["mm"]: point for point in result["moved"]["rows"]}[mm] for mm in (0.0, 4.0, 6.0)
    )
    right = [percent(point["accuracy"][0], 0) for point in (still, row, far)]
    return (
        f"On the simulated skin {right[0]} of the sweeps are answered correctly in the trained "
        f"place, {right[1]} one row of\n"
        f"taxels away ({percent(row['network'][0], 0)} by label alone, `unsure` and `unknown` "
        f"aside), {right[2]} one and a half."
    )


def _moved(result: Json) -> Iterator[tuple[str, Json]]:
    for direction, shown in SHOWN.items():
        points: Sequence[Json] = result["moved"][direction]
        for mm, text in shown:
            yield from ((text, point) for point in points if point["mm"] == mm)


def _cells(text: str, point: Json) -> tuple[str, ...]:
    return (
        text,
        estimate(point["accuracy"]),
        estimate(point["wrong_share"]),
        str(point["unsure"]),
        str(point["unknown"]),
        estimate(point["network"]),
        estimate(point["moved"], 0),
        str(point["wrong_unflagged"]),
    )
