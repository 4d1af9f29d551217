"""A bundle on trial: which starts count, how it ends, and trouble with the disk."""

from __future__ import annotations

import re
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.errors import BundleError, LineError, ModelError
from palpate.core.types import Status, Verdict
from palpate.deployment.state import MOST_STARTS, Standing
from palpate.deployment.store import Store
from palpate.deployment.trial import Trial
from tests.factories import deliveries
from tests.factories.deliveries import Delivery
from tests.factories.feeds import health
from tests.factories.simulated_box import tubes
from tests.factories.slow_disk import SlowDisk

pytestmark = deliveries.NEEDED
Ready = tuple[str, str, str]


def verdict(label: str = "Canvas") -> Verdict:
    """An answer, by default with a label."""
    status = Status.OK if label else Status.NO_CONTACT
    return Verdict(1, 0, status, label, 1.0, 1.0, np.empty(0), 1, 0, 0, "", "")


class Trying(Delivery):
    """A box with bundle 1 committed and 2 on trial, for 5 sweeps or 600 s."""

    def __init__(self, folder: Path, ready: Ready) -> None:
        """ready: the store of such a box, with the sha256 of both bundles."""
        super().__init__(folder)
        made, self.one, self.two = ready
        shutil.copytree(made, self.how.folder, symlinks=True, dirs_exist_ok=True)

    def tried(self) -> Trial:
        """The trial of one more start."""
        trial = self.store.choose().trial
        assert trial
        return trial

    @property
    def standing(self) -> Standing:
        """The recorded state of the bundle on trial."""
        return self.store.state.of(self.two)


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Ready:
    """The store of a box with bundle 1 committed and bundle 2 on trial."""
    made = Delivery(tmp_path_factory.mktemp("ready"))
    one, two = made.committed(1), made.installed(2)
    return made.how.folder, one, two


@pytest.fixture
def box(tmp_path: Path, ready: Ready) -> Trying:
    """A box with a bundle on trial."""
    return Trying(tmp_path, ready)


def booted(box: Trying, name: str) -> None:
    """Change the id of the boot, as after a power cut."""
    file = box.folder / "boot_id"
    file.write_text(f"{name}\n")
    box.store = Store(box.how, lambda bundle: None, boot=file)


def test_power_cuts_do_not_count_against_the_bundle(box):
    """A crash within one boot counts, also after power cuts."""
    for cut in range(3):
        booted(box, f"boot {cut}")
        assert box.start() == box.two
        assert (box.standing.starts, box.standing.cuts) == (1, cut)
    assert [box.start(), box.start()] == [box.two] * 2
    assert box.start() == box.one
    booted(box, "the next")
    assert box.start() == box.one


@pytest.mark.parametrize("sweeps", [0, 1], ids=["no sweep", "a sweep"])
def test_thirty_days_each_ended_by_the_mains_switch_commit_the_bundle(box, sweeps):
    """Little work a day: with a sweep, or with 301 s of streaming, the bundle is committed by what
    all days have shown. Ten power-offs soon after the start before that leave it on trial."""
    for day in range(30):
        booted(box, f"day {day}")
        choice = box.store.choose()
        assert choice.bundle.id == box.two[:8]
        if choice.trial and day > 8:  # days on which nothing happens, at first
            for t in range(302 * (1 - sweeps)):
                choice.trial.turn(health(t))
            for _ in range(sweeps):
                choice.trial.answered(verdict())
                choice.trial.turn(health(0))
    assert box.standing.committed


@pytest.mark.slow
def test_a_bundle_under_which_the_computer_is_reset_again_and_again_gives_way(box):
    """The bundle is replaced after ten power cuts. Else a bundle that resets the computer would
    stay for ever. An id of the boot that cannot be read is that of a crash."""
    box.store = Store(box.how, lambda bundle: None, boot=box.folder / "none")
    for n in range(2):
        assert box.start() == box.two
        assert (box.standing.starts, box.standing.cuts) == (n + 1, 0)
    box.tried().stopping()
    assert box.installed(2) == box.two
    for cut in range(10):
        booted(box, f"boot {cut}")
        assert box.start() == box.two
    booted(box, "the last")
    assert box.start() == box.one


