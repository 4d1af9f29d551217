"""`palpate check` reports a board that is too slow for its skin."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from palpate.answer.slide import SpeedRange
from palpate.bundle import bundle
from palpate.core import config
from palpate.core.clock import Clock
from palpate.io import skin_profile
from palpate.runtime import selftest
from palpate.sim import devices, rig, script
from palpate_train.answer import fit_unknown
from tests.factories.skins import devices as played
from tests.factories.skins import sweeps


def results_of(model: bundle.Bundle, share: float = 0.01) -> dict[str, selftest.CheckResult]:
    """The checks by component, of a simulated skin whose reading takes `share` of a core."""
    acts, source, format = script.named("skin", None, 1, spread=False)
    built = devices.build(format, acts, rig.VirtualClock(), source)
    wired = built.wire(config.load(None))
    found = selftest.check(wired, lambda: model, built, spending(built.clock, share))
    return {result.component: result for result in found}


def spending(clock: Clock, share: float) -> Callable[[], int]:
    """Processor time of a thread that is busy by `share`."""
    return lambda: round(clock.now_ns() * share)


@pytest.mark.parametrize(
    ("share", "ok"), [(0.043, True), (0.49, True), (0.51, False), (0.97, False)]
)
def test_what_reading_takes_of_a_core(default_bundle, share, ok):
    """The check shows the share of a core. Above half a core it fails and says what to do."""
    found = results_of(default_bundle, share)["skin"]
    assert found.ok == ok
    assert re.findall(r"\d+", found.detail)[4:9] == ["750", "750", "1", "0", "0"]
    assert f"{100 * share:.1f} %" in found.detail
    assert ("faster" in found.detail) != ok


@pytest.mark.parametrize(
    ("component", "changes", "part"),
    [
        ("speed", {"speeds": None}, "from 8 to 400 mm/s; the bundle does not state"),
        ("speed", {"speeds": SpeedRange(27.6, 33.1)}, "from 8 to 400 mm/s, trained 28 to 33"),
        ("speed", {"contact": None, "displacement": None}, "not measured: the distance"),
        ("bundle", {}, "up to 4 broken taxels or one row or one column bridged"),
        ("bundle", {"bridging": None}, "are refused"),
        ("bundle", {"disturbances": None}, "look like an unknown material"),
    ],
)
def test_check_says_what_the_bundle_allows(default_bundle, component, changes, part):
    """Speeds, bridged taxels, disturbances; without them it passes."""
    changed = replace(default_bundle, manifest=replace(default_bundle.manifest, **changes))
    found = results_of(changed)[component]
    assert found.ok
    assert part in found.detail
    if component == "bundle":
        assert ("material" in found.detail) == ("disturbances" in changes)


def test_check_says_that_unknown_materials_get_a_label(default_bundle):
    """Only of a bundle without limits, for which classifier.strangers chooses nothing."""
    limitless = fit_unknown.without(default_bundle)
    for model in (default_bundle, limitless):
        assert (selftest.UNLIMITED in results_of(model)["bundle"].detail) == (model is limitless)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent_hz", "ok"), [(28.0, True), (29.0, True), (100.0, False), (20.0, False)]
)
def test_the_rate_of_a_skin_without_a_clock(sent_hz, ok, tmp_path):
    """Frames are counted for long enough: another rate fails with both figures."""
    profile = skin_profile.load("anyskin", [config.load(None).folder / "skins"])
    seen = sweeps.view("anyskin", profile.format)
    acts, source, format = script.named("skin", profile.format, 1, seen=seen)
    built = played.build("anyskin", profile, format, acts, rig.VirtualClock(), source)
    built.player.wire.period_ns = 1e9 / sent_hz
    results = selftest.check(
        built.wire(config.load(None, ["skin.profile=anyskin"])),
        lambda: bundle.load(tmp_path),
        built,
        spending(built.clock, 0.01),
    )
    found = next(result for result in results if result.component == "skin")
    assert found.ok is ok, found.detail
    if not ok:
        assert re.search(rf"sends {sent_hz - 1:.0f}|sends {sent_hz:.0f}", found.detail)
        assert "28" in found.detail
