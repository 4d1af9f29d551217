"""Two releases: the release that runs after installs, crashes, power-offs and faults."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle.bundle import DEFAULT
from palpate.cli import run_command, teach_command
from palpate.cli.main import main
from palpate.core.errors import ConfigError
from palpate.core.types import Status, Verdict
from palpate.deployment import release_trial, releases
from palpate.deployment.release_trial import ReleaseTrial
from palpate.deployment.releases import Releases
from palpate.sim import skin
from palpate.sweeps.black_box import BlackBox
from tests.factories.feeds import health

OLD, NEW, NEXT = "palpate-1-a", "palpate-2-b", "palpate-3-c"


def verdict(status: Status = Status.OK) -> Verdict:
    """An answer, with a label if it is ok."""
    label = "Canvas" if status is Status.OK else ""
    return Verdict(7, 0, status, label, 1.0, 1.0, np.empty(0), 1, 0, 0, "", "no memory")


class TrialBox:
    """A box whose service is started and ended in several ways."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.opt, self.report, self.boot = folder / "opt", folder / "var", folder / "boot_id"
        for name in (OLD, NEW, NEXT):
            (self.opt / name).mkdir(parents=True)
        self.report.mkdir()
        self.boot.write_text("first\n")
        self.env = {"STATE_DIRECTORY": str(self.report)}
        self.releases = Releases(self.opt, self.report, self.boot)
        self._patch = monkeypatch
        self.releases.activate(OLD)

    def start(self) -> ReleaseTrial | None:
        """Start the service, as systemd does. Returns its trial."""
        self.said = self.releases.begin()
        self._patch.setattr(sys, "prefix", str(self.opt / "palpate"))
        return release_trial.observed(self.env)

    @property
    def runs(self) -> str:
        """The release that runs."""
        return self.releases.current


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrialBox:
    """A box with a new release on trial."""
    made = TrialBox(tmp_path, monkeypatch)
    made.releases.activate(NEW)
    return made


def crash(box: TrialBox) -> None:
    """A start that ends without an orderly end."""
    box.start()


def stop(box: TrialBox) -> None:
    """A start that is stopped in order."""
    trial = box.start()
    if trial:
        trial.stopping()


def unplugged(box: TrialBox) -> None:
    """A start without a skin, killed."""
    trial = box.start()
    if trial:
        trial.turn(health(1, streams=False))


def cut(box: TrialBox) -> None:
    """A start that a loss of power ends soon."""
    box.start()
    box.boot.write_text(f"after {os.urandom(4).hex()}\n")


def day(box: TrialBox) -> None:
    """A day with one sweep and 301 s of streaming that the mains switch ends."""
    trial = box.start()
    for t in (0, 300, 301):
        if trial:
            trial.turn(health(t))
    if trial:
        trial.answered(verdict())
        trial.turn(health(302))
    box.boot.write_text(f"after {os.urandom(4).hex()}\n")


def teach(box: TrialBox) -> None:
    """A start of a box that is taught first, killed."""
    trial = box.start()
    if trial:
        trial.serves()


def lesson(box: TrialBox) -> None:
    """A day of teaching that the mains switch ends."""
    teach(box)
    box.boot.write_text(f"after {os.urandom(4).hex()}\n")


def work(box: TrialBox) -> None:
    """A start that answers a sweep and then crashes."""
    trial = box.start()
    if trial:
        trial.answered(verdict())
        trial.turn(health(1))


def fault(box: TrialBox) -> None:
    """A start that a segmentation fault ends."""
    box.start()
    releases.note_fault(box.env | {"EXIT_CODE": "dumped", "EXIT_STATUS": "SEGV"})


def killed(box: TrialBox) -> None:
    """A start that a person or the kernel kills."""
    box.start()
    releases.note_fault(box.env | {"EXIT_CODE": "killed", "EXIT_STATUS": "KILL"})


def failing(box: TrialBox) -> None:
    """A start in which a sweep fails."""
    trial = box.start()
    if trial:
        trial.answered(verdict(Status.FAILED))
        trial.turn(health(1))
        trial.stopping()


