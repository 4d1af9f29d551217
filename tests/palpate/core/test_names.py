"""Labels and display names of materials."""

from __future__ import annotations

import pytest

from palpate.core import names
from palpate.core.names import TypedNames
from palpate.core.text import closest


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("wood", "wood"),
        ("Spülmaschinentuch", "Spuelmaschinentuch"),
        ("mi-bois, été", "mi-bois ete"),
        ("ミラー 2", "2"),
        ("木", "material"),
        ("$PPLP,RES", "PPLP RES"),
        ("x" * 30, "x" * 24),
    ],
)
def test_each_name_has_a_label_that_can_be_sent(name, label):
    """It is like the name, and another where that is taken."""
    assert names.sendable(name) == label
    assert names.LABEL.fullmatch(names.sendable(name, {label})) or name == label
    if name != label:
        assert names.sendable(name, {label}) not in (label, name)


@pytest.mark.parametrize(
    ("text", "can"),
    [
        ("Holz, geölt", True),
        ("木", True),
        ("x" * 60, True),
        ("x" * 61, False),
        ("", False),
        (" ", False),
        ("a\nb", False),
        ("a\u202eb", False),
        *((f"a{unseen}", False) for unseen in "\u3164\u2800\u115f\ufe0f\u034f\U000e0101"),
        *((f"a{unseen}", False) for unseen in "\ufffc\U0001107f\U00016fe4\U00013441"),
        (7, False),
    ],
)
def test_only_short_printed_texts_are_shown(text, can):
    """No line breaks, nothing that turns the direction of a text; `shown` replaces them."""
    assert names.can_be_shown(text) is can
    if isinstance(text, str) and text.strip():
        assert names.can_be_shown(names.shown(text))


def test_names_keep_labels_and_the_closest_are_proposed():
    """Typed again the same; other scripts take no label; none that is too far."""
    known = ["max_sweeps", "max_sheets", "black_box"]
    assert closest("max_sweepz", known) == ["max_sweeps"]
    assert closest("MAX_SWEEPZ", known, 3) == ["max_sweeps", "max_sheets"]
    assert closest("zzz", known, 3) == []
    known = TypedNames()
    known.add("Filz weiss", None)
    known.add("Holz", "Holz, geölt")
    assert known.label(" Holz, geölt ") == "Holz"
    assert known.label("Filz weiß") == known.label("Filz weiß") == "Filz weiss 2"
    assert known.label("Filz weiss") == "Filz weiss"
    for bad in ("a\nb", "ä\nb", "-wood", "<b>", ""):
        assert known.label(bad) == bad
    assert known.displays == {"Holz": "Holz, geölt", "Filz weiss 2": "Filz weiß"}
    known = TypedNames()
    known.add("material", None)
    known.add("Spuele", "Spu\u0308le")
    assert known.label("木") == "material 2"
    assert known.label("石") == "material 3"
    assert known.label("Sp\u00fcle") == known.label("Spu\u0308le") == "Spuele"
