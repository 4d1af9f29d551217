"""Shadow mode: how a candidate is compared, and that it cannot affect the robot."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.answer.taxels import Bridging
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core import statistics, storage, sweep_file, types
from palpate.core.config import UNTIL_NEW_OBJECT
from palpate.core.errors import ApplianceError, BundleError
from palpate.core.observer import Health
from palpate.core.types import Status, Sweep
from palpate.deployment import shadow
from palpate.deployment.shadow import Shadow
from palpate.inference.classifier import Classifier
from palpate.sim import rig, skin
from tests.factories import toy_bundle
from tests.factories.simulated_box import SECOND
from tests.factories.slow_disk import SlowDisk, full

IDLE = Health(0, "streaming", "", True, False, 0, 0, 0, 0, 1, 0, "", "sim", *[0] * 6)


class Side:
    """A current bundle and a candidate beside it, without a box."""

    def __init__(self, current: Bundle, candidate: Bundle, folder: Path, **how: Any) -> None:
        self.clock, self.folder = rig.VirtualClock(), folder
        self.tare = np.zeros((current.format.rows, current.format.cols))
        rule = replace(UNTIL_NEW_OBJECT, **how)
        self.current = Classifier(current, self.clock, rule)
        self.shadow = Shadow(
            candidate, current, folder, self.clock, lambda b: Classifier(b, self.clock, rule)
        )

    def judge(self, *sweeps: Sweep) -> None:
        """Let both bundles classify each sweep, and end its turn."""
        for one in sweeps:
            self.shadow.sweep(one, self.current(one), {"tare": self.tare.tolist()})
            self.turn()

    def turn(self, health: Health = IDLE, n: int = 2) -> None:
        """Take turns."""
        for _ in range(n):
            self.shadow.turn(health)

    def written(self) -> shadow.Agreement:
        """The agreement on the disk."""
        found = shadow.read(self.folder)
        assert found
        return found

    def kept(self) -> list[Path]:
        """The kept sweeps."""
        return sorted(self.folder.glob("*.npy"))


def renamed(old: Bundle, name: str = "aaaaaaaa") -> Bundle:
    """The same bundle with its labels in another order: every material gets a wrong label."""
    return replace(
        old,
        id=name,
        manifest=replace(old.manifest, labels=(*old.manifest.labels[1:], old.manifest.labels[0])),
    )


@pytest.fixture
def side(tmp_path: Path) -> Callable[..., Side]:
    """Makes a toy bundle with a candidate: the same bundle, or what `change` returns for it."""

    def make(
        change: Callable[[Bundle], Bundle] = lambda b: replace(b, id="bbbbbbbb"), **how: Any
    ) -> Side:
        current = toy_bundle.load(tmp_path / "toy", known=None)
        return Side(current, change(current), tmp_path / "shadow", **how)

    return make


A, B = toy_bundle.sweep(0, 0), toy_bundle.sweep(6, 0, 2)


def test_two_that_agree_are_counted_and_nothing_is_kept(side):
    """Written once a minute and at the end; with an interval."""
    pair = side()
    none = types.Frames.empty(toy_bundle.FORMAT)
    pair.judge(A, B, replace(A, status=Status.SHORT, frames=none))
    assert pair.written().compared == 0
    pair.clock.sleep_until(pair.clock.now_ns() + 61 * SECOND)
    pair.turn()
    assert (pair.written().compared, pair.written().agreed) == (2, 2)
    pair.judge(toy_bundle.sweep(0, 0, 3))
    pair.shadow.stopping()
    assert pair.written().pairs == {"a": {"a": 2}, "b": {"b": 1}}
    assert pair.kept() == []
    assert "[43.9 to 100.0 %]" in pair.written().text


def test_a_sweep_on_which_they_differ_is_kept_with_both_verdicts(side):
    """At the end of the turn; bit for bit."""
    pair = side(renamed)
    pair.judge(A)
    (path,) = pair.kept()
    again, format = sweep_file.load(path)
    told = sweep_file.sidecar(path)
    assert (told["verdict"]["label"], told["candidate"]["label"]) == ("a", "b")
    assert format == toy_bundle.FORMAT
    for name, run in (("verdict", pair.current), ("candidate", pair.shadow._classifier)):
        assert run(again).scores.tolist() == told[name]["scores"]
    written = pair.written()
    assert (written.compared, written.agreed, written.kept) == (1, 0, 1)
    assert written.pairs == {"a": {"b": 1}}
    counted, kept = written.lines(pair.folder)[1:]
    assert (counted, str(pair.folder) in kept) == ("  a -> b: 1", True)


def test_counts_are_not_written_while_a_sweep_is_open(side, monkeypatch):
    """Sweeps are kept at once, up to the limit; the counts follow."""
    sweeping = IDLE._replace(sweeping=True)
    monkeypatch.setattr(shadow, "KEPT", 2)
    pair = side(renamed)
    for one in (A, B, replace(A, id=9)):
        pair.shadow.sweep(one, pair.current(one), {"tare": pair.tare.tolist()})
    pair.turn(sweeping, 10)
    assert (len(pair.kept()), pair.written().compared) == (2, 0)
    pair.turn(n=1)
    assert (pair.written().kept, pair.written().compared) == (2, 3)


def test_a_sweep_that_is_being_written_counts_for_the_limit(side, monkeypatch):
    """The disk is slow; of three sweeps on which they differ two are kept."""
    monkeypatch.setattr(shadow, "KEPT", 2)
    pair, disk = side(renamed), SlowDisk()
    monkeypatch.setattr(pair.shadow, "_disk", disk)
    pair.judge(*(toy_bundle.sweep(0, 0, i) for i in range(1, 4)))
    disk.settle()
    pair.turn()
    disk.settle()
    assert len(pair.kept()) == 2
    pair.judge(toy_bundle.sweep(0, 0, 4))
    disk.settle()
    assert (len(pair.kept()), pair.written().kept) == (2, 2)


def test_a_disk_that_stands_still_has_room_for_the_black_box(side, monkeypatch):
    """One file waits there; no sweep is lost, however many wait for it, nor at the end."""
    pair, disk = side(renamed), SlowDisk()
    monkeypatch.setattr(pair.shadow, "_disk", disk)
    pair.judge(*(toy_bundle.sweep(0, 0, i) for i in range(1, 21)))
    assert len(disk._work) == 1
    for _ in range(10):
        disk.settle()
        pair.turn()
    assert len(pair.kept()) == 10
    pair.shadow.stopping()
    assert (len(pair.kept()), pair.written().kept, pair.written().compared) == (20, 20, 20)


def test_a_sweep_that_could_not_be_kept_is_not_counted(side, monkeypatch):
    """Though the counts can be written, which are small."""
    pair, disk = side(renamed), SlowDisk()
    monkeypatch.setattr(pair.shadow, "_disk", disk)
    monkeypatch.setattr(pair.shadow._sweeps, "put", full)
    pair.judge(A)
    disk.settle()
    pair.turn()
    disk.settle()
    assert (pair.written().compared, pair.written().kept) == (1, 0)


def test_it_fuses_by_the_same_rule(side):
    """The candidate fuses an object's sweeps, so neither asks for a third."""
    pair = side(min_probability=0.9)
    pair.judge(
        toy_bundle.sweep(2.5, 0, 1, object=1),
        toy_bundle.sweep(2.5, 0, 2, object=1),
        toy_bundle.sweep(2.5, 0, 3, object=1),
    )
    told = pair.shadow.agreement.pairs
    assert told == {"(unsure) a": {"(unsure) a": 1}, "a": {"a": 2}}


