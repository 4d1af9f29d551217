"""The results that a client of a bridge has missed: the newest from memory, older results and
results before a restart from the file of verdicts (client/verdicts.py)."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from palpate.client.answers import Answer
from palpate.core import wall_clock
from palpate.core.errors import FeedError

KEPT = 1000
"""Results that a bridge holds in memory; then the oldest is lost."""
SAME_S = 5.0
"""The same sweep of two programs, by their clocks: a restart of the box takes longer."""
MOST = 100
"""Results of one question."""


class Results:
    """file: of verdicts, which `palpate bridge memory` writes; it may be missing."""

    def __init__(self, file: Path) -> None:
        self._file, self._began_s = file, wall_clock.seconds()
        self._newest: deque[tuple[float, Answer]] = deque(maxlen=KEPT)

    def add(self, at_s: float, answer: Answer) -> None:
        """Keep a result. at_s: when it was heard, seconds since 1970."""
        self._newest.append((at_s, answer))

    def since(self, from_s: float, most: int = MOST) -> list[Mapping[str, Any]]:
        """The first `most` results since this time, in order, with the columns of the file."""
        from palpate.client import verdicts  # SQLite takes a MiB, and few clients ask

        newest, before = [*self._newest], list[Mapping[str, Any]]()
        first_s = newest[0][0] if len(newest) == KEPT else self._began_s
        if from_s < first_s:
            with suppress(FeedError):
                before = [*verdicts.since(self._file, from_s, most)]
        if before:  # its writer may be off, or be late
            last_s, last = before[-1]["at"], before[-1]["sweep"]
            same = (one.sweep == last and abs(at - last_s) < SAME_S for at, one in newest)
            ends = [i for i, found in enumerate(same) if found]
            newest = newest[ends[-1] + 1 :] if ends else [e for e in newest if e[0] > last_s]
        names = [name for name in verdicts.COLUMNS if name != "at"]
        found = islice((e for e in newest if e[0] >= from_s), most - len(before))
        rows = [{"at": at, **{name: getattr(one, name) for name in names}} for at, one in found]
        return before + rows
