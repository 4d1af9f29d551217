"""Broken taxels over the stream and in a window, and the answers of the box to both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.types import EPOCH_BITS, Frames, Status, Sweep
from palpate.inference.classifier import Classifier
from palpate.inference.early_exit import EarlyExit
from palpate.inference.taxel_watch import CERTAIN, SOUND, TaxelWatch
from palpate.signal.broken_taxels import Bridging
from palpate.sim.rig import VirtualClock
from tests.factories import toy_bundle

FORMAT = replace(toy_bundle.FORMAT, rows=4, cols=4, window=100)
RULE = Bridging(taxels=2, row=True, column=False, noise=4.0, quietest=2.0, still=False)
NEVER = np.zeros((4, 4))


def made(tmp_path: Path, rule: Bridging | None = RULE, **more: Any) -> bundle.Bundle:
    """A toy bundle of 4x4 taxels with this rule."""
    loaded = toy_bundle.load(tmp_path / "toy", format=FORMAT, **more)
    return replace(loaded, manifest=replace(loaded.manifest, bridging=rule))


def watch(rule: Bridging | None = RULE) -> TaxelWatch:
    manifest = bundle.Manifest(
        "toy", "1", FORMAT, "raw", ("a", "b"), toy_bundle.LIMITS, {}, bridging=rule
    )
    return TaxelWatch(manifest)


def frames(taxels: np.ndarray, epoch: int = 0) -> Frames:
    n = np.arange(len(taxels))
    return Frames(n, n + (epoch << EPOCH_BITS), taxels)


def broken(place: Any, kind: str = "silent", z1: float = 0) -> np.ndarray:
    """A window of the toy with broken taxels: raw counts [100, 4, 4]."""
    taxels = toy_bundle.window(z1, 0, FORMAT)
    if kind == "silent":
        taxels[place] = 0
    else:
        taxels[place] += np.rint(30 * np.random.default_rng(0).standard_normal(100)).astype(
            np.int16
        )
    return taxels


def sweep(taxels: np.ndarray, share: float = 1.0) -> Sweep:
    return Sweep(1, 0, 0, Status.OK, frames(taxels), share=share)


@pytest.mark.parametrize(
    ("taxels", "degraded"),
    [
        (broken(np.s_[:, 1, 1]), "silent taxel 2.2"),
        (broken(np.s_[:, 1:3, 1]), "silent taxel 2.2 3.2"),
        (broken(np.s_[:, 2]), "silent row 3"),
        (broken(np.s_[:, 0, 0], z1=6), "silent taxel 1.1"),
        (broken(np.s_[:, 1, 1], "noisy"), "noisy taxel 2.2"),
    ],
)
def test_a_broken_taxel_is_bridged_and_named(tmp_path: Path, taxels: np.ndarray, degraded: str):
    """The answer is ok. Taxel 1.1 carries the material of the toy; its neighbour 1.2 does not, so
    that the bridged load is that of material a."""
    verdict = Classifier(made(tmp_path), VirtualClock())(sweep(taxels))
    assert (verdict.status, verdict.label) == (Status.OK, "a")
    assert (verdict.degraded, verdict.detail) == (degraded, f"degraded: {degraded}")
    assert verdict.as_dict()["degraded"] == degraded


def clipped(place: Any) -> np.ndarray:
    """A window of the toy whose amplifier holds some taxels at its highest count."""
    taxels = toy_bundle.window(0, 0, FORMAT)
    taxels[place] = taxels.max() + 20
    return taxels


def test_clipped_taxels_are_answered_as_far_as_the_bundle_tolerates(tmp_path: Path):
    """Six constant taxels are more than may be bridged. They are at the ceiling, so they are not
    broken; a bundle that tolerates as many full counts answers and says the share."""
    place = np.s_[:, 1:3, 1:]
    few, many = made(tmp_path), made(tmp_path)
    limits = replace(many.manifest.thresholds, saturated=0.5)
    many = replace(many, manifest=replace(many.manifest, thresholds=limits))
    refused = Classifier(few, VirtualClock())(sweep(clipped(place)))
    assert refused.status is Status.SATURATED
    assert "2.2 2.3 2.4" in refused.detail
    verdict = Classifier(many, VirtualClock())(sweep(clipped(place)))
    assert (verdict.status, verdict.label) == (Status.OK, "a")
    assert (verdict.degraded, verdict.detail) == ("", "38% of the counts at full scale")
    below = clipped(place)
    below[place] = 3
    assert Classifier(many, VirtualClock())(sweep(below)).status is Status.DEAD_TAXEL


def test_clipped_taxels_do_not_count_as_broken_over_the_stream():
    """However long the finger presses; one that is stuck below the ceiling does."""
    one = watch()
    taxels = clipped(np.s_[:, 1:3, 1:])
    for _ in range(2 * CERTAIN):
        one.put(frames(taxels), NEVER)
    assert one.broken is None
    taxels[:, 0, 3] = 3
    for _ in range(2 * CERTAIN):
        one.put(frames(taxels), NEVER)
    assert one.broken
    assert one.broken.text == "silent taxel 1.4"


def test_the_recorded_sweep_stays_as_it_was(tmp_path: Path):
    """Bridging works on a copy."""
    taxels = broken(np.s_[:, 1, 1])
    before = taxels.copy()
    Classifier(made(tmp_path), VirtualClock())(sweep(taxels))
    assert (taxels == before).all()


@pytest.mark.parametrize(
    ("place", "count", "status", "detail"),
    [
        (np.s_[:, 1:3, 1:3], 0, Status.DEAD_TAXEL, "taxel 2.2 2.3 3.2 3.3"),
        (np.s_[:, 1:3, 1:3], 90, Status.STUCK_TAXEL, "taxel 2.2 2.3 3.2 3.3"),
        (np.s_[:, :, 1], 0, Status.DEAD_TAXEL, "column 2"),
    ],
)
def test_more_silent_taxels_than_are_proven_are_refused(
    tmp_path: Path, place: Any, count: int, status: Status, detail: str
):
    """The status and the places are those of a box that bridges nothing."""
    taxels = toy_bundle.window(0, 0, FORMAT)
    taxels[place] = count
    verdict = Classifier(made(tmp_path), VirtualClock())(sweep(taxels))
    assert (verdict.status, verdict.label, verdict.detail) == (status, "", detail)
    assert verdict.degraded == ""


def test_more_noisy_taxels_than_are_proven_reach_the_network(tmp_path: Path):
    """As before bridging; silent taxels beside them are still bridged."""
    noise = np.rint(30 * np.random.default_rng(0).standard_normal((100, 3))).astype(np.int16)
    taxels = toy_bundle.window(0, 0, FORMAT)
    taxels[:, [1, 2, 3], [1, 3, 0]] += noise
    run = Classifier(made(tmp_path), VirtualClock())
    assert (run(sweep(taxels)).status, run(sweep(taxels)).degraded) == (Status.OK, "")
    taxels[:, 1, 2] = 0
    assert run(sweep(taxels)).degraded == "silent taxel 2.3"


def test_a_bundle_without_the_figure_refuses_as_before(tmp_path: Path):
    """A dead taxel is refused, a noisy one reaches the network, and the stream changes nothing."""
    run = Classifier(made(tmp_path, None), VirtualClock())
    for taxels, status in (
        (broken(np.s_[:, 1, 1]), Status.DEAD_TAXEL),
        (broken(np.s_[:, 1, 1], "noisy"), Status.OK),
    ):
        run.frames(frames(taxels))
        verdict = run(sweep(taxels))
        assert (verdict.status, verdict.degraded, run.degraded) == (status, "", "")


def test_a_bridged_window_without_contact_is_refused(tmp_path: Path):
    """A single stuck taxel does not count as contact."""
    taxels = np.where(np.arange(100) % 2, 5, 0).astype(np.int16)[:, None, None] * np.ones(
        (4, 4), np.int16
    )
    taxels[:, 2, 2] = 90
    assert Classifier(made(tmp_path), VirtualClock())(sweep(taxels)).status is Status.NO_CONTACT


def test_the_place_of_the_contact_is_computed_from_bridged_taxels(tmp_path: Path):
    """A dead taxel at the edge would move the centre of the contact."""
    at = replace(toy_bundle.IN_PLACE, rows_mm=(1.5,), cols_mm=(1.5,), limit_mm=0.05)
    run = Classifier(made(tmp_path, contact=at), VirtualClock())
    dead = broken(np.s_[:, 3, 3])
    assert run(sweep(dead)).displacement == ""
    run = Classifier(made(tmp_path, None, contact=at), VirtualClock())
    dead[::2, 3, 3] = 1  # neither constant nor loaded
    assert run(sweep(dead)).displacement


def test_an_early_answer_bridges_too(tmp_path: Path):
    """The answer names the taxel; with too many broken taxels the rest of the sweep is needed."""
    early = bundle.Early((0.5,) * 3, 1)
    run = Classifier(
        made(tmp_path, early=early, outputs=("logits", "embedding", "early")), VirtualClock()
    )
    dead = broken(np.s_[:, 1, 1])[:75]
    verdict = EarlyExit(run)(sweep(dead, 0.75))
    assert verdict
    assert (verdict.status, verdict.degraded) == (Status.OK, "silent taxel 2.2")
    crowded = toy_bundle.window(0, 0, FORMAT)[:75]
    crowded[:, 1:3, 1:3] = 0
    assert EarlyExit(run)(sweep(crowded, 0.75)) is None


@pytest.mark.parametrize("kind", ["silent", "noisy"])
def test_a_taxel_is_broken_over_the_stream_after_several_stretches(kind: str):
    """It is then bridged in every window, until it has been sound for a while."""
    it, bad, good = watch(), broken(np.s_[:, 1, 1], kind), toy_bundle.window(0, 0, FORMAT)
    for _ in range(CERTAIN):
        assert it.broken is None
        it.put(frames(bad), NEVER)
    assert it.broken
    assert it.broken.text == f"{kind} taxel 2.2"
    assert it.repaired(good, NEVER)[1].degraded == f"{kind} taxel 2.2"
    for _ in range(SOUND):
        assert it.broken
        it.put(frames(good), NEVER)
    assert it.broken is None
    assert it.repaired(good, NEVER)[1].degraded == ""


def test_single_bad_stretches_are_forgiven():
    """A taxel that fails in every second stretch is not broken over the stream."""
    it = watch()
    for _ in range(4 * CERTAIN):
        for taxels in (broken(np.s_[:, 1, 1]), toy_bundle.window(0, 0, FORMAT)):
            it.put(frames(taxels), NEVER)
    assert it.broken is None


def test_a_taxel_that_fails_more_often_than_not_is_found():
    """Two bad stretches to a good one are enough in the end."""
    it = watch()
    for _ in range(CERTAIN):
        for bad in (True, True, False):
            it.put(
                frames(toy_bundle.window(0, 0, FORMAT) if not bad else broken(np.s_[:, 1, 1])),
                NEVER,
            )
    assert it.broken


def test_a_resting_skin_says_nothing_about_silent_taxels():
    """A constant skin neither makes a taxel silent nor clears it."""
    it, rest = watch(), np.full((100, 4, 4), 50, np.int16)
    for _ in range(3 * CERTAIN):
        it.put(frames(rest), NEVER)
    assert it.broken is None
    for _ in range(CERTAIN):
        it.put(frames(broken(np.s_[:, 1, 1])), NEVER)
    for _ in range(2 * SOUND):
        it.put(frames(rest), NEVER)
    assert it.broken


def test_the_grouping_of_frames_does_not_matter():
    """Frames come in packets of any size."""
    it, bad = watch(), np.concatenate([broken(np.s_[:, 1, 1])] * (CERTAIN + 1))
    for at in range(0, len(bad), 30):
        it.put(frames(bad[at : at + 30]), NEVER)
    assert it.broken


def test_another_skin_begins_without_broken_taxels():
    """Frames of a new enumeration may be of another skin."""
    it = watch()
    for _ in range(CERTAIN):
        it.put(frames(broken(np.s_[:, 1, 1])), NEVER)
    assert it.broken
    it.put(frames(toy_bundle.window(0, 0, FORMAT), epoch=1), NEVER)
    assert it.broken is None


def test_too_many_taxels_over_the_stream_are_refused(tmp_path: Path):
    """Also in a window in which they happen to be sound."""
    run = Classifier(made(tmp_path), VirtualClock())
    for _ in range(CERTAIN):
        run.frames(frames(broken(np.s_[:, 1:3, 1:3])))
    assert run.degraded == "silent taxel 2.2 2.3 3.2 3.3"
    verdict = run(sweep(toy_bundle.window(0, 0, FORMAT)))
    assert verdict.status is Status.STUCK_TAXEL
    assert run.about()["broken"][0][1] == [False, True, True, False]


def test_a_sidecar_of_a_sound_skin_has_no_entry(tmp_path: Path):
    """Sidecars of sound skins keep the bytes of earlier versions."""
    assert "broken" not in Classifier(made(tmp_path), VirtualClock()).about()