@pytest.mark.parametrize(
    ("events", "runs"),
    [
        ([crash] * 2, NEW),
        ([crash] * 3, OLD),
        ([work] * 3, OLD),
        ([crash, stop, crash, stop], NEW),
        ([stop] * 30, NEW),
        ([unplugged] * 30, NEW),
        ([day] * 30, NEW),
        ([*[cut] * 9, day] * 3, NEW),
        ([lesson] * 30, NEW),
        ([teach] * 3, OLD),
        ([cut] * 10, OLD),
        ([killed] * 2, NEW),
        ([killed] * 3, OLD),
        ([day, fault], OLD),
        ([failing], OLD),
        ([crash, day, day, crash, day, day, crash], OLD),
    ],
    ids=lambda one: one if isinstance(one, str) else "-".join(e.__name__ for e in one[:4]),
)
def test_what_runs_after(box: TrialBox, events: list[Callable[[TrialBox], None]], runs: str):
    """Crashes, faults and failed sweeps send a release back; stops, unplugged skins and a month of
    evenings at the mains switch do not. The old release then says why. The new release is refused
    until its rejection is removed."""
    for event in events:
        event(box)
        assert box.runs == NEW
    trial = box.start()
    assert (box.runs, trial is not None) == (runs, runs == NEW)
    if runs == OLD:
        assert NEW in box.said
        assert NEW in releases.text()
        with pytest.raises(ConfigError, match="rejected"):
            box.releases.activate(NEW)
        (box.opt / "palpate.rejected").unlink()
        box.releases.activate(NEW)
        assert (box.start() is not None, box.runs) == (True, NEW)


def test_fifty_sweeps_and_a_day_of_streaming_end_the_trial(box: TrialBox):
    """Both, over days of an hour that the mains switch ends, each with some minutes that were not
    recorded yet. From the next start on nothing of the trial is left, and the service writes no
    report."""
    for n in range(30):
        trial = box.start()
        assert trial, n
        for t in range(0, 3601, 60):
            trial.turn(health(t))
            if t < 120:
                trial.answered(verdict())
        box.boot.write_text(f"day {n}\n")
        if not trial.text:
            break
    assert n == 25
    assert box.start() is None
    assert (box.runs, box.releases.trial, box.said) == (NEW, None, "")
    assert sorted(path.name for path in box.opt.iterdir() if path.is_symlink()) == [
        "palpate",
        "palpate.previous",
    ]
    assert not (box.opt / "palpate.trial").exists()


def test_the_progress_of_a_start_that_failed_is_lost(box: TrialBox):
    """A release that dies after each sixth sweep is not proven by them."""
    for sweeps in (4, 6):
        trial = box.start()
        assert trial
        assert f"on trial: {0 if sweeps == 4 else 4} of 50" in trial.text
        for _ in range(sweeps):
            trial.answered(verdict())
        trial.turn(health(0))
        if sweeps == 4:
            trial.stopping()
    trial = box.start()
    assert trial
    assert "on trial: 4 of 50" in trial.text


def test_a_second_release_on_trial_goes_back_to_the_proven_one(box: TrialBox):
    """The release on trial is not proven. The proven release itself needs no trial."""
    box.start()
    box.releases.activate(NEXT)
    for event in (crash, crash, crash, stop):
        event(box)
    assert box.runs == OLD
    box.releases.activate(NEW)
    assert box.start() is not None
    box.releases.activate(OLD)
    assert (box.start(), box.runs, box.releases.trial) == (None, OLD, None)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"id": 3}',
        b'{"id": "x", "why": "bad"}',
        b"[" * 9999,
        None,
        "link",
        "fifo",
    ],
    ids=lambda one: str(one)[:12],
)
def test_what_another_puts_in_place_of_the_report_counts_for_nothing(
    box: TrialBox, tmp_path: Path, content: bytes | str | None
):
    """Root reads a file that the service's user may replace: it is neither followed, nor waited
    for, nor believed."""
    box.start()
    file = box.report / releases.REPORT
    file.unlink(missing_ok=True)
    if content == "link":
        (tmp_path / "other").write_text('{"id": "x"}')
        file.symlink_to(tmp_path / "other")
    elif content == "fifo":
        os.mkfifo(file)
    elif isinstance(content, bytes):
        file.write_bytes(content)
    else:
        file.mkdir()
    assert (box.releases.begin(), box.runs) == ("", NEW)
    assert box.releases.trial
    assert box.releases.trial.standing.starts == 2


