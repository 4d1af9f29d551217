"""Patterns over file names: their fields, ambiguous names, texts that are no pattern."""

import pytest

from palpate.core.errors import FormatError
from palpate_train.data.file_names import NamePattern, group


@pytest.mark.parametrize(
    ("pattern", "path", "fields"),
    [
        (
            "{material}_{force}N_{trial}.csv",
            "wood_2.5N_3.csv",
            {"material": "wood", "force": "2.5", "trial": "3"},
        ),
        ("{material}/{speed}/{}.csv", "wood/fast/run 7.csv", {"material": "wood", "speed": "fast"}),
        (
            "{material}_{force:d}N.csv",
            "plastic_rough_5N.csv",
            {"material": "plastic_rough", "force": "5"},
        ),
        ("{material}_{x:f}.csv", "wood_-0.5.csv", {"material": "wood", "x": "-0.5"}),
        ("./a\\{material}.csv", "a/wood.csv", {"material": "wood"}),
        ("{material}.(1).csv", "a+b.(1).csv", {"material": "a+b"}),
        ("{material}.csv", "wood.txt", None),
        ("{material}.csv", "deep/wood.csv", None),
        ("{material}_{force:d}.csv", "wood_x.csv", None),
    ],
)
def test_a_pattern_reads_a_name(pattern: str, path: str, fields: dict[str, str] | None):
    """Text, whole numbers, numbers, ignored parts; a field stays within one name."""
    assert NamePattern(pattern).read(path) == fields


def test_a_name_that_fits_in_several_ways_is_refused():
    """`plastic_rough_5N_1` may be plastic or plastic_rough; nothing is guessed."""
    with pytest.raises(FormatError, match="'plastic'"):
        NamePattern("{material}_{force}N_{trial}.csv").read("plastic_rough_5N_1.csv")


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("*/{material}.csv", "for any text"),
        ("{material}_{a}_{a}.csv", "'a' stands twice"),
        ("{material}_{A}.csv", "'A'"),
        ("{material}_{a.csv", "brace"),
        ("{material}_{a:x}.csv", "'x'"),
        ("{material}_{recording}.csv", "each file"),
    ],
)
def test_what_is_no_pattern_is_refused(pattern: str, message: str):
    """Each invalid pattern has its message."""
    with pytest.raises(FormatError, match=message):
        NamePattern(pattern)


@pytest.mark.parametrize(
    ("field", "texts", "values", "unit"),
    [
        ("{x}", ["10", "5", "10"], [10, 5, 10], ""),
        ("{x}", ["2.5", "10", "-1"], [2.5, 10.0, -1.0], ""),
        ("{x:f}", ["0", "0.5", "1", "1.5"], [0.0, 0.5, 1.0, 1.5], ""),
        ("{x:f}N", ["0", "0.5"], [0.0, 0.5], "N"),
        ("{x}mm_s_", ["10", "20"], [10, 20], "mm/s"),
        ("{x}newtons", ["10", "20"], [10, 20], ""),
        ("{x}", ["5N", "10N"], [5, 10], "N"),
        ("{x}", ["5N", "500mN"], ["5N", "500mN"], ""),
        ("{x}", ["5 mm", "12.5 mm"], [5.0, 12.5], "mm"),
        ("{x}", ["slow", "fast"], ["slow", "fast"], ""),
        ("{x}N", ["slow", "fast"], ["slow", "fast"], ""),
        ("{x}", ["01", "10"], ["01", "10"], ""),
        ("{x:d}", ["01", "10"], [1, 10], ""),
        ("{x}", ["1", "1.0"], ["1", "1.0"], ""),
        ("{x:d}", ["20261126101112123456789"], ["20261126101112123456789"], ""),
        ("{x}", ["1", "fast"], ["1", "fast"], ""),
        ("{x_mn:d}", ["100", "300"], [100, 300], "mN"),
    ],
)
def test_values_stay_what_they_are(field: str, texts: list[str], values: list, unit: str):
    """Numbers and names stay; a unit is of the pattern, of every text, or of the field."""
    pattern = NamePattern("{material}_" + field + ".csv")
    found, of = group(pattern, pattern.names[-1], texts)
    assert found.tolist() == values
    assert [type(value) for value in found.tolist()] == [type(value) for value in values]
    assert of == unit
