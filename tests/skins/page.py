"""Writes the tables of docs/skins.md from docs/data/skins.json, each between its markers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from palpate.core.storage import put
from palpate_studies import marked_text
from palpate_train.reports import provenance

Json = dict[str, Any]


def write(path: Path, results: Json) -> None:
    """Put each table and the header into the page. Raises FormatError unless each pair of markers
    occurs once."""
    text = path.read_text("utf-8")
    for part, table in TABLES.items():
        text = marked_text.insert(text, part, "\n".join(table(results.get(part, {}))), str(path))
    put(path, provenance.in_markdown(text, provenance.of(results)).encode())


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _way(found: dict[str, Json]) -> Iterator[str]:
    yield (
        "| skin | as recorded | chosen by `fit` | classified correctly, at other positions "
        "| 95 % interval | frames lost | bundle |"
    )
    yield "|---|---|---|---|---|---|---|"
    for name, row in found.items():
        low, high = map(_percent, row["interval"])
        right = f"{row['right']} of {row['total']}: {_percent(row['right'] / row['total'])}"
        described = f"{row['sweeps']} sweeps, {row['format']}"
        yield (
            f"| {name} | {described} | {row['chosen']} | {right} | {low} to {high} "
            f"| {row['lost']} | {row['bundle_kb']} kB |"
        )


def _noise(found: dict[str, Json]) -> Iterator[str]:
    kinds = {
        "lost": "1 to 8 bytes lost",
        "added": "1 to 64 added",
        "twice": "a part twice",
        "changed": "a byte changed",
    }
    yield f"| skin | {' | '.join(kinds.values())} | frames taken of those not damaged |"
    yield "|---|---|---|---|---|---|"
    for name, row in found.items():
        wrong = [_rate(row[kind]["wrong"], row[kind]["faults"]) for kind in kinds]
        sound = sum(row[kind]["sent"] - row[kind]["faults"] for kind in kinds)
        taken = sum(row[kind]["taken"] - row[kind]["wrong"] for kind in kinds)
        yield f"| {name} | {' | '.join(wrong)} | {min(1.0, taken / sound):.1%} |"


def _rate(wrong: int, faults: int) -> str:
    """Wrong frames in this many faults; if there are none, their highest rate by the rule of
    three."""
    if not wrong:
        return f"0 of {faults:,} (below {3 / faults:.2%})"
    return f"{wrong:,} of {faults:,} ({wrong / faults:.2%})"


def _load(found: dict[str, Json]) -> Iterator[str]:
    yield "| skin | frames | share of a core | edge to sentence | time | frames that came | lost |"
    yield "|---|---|---|---|---|---|---|"
    for name, row in found.items():
        times = (
            f"{row['answer_ms']['p50']:.1f} ms, 99 % within {row['answer_ms']['p99']:.1f} ms "
            f"(n = {row['answers']})"
        )
        yield (
            f"| {name} | {row['format']} | {_percent(row['share'])} | {times} "
            f"| {row['seconds']:.0f} s | {row['came']:,} "
            f"| {row['missing']} |"
        )


TABLES: dict[str, Callable[[dict[str, Json]], Iterator[str]]] = {
    "way": _way,
    "noise": _noise,
    "load": _load,
}
