"""Judges a soak: sums with intervals from a record, against the targets; reads nothing."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from palpate.core.statistics import wilson
from palpate.core.types import Status

Json = Mapping[str, Any]
ANSWER = ("s", "number", "touched", "status", "label", "alone", "latency_ms", "lost")
"""Columns of an answer: its time (seconds of the soak), the touched material, and its RES sentence.
alone: the label of the same bundle for the exact frames of the script, computed by the recorder
(see `said`)."""
SAMPLE = (
    *("s", "rss_kib", "pss_kib", "cpu_s", "files", "threads", "received", "lost", "garbage"),
    *("enumerations", "dropped", "behind"),
)
"""Columns of a sample: the process, then the counters of the last STA. behind: frames that the
board had taken and the box had not yet counted as received or lost; the minimum since the previous
sample."""
GROWTH_KIB_H = 256.0
"""Memory counts as flat if the upper end of the slope's 95 % interval is below this; fixed before
the first run."""
IN_FLIGHT = 12
"""Frames of two packets: the counts of the board and of the box may differ by this much between two
looks."""
LOOKS = 6
"""Number of samples, one minute, over which the minimum of `behind` counts: a box that is late for
a while has lost nothing."""
SECURE_MIN = 10
"""Minutes that the second half must last before growth or flatness is judged."""


@dataclass(slots=True)
class SoakRun:
    """One unbroken run of one box; an interrupted soak has several runs.

    began_s, length_s: in seconds of the soak, without interruptions. due: sweeps that should be
    answered by its end. faults: [seconds, description]. silence_s: longest time without a sentence.
    ended: the reason, "" while it runs.
    """

    seed: int
    began_s: float = 0.0
    length_s: float = 0.0
    due: int = 0
    answers: list[list[Any]] = field(default_factory=list)
    samples: list[list[Any]] = field(default_factory=list)
    faults: list[list[Any]] = field(default_factory=list)
    silence_s: float = 0.0
    ended: str = ""


def columns(rows: Sequence[Sequence[Any]], names: Sequence[str]) -> dict[str, list[Any]]:
    """Rows as named columns."""
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def numbering(number: int, last: int, started: int) -> str:
    """What is wrong with the number of an answer after `last`, or ""."""
    if number == last + 1:
        return (
            ""
            if number <= started
            else f"answer {number} came before its start edge, the robot had given {started}"
        )
    if number <= last:
        return f"answer {number} came again, {last} was answered already"
    return f"answer {number} came after {last}: {number - last - 1} left out"


def kind(status: str, label: str, touched: str) -> str:
    """Right, wrong, unsure or refused; cut if the end of the soak aborted it."""
    if status == Status.OK:
        return "right" if label == touched else "wrong"
    if status == Status.ABORTED:
        return "cut"
    return "unsure" if status in (Status.UNSURE, Status.UNDECIDED) else "refused"


def short_answer(status: str, label: str) -> str:
    """An answer as one word: the label if the status is ok, else the status."""
    return label if status == Status.OK else status


def sums(box: Json) -> dict[str, Any]:
    """All figures of a box."""
    runs = box["runs"]
    rows = [row for run in runs for row in run["answers"]]
    a = columns(rows, ANSWER)
    kinds = Counter(kind(*row) for row in zip(a["status"], a["label"], a["touched"], strict=True))
    judged = len(rows) - kinds["cut"]
    due = sum(run["due"] for run in runs)
    result = {
        "hours": sum(run["length_s"] for run in runs) / 3600,
        "due": due,
        "answers": len(rows),
        "unanswered": sum(
            len({*range(1, run["due"] + 1)} - {row[1] for row in run["answers"]}) for run in runs
        ),
        "cut": kinds["cut"],
        "differs": sum(
            row[3] != Status.ABORTED and short_answer(row[3], row[4]) != row[5] for row in rows
        ),
        "statuses": dict(Counter(a["status"])),
        "faults": sum(len(run["faults"]) for run in runs),
        "silence_s": max((run["silence_s"] for run in runs), default=0.0),
        "latency_ms": _percentiles([row[6] for row in rows if row[3] != Status.ABORTED]),
        "memory": slope(runs),
        "wrong_band": band(rows)[1][-1] if judged else [0, 0],
    }
    result |= {name: share(kinds[name], judged) for name in ("right", "wrong", "unsure", "refused")}
    return result | _counted(runs)


def share(n: int, total: int) -> dict[str, Any]:
    """`n` of `total` with its 95 % Wilson interval."""
    low, high = wilson(n, total) if total else (0.0, 1.0)
    return {"n": n, "of": total, "low": round(max(low, 0.0), 5), "high": round(min(high, 1.0), 5)}


def band(rows: Sequence[Sequence[Any]]) -> tuple[list[float], list[list[int]]]:
    """Seconds of the answers, and expected wrong answers: 95 % of the bundle's own binomial."""
    rows = [row for row in rows if row[3] != Status.ABORTED]
    alone = [row[5] not in (row[2], *Status) for row in rows]  # a wrong label, but not a refusal
    rate = sum(alone) / len(rows) if rows else 0.0
    n = np.arange(1, len(rows) + 1)
    from scipy import stats

    low, high = stats.binom.ppf([[0.025], [0.975]], n, rate).astype(int)
    return [row[0] for row in rows], np.stack([low, high], axis=1).tolist()


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {}
    return {f"p{q}": round(float(np.percentile(values, q)), 2) for q in (50, 99)} | {
        "max": max(values)
    }