def test_without_a_tare_each_bundle_has_its_own(side):
    """The candidate has another unloaded skin, which it uses until the robot sends a TARE."""
    other = {"id": "bbbbbbbb", "golden_refusals": (Status.NO_CONTACT,) * 2}
    pair = side(lambda b: replace(b, **other, manifest=replace(b.manifest, unloaded=(1e4,) * 4)))
    pair.judge(A)
    assert pair.shadow.agreement.pairs == {"a": {"(no-contact)": 1}}
    pair.tare = pair.current.tare = np.ones((2, 2))
    pair.judge(A)
    assert pair.shadow.agreement.pairs == {"a": {"(no-contact)": 1, "a": 1}}


def test_taxels_that_are_broken_over_the_stream_count_for_both(side):
    """The candidate, which sees no stream, bridges the same taxels."""
    rule = Bridging(taxels=1, row=False, column=False, noise=4.0, quietest=2.0, still=False)
    pair = side(lambda b: replace(b, id="bbbbbbbb", manifest=replace(b.manifest, bridging=rule)))
    far, broken = toy_bundle.sweep(6, 0), np.zeros((2, 2, 2), bool)
    broken[0, 0, 0] = True  # the taxel that carries the material of the toy
    for circumstances in ({}, {"broken": broken.tolist()}):
        about = {"tare": pair.tare.tolist(), **circumstances}
        pair.shadow.sweep(far, pair.current(far), about)
    assert pair.shadow.agreement.pairs == {"b": {"b": 1, "a": 1}}


