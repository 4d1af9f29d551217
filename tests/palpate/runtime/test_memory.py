"""Memory that a box would take with each sweep, for hours, although no object is held."""

from __future__ import annotations

import gc
import re
import sys

import pytest


@pytest.mark.skipif(not hasattr(sys, "_debugmallocstats"), reason="counts of CPython's allocator")
def test_the_store_of_freed_tuples_does_not_grow_with_sweeps(rigged, capfd):
    """A tuple that is made of a generator is kept after its end, up to 2,000 of each length."""
    free = re.compile(r"(\d+) free +(\d+)-sized PyTupleObjects")
    sweeps = 8

    def kept() -> dict[str, int]:
        capfd.readouterr()
        sys._debugmallocstats()
        return {length: int(n) for n, length in free.findall(capfd.readouterr().err)}

    box = rigged()
    gc.disable()  # a full collection would empty the store
    try:
        box.until(lambda: len(box.kept) == 4)
        before = kept()
        box.until(lambda: len(box.kept) == 4 + sweeps)
        after = kept()
    finally:
        gc.enable()
    assert before
    assert {n: after[n] - before[n] for n in after if after[n] - before[n] >= sweeps} == {}
