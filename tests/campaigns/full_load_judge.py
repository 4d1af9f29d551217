"""The judgement of a box under full load: figures, missed targets in words, and tables, from its
counts, the phases and its robot's sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from palpate.runtime.selftest import MOST_READING
from tests.campaigns.feed_load import LATE_MS

Json = dict[str, Any]
COUNTS = ("came", "missing", "counted", "stops", "answered", "said", "dropped")
Phase = tuple[str, float, float]
"""Name, begin and end in seconds; "calm" is the phase without faults."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 99th percentile and maximum."""
    return (
        {f"p{q}": round(float(np.percentile(values, q)), 2) for q in (50, 99, 100)}
        if len(values)
        else {}
    )


def figures(
    lines: Sequence[Json],
    phases: Sequence[Phase],
    timed: Sequence[tuple[float, float]],
    looks: Sequence[tuple[float, float, int]],
) -> Json:
    """The figures of one box: counts of the whole run; share, memory and times of the calm phase;
    counts of each kind of fault.

    timed: (time of a sentence, milliseconds in the box). looks: (time, processor seconds, KiB
    resident).
    """
    counts = [line for line in lines if "came" in line]
    answers = [line for line in lines if "sweep" in line]
    _, begin_s, end_s = phases[0]
    calm = [line for line in answers if begin_s <= line["at_s"] < end_s]
    turns = [line["turn_ms"] for line in counts if begin_s <= line["at_s"] < end_s]
    looked = [look for look in looks if begin_s <= look[0] < end_s]
    (first_s, first_cpu_s, first_kib), (last_s, last_cpu_s, last_kib) = looked[0], looked[-1]
    return {
        **{name: counts[-1][name] for name in (*COUNTS, "found", "loss_known")},
        "answers": len(answers),
        "seconds": round(end_s - begin_s, 1),
        "calm": {
            **_between(counts, begin_s, end_s),
            "n": len(calm),
            "edge_ms": spread([line["answer_ms"] for line in calm]),
            "in_box_ms": spread([ms for at_s, ms in timed if begin_s <= at_s < end_s]),
            "turn_ms": spread(turns),
            "share": round((last_cpu_s - first_cpu_s) / (last_s - first_s), 4),
            "first_mib": round(first_kib / 1024, 1),
            "last_mib": round(last_kib / 1024, 1),
            "most_mib": round(max(kib for *_, kib in looked) / 1024, 1),
        },
        "faults": {
            name: _fault(counts, answers, name, phases)
            for name in dict.fromkeys(n for n, *_ in phases[1:])
        },
    }


def _between(counts: Sequence[Json], begin_s: float, end_s: float) -> Json:
    """How much the counts grew in this time."""
    before, after = (
        [line for line in counts if line["at_s"] <= at_s][-1] for at_s in (begin_s, end_s)
    )
    return {name: after[name] - before[name] for name in COUNTS}


def _fault(
    counts: Sequence[Json], answers: Sequence[Json], name: str, phases: Sequence[Phase]
) -> Json:
    """The reaction of the box to all faults of a kind."""
    total: Counter[str] = Counter()
    statuses: Counter[str] = Counter()
    times = [(begin_s, end_s) for kind, begin_s, end_s in phases if kind == name]
    for begin_s, end_s in times:
        for key, grown in _between(counts, begin_s, end_s).items():
            total[key] += grown
        statuses.update(line["status"] for line in answers if begin_s <= line["at_s"] < end_s)
    return {"times": len(times), **total, "statuses": dict(statuses)}


def missed(content: Json) -> list[str]:
    """The targets that were missed, in words."""
    found = []
    for box in content["boxes"]:
        name = f"{box['skin']}, {'all attached' if box['full'] else 'bare'}"
        found += [f"{name}: {text}" for text in _of_box(box)]
    for bare, full in _pairs(content["boxes"]):
        slow, plain = full["calm"]["in_box_ms"]["p50"], bare["calm"]["in_box_ms"]["p50"]
        if slow > plain + LATE_MS:
            found.append(f"{full['skin']}: {slow} ms in the box in the median, bare {plain} ms")
    for skin, peers in content["peers"].items():
        got = peers["feed"] | {kind: peers[kind] for kind in ("page", "tcp", "modbus")}
        found += [
            f"{skin}: the peer at {kind} got nothing"
            for kind in ("verdict", "page", "tcp", "modbus")
            if not got.get(kind)
        ]
    return found


def _pairs(boxes: Sequence[Json]) -> Iterator[tuple[Json, Json]]:
    """The bare and the full box of each skin."""
    for skin in dict.fromkeys(box["skin"] for box in boxes):
        bare, full = sorted(
            (box for box in boxes if box["skin"] == skin), key=lambda box: bool(box["full"])
        )
        yield bare, full