def test_an_early_answer_is_compared_where_the_candidate_gives_one(tmp_path):
    """Else the sweep is counted, not compared."""
    files = {"outputs": ("logits", "early"), "known": None}
    eager, slow = (
        toy_bundle.load(tmp_path / name, early=Early((least,) * 3, 1), **files)
        for name, least in (("eager", 0.5), ("slow", 2.0))
    )
    plain = toy_bundle.load(tmp_path / "plain", known=None)
    half = replace(
        A,
        share=0.5,
        frames=types.Frames(*(v[:10] for v in (A.frames.t_ns, A.frames.seq, A.frames.taxels))),
    )
    known = (replace(eager, id="e"), (1, 1, 0)), (slow, (0, 0, 1)), (plain, (0, 0, 1))
    for candidate, counts in known:
        pair = Side(eager, candidate, tmp_path / f"shadow-{candidate.id}")
        verdict = shadow.EarlyExit(pair.current)(half)
        assert verdict
        pair.shadow.sweep(half, verdict, {"tare": pair.tare.tolist()})
        found = pair.shadow.agreement
        assert (found.compared, found.agreed, found.later) == counts


def test_a_candidate_that_fails_ends_its_shadow_and_nothing_else(side, logged):
    """Three in a row or slow ones; one line; stopped."""

    def strange() -> None:
        """An error like those of onnxruntime, whose only common base is Exception."""
        raise type("Fail", (Exception,), {})("[ONNXRuntimeError] : 1 : FAIL : no")

    class FailingClassifier:
        """A candidate whose model fails on some sweeps, with an exception of its own."""

        def __init__(
            self, run: Classifier, fails: Callable[[Sweep], bool], act: Callable[[], None]
        ) -> None:
            self.format, self.taxels, self.bundle = run.format, run.taxels, run.bundle
            self.self_test, self._run, self._fails, self._act = run.self_test, run, fails, act

        def __call__(self, one: Sweep):
            """Fail, or judge."""
            if self._fails(one):
                self._act()
            return self._run(one)

    pair = side()
    pair.shadow._classifier = FailingClassifier(
        pair.shadow._classifier, lambda s: s.id != 3, strange
    )
    pair.judge(*(toy_bundle.sweep(0, 0, i) for i in range(1, 10)))
    found = pair.shadow.agreement
    assert (found.compared, found.failed) == (1, 5)
    assert len(logged) == 1
    assert "[ONNXRuntimeError]" in logged[0]
    pair.turn()
    pair.clock.sleep_until(pair.clock.now_ns() + 61 * SECOND)
    pair.turn()
    assert pair.written().failed == 5
    pair.shadow.stopping()
    pair = side()
    slow = lambda: pair.clock.sleep_until(pair.clock.now_ns() + SECOND // 5)  # noqa: E731
    pair.shadow._classifier = FailingClassifier(pair.shadow._classifier, lambda s: True, slow)
    pair.judge(*(toy_bundle.sweep(0, 0, i) for i in range(1, 5)))
    assert (pair.shadow.agreement.compared, pair.shadow.agreement.failed) == (1, 8)
    assert "200 ms" in logged[1]


def test_the_counts_go_on_over_restarts_and_begin_anew_with_another_pair(side, tmp_path):
    """Of either bundle."""
    pair = side(renamed)
    pair.judge(A)
    pair.shadow.stopping()
    pair = side(renamed)
    pair.judge(A)
    assert (pair.written().compared, len(pair.kept())) == (2, 2)
    pair.shadow.stopping()
    pair = side(lambda b: renamed(b, "cccccccc"))
    assert (pair.written().candidate, pair.written().compared, pair.kept()) == ("cccccccc", 0, [])
    pair.judge(A)
    pair.shadow.stopping()
    other = replace(toy_bundle.load(tmp_path / "toy", known=None), id="dddddddd")
    pair = Side(other, renamed(other, "cccccccc"), pair.folder)
    assert (pair.written().current, pair.written().compared, pair.kept()) == ("dddddddd", 0, [])


@pytest.mark.slow
def test_a_candidate_that_kills_the_program_stays_away(side):
    """After three starts that died; an order or a minute resets."""

    def start(judged_s: float) -> Shadow:
        pair = side()
        pair.clock.sleep_until(pair.clock.now_ns() + round(judged_s * SECOND))
        pair.judge(A)
        return pair.shadow

    for _ in range(2):
        for lived_s in (1, 1, 61):
            start(lived_s)._sweeps.close()  # the lock ends with the program
        for _ in range(2):
            start(1)._sweeps.close()
        start(1).stopping()
    for _ in range(3):
        start(1)._sweeps.close()
    for _ in range(2):
        with pytest.raises(ApplianceError, match=r"agreement\.json"):
            start(1)


def test_a_full_disk_costs_the_record_alone(side, monkeypatch, logged):
    """It is logged once; verdicts are still compared."""
    pair = side(renamed)

    def full(*_: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(storage, "put_all", full)
    pair.judge(*(toy_bundle.sweep(0, 0, i) for i in range(1, 5)))
    pair.shadow.stopping()
    assert pair.shadow.agreement.compared == 4
    assert ["No space left" in line for line in logged] == [True]


def test_a_candidate_that_cannot_be_one_is_named(side, tmp_path, default_bundle):
    """Another format, two large models, failing goldens, a folder's file."""
    with pytest.raises(BundleError, match="4x4"):
        side(lambda b: default_bundle)
    with pytest.raises(BundleError, match="together"):
        side(lambda b: replace(b, id="bbbbbbbb", model=bytes(shadow.MOST_MODELS)))
    with pytest.raises(BundleError, match="golden"):
        side(lambda b: replace(b, golden_logits=b.golden_logits[:, ::-1].copy()))
    assert shadow.read(tmp_path / "shadow").starts == 0  # a refusal does not count as a crash
    shutil.rmtree(tmp_path / "shadow")
    (tmp_path / "shadow").write_text("")
    with pytest.raises(ApplianceError, match="room"):
        side()


@pytest.mark.parametrize(
    "text", ["", "[]", '{"candidate": "x"}', '{"candidate": "x", "current": "y", "schema": 2}']
)
def test_a_broken_agreement_begins_anew(side, tmp_path, text, logged):
    """The log names the file, and the counts begin with this start."""
    (tmp_path / "shadow").mkdir()
    (tmp_path / "shadow" / shadow.FILE).write_text(text)
    pair = side()
    assert "cannot" in logged[0]
    assert pair.written().starts == 1


def test_the_interval_is_wilson_s():
    """The interval is the same as that of scipy."""
    stats = pytest.importorskip(
        "scipy.stats", reason="scipy comes with the desktop's tools (make test)"
    )
    for k, n in ((0, 1), (118, 120), (7, 9), (20, 20)):
        want = stats.binomtest(k, n).proportion_ci(method="wilson")
        assert statistics.wilson(k, n) == pytest.approx((want.low, want.high), abs=1e-6)


def test_the_robot_notices_nothing(rigged, default_bundle, tmp_path):
    """A candidate that is always wrong: the same sentences; each sweep is kept."""
    heard = []
    for beside in (False, True):
        clock = rig.VirtualClock()
        ghost = Shadow(
            renamed(default_bundle),
            default_bundle,
            tmp_path / "shadow",
            clock,
            lambda b, clock=clock: Classifier(b, clock),
        )
        made = rigged(observers=[ghost] if beside else [])
        verdicts = made.until(lambda made=made: made.box.answered >= 3)
        heard.append([line for line in made.heard if ",RES," in line])
        ghost.stopping()
    assert heard[0] == heard[1]
    assert len(heard[0]) == 3
    named = {v.label for v in verdicts}
    found = shadow.read(tmp_path / "shadow")
    assert found
    assert (found.compared, found.agreed, set(found.pairs)) == (3, 0, named)
    kept = sorted((tmp_path / "shadow").glob("*.npy"))
    assert [sweep_file.load(path)[1] for path in kept] == [skin.FORMAT] * 3
    about = json.loads(kept[0].with_suffix(".json").read_text())
    assert about["candidate"]["bundle"] == "aaaaaaaa"
    assert about["bundle"] == default_bundle.id == bundle.load(bundle.DEFAULT).id
