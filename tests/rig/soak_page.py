"""The page of a soak, from records with their sums: HTML and a picture of four charts over time.

Only charts are computed here; every sentence with a number takes it from the sums.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from palpate_train.reports import formatting, html, provenance
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    SMALL,
    WIDTH,
    add_axes,
    set_ticks,
    to_svg,
)
from tests.rig.soak_judge import (
    ANSWER,
    GROWTH_KIB_H,
    IN_FLIGHT,
    SAMPLE,
    SECURE_MIN,
    band,
    columns,
    estimate,
    kind,
    targets,
)

Json = Mapping[str, Any]
LOOKS = (
    {"color": ACCENT, "linewidth": 1.8},
    {"color": BLACK, "linewidth": 1.4, "linestyle": (0, (3, 1.5))},
)
"""Styles of the boxes; if two curves coincide, the lower shows through the upper."""
DOTS = 1500
"""Largest number of dots of a chart; of more sweeps, the slowest of each group is drawn."""
ORIGIN = {
    "what": "what runs",
    "machine": "machine",
    "versions": "versions",
    "bundle": "bundle",
    "commit": "commit",
    "seed": "seed",
    "format": "skin",
    "started": "started (UTC)",
    "runs": "runs",
}
"""Description of the run: names in the records and on the page."""


ENDS = {
    "time": "to its end",
    "interrupted": "interrupted",
    "gone": "the box was gone",
    "": "not ended",
}


def render(records: Json) -> tuple[str, str]:
    """The page (HTML) and its picture (SVG)."""
    boxes = records["boxes"]
    svg = charts(records)
    page = html.render(
        "soak_page.html.j2",
        Path(__file__).parent,
        header=provenance.of(records),
        home=html.HOME,
        picture=html.picture(svg),
        names=list(boxes),
        ran=[f"{_ran(box)} on {_the(name)}" for name, box in boxes.items()],
        left_out=[(_the(name), why) for name, why in records["left_out"].items()],
        verdicts=[f"{_the(name)}: {_verdict(box)}" for name, box in boxes.items()],
        targets=_targets(boxes),
        lines=[f"{_the(name)} {'dashed' if i else 'in blue'}" for i, name in enumerate(boxes)],
        sums=_sums([box["sums"] for box in boxes.values()]),
        growth_limit=GROWTH_KIB_H,
        least_minutes=SECURE_MIN,
        in_flight=IN_FLIGHT,
        faults=[
            [name, f"{at_s:.1f}", what]
            for name, box in boxes.items()
            for run in box["runs"]
            for at_s, what in run["faults"]
        ],
        origin=[
            [text, *(_about(box, name) for box in boxes.values())] for name, text in ORIGIN.items()
        ],
    )
    return page, svg


def _targets(boxes: Json) -> list[Json]:
    """The targets and the result of each box, a row for each target."""
    each = zip(*(targets(box["sums"]) for box in boxes.values()), strict=True)
    return [
        {
            "what": row[0][0],
            "target": row[0][1],
            "here": [came for _, _, came, _ in row],
            "met": [met for *_, met in row],
        }
        for row in each
    ]


def _verdict(box: Json) -> str:
    """How many targets a box reached, and which it missed."""
    met = {f"{what}, {came}": reached for what, _, came, reached in targets(box["sums"])}
    missed = [text for text, reached in met.items() if reached is False]
    count = f"{sum(map(bool, met.values()))} of {len(met)} targets reached"
    return f"{count}; missed: {'; '.join(missed)}" if missed else count


FRAMES: Sequence[tuple[str, Callable[[Json], str]]] = (
    ("frames received", lambda s: f"{s['received']:,}"),
    ("frames lost, reported by the box", lambda s: f"{s['lost']:,}"),
    ("frames not accounted for", lambda s: f"{s['unaccounted']:,}"),
    ("bytes that belonged to no packet", lambda s: f"{s['garbage']:,}"),
    ("times that the skin was found on the bus", lambda s: f"{s['enumerations']}"),
    ("sentences dropped", lambda s: f"{s['dropped']}"),
    ("longest silence, s", lambda s: f"{s['silence_s']:.1f}"),
    (
        "latency, ms: median, 99 %, worst",
        lambda s: " / ".join(f"{v:.1f}" for v in s["latency_ms"].values()),
    ),
    ("resident memory, MiB: start, half-way, end", lambda s: _mib(s["rss_kib"])),
    (
        "the same, shared pages divided by their users, MiB: start, half-way, end",
        lambda s: _mib(s["pss_kib"]),
    ),
    (
        "growth of resident memory in the second half, KiB an hour",
        lambda s: _slope(s["memory"]),
    ),
    ("the same, KiB for 1,000 sweeps", lambda s: _each(s)),
    ("share of a core used", lambda s: formatting.percent(s["cpu"])),
)
"""Rows about frames, times and the process."""


def _sums(sums: Sequence[Json]) -> list[list[str]]:
    """All sums, a line each."""
    statuses = dict.fromkeys(status for s in sums for status in s["statuses"])
    lines: list[tuple[str, Any]] = [
        ("hours", lambda s: f"{s['hours']:.2f}"),
        ("sweeps, answered of begun", lambda s: f"{s['due'] - s['unanswered']:,} of {s['due']:,}"),
        ("aborted by the end of the soak", lambda s: f"{s['cut']}"),
        *(
            (name, lambda s, n=name: _share(s[n]))
            for name in ("right", "wrong", "unsure", "refused")
        ),
        *(
            (f"answered {name}", lambda s, n=name: f"{s['statuses'].get(n, 0):,}")
            for name in statuses
        ),
        (
            "other than the network by itself",
            lambda s: f"{s['differs']} of {s['answers'] - s['cut']:,}",
        ),
        *FRAMES,
    ]
    return [[what, *(of(s) for s in sums)] for what, of in lines]


def charts(records: Json) -> str:
    """Four small charts, memory and latency above loss and verdicts."""
    figure = Figure((WIDTH, 5.0))
    boxes = list(records["boxes"].items())
    hours = max([box["sums"]["hours"] for _, box in boxes] or [0]) or 1
    by, unit = (1, "minutes") if hours < 4 else (60, "hours")
    for i, (title, draw) in enumerate(
        (
            ("memory, MiB", _memory),
            ("latency, ms", _latency),
            ("frames lost in a minute", _loss),
            ("wrong verdicts", _wrong),
        )
    ):
        row, column = divmod(i, 2)
        left, top = 0.1 + 0.5 * column, 0.9 - 0.47 * row
        axes = add_axes(
            figure, left, left + 0.375, top, top - 0.3
        )  # the last tick is centred on the end of the axis
        axes.set_xlim(0, 60 * hours / by * 1.01)
        for (_, box), look in zip(boxes, LOOKS, strict=False):
            draw(axes, box, look, 60 * by)
        _scales(axes)
        axes.set_xlabel(f"{unit} since the start", color=GREY, size=SMALL)
        axes.set_ylabel(title, color=BLACK, size=SMALL + 0.5, rotation=0, ha="left", va="bottom")
        axes.yaxis.set_label_coords(0, 1.03)
    for i, ((name, _), look) in enumerate(zip(boxes, LOOKS, strict=False)):
        mark = "╍" if "linestyle" in look else "—"
        figure.text(
            0.1 + 0.25 * i,
            0.97,
            f"{mark} {name}",
            color=look["color"],
            size=SMALL + 0.5,
            va="center",
        )
    with matplotlib.rc_context(
        {"path.simplify": False}
    ):  # it would leave out strokes without length
        return to_svg(figure, "memory, latency, loss and wrong verdicts of a soak over time")


def _memory(axes: Axes, box: Json, look: Json, unit_s: float) -> None:
    samples = columns([row for run in box["runs"] for row in run["samples"]], SAMPLE)
    mib = np.divide(samples["rss_kib"], 1024)
    axes.plot(np.divide(samples["s"], unit_s), mib, **look)
    low, high = (axes.get_ylim() if axes.lines[1:] else (np.inf, -np.inf)) if len(mib) else (0, 1)
    axes.set_ylim(
        min(low, np.min(mib, initial=np.inf) - 4), max(high, np.max(mib, initial=-np.inf) + 4)
    )


def dots(box: Json) -> tuple[Any, Any]:
    """Seconds and latencies in ms of the sweeps that are drawn: all, or the slowest of each
    group."""
    rows = [
        row
        for run in box["runs"]
        for row in run["answers"]
        if kind(row[3], row[4], row[2]) != "cut"
    ]
    s, ms = (np.array(columns(rows, ANSWER)[name], float) for name in ("s", "latency_ms"))
    each = max(-(-len(s) // DOTS), 1)
    pick = [k + int(np.argmax(ms[k : k + each])) for k in range(0, len(s), each)]
    return s[pick], ms[pick]


def _latency(axes: Axes, box: Json, look: Json, unit_s: float) -> None:
    s, ms = dots(box)
    # dots as strokes without length: a single path for all, instead of an element for each
    x, y = (np.repeat(v, 3).astype(float) for v in (s / unit_s, ms))
    x[2::3] = np.nan
    axes.plot(x, y, color=look["color"], linewidth=2.2, alpha=0.7, solid_capstyle="round")
    axes.set_yscale("log")
    low, high = axes.get_ylim() if axes.lines[1:] else (1.0, 10.0)
    axes.set_ylim(
        min(low, 0.8 * float(ms.min(initial=1))), max(high, 1.5 * float(ms.max(initial=1)))
    )


def _loss(axes: Axes, box: Json, look: Json, unit_s: float) -> None:
    most = 1.0
    for run in box["runs"]:
        samples = columns(run["samples"], SAMPLE)
        minutes = np.arange(run["began_s"], run["began_s"] + run["length_s"] + 1, 60)
        if len(minutes) < 2 or not samples["s"]:
            continue
        lost = np.interp(minutes, samples["s"], samples["lost"])
        axes.stairs(np.diff(lost), minutes / unit_s, baseline=None, **look)
        most = max(most, 1.1 * float(np.diff(lost).max(initial=0)))
    axes.set_ylim(-0.04 * most, max(most, axes.get_ylim()[1] if axes.patches[1:] else 0))


def _wrong(axes: Axes, box: Json, look: Json, unit_s: float) -> None:
    rows = [row for run in box["runs"] for row in run["answers"]]
    s, ends = band(rows)
    low, high = np.transpose(ends) if ends else ([], [])
    axes.fill_between(
        np.divide(s, unit_s), low, high, color=look["color"], alpha=0.13, linewidth=0, step="post"
    )
    wrong = np.cumsum([kind(row[3], row[4], row[2]) == "wrong" for row in rows])
    axes.step(np.divide([row[0] for row in rows], unit_s), wrong, where="post", **look)
    most = max([1, *high, *wrong[-1:]])
    axes.set_ylim(-0.04 * most, max(1.1 * most, axes.get_ylim()[1] if axes.lines[1:] else 0))


def _scales(axes: Axes) -> None:
    """Few round ticks."""
    for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        along = (
            MaxNLocator(4, integer=True, steps=[1, 1.5, 2, 3, 6, 10])
            if axis is axes.xaxis
            else MaxNLocator(4)
        )
        there = (
            [10.0**k for k in range(-3, 7)]
            if axis.get_scale() == "log"
            else along.tick_values(*ends)
        )
        ticks = [tick for tick in there if ends[0] <= tick <= ends[1]]
        set_ticks(axis, ticks)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)


def _the(name: str) -> str:
    return name if name.startswith("this") else f"the {name}"


def _ran(box: Json) -> str:
    """How long a box swept: in one run, or in several of their own start, which ran at the same
    time and are drawn end to end."""
    each = [run["length_s"] / 3600 for run in box["runs"]]
    if len(each) == 1:
        return f"one run of {_hours(each[0])}"
    return f"{len(each)} runs side by side, of {_hours(min(each))} each, drawn end to end,"


def _hours(hours: float) -> str:
    return f"{hours:.3g} h" if hours >= 0.995 else f"{60 * hours:.0f} min"


def _share(s: Json) -> str:
    return f"{s['n']:,}: {formatting.estimate([s['n'] / max(s['of'], 1), s['low'], s['high']])}"


def _mib(kib: Sequence[float]) -> str:
    return " / ".join(f"{k / 1024:.1f}" for k in kib)


def _slope(m: Json, by: float = 1.0) -> str:
    return (
        "" if m["high"] is None else estimate(*(m[name] * by for name in ("kib_h", "low", "high")))
    )


def _each(s: Json) -> str:
    return _slope(s["memory"], 1000 * s["hours"] / s["answers"]) if s["answers"] else ""


def _about(box: Json, name: str) -> str:
    if name == "versions":
        return ", ".join(f"{k} {v}" for k, v in box[name].items())
    if name == "runs":
        return "; ".join(
            f"{run['length_s'] / 60:.1f} min, {ENDS[run['ended']]}" for run in box[name]
        )
    return str(box.get(name, "not noted"))