def test_a_report_of_an_earlier_trial_counts_for_nothing(box: TrialBox):
    """The same release on trial again begins anew, though it had passed, or had failed."""
    box.start()
    trial = box.releases.trial
    assert trial
    before = releases.ReleaseReport(trial.id, start=1)
    for report in (replace(before, passed=True), replace(before, why="slow")):
        releases.write_report(box.report, replace(report, id="another"))
        box.start()
        assert (box.runs, box.releases.trial is not None) == (NEW, True)


def comparing(box: TrialBox, trial: ReleaseTrial, program: str) -> release_trial.ReleaseComparison:
    """A comparison by a proven release that is this shell program."""
    proven = box.opt / OLD / "bin" / "python"
    proven.parent.mkdir(exist_ok=True)
    proven.write_text(f"#!/bin/sh\n{program}\n")
    proven.chmod(0o755)
    kept = BlackBox(box.opt.parent / "kept", skin.FORMAT, 9)
    compared = release_trial.comparison(trial, kept, box.report)
    kept.close()
    assert compared
    return compared


def answer(box: TrialBox, trial: ReleaseTrial, program: str, n: int) -> int:
    """Answer n sweeps; the number after which the program ends."""
    compared = comparing(box, trial, program)
    for i in range(n):
        compared.answered(verdict())
        for t in (i, i + 0.5):
            compared.turn(health(t))
            if compared._process:
                compared._process.wait(10)
        if trial.over:
            return i + 1
    compared.stopping()
    return 0


def test_a_release_that_answers_otherwise_goes_back_within_fifty_sweeps(box: TrialBox):
    """By the box alone, with the reason; nothing is compared after fifty sweeps."""
    trial = box.start()
    assert trial
    calls = box.opt / "calls"
    program = f'echo "$@" >> {calls}; [ $(wc -l < {calls}) -lt 4 ] || {{ echo 2 of 40; exit 3; }}'
    assert 40 <= answer(box, trial, program, 60) <= 50
    assert "palpate.runtime.replay" in calls.read_text()
    trial.stopping()
    assert box.start() is None
    assert (box.runs, box.releases.rejected[NEW][0]) == (OLD, "2 of 40")


def test_a_fault_during_a_write_sends_the_release_back(box: TrialBox, monkeypatch):
    """The disk thread writes progress while the loop finds a sweep without an answer."""
    trial, write = box.start(), releases.write_report
    assert trial

    def slow(*report: object) -> None:
        monkeypatch.setattr(releases, "write_report", write)
        trial.goes_back("2 of 40")
        write(*report)

    monkeypatch.setattr(releases, "write_report", slow)
    trial.turn(health(1, streams=False))
    trial.stopping()
    box.start()
    assert box.releases.rejected[NEW][0] == "2 of 40"


@pytest.mark.parametrize("program", ["exit 0", "exit 1", "echo of an old release; exit 2"])
def test_a_release_that_answers_alike_stays(box: TrialBox, program: str):
    """Also if the proven release cannot compare; five comparisons, and no more."""
    trial = box.start()
    assert trial
    calls = box.opt / "calls"
    assert answer(box, trial, f"echo >> {calls}; {program}", 90) == 0
    assert len(calls.read_text()) == 5
    trial.stopping()
    assert box.start() is not None
    assert box.runs == NEW


RUN = ["run", "--sim", "skin", "--virtual", "--sweeps", "3", "--set"]


