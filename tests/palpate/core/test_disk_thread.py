"""Work on the disk beside the loop: order, bound, faults, the wait at the end."""

from __future__ import annotations

import threading

import pytest

from palpate.core import disk_thread
from palpate.core.disk_thread import AtOnce, DiskThread
from palpate.sim.rig import VirtualClock
from palpate.sweeps.black_box import BlackBox
from palpate.sweeps.recording import Labels, RecordingSession
from tests.cuts.recording import SHORT, taken


def held(most: int = 3) -> tuple[DiskThread, threading.Event]:
    """A thread whose first piece of work lasts until the event."""
    disk, free = DiskThread(most), threading.Event()
    assert disk(free.wait)
    return disk, free


@pytest.mark.parametrize("make", [AtOnce, DiskThread])
def test_results_come_back_in_order(make):
    """Each piece of work is done once, and its result is given back in the caller's thread."""
    disk, given = make(), []
    for n in range(5):
        assert disk(lambda n=n: n, lambda n: given.append((n, threading.current_thread())))
    assert disk.settle()
    assert given == [(n, threading.main_thread()) for n in range(5)]


def test_work_beyond_the_bound_is_refused_counted_and_told(logged):
    """The caller does not wait, or the test would not end. The loss and its end are logged once."""
    disk, free = held()
    done: list[int] = []
    accepted = [disk(lambda n=n: n, done.append) for n in range(5)]
    assert accepted == [True, True, False, False, False]
    assert (disk.refused, "3 times" in disk.text) == (3, True)
    free.set()
    disk.settle()
    assert disk(lambda: 7, done.append)
    disk.settle()
    assert done == [0, 1, 7]
    assert len(logged) == 2
    assert "slow" in logged[0]
    assert "again" in logged[1]


def test_a_fault_comes_back_to_the_loop():
    """It is raised where results are given back, and the thread goes on."""
    disk, done = DiskThread(), []
    disk(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        disk.settle()
    disk(lambda: 1, done.append)
    disk.settle()
    assert done == [1]


def test_the_end_waits_for_a_bounded_time(monkeypatch, logged):
    """A disk that hangs cannot keep the program from ending; the log has the loss."""
    monkeypatch.setattr(disk_thread, "SETTLE_S", 0.05)
    disk, free = held()
    assert not disk.settle()
    assert "0.05" in logged[-1]
    free.set()


def test_a_slow_disk_costs_recordings_and_tells_so(tmp_path):
    """Failed or stored, as it was; nothing is discarded while written."""
    disk, free = held(2)
    said: list[str] = []
    session = RecordingSession(
        tmp_path / "kept",
        SHORT,
        Labels("cork", "1", "s"),
        VirtualClock(),
        lambda line: said.append(line.decode()),
        disk=disk,
    )
    for number in (1, 2):
        session.sweep(*taken(number, SHORT), {})
    assert [line.split(",")[2:4] for line in said] == [["2", "failed"]]
    assert "disk" in said[0]
    with pytest.raises(Exception, match="written"):
        session.commands["DISCARD"]("")
    free.set()
    session.close()
    assert [line.split(",")[2:4] for line in said[1:]] == [["1", "stored"]]
    assert len(list((tmp_path / "kept").glob("*.npy"))) == 1


def test_the_black_box_does_not_wait(tmp_path):
    """Sweeps are kept in order beside the loop, the oldest are removed, and the end waits."""
    disk, free = held(10)
    box = BlackBox(tmp_path / "box", SHORT, 2, disk)
    for number in (1, 2, 3):
        box.sweep(*taken(number, SHORT), {})
    assert not list((tmp_path / "box").glob("*.npy"))
    free.set()
    box.close()
    assert [p.stem for p in sorted((tmp_path / "box").glob("*.npy"))] == [
        "sweep-000002",
        "sweep-000003",
    ]
