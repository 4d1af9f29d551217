"""Broken taxels over the stream and in a window, and the answers of the box to both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.answer.taxels import CERTAIN, SOUND, Bridging, TaxelWatch
from palpate.bundle import bundle
from palpate.core.types import Status
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle
from tests.factories.toy_bundle import frames_of, sweep_of

FORMAT = replace(toy_bundle.FORMAT, rows=4, cols=4, window=100)
RULE = Bridging(taxels=2, row=True, column=False, noise=4.0, quietest=2.0, still=False)
GOOD = toy_bundle.window(0, 0, FORMAT)


def made(tmp_path: Path, rule: Bridging | None = RULE, **more: Any) -> bundle.Bundle:
    """A toy bundle of 4x4 taxels with this rule."""
    loaded = toy_bundle.load(tmp_path / "toy", format=FORMAT, **more)
    return replace(loaded, manifest=replace(loaded.manifest, bridging=rule))


@pytest.fixture
def run(tmp_path: Path) -> Classifier:
    """A classifier that bridges."""
    return Classifier(made(tmp_path), VirtualClock())


@pytest.fixture
def watch() -> TaxelWatch:
    """A watch over the stream alone."""
    return TaxelWatch(FORMAT, toy_bundle.LIMITS, RULE, np.zeros(FORMAT.shape))


def seen(watch: TaxelWatch, *stretches: np.ndarray, times: int = 1, epoch: int = 0) -> str:
    """The broken taxels after these stretches of the stream."""
    for _ in range(times):
        for taxels in stretches:
            watch.put(frames_of(taxels, epoch), np.zeros((4, 4)))
    return watch.broken.text if watch.broken else ""


def broken(place: Any, kind: str = "silent", z1: float = 0, count: int = 0) -> np.ndarray:
    """A window of the toy with broken taxels: raw counts [100, 4, 4]."""
    taxels = toy_bundle.window(z1, 0, FORMAT)
    if kind == "noisy":
        noise = 30 * np.random.default_rng(0).standard_normal(100)
        taxels[place] += np.rint(noise).astype(np.int16)
    else:
        taxels[place] = count
    return taxels


ONE, FOUR, SIX = np.s_[:, 1, 1], np.s_[:, 1:3, 1:3], np.s_[:, 1:3, 1:]
BAD = broken(ONE)
CLIPPED = broken(SIX, count=GOOD.max() + 20)
"""An amplifier holds six taxels at its highest count."""


@pytest.mark.parametrize(
    ("taxels", "degraded"),
    [
        (BAD, "silent taxel 2.2"),
        (broken(np.s_[:, 1:3, 1]), "silent taxel 2.2 3.2"),
        (broken(np.s_[:, 2]), "silent row 3"),
        (broken(np.s_[:, 0, 0], z1=6), "silent taxel 1.1"),
        (broken(ONE, "noisy"), "noisy taxel 2.2"),
    ],
)
def test_a_broken_taxel_is_bridged_and_named(run, taxels, degraded):
    """Answered as material a, which the neighbour shows; the sweep stays as it was."""
    before = taxels.copy()
    verdict = run(sweep_of(taxels))
    assert (verdict.status, verdict.label) == (Status.OK, "a")
    assert (verdict.degraded, verdict.detail) == (degraded, f"degraded: {degraded}")
    assert verdict.as_dict()["degraded"] == degraded
    assert (taxels == before).all()


def test_clipped_taxels_are_answered_as_far_as_the_bundle_tolerates(run, tmp_path):
    """At the ceiling they are not broken; the share is said."""
    few = made(tmp_path)
    limits = replace(few.manifest.thresholds, saturated=0.5)
    many = replace(few, manifest=replace(few.manifest, thresholds=limits))
    refused = run(sweep_of(CLIPPED))
    assert refused.status is Status.SATURATED
    assert "2.2 2.3 2.4" in refused.detail
    tolerant = Classifier(many, VirtualClock())
    verdict = tolerant(sweep_of(CLIPPED))
    assert (verdict.status, verdict.label, verdict.degraded) == (Status.OK, "a", None)
    assert verdict.detail.startswith("38% ")
    assert tolerant(sweep_of(broken(SIX, count=3))).status is Status.DEAD_TAXEL


@pytest.mark.parametrize(
    ("place", "count", "status", "detail"),
    [
        (FOUR, 0, Status.DEAD_TAXEL, "taxel 2.2 2.3 3.2 3.3"),
        (FOUR, 90, Status.STUCK_TAXEL, "taxel 2.2 2.3 3.2 3.3"),
        (np.s_[:, :, 1], 0, Status.DEAD_TAXEL, "column 2"),
    ],
)
def test_more_silent_taxels_than_are_proven_are_refused(run, place, count, status, detail):
    """The status and the places are those of a box that bridges nothing."""
    verdict = run(sweep_of(broken(place, count=count)))
    assert (verdict.status, verdict.label, verdict.detail) == (status, "", detail)
    assert verdict.degraded is None


def test_more_noisy_taxels_than_are_proven_reach_the_network(run):
    """Silent taxels near them are still bridged."""
    noise = np.rint(30 * np.random.default_rng(0).standard_normal((100, 3))).astype(np.int16)
    taxels = GOOD.copy()
    taxels[:, [1, 2, 3], [1, 3, 0]] += noise
    verdict = run(sweep_of(taxels))
    assert (verdict.status, verdict.degraded) == (Status.OK, None)
    taxels[:, 1, 2] = 0
    assert run(sweep_of(taxels)).degraded == "silent taxel 2.3"


@pytest.mark.parametrize(
    ("taxels", "status"), [(BAD, Status.DEAD_TAXEL), (broken(ONE, "noisy"), Status.OK)]
)
def test_a_bundle_without_the_figure_bridges_nothing(tmp_path, taxels, status):
    """A dead taxel is refused, a noisy one reaches the network, and the stream changes nothing."""
    bare = Classifier(made(tmp_path, None), VirtualClock())
    bare.frames(frames_of(taxels))
    verdict = bare(sweep_of(taxels))
    assert (verdict.status, verdict.degraded, bare.degraded) == (status, None, "")


def test_windows_without_contact_or_with_too_many_broken_taxels_are_refused(run):
    """Stuck alone, or sound just now; sidecars of sound skins have no entry."""
    taxels = np.where(np.arange(100) % 2, 5, 0)[:, None, None] * np.ones((4, 4))
    taxels[:, 2, 2] = 90
    assert run(sweep_of(taxels.astype(np.int16))).status is Status.NO_CONTACT
    assert "broken" not in run.about()
    for _ in range(CERTAIN):
        run.frames(frames_of(broken(FOUR)))
    assert run.degraded == "silent taxel 2.2 2.3 3.2 3.3"
    assert run(sweep_of(GOOD)).status is Status.STUCK_TAXEL
    assert run.about()["broken"][0][1] == [False, True, True, False]


def test_early_answers_and_places_of_contact_are_of_bridged_taxels(tmp_path):
    """With too many broken taxels the rest is needed; a dead edge would move the centre."""
    outputs, rule = ("logits", "embedding", "early"), Early((0.5,) * 3, 1)
    early = EarlyExit(Classifier(made(tmp_path, early=rule, outputs=outputs), VirtualClock()))
    verdict = early(sweep_of(BAD[:75], share=0.75))
    assert verdict
    assert (verdict.status, verdict.degraded) == (Status.OK, "silent taxel 2.2")
    assert early(sweep_of(broken(FOUR)[:75], share=0.75)) is None
    at = replace(toy_bundle.IN_PLACE, rows_mm=(1.5,), cols_mm=(1.5,), limit_mm=0.05)
    dead = broken(np.s_[:, 3, 3])
    assert (
        Classifier(made(tmp_path, contact=at), VirtualClock())(sweep_of(dead)).displacement is None
    )
    dead[::2, 3, 3] = 1  # neither constant nor loaded
    assert Classifier(made(tmp_path, None, contact=at), VirtualClock())(sweep_of(dead)).displacement


@pytest.mark.parametrize("kind", ["silent", "noisy"])
def test_a_taxel_is_broken_over_the_stream_after_several_stretches(watch, kind):
    """It is then bridged in every window, until it has been sound for a while."""
    bad, named, tare = broken(ONE, kind), f"{kind} taxel 2.2", np.zeros((4, 4))
    assert [seen(watch, bad) for _ in range(CERTAIN)] == [""] * (CERTAIN - 1) + [named]
    assert watch.repaired(GOOD, tare)[1].degraded == named
    assert [seen(watch, GOOD) for _ in range(SOUND)] == [named] * (SOUND - 1) + [""]
    assert watch.repaired(GOOD, tare)[1].degraded is None


@pytest.mark.parametrize(
    ("stretches", "named"),
    [
        ([BAD, GOOD], ""),  # a taxel that fails in every second stretch
        ([BAD, BAD, GOOD], "silent taxel 2.2"),
        ([np.full((100, 4, 4), 50, np.int16)], ""),  # a skin at rest
        ([CLIPPED], ""),  # however long the finger presses
        ([np.where(np.arange(16).reshape(4, 4) == 3, 3, CLIPPED)], "silent taxel 1.4"),
        ([BAD[:30], BAD[30:60], BAD[60:90], BAD[90:]], "silent taxel 2.2"),
        ([BAD[:30], BAD[30:60]], "silent taxel 2.2"),
    ],
)
def test_which_streams_make_a_taxel_broken(watch, stretches, named):
    """Single bad stretches are forgiven, grouping does not matter, a skin begins sound."""
    assert seen(watch, *stretches, times=4 * CERTAIN) == named
    assert seen(watch, GOOD, epoch=1) == ""


def test_a_resting_skin_does_not_clear_a_silent_taxel(watch):
    """A constant skin says nothing about silent taxels."""
    assert seen(watch, BAD, times=CERTAIN)
    assert seen(watch, np.full((100, 4, 4), 50, np.int16), times=2 * SOUND) == "silent taxel 2.2"
