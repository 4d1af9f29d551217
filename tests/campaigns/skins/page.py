"""Writes the tables of docs/skins.md from docs/data/skins.json, each between its markers."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from palpate.core.storage import put
from palpate_studies import markdown
from palpate_train.reports import provenance
from palpate_train.reports.formatting import estimate, percent

Json = dict[str, Any]


def write(path: Path, results: Json) -> None:
    """Put tables and header into the page. Raises FormatError without each marker once."""
    text = path.read_text("utf-8")
    for part, table in TABLES.items():
        text = markdown.insert(text, part, "\n".join(table(results.get(part, {}))), str(path))
    put(path, provenance.in_markdown(text, provenance.of(results)).encode())


def _way(found: dict[str, Json]) -> Iterator[str]:
    yield _frames_lost(row["lost"] for row in found.values())
    yield "| skin | format | classified correctly, at other positions, 95 % interval |"
    yield "|---|---|---|"
    for name, row in found.items():
        right = estimate([row["right"] / row["total"], *row["interval"]])
        yield f"| {name} | {row['format']} | {right} |"


def _frames_lost(lost: Iterable[int]) -> str:
    return f"{sum(lost):,} frames were lost.\n"


def _noise(found: dict[str, Json]) -> Iterator[str]:
    kinds = {
        "lost": "1 to 8 bytes lost",
        "added": "1 to 64 added",
        "twice": "a part twice",
        "changed": "a byte changed",
    }
    if found:
        fewest = min(row[kind]["faults"] for row in found.values() for kind in kinds)
        # the rule of three gives the highest rate that agrees with no wrong frame
        yield (
            f"In %, of at least {fewest:,} frames damaged in each way; 0 is a rate below "
            f"{300 / fewest:.2g} % (95 %).\n"
        )
    yield f"| skin | {' | '.join(kinds.values())} | intact frames that arrived |"
    yield "|---|---|---|---|---|---|"
    for name, row in found.items():
        wrong = [_rate(row[kind]["wrong"], row[kind]["faults"]) for kind in kinds]
        sound = sum(row[kind]["sent"] - row[kind]["faults"] for kind in kinds)
        taken = sum(row[kind]["taken"] - row[kind]["wrong"] for kind in kinds)
        yield f"| {name} | {' | '.join(wrong)} | {100 * min(1.0, taken / sound):.1f} |"


def _rate(wrong: int, faults: int) -> str:
    """Share of wrong frames among the damaged ones, in %; without a wrong frame "0"."""
    return f"{100 * wrong / faults:.2f}" if wrong else "0"


def _load(found: dict[str, Json]) -> Iterator[str]:
    yield _frames_lost(row["missing"] for row in found.values())
    yield "| skin | share of a core | edge to sentence: median, 99 % within, ms |"
    yield "|---|---|---|"
    for name, row in found.items():
        times = f"{row['answer_ms']['p50']:.1f}, {row['answer_ms']['p99']:.1f}"
        yield f"| {name} | {percent(row['share'])} | {times} |"


TABLES: dict[str, Callable[[dict[str, Json]], Iterator[str]]] = {
    "way": _way,
    "noise": _noise,
    "load": _load,
}
