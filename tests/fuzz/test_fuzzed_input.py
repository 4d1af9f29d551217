"""Results of fuzzing, tested in each run: seeds, the corpus, and all former crashes."""

from __future__ import annotations

import pytest

from tests.fuzz import corpus, seeds, targets


@pytest.mark.slow
@pytest.mark.parametrize("target", sorted(targets.TARGETS))
def test_what_was_found_still_holds(target, tmp_path):
    """Each promise of a target is kept for all known inputs."""
    crashes = (path.read_bytes() for path in corpus.crashes(target))
    inputs = [*seeds.SEEDS[target](), *corpus.load(target), *crashes]
    assert len(inputs) > 2
    for data in inputs:
        targets.TARGETS[target](data, tmp_path)