def test_a_start_counts_until_the_program_ends_in_order(box):
    """Also over power cuts; a person's commit ends the trial."""
    booted(box, "first")
    box.tried()
    for boot in ("second", "third"):
        trial = box.tried()
        assert box.standing.starts == 2
        trial.stopping()
        trial.stopping()
        booted(box, boot)
    assert (box.standing.starts, box.standing.cuts) == (1, 0)
    trial = box.tried()
    assert box.store.commit()
    trial.turn(health(0, streams=False))
    trial.stopping()
    assert box.standing.committed


@pytest.mark.slow
def test_a_skin_that_is_unplugged_never_counts(box):
    """Starts without a skin do not count. Once the skin streams, the start counts."""
    for _ in range(3 * MOST_STARTS):
        trial = box.tried()
        assert box.standing.starts == 1
        for t in range(5):
            trial.turn(health(t, streams=False))
        assert box.standing.starts == 0
    trial.turn(health(5))
    assert box.standing.starts == 1
    trial.turn(health(6, streams=False))
    assert box.standing.starts == 0


def test_nothing_is_written_while_nothing_is_new(box):
    """There is a turn about every millisecond; a file is written only when a fact has changed."""
    trial = box.tried()
    trial.turn(health(0))
    book = Path(box.how.folder, "bundles.json")
    before = book.stat().st_mtime_ns, book.stat().st_ino
    for t in range(100):
        trial.turn(health(t))
    assert before == (book.stat().st_mtime_ns, book.stat().st_ino)


def test_another_command_is_not_waited_for(box, logged):
    """The loop goes on, and the write is tried again later."""
    trial = box.tried()
    with box.store._locked():
        trial.turn(health(0, streams=False))
    assert box.standing.starts == 1
    assert "use" in logged[-1]
    trial.turn(health(11, streams=False))
    assert box.standing.starts == 0


def test_enough_sweeps_commit(box, logged):
    """Sweeps with a label, once none is open; older bundles are refused then."""
    trial = box.tried()
    for _ in range(box.how.trial_sweeps - 1):
        trial.answered(verdict())
    for _ in range(10):
        trial.answered(verdict(label=""))
    trial.turn(health(1))
    assert re.findall(r"\d+", trial.text) == ["4", "5", "0", "600"]
    trial.answered(verdict())
    trial.turn(health(2, sweeping=True))
    assert not box.standing.committed
    trial.turn(health(3))
    assert box.standing.committed
    assert box.two[:8] in logged[-1]
    assert (box.store.state.counter, box.store.state.highest, trial.text) == (2, box.two, "")
    trial.stopping()
    trial.turn(health(4, streams=False))
    assert box.store.state.of(box.two) == Standing(box.one, 2)
    assert box.start() == box.two


def test_enough_time_commits(box):
    """Only time with a streaming skin counts."""
    trial = box.tried()
    for t in range(0, 400):
        trial.turn(health(t))
    for t in range(400, 2000):
        trial.turn(health(t, streams=False))
    assert not box.standing.committed
    for t in range(2000, 2201):
        trial.turn(health(t))
    assert not box.standing.committed
    trial.turn(health(2202))
    assert box.standing.committed


def test_what_a_crashed_start_has_shown_is_lost(box):
    """A bundle that crashes after each third sweep is not committed by six of them."""
    for _ in range(2):
        dies = box.tried()
        assert dies.text.startswith("on trial: 0 of 5")
        for _ in range(3):
            dies.answered(verdict())
            dies.turn(health(0))
    box.tried()
    assert box.start() == box.one


def test_what_an_orderly_run_has_shown_counts_in_the_next(box):
    """The progress of a crashed start is lost."""
    for n in range(2):
        trial = box.tried()
        trial.turn(health(0))
        trial.turn(health(100))
        trial.answered(verdict())
        trial.answered(verdict())
        trial.stopping()
        assert (box.standing.sweeps, box.standing.streamed_s) == (2 * (n + 1), 100 * (n + 1))
    dies = box.tried()
    dies.answered(verdict())
    trial = box.tried()
    assert re.findall(r"\d+", trial.text) == ["4", "5", "200", "600"]


