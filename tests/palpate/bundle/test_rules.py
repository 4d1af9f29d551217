"""One contract for all rules in a manifest: read as written, refused by name out of range."""

from __future__ import annotations

import json
from dataclasses import replace
from math import inf, nan
from typing import Any

import pytest

from palpate.answer.correlation import Correlations
from palpate.answer.disturbance import Allowance, Disturbances
from palpate.answer.early import Early
from palpate.answer.slide import SlideLimits, SpeedRange
from palpate.answer.taxels import Bridging, LoadModes
from palpate.bundle.manifest import Manifest
from palpate.core.errors import BundleError
from tests.factories import toy_bundle
from tests.factories.contacts import MIDDLE

BRIDGING = Bridging(taxels=3, row=True, column=False, noise=4.0, quietest=1.0, still=False)
LOADS = LoadModes((1.0,) * 16, ((2.0,) * 16,), 0.5)
LOST = Allowance("lost", 0.0, 1.0, 1.0)
SPEED = Allowance("speed", 2.0, 1.5, 1.0)
EARLY = Early((0.6, 0.6, 0.6), 2, (4.0, 4.0, 4.0))
WRITTEN: list[dict[str, Any]] = [
    {"contact": MIDDLE},
    {"displays": {"wood": "木, geölt"}},
    {"disturbances": Disturbances((LOST, replace(SPEED, tried=1.2)), 4.0)},
    {"speeds": SpeedRange(28.0, 33.0)},
    {"bridging": BRIDGING},
    {"bridging": replace(BRIDGING, loads=LOADS)},
    {"sliding": SlideLimits((-5.0, -1.0), 0.3)},
    {"correlations": Correlations(0.02, -1.0)},
    {"early": EARLY},
    {"unloaded": tuple(map(float, range(16)))},
]


@pytest.mark.parametrize("rules", WRITTEN, ids=lambda rules: next(iter(rules)))
def test_a_rule_is_read_as_it_was_written(default_bundle, rules):
    """By way of the manifest's JSON."""
    manifest = replace(default_bundle.manifest, **rules)
    assert Manifest.parse(manifest.json()) == manifest


OUT: list[tuple[Any, str, str, tuple[Any, ...]]] = [
    (MIDDLE, "pitch_mm", "pitch_mm", (0.0, nan, "4", 1e7)),
    (MIDDLE, "limit_mm", "limit_mm", (-1.0, inf, True)),
    (MIDDLE, "rows_mm", "rows_mm", ((6.0, -1e7), (), (6.0, nan), [6.0, 6.4])),
    (MIDDLE, "cols_mm", "cols_mm", ((6.0, None), (6.0,))),
    (LOST, "of", "'wind'", ("wind",)),
    (LOST, "end", "start and end 0", (0.0,)),
    (LOST, "end", "end inf", (inf,)),
    (LOST, "slope", "slope -1", (-1.0,)),
    (LOST, "slope", r"\(lost\)\.slope", ("1",)),
    (LOST, "tried", "tried 0.5 for lost", (0.5,)),
    (LOST, "tried", "tried inf", (inf,)),
    (SPEED, "tried", "beyond the end 1.5", (1.6,)),
    (SPEED, "tried", "tried '1'", ("1",)),
    (Disturbances(), "hum", "hum ", (0.0, -1.0, nan, inf, "4")),
    (LOADS, "modes", r"modes \(\)", ((),)),
    (LOADS, "modes", "from 1 to 8", (LOADS.modes * 10,)),
    (LOADS, "modes", "as many values", (((1.0, 2.0),),)),
    (LOADS, "rest", r"rest (0\.0|nan)", (0.0, nan)),
    (LOADS, "mean", r"mean \(inf", ((inf,) * 16,)),
    (LOADS, "modes", "1e[+]300", (((1e300,) * 16,),)),
    (BRIDGING, "taxels", "taxels (-1|True)", (-1, True)),
    (BRIDGING, "noise", "noise (0.0|1e-300)", (0.0, 1e-300)),
    (BRIDGING, "quietest", "quietest (inf|1e[+]39)", (inf, 1e39)),
    (EARLY, "limits", r"early\.limits", ((4.0,), (4.0, 0.0, 4.0), (4.0, "4", 4.0))),
    (toy_bundle.DISPLACEMENT, "farthest_mm", "farthest_mm", (0,)),
    (SlideLimits(()), "least", r"sliding\.least", ((inf,), (nan, -1.0), ("-5",))),
    (Correlations(), "frames", r"correlations\.frames", (-1.1, nan, "0")),
    (Correlations(), "taxels", r"correlations\.taxels", (1.1, inf)),
    (SlideLimits(()), "pattern", r"sliding\.pattern", (0.0, -1.0, inf, nan)),
]
"""A rule, a field of it, what its refusal says, and the values that are refused."""


@pytest.mark.parametrize(
    ("rule", "field", "why", "value"),
    [(rule, field, why, value) for rule, field, why, values in OUT for value in values],
)
def test_a_value_out_of_range_is_refused(rule, field, why, value):
    """The message has the field, or what is wrong with its value."""
    with pytest.raises(BundleError, match=why):
        replace(rule, **{field: value})


SPEEDS = {"least_mm_s": 28, "most_mm_s": 33}


@pytest.mark.parametrize(
    ("rules", "why"),
    [
        ({"speeds": SPEEDS | {"least_mm_s": 0}}, "least_mm_s 0"),
        ({"speeds": SPEEDS | {"least_mm_s": 34}}, "34 to 33"),
        ({"speeds": SPEEDS | {"most_mm_s": 2e6}}, r"1e\+06"),
        ({"speeds": SPEEDS | {"least_mm_s": True}}, "least_mm_s True"),
        ({"speeds": {"least_mm_s": 28}}, "manifest"),
        ({"speeds": [28, 33]}, "manifest"),
        ({"displays": {"felt": "Filz"}}, "'felt'.* not a label"),
        *(({"displays": {"wood": name}}, "cannot be shown") for name in ("", "x" * 61, 7)),
        *(({"displays": {"wood": f"a{c}b"}}, "cannot be") for c in ("\u202e", "\n<3>", "\x1b[2J")),
        ({"displays": ["wood"]}, "manifest cannot be read"),
    ],
)
def test_a_rule_of_another_form_is_refused(default_bundle, rules, why):
    """One line, with the value where there is one."""
    content = json.loads(default_bundle.manifest.json()) | rules
    with pytest.raises(BundleError, match=why) as refused:
        Manifest.parse(json.dumps(content).encode())
    assert str(refused.value).isprintable()


def test_lists_of_a_rule_fit_the_skin_and_the_labels(default_bundle):
    """Positions are counted; loads are as many as values of the skin, limits at most as labels."""
    many = (6.0,) * 1001
    with pytest.raises(BundleError, match="1000"):
        replace(MIDDLE, rows_mm=many, cols_mm=many)
    manifest = default_bundle.manifest
    loads = LoadModes((1.0,) * 6, ((2.0,) * 6,), 0.5)
    with pytest.raises(BundleError, match=r"6 loads .* for 16"):
        replace(manifest, bridging=replace(BRIDGING, loads=loads))
    with pytest.raises(BundleError, match=r"7 .* 6 "):
        replace(manifest, sliding=SlideLimits((-5.0,) * 7))
