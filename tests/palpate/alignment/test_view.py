"""Loads in text."""

from __future__ import annotations

import pytest

from palpate.alignment.view import figure


@pytest.mark.parametrize(
    ("value", "full", "unit", "text"),
    [
        (1.254, 2.0, "N", "1.25"),
        (31.0, 200.0, "N", "31.00"),
        (1.254, 2.0, "", "1"),
        (1.254, 2.0, "uT", "1.25"),
        (31.04, 60.0, "uT", "31.0"),
        (310.4, 600.0, "uT", "310"),
    ],
)
def test_newtons_have_two_digits(value: float, full: float, unit: str, text: str):
    """Raw counts have none, other units as many as three digits in all leave."""
    assert figure(value, full, unit) == text
