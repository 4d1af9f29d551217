"""Results that a client of a bridge has missed, where the file of verdicts has a part of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.bridges import results
from palpate.bridges.results import Results
from palpate.client.answers import Answer
from palpate.client.verdicts import VerdictFile
from palpate.core import sentences, wall_clock
from tests.factories.speaking_box import result


@pytest.mark.parametrize(
    ("filed", "heard"),
    [
        ([], [1, 2, 3]),
        ([1, 2], [3, 4, 5]),  # its writer is off since the bridge was started
        ([1, 2, 3], [2, 3, 4]),  # its writer is late
        ([1, 2, 3, 4], [3, 4]),
        ([1, 2, 3, 4], [3]),  # the bridge has missed one
    ],
)
def test_file_and_memory_make_one_list(tmp_path: Path, filed: list[int], heard: list[int]) -> None:
    """Each result once, in order, up to as many as are wanted."""
    now_s = wall_clock.seconds()
    if filed:
        file = VerdictFile(tmp_path / "verdicts.db")
        for sweep in filed:
            file.add(now_s + sweep, {"sweep": sweep, "status": "ok", "label": "wood"})
        file.close()
    kept = Results(tmp_path / "verdicts.db")
    for sweep in heard:
        (said,), _ = sentences.parse(result(sweep), b"")
        kept.add(now_s + sweep + 0.01, Answer.of(said.fields))
    whole = sorted({*filed, *heard})
    assert [row["sweep"] for row in kept.since(now_s - 60)] == whole
    assert [row["sweep"] for row in kept.since(now_s - 60, 2)] == whole[:2]


def test_sweeps_are_counted_anew_after_a_restart_of_the_box(tmp_path, monkeypatch):
    """The same number at another time is another result."""
    monkeypatch.setattr(results, "SAME_S", 0.5)
    now_s = wall_clock.seconds()
    file = VerdictFile(tmp_path / "verdicts.db")
    file.add(now_s, {"sweep": 1, "status": "ok", "label": "wood"})
    file.close()
    kept = Results(tmp_path / "verdicts.db")
    (said,), _ = sentences.parse(result(1), b"")
    kept.add(now_s + 1, Answer.of(said.fields))
    assert [row["sweep"] for row in kept.since(now_s - 60)] == [1, 1]
