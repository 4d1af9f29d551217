"""The table of the box's time and memory, in Markdown, from docs/data/bench.json, which
`make bench` writes."""

from __future__ import annotations

from typing import Any

from palpate_studies import markdown
from palpate_train.reports import provenance

Json = dict[str, Any]


def _times(at: str) -> str:
    """Median and 99th percentile of n times, of the figures named `at`."""
    return f"median {{{at}[p50]:.2f}} ms, 99 % within {{{at}[p99]:.2f}} ms (n = {{{at}[n]}})"


# fmt: off
CAPTION = (
    "Measured by `make bench` with the simulated skin, on {machine[cores]} cores of {processor}"
    " ({machine[arch]}, {machine[system]}, Python {machine[python]}, onnxruntime"
    " {machine[onnxruntime]}), one thread; {date}, commit {commit}, seed {seed}, bundle {bundle}."
    " Load average of the machine, which other work shares: {load_average[before][0]:.1f} before,"
    " {load_average[after][0]:.1f} after."
)
ROWS = (
    ("simulated sweeps classified correctly (not the skin's accuracy), n = {accuracy[total]}, with"
        " 95 % interval; `unknown` counts as wrong",
        "{accuracy[right]} of {accuracy[total]}: {share:.1f} % [{low:.1f}, {high:.1f}]"),
    ("frames lost in these sweeps", "{frames_lost}"),
    ("from reading the last frame of the window to the sentence at the port",
        _times("edge_to_sentence_ms")),
    ("from the STOP edge to its being in hand, with the last frame (glitch filter, rest of a USB"
        " packet)", _times("edge_seen_ms")),
    ("inference of the packaged bundle (int8)", _times("inference_ms[int8]")),
    ("for comparison, inference of its network alone in float32", _times("inference_ms[fp32]")),
    ("for comparison, inference of the paper's network (CNN) in int8",
        _times("inference_ms[paper_int8]")),
    ("resident memory after 1,000 sweeps, with the simulated readout board in it",
        "{rss_mb[after_1000]:.1f} MiB; {growth:+.1f} MiB in the next 900"),
    ("of it without the simulated readout board", "{rss_mb[without_board]:.1f} MiB"),
    ("share of one core while the skin streams, without the simulated readout board",
        "{streaming:.1f} %"),
    ("start of the process to READY with a streaming skin",
        "median {cold_start_s:.2f} s, longest {cold_start_worst_s:.2f} s"),
    ("size of the packaged bundle on the disk",
        "{bundle_kb[all]:.1f} kB, of it the network {bundle_kb[model]:.1f} kB"),
)
# fmt: on
"""Name and value of each measured figure."""


def table(figures: Json) -> str:
    """The table with a caption. Figures of an older bundle are marked as such. Raises KeyError if a
    figure is missing."""
    accuracy = figures["accuracy"]
    low, high = (100 * value for value in accuracy["interval"])
    known = figures | {
        "processor": figures["machine"]["processor"] or "a machine",
        "share": 100 * accuracy["right"] / accuracy["total"],
        "low": low,
        "high": high,
        "growth": round(figures["rss_mb"]["growth_next_900"], 1) + 0.0,  # 0 has no sign
        "streaming": 100 * figures["cpu_share_streaming"],
    }
    older, about = provenance.of(figures).older, CAPTION.format(**known)
    about = f"**{older}**\n\n{about}" if older else about
    rows = ([cell.format(**known) for cell in row] for row in ROWS)
    return markdown.table(("what", "measured"), rows, about)