def slope(runs: Sequence[Json]) -> dict[str, Any]:
    """Growth of resident memory over the second half of each run, KiB an hour, by least squares
    with its 95 % interval.

    Runs are separate processes: each has its own level, and all share a slope. Neighbouring samples
    are correlated, so the interval is computed for the equivalent number of independent samples
    (Bartlett 1946, first order).
    """
    held = [
        columns(half, SAMPLE)
        for run in runs
        if len(half := run["samples"][len(run["samples"]) // 2 :]) > 1
    ]
    result = {
        "samples": sum(len(h["s"]) for h in held),
        "minutes": sum(h["s"][-1] - h["s"][0] for h in held) / 60,
    }
    n, fitted = result["samples"], len(held) + 1
    if n <= fitted:
        return result | {"kib_h": None, "low": None, "high": None}
    x, y = (
        np.concatenate([np.subtract(v, np.mean(v)) for v in values])
        for values in ([h["s"] for h in held], [h["rss_kib"] for h in held])
    )
    x = x / 3600
    b = float(x @ y / (x @ x))
    rest = y - b * x
    power = float(rest @ rest)
    alike = min(max(float(rest[:-1] @ rest[1:]) / power, 0.0), 0.99) if power > 0 else 0.0
    fewer = (1 + alike) / (1 - alike)
    error = math.sqrt(power / (n - fitted) / float(x @ x) * fewer)
    from scipy import stats

    half = float(stats.t.ppf(0.975, max(n / fewer - fitted, 1))) * error
    return result | {"kib_h": round(b, 1), "low": round(b - half, 1), "high": round(b + half, 1)}


def _counted(runs: Sequence[Json]) -> dict[str, Any]:
    """Counters of the box, and frames that the board took and it never counted."""
    last = [columns(run["samples"], SAMPLE) for run in runs if run["samples"]]
    result: dict[str, Any] = {
        name: sum(c[name][-1] for c in last)
        for name in ("received", "lost", "garbage", "enumerations", "dropped")
    }
    result["unaccounted"] = sum(unaccounted(c["behind"]) for c in last)
    result["cpu"] = sum(c["cpu_s"][-1] - c["cpu_s"][0] for c in last) / max(
        sum(c["s"][-1] - c["s"][0] for c in last), 1
    )
    for name in ("rss_kib", "pss_kib", "files", "threads"):
        result[name] = [c[name][i] for c in last[-1:] for i in (0, len(c[name]) // 2, -1)]
    return result


def unaccounted(behind: Sequence[float]) -> int:
    """Frames that the board took and the box counted neither as received nor as lost, from its lag
    over time.

    Frames on their way are counted within a minute; frames dropped in silence are never counted.
    More frames than were taken count as an error as well.
    """
    if not behind:
        return 0
    more = round(min(behind[-LOOKS:]) - min(behind[:LOOKS]))
    return abs(more) if abs(more) > IN_FLIGHT else 0


def targets(result: Json) -> Iterator[tuple[str, str, str, bool | None]]:
    """(name, wanted, measured, reached) of each target; None if too short."""
    for name, key, of in (
        ("sweeps without an answer", "unanswered", f" of {result['due']}"),
        ("sentences out of order, broken or missing", "faults", ""),
        ("frames lost and not accounted for", "unaccounted", f" of {_taken(result)}"),
        ("sentences dropped", "dropped", ""),
    ):
        yield name, "0", f"{result[key]}{of}", result[key] == 0
    most = result["wrong_band"][1]
    wrong = result["wrong"]["n"]
    yield (
        "wrong verdicts, against the network by itself",
        f"at most {most}",
        f"{wrong}",
        wrong <= most,
    )
    m = result["memory"]
    grown = "" if m["high"] is None else estimate(m["kib_h"], m["low"], m["high"])
    flat = grown and m["high"] < GROWTH_KIB_H
    yield (
        "growth of memory, KiB an hour",
        f"< {GROWTH_KIB_H:g}",
        grown,
        bool(flat) if m["minutes"] >= SECURE_MIN else None,
    )
    steady = all(
        result[name][-1] <= max(result[name][:2]) for name in ("files", "threads") if result[name]
    )
    held = ", ".join(str(result[name][-1]) for name in ("files", "threads") if result[name])
    yield "open files, threads", "no more", held, steady


def estimate(value: float, low: float, high: float) -> str:
    """A figure with its interval."""
    return f"{value:,.0f} [{low:,.0f}, {high:,.0f}]".replace("-", "−")


def _taken(result: Json) -> str:
    return f"{result['received'] + result['lost']:,}"