@pytest.mark.parametrize(("black_box", "folder"), [(0, "run/trial"), (9, "var/black-box")])
def test_sweeps_on_trial_are_written_once(
    box: TrialBox, monkeypatch: pytest.MonkeyPatch, black_box: int, folder: str
):
    """Into the black box, else into memory; the proven release gets the sweeps of this run."""
    folders = f"store.folder={box.opt.parent / 'var'}", f"store.runtime={box.opt.parent / 'run'}"
    words = [*RUN, f"store.black_box={black_box}", *(w for f in folders for w in ("--set", f))]
    if black_box:
        assert main(words) == 0
    trial, asked = box.start(), []
    monkeypatch.setattr(release_trial, "observed", lambda: trial)
    given = release_trial.ReleaseComparison
    monkeypatch.setattr(
        release_trial,
        "ReleaseComparison",
        lambda command, differs: asked.append(command) or given(command, differs),
    )
    assert main(words) == 0
    kept = box.opt.parent / folder
    runs = 2 if black_box else 1
    assert len([*box.opt.parent.rglob("*.npy")]) == len([*kept.glob("*.npy")]) == 3 * runs
    assert asked[0][-3:] == [str(kept), str(DEFAULT), str(3 * (runs - 1))]


def test_a_box_that_is_taught_first_may_be_switched_off(
    box: TrialBox, monkeypatch: pytest.MonkeyPatch
):
    """Its service has nothing to answer until it is taught."""
    monkeypatch.setattr(run_command, "untaught", lambda *of: True)
    seen: list[bool] = []

    def until_taught(*of: object) -> int:
        trial = box.releases.trial
        seen.append(bool(trial and releases.read_report(box.report, trial).worked))
        return 0

    monkeypatch.setattr(teach_command, "until_taught", until_taught)
    trial = box.start()
    monkeypatch.setattr(release_trial, "observed", lambda: trial)
    assert main([*RUN, f"store.folder={box.opt.parent / 'store'}"]) == 0
    assert seen == [True]


def test_a_comparison_that_hangs_is_ended(box: TrialBox):
    """After a minute, or with the program; nothing waits for it."""
    trial = box.start()
    assert trial
    compared = comparing(box, trial, "exec sleep 600")
    for _ in range(30):
        compared.answered(verdict())
    compared.turn(health(0))
    first = compared._process
    assert first
    compared.turn(health(59))
    assert compared._process is first
    compared.turn(health(61))
    assert (first.returncode, compared._process) == (-9, None)
    compared.turn(health(62))
    second = compared._process
    compared.stopping()
    assert second
    assert second.returncode == -9


def test_a_sweep_that_fails_ends_the_program(box: TrialBox):
    """So the release goes back now; where nothing is left to go back to, it goes on."""
    for there in (True, False):
        trial = box.start()
        assert trial
        comparing(box, trial, "exit 0")
        if not there:
            trial.proven = str(box.opt / "nothing")
        trial.answered(verdict(Status.FAILED))
        assert trial.over == there


def test_each_finger_of_a_hand_counts_its_own_starts(box: TrialBox):
    """Two units start in turn, many times in order; then one dies three times."""
    reports = [box.report.parent / f"palpate-{name}" for name in ("left", "right")]

    def started(report: Path) -> ReleaseTrial | None:
        report.mkdir(exist_ok=True)
        box.releases = Releases(box.opt, report, box.boot)
        box.env = {"STATE_DIRECTORY": str(report)}
        return box.start()

    for _ in range(6):
        both = [started(report) for report in reports]
        assert box.runs == NEW
        for trial in both:
            assert trial
            trial.turn(health(1))
            trial.stopping()
    for _ in range(4):
        started(reports[0])
    assert (box.runs, list(box.releases.rejected)) == (OLD, [NEW])
    assert started(reports[1]) is None
    assert not list(box.opt.glob("*.trial*"))


def test_a_program_that_is_no_service_observes_no_trial(box: TrialBox):
    """Nor does one of another release."""
    assert box.start() is not None
    assert release_trial.observed({}) is None
    box._patch.setattr(sys, "prefix", str(box.opt / OLD))
    assert release_trial.observed(box.env) is None
    assert releases.text() == ""


def test_a_release_with_nothing_to_go_back_to_stays(box: TrialBox):
    """The folder of the old release was removed."""
    for _ in range(3):
        crash(box)
    (box.opt / OLD).rmdir()
    assert box.start() is not None
    assert (box.runs, box.releases.rejected) == (NEW, {})
