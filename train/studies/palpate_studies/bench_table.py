"""The table of the box's time and memory, in Markdown, from docs/data/bench.json, which
`make bench` writes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from palpate_studies import markdown
from palpate_train.reports import provenance

Json = dict[str, Any]


def table(figures: Json) -> str:
    """The table with a caption. Figures of an older bundle are marked as such. Raises KeyError if a
    figure is missing."""
    older, about = provenance.of(figures).older, _caption(figures)
    about = f"**{older}**\n\n{about}" if older else about
    return markdown.table(("what", "measured"), _rows(figures), about)


def _caption(figures: Json) -> str:
    machine, load = figures["machine"], figures["load_average"]
    return (
        f"Measured by `make bench` with the simulated skin, on {machine['cores']} cores "
        f"of {machine['processor'] or 'a machine'} "
        f"({machine['arch']}, {machine['system']}, Python {machine['python']}, "
        f"onnxruntime {machine['onnxruntime']}), one "
        f"thread; {figures['date']}, commit {figures['commit']}, seed {figures['seed']}, "
        f"bundle {figures['bundle']}. Load "
        f"average of the machine, which other work shares: {load['before'][0]:.1f} "
        f"before, {load['after'][0]:.1f} after."
    )


def _rows(figures: Json) -> Iterator[tuple[str, str]]:
    """Name and value of each measured figure."""
    yield from _answer_rows(figures)
    inference = figures["inference_ms"]
    yield "inference of the packaged bundle (int8)", _times(inference["int8"])
    yield "for comparison, inference of its network alone in float32", _times(inference["fp32"])
    yield (
        "for comparison, inference of the paper's network (CNN) in int8",
        _times(inference["paper_int8"]),
    )
    yield from _resource_rows(figures)


def _answer_rows(figures: Json) -> Iterator[tuple[str, str]]:
    """Accuracy and time of the answers."""
    accuracy = figures["accuracy"]
    right, n = accuracy["right"], accuracy["total"]
    low, high = (100 * value for value in accuracy["interval"])
    yield (
        f"simulated sweeps classified correctly (not the skin's accuracy), n = {n}, with 95 % "
        "interval; `unknown` counts as wrong",
        f"{right} of {n}: {100 * right / n:.1f} % [{low:.1f}, {high:.1f}]",
    )
    yield "frames lost in these sweeps", str(figures["frames_lost"])
    yield (
        "from reading the last frame of the window to the sentence at the port",
        _times(figures["edge_to_sentence_ms"]),
    )
    yield (
        "from the STOP edge to its being in hand, with the last frame (glitch filter, rest of a "
        "USB packet)",
        _times(figures["edge_seen_ms"]),
    )


def _resource_rows(figures: Json) -> Iterator[tuple[str, str]]:
    """Memory, processor time, start and size."""
    memory = figures["rss_mb"]
    growth = round(memory["growth_next_900"], 1) + 0.0  # 0 has no sign
    yield (
        "resident memory after 1,000 sweeps, with the simulated readout board in it",
        f"{memory['after_1000']:.1f} MiB; {growth:+.1f} MiB in the next 900",
    )
    yield "of it without the simulated readout board", f"{memory['without_board']:.1f} MiB"
    yield (
        "share of one core while the skin streams, without the simulated readout board",
        f"{100 * figures['cpu_share_streaming']:.1f} %",
    )
    yield (
        "start of the process to READY with a streaming skin",
        f"median {figures['cold_start_s']:.2f} s, longest {figures['cold_start_worst_s']:.2f} s",
    )
    size = figures["bundle_kb"]
    yield (
        "size of the packaged bundle on the disk",
        f"{size['all']:.1f} kB, of it the network {size['model']:.1f} kB",
    )


def _times(ms: Json) -> str:
    """Median and 99th percentile of n times."""
    return f"median {ms['p50']:.2f} ms, 99 % within {ms['p99']:.2f} ms (n = {ms['n']})"
