"""The study `alignment`: answers to sweeps of a displaced skin, and its page."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate.signal.contact import ContactPositions
from palpate_studies import alignment, contact_plot, contact_table
from tests.factories.contacts import MIDDLE
from tests.factories.paths import ROOT


@pytest.fixture
def model(default_bundle: Bundle) -> Bundle:
    """The default bundle, which has trained positions."""
    return replace(default_bundle, manifest=replace(default_bundle.manifest, contact=MIDDLE))


@pytest.mark.slow
def test_moving_is_measured(model: Bundle, monkeypatch: pytest.MonkeyPatch):
    """A skin in place is not flagged; a skin displaced by a row always is. Figures and picture
    agree.
    """
    monkeypatch.setattr(alignment, "OFF_MM", (8.0,))
    wide = replace(
        model, manifest=replace(model.manifest, contact=ContactPositions(4.0, (5.5,), (6.0,), 1.2))
    )
    figures = alignment.measure(
        Classifier(wide, SystemClock()),
        "sim:T-LAB/level-blind:3:2",
        "sim:T-LAB/level-blind:1:1",
        "sim:T-HARD/level-blind:1:1",
        lambda line: None,
    )
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
    text = "\n".join(alignment.lines(figures))
    assert "rows +8.0 mm" in text
    assert "network alone" in text
    assert "marked" in contact_plot.draw(figures)
    table = contact_table.table(figures)
    assert [line.split(" | ")[0] for line in table.splitlines()[4:]] == [
        "| T-HARD, a row ahead and all else anew",
        "| not at all",
    ]
    assert (
        f"| {home['unsure']} | {home['unknown']} | {100 * home['network'][0]:.1f} % ["
        in table.splitlines()[-1]
    )
    with pytest.raises(FormatError, match="no positions"):
        alignment.measure(
            Classifier(
                replace(wide, manifest=replace(wide.manifest, contact=None, displacement=None)),
                SystemClock(),
            ),
            "",
            "",
            "",
            print,
        )


def committed() -> dict:
    """The results of the study `alignment`."""
    return json.loads((ROOT / "docs" / "data" / "alignment.json").read_text())


def test_the_headline_says_what_was_missed():
    """It gives false flags in place, flags where accuracy drops, wrong answers a row off, and the
    worst distance.
    """
    figures = committed()
    figures["moved"]["rows"][3]["wrong_unflagged"] = 77
    figures["other positions"]["moved"] = [5 / 432, 0.0, 0.1]
    figures["rows, forwards"] = {
        "lost_at_mm": 2.5,
        "moved": [0.5, 0.4, 0.6],
        "moved_before": [0.0, 0.0, 0.1],
    }
    figures["columns, forwards"] = {
        "lost_at_mm": None,
        "moved": [1.0, 0.9, 1.0],
        "moved_before": [1.0, 0.9, 1.0],
    }
    for direction, wrong, told in (("rows", 0.5, 3.25), ("columns", 0.25, 0.75)):
        for point in figures["moved"][direction]:
            if abs(point["mm"]) == 4:
                point["wrong_share"], point["told_mm"] = [wrong, 0.0, 1.0], told
    text = contact_table.headline(figures)
    for part in (
        "5 of 432 at others",
        "towards row 4, 2.5 mm: 50 % [40, 60]",
        "towards column 4 nothing is lost up to 6 mm",
        "25.0 to 50.0 %",
        f"77 of 432, at {abs(figures['moved']['rows'][3]['mm']):g} mm",
        "0.8 to 3.2 mm: too little",
    ):
        assert part in text, part
