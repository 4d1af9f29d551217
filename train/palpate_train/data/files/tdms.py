"""Reads LabVIEW's TDMS with npTDMS."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files.table import ReadPlan, Table, from_columns, normal, only, timed

STEP = "wf_increment"


def read(path: Path, wanted: ReadPlan) -> Table:
    """The channels of the only group with numbers, or of the group `wanted.variable`.

    The vector `time`, in seconds, exists if the channels state their interval. Raises FormatError.
    """
    nptdms = library("nptdms", "a TDMS file")
    with nptdms.TdmsFile.open(path) as file:
        groups = {normal(group.name): group for group in file.groups()}
        groups = {n: g for n, g in groups.items() if any(_is_numeric(c) for c in g.channels())}
        group = groups[only("group", dict.fromkeys(groups, ""), wanted.variable, lambda _: True)]
        facts = {normal(k): str(v) for k, v in {**file.properties, **group.properties}.items()}
        return replace(_table(group), facts=facts)


def _is_numeric(channel: Any) -> bool:
    return len(channel) > 0 and channel.dtype.kind in "biuf"


def _table(group: Any) -> Table:
    kept = [c for c in group.channels() if _is_numeric(c) or (len(c) and c.dtype.kind in "OSUM")]
    lengths = {c.name: len(c) for c in kept}
    usual, of_all = Counter(lengths.values()).most_common(1)[0]
    if 2 * of_all <= len(kept):
        raise FormatError(
            f"its channels differ in length: {', '.join(f'{k} {n}' for k, n in lengths.items())}; "
            "save the skin's channels as a group"
        )
    notes = [
        f"{k} is left out: it has {n} values, not {usual}" for k, n in lengths.items() if n != usual
    ]
    kept = [c for c in kept if len(c) == usual]
    columns = [(c.name, c[:] if _is_numeric(c) else list(map(str, c[:]))) for c in kept]
    made = from_columns(columns, notes)
    steps = {str(step) for c in kept if (step := c.properties.get(STEP))}
    return timed(made, STEP, steps.pop()) if len(steps) == 1 else made