@pytest.mark.parametrize(
    ("error", "counts"),
    [
        (None, 0),
        (LineError("no chip"), 0),
        (KeyboardInterrupt(), 0),
        (BundleError("bad"), 1),
        (ModelError("3 sweeps"), 1),
        (IndexError("bug"), 1),
    ],
    ids=repr,
)
def test_what_ends_the_program_decides_whether_the_start_counts(box, error, counts):
    """Missing hardware and a person do not."""
    with suppress(type(error)), box.tried():
        if error:
            raise error
    assert box.standing.starts == counts


def test_an_orderly_end_is_written_once(box, monkeypatch):
    """By the loop and then by the context; a bad card takes seconds for each write."""
    notes: list[bool] = []
    with box.tried() as trial:
        monkeypatch.setattr(box.store, "note", lambda *of, counted: notes.append(counted))
        trial.stopping()
    assert notes == [False]


def test_a_disk_that_stands_still_has_room_for_sweeps(box, monkeypatch):
    """One write of the trial waits there, though the skin comes and goes; the last state holds."""
    trial, disk = box.tried(), SlowDisk()
    monkeypatch.setattr(trial, "disk", disk)
    for t in range(20):
        trial.turn(health(t, streams=t % 2 == 1))
    assert len(disk._work) == 1
    disk.settle()
    assert box.standing.starts == 0
    trial.turn(health(20))
    disk.settle()
    assert box.standing.starts == 1


def test_a_full_disk_is_told_once_and_tried_again(box, monkeypatch, logged):
    """Nothing is raised; the commit comes when the disk can be written again."""
    trial = box.tried()
    calls: list[float] = []

    def full(path: Path, data: bytes) -> None:
        calls.append(1)
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr("palpate.core.storage.put", full)
        for t in range(100):
            trial.turn(health(t / 10, streams=False))
        assert len(calls) == 1
        for _ in range(5):
            trial.answered(verdict())
        for t in range(100, 200):
            trial.turn(health(t / 10))
        trial.stopping()
    assert len(calls) == 3
    assert len(logged) == 2
    assert "space" in logged[1]
    trial.turn(health(30))
    assert box.standing.committed


@pytest.mark.slow
def test_a_bundle_that_is_no_longer_current_is_not_committed(box):
    """Another bundle was deployed, or a person rolled back, while the old bundle still runs."""
    for way in (lambda: box.installed(3), box.store.rollback):
        trial = box.tried()
        way()
        for _ in range(5):
            trial.answered(verdict())
        trial.turn(health(1))
        assert trial.text == ""
        assert not box.standing.committed
        assert box.store.state.counter == 1
        box.store.install(box.made(2))


@pytest.mark.slow
def test_a_box_at_work_commits(box, rigged):
    """On the simulated box: five sweeps of the simulated robot, each with its answer."""
    trial = box.tried()
    simulated = tubes(1)
    running = rigged(simulated, model=bundle.load(box.store.bundles.at(box.two)), observers=[trial])
    running.until(lambda: running.box.answered >= 5 and not trial.text)
    assert box.standing.committed


def test_a_failed_sweep_begins_the_trial_anew(box):
    """Sweeps and time before it do not count, also not those that were recorded already."""

    def failed() -> Verdict:
        """The answer to a sweep on which the bundle failed."""
        return replace(verdict(""), status=Status.FAILED)

    trial = box.tried()
    for _ in range(4):
        trial.answered(verdict())
    trial.turn(health(1))
    trial.turn(health(500))
    trial.turn(health(501, streams=False))
    assert (box.standing.sweeps, box.standing.streamed_s > 400) == (4, True)
    trial.answered(failed())
    trial.turn(health(502, streams=False))
    assert (box.standing.sweeps, box.standing.streamed_s) == (0, 0)
    for _ in range(4):
        trial.answered(verdict())
    trial.turn(health(503))
    assert not box.standing.committed
    trial.answered(verdict())
    trial.turn(health(504))
    assert box.standing.committed