def _of_box(box: Json) -> Iterator[str]:
    if not told(box):
        yield f"{box['missing']:,} frames are missing, {box['counted']:,} are counted as lost"
    if box["found"] != 1:
        yield f"the skin was lost and found {box['found'] - 1} times"
    # the sweep that is open at the end is answered without a stop edge
    if not 0 <= box["answered"] - box["stops"] <= 1 or box["answers"] != box["answered"]:
        yield (
            f"{box['stops']} stop edges, {box['answered']} answers, of which observers "
            f"saw {box['answers']}"
        )
    if box["twice"]:
        yield f"{box['twice']} answers came twice"
    if box["said"] != box["heard"] + box["dropped"]:
        yield (
            f"{box['said']:,} sentences were sent, {box['heard']:,} came "
            f"and {box['dropped']:,} are counted as dropped"
        )
    if box["calm"]["dropped"]:
        yield f"{box['calm']['dropped']} sentences dropped in the time without faults"
    if box["full"]:
        yield from (
            f"nothing in {kind}" for kind in ("recorded", "black_box", "compared") if not box[kind]
        )
        if "disk full" in box["faults"] and not box["kept"].get("full"):
            yield "the disk was never full for a recording"


def told(box: Json) -> bool:
    """Whether the box reports all missing frames.

    For a skin without a count, the box reports that losses cannot be seen, and only the time of the
    loss remains. This may err by a frame in each stop of the processor, and upwards by any number,
    because good frames look lost if the machine passes bytes on late.
    """
    if box["loss_known"]:
        return bool(box["missing"] == box["counted"])
    return bool(
        box["missing"] <= box["counted"] + box["faults"].get("processor away", {}).get("times", 0)
    )


def table(content: Json) -> str:
    """The measurements in Markdown."""
    boxes = content["boxes"]
    shown: Mapping[bool, str] = {False: "nothing attached", True: "all attached"}
    rows = [
        "Measured by `python -m tests.campaigns.full_load`, all boxes at the same time "
        f"for {boxes[0]['seconds'] / 60:.3g} min without faults, "
        f"on {content['machine']}{', with real-time priority' * content['real_time']}; "
        f"load average {content['load'][0]:.1f} before, "
        f"{content['load'][1]:.1f} after; seed {content['seed']}, commit {content['commit'][:12]}.",
        "",
        "| skin | box | frames | missing, of these counted | stop edges, answers | edge to "
        "sentence, p50 / p99 / most | in the box, p50 / p99 / most | longest turn | share of a "
        "core | memory, first, most |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for box in boxes:
        calm = box["calm"]
        edge, within = (
            "{p50:.1f} / {p99:.1f} / {p100:.1f} ms".format(**calm[f"{kind}_ms"])
            for kind in ("edge", "in_box")
        )
        rows.append(
            f"| {box['skin']}, {box['format']} | {shown[box['full']]} | {calm['came']:,} "
            f"| {calm['missing']:,}, {calm['counted']:,} | "
            f"{calm['stops']}, {calm['n']} | {edge} | {within} | {calm['turn_ms']['p100']:.0f} "
            f"ms | {100 * calm['share']:.1f} % | "
            f"{calm['first_mib']}, {calm['most_mib']} MiB |"
        )
    rows += [
        "",
        "Then faults, each with the 10 s after it:",
        "",
        "| fault | skin | box | times | frames missing, counted | stop edges, answers | "
        "sentences dropped | answers |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in boxes[0]["faults"]:
        for box in boxes:
            one = box["faults"][name]
            answers = ", ".join(f"`{status}` {n}" for status, n in sorted(one["statuses"].items()))
            rows.append(
                f"| {name} | {box['skin']} | {shown[box['full']]} | {one['times']} "
                f"| {one['missing']:,}, {one['counted']:,} | "
                f"{one['stops']}, {one['answered']} | {one['dropped']:,} | {answers} |"
            )
    return "\n".join([*rows, "", *_wholes(content)])


def _wholes(content: Json) -> Iterator[str]:
    """The results of the whole run, in sentences."""
    boxes = content["boxes"]
    said, heard, dropped = (
        sum(box[name] for box in boxes) for name in ("said", "heard", "dropped")
    )
    yield (
        f"In the whole run {said:,} sentences were sent, {heard:,} came and {dropped:,} were "
        "counted as dropped.\n"
    )
    for box in boxes:
        if box["full"]:
            peers = content["peers"][box["skin"]]
            yield (
                f"{box['skin']}: {box['recorded']:,} sweeps "
                f"recorded, {box['kept'].get('full', 0)} while the disk was "
                f"full, {box['black_box']} in the "
                f"black box, {box['compared']:,} judged by the shadow; "
                f"readers got {peers['feed']['verdict']:,} verdicts and "
                f"{peers['feed']['frame']:,} frames, the page {peers['page']:,} events, robots "
                f"at the bridges {peers['tcp']:,} and "
                f"{peers['modbus']:,} answers.\n"
            )
    yield "By arithmetic from these shares, not measured, with all attached:\n"
    yield from (_slower(box) for box in boxes if box["full"])


def _slower(box: Json) -> str:
    """The share on a slower core, in proportion."""
    reading, share = box["reading"], box["calm"]["share"]
    slow = (
        f"{100 * n * share:.0f} % of a core {word} times slower, reading "
        f"alone {100 * n * reading:.0f} %"
        + ": `palpate check` fails there"
        * (n * reading > MOST_READING)
        for n, word in ((6, "six"), (10, "ten"))
    )
    return (
        f"- {box['skin']}: {100 * share:.1f} % of a core here, reading "
        f"alone {100 * reading:.1f} % (`palpate check`); {'; '.join(slow)}."
    )
