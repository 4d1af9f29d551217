"""`palpate check` reports a board that is too slow for its skin."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from palpate.bundle import bundle
from palpate.core import config
from palpate.core.clock import Clock
from palpate.io import skin_profile
from palpate.runtime import selftest
from palpate.signal.slide import SpeedRange
from palpate.sim import devices, rig, script
from tests.factories.skins import devices as played
from tests.factories.skins import sweeps


def skin_of(share: float) -> selftest.CheckResult:
    """The check of the simulated skin on a board where reading takes the share `share` of a core
    while the skin streams, and the whole core before."""
    acts, source, format = script.named("skin", None, 1, spread=False)
    built = devices.build(format, acts, rig.VirtualClock(), source)
    results = selftest.check(
        built.wire(config.load(None)),
        lambda: bundle.load(bundle.DEFAULT),
        built,
        spending(built.clock, share),
    )
    return next(result for result in results if result.component == "skin")


def spending(clock: Clock, share: float) -> Callable[[], int]:
    """Processor time of a thread that is busy by `share`."""
    return lambda: round(clock.now_ns() * share)


@pytest.mark.parametrize(
    ("share", "ok"), [(0.043, True), (0.49, True), (0.51, False), (0.97, False)]
)
def test_what_reading_takes_of_a_core(share: float, ok: bool):
    """The check shows the share of a core. Above half a core it fails and says what to do."""
    found = skin_of(share)
    assert found.ok == ok
    assert f"750 Hz, 750 frames in 1.0 s, 0 lost, {100 * share:.1f} % of a core" in found.detail
    assert ("use a faster board" in found.detail) != ok


@pytest.mark.parametrize(
    ("changes", "detail"),
    [
        (
            {"speeds": None},
            "measured from 8 to 400 mm/s; the bundle does not state those of training: export",
        ),
        ({"speeds": SpeedRange(27.6, 33.1)}, "measured from 8 to 400 mm/s, trained 28 to 33"),
        (
            {"contact": None, "displacement": None},
            "not measured: the distance between taxels is unknown; export with --pitch-mm",
        ),
    ],
)
def test_which_speeds_are_measured(changes: dict[str, Any], detail: str):
    """The check shows the speeds that can be measured and those of training, or the reason."""
    acts, source, format = script.named("skin", None, 1, spread=False)
    built = devices.build(format, acts, rig.VirtualClock(), source)
    packaged = bundle.load(bundle.DEFAULT)
    changed = replace(packaged, manifest=replace(packaged.manifest, **changes))
    found = {
        result.component: result
        for result in selftest.check(built.wire(config.load(None)), lambda: changed, built)
    }
    assert found["speed"].ok
    assert found["speed"].detail.startswith(detail)


@pytest.mark.parametrize("proven", [True, False])
def test_check_says_how_many_broken_taxels_are_bridged(proven: bool):
    """And that a bundle without this figure refuses them; it still passes."""
    acts, source, format = script.named("skin", None, 1, spread=False)
    built = devices.build(format, acts, rig.VirtualClock(), source)
    packaged = bundle.load(bundle.DEFAULT)
    manifest = packaged.manifest if proven else replace(packaged.manifest, bridging=None)
    first, *_ = selftest.check(
        built.wire(config.load(None)), lambda: replace(packaged, manifest=manifest), built
    )
    assert first.component == "bundle"
    assert first.ok
    wanted = "up to 4 broken taxels or one row or one column bridged" if proven else "are refused"
    assert wanted in first.detail


@pytest.mark.parametrize("allowed", [True, False])
def test_check_says_if_disturbances_are_not_allowed_for(allowed: bool):
    """An older bundle passes, and answers disturbed sweeps as before."""
    acts, source, format = script.named("skin", None, 1, spread=False)
    built = devices.build(format, acts, rig.VirtualClock(), source)
    packaged = bundle.load(bundle.DEFAULT)
    found = packaged.manifest.disturbances if allowed else None
    older = replace(packaged, manifest=replace(packaged.manifest, disturbances=found))
    first, *_ = selftest.check(built.wire(config.load(None)), lambda: older, built)
    assert first.ok
    assert ("look like an unknown material" in first.detail) is not allowed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent_hz", "ok"), [(28.0, True), (29.0, True), (100.0, False), (20.0, False)]
)
def test_the_rate_of_a_skin_without_a_clock(sent_hz: float, ok: bool, tmp_path: Path):
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
        assert re.search(rf"sends {sent_hz - 1:.0f}|sends {sent_hz:.0f}", found.detail), (
            found.detail
        )
        assert "28 are expected" in found.detail
