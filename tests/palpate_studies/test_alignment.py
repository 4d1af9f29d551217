"""The study `alignment`: answers to sweeps of a displaced skin, and its page."""

from dataclasses import replace

import pytest

from palpate.answer.contact import ContactPositions
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate_studies import alignment, tables
from tests.factories.contacts import MIDDLE


@pytest.fixture
def model(default_bundle: Bundle) -> Bundle:
    """The default bundle, which has trained positions."""
    return replace(default_bundle, manifest=replace(default_bundle.manifest, contact=MIDDLE))


@pytest.mark.slow
def test_moving_is_measured(model: Bundle, monkeypatch: pytest.MonkeyPatch):
    """A skin in place is not flagged, one displaced by a row is; figures and table agree."""
    monkeypatch.setattr(alignment, "OFF_MM", (8.0,))
    wide = replace(
        model, manifest=replace(model.manifest, contact=ContactPositions(4.0, (5.5,), (6.0,), 1.2))
    )
    names = ("T-LAB/level-blind:1:1", "T-LAB/level-blind:3:2", "T-HARD/level-blind:1:1")
    given = dict(zip(alignment.SETS, (f"sim:{name}" for name in names), strict=True))
    monkeypatch.setattr(alignment, "SETS", given)
    box = Classifier(wide, SystemClock())
    figures = alignment.measure(box, lambda line: None)
    assert figures["other positions"]["moved"][0] == 0
    assert figures["T-HARD"]["moved"][0] == 1
    back, home, ahead = figures["moved"]["rows"]
    assert (back["mm"], home["mm"], ahead["mm"]) == (-8, 0, 8)
    assert home["accuracy"] == figures["other positions"]["accuracy"]
    assert (home["n"], home["attachments"], home["moved"][0], ahead["moved"][0]) == (12, 1, 0, 1)
    assert back["told_mm"] > ahead["told_mm"] + 0.5  # the trained position is a little ahead
    assert ahead["accuracy"][0] < home["accuracy"][0] > 0.8
    assert figures["rows, forwards"]["lost_at_mm"] == 8
    assert ahead["told_mm"] > 1.2 > home["told_mm"]
    for point in (home, ahead):
        assert point["accuracy"][0] * 12 + point["wrong"] + point["unsure"] + point[
            "unknown"
        ] == pytest.approx(12, abs=0.01)
        assert point["wrong_share"][0] == pytest.approx(point["wrong"] / 12, abs=1e-3)
        assert point["network"][0] >= point["accuracy"][0]
    table = tables.alignment(figures)
    starts = ("| T-HARD, a row ahead", "| not at all | ")
    assert all(map(str.startswith, table.splitlines()[4:], starts))
    assert f"| {home['unsure']} | {home['unknown']} | " in table.splitlines()[-1]
    without = replace(wide.manifest, contact=None, displacement=None)
    box = Classifier(replace(wide, manifest=without), SystemClock())
    with pytest.raises(FormatError, match="no positions"):
        alignment.measure(box, print)
