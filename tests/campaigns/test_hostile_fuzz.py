"""A sample of the campaign of hostile models."""

import pytest

from tests.campaigns import hostile_fuzz
from tests.fuzz import mutated_models


@pytest.mark.slow
@pytest.mark.thorough  # a sample of the campaign hostile
@pytest.mark.parametrize(("enrolled", "count", "ran"), [(0.0, 150, 15), (1.0, 100, 5)])
def test_fuzzed_models_neither_hang_nor_kill(
    enrolled: float, count: int, ran: int, monkeypatch: pytest.MonkeyPatch
):
    """Limited children; enough reach onnxruntime; no label without probability."""
    monkeypatch.setattr(hostile_fuzz, "ENROLLED", enrolled)
    owns = mutated_models.own_models(mutated_models.QUICK)
    record = hostile_fuzz.fresh(3)
    for told in hostile_fuzz.Fuzz(owns, 3).results(0, count):
        hostile_fuzz.note(record, told)
    assert record["done"] == count
    assert record["finds"] == []
    assert record["outcomes"]["ran"] >= ran
