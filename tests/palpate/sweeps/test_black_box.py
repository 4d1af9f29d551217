"""The black box: which sweeps it keeps, over restarts and on a full disk, and that its errors never
stop the box."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict, sidecar
from palpate.sim import devices, rig, script, skin
from palpate.sweeps import sweep_folder
from palpate.sweeps.black_box import BlackBox
from tests.factories import toy_bundle
from tests.factories.simulated_box import OnSweep, Rigged

MOST = 3


def box(folder: Path, most: int = MOST) -> BlackBox:
    """A black box for the toy skin."""
    return BlackBox(folder, toy_bundle.FORMAT, most)


def judged(
    number: int, status: Status = Status.OK, window: bool = True
) -> tuple[Sweep, Verdict, dict[str, Any]]:
    """A sweep, its verdict and its circumstances."""
    frames = toy_bundle.sweep(0, 0).frames if window else Frames.empty(toy_bundle.FORMAT)
    sweep = Sweep(number, 0, 1, Status.OK if window else status, frames)
    return (
        sweep,
        Verdict(number, 5, status, "", 0.0, 0.0, np.empty(0), 0, 0, 1, "b"),
        {"bundle": "b"},
    )


def numbers(folder: Path) -> list[int]:
    """The numbers of the complete sweeps in a folder."""
    numbers = sorted(int(path.stem[6:]) for path in folder.glob("*.npy"))
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"sweep-{n:06d}.{kind}" for n in numbers for kind in ("json", "npy")
    )
    return numbers


def test_the_last_sweeps_are_kept_over_restarts(tmp_path: Path):
    """Each new sweep pushes out the oldest sweep, also in a later run and for any status. A sweep
    without a window does not."""
    first = box(tmp_path / "b")
    for n in range(1, 6):
        first.sweep(*judged(n, Status.STUCK_TAXEL if n == 4 else Status.OK))
    first.sweep(*judged(6, Status.SHORT, window=False))
    assert numbers(tmp_path / "b") == [3, 4, 5]
    assert sidecar(tmp_path / "b" / "sweep-000004.npy")["verdict"]["status"] == "stuck-taxel"
    first.close()
    second = box(tmp_path / "b")
    second.sweep(*judged(1))
    assert numbers(tmp_path / "b") == [4, 5, 6]
    second.close()
    box(tmp_path / "b", most=1).sweep(*judged(1))
    assert numbers(tmp_path / "b") == [7]


def test_the_oldest_goes_once_the_newest_is_safe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The last sweeps exist at every moment: a sweep is removed only after the new sweep has its
    name."""
    black = box(tmp_path)
    for n in range(1, 4):
        black.sweep(*judged(n))
    there: list[list[str]] = []
    unlink = Path.unlink

    def noted(path: Path, missing_ok: bool = False) -> None:
        there.append(sorted(p.name for p in tmp_path.glob("*.npy")))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", noted)
    black.sweep(*judged(4))
    assert [len(names) for names in there] == [4, 3]


def test_a_full_disk_drops_the_oldest_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logged: list[str]
):
    """The oldest sweep is removed for a new sweep. If that does not help, one line is logged, and
    another when writing works again."""
    black = box(tmp_path)
    limit = [2]

    def tight(path: Path, sweep: Sweep, format: SweepFormat, about: Mapping[str, object]) -> None:
        if len(list(tmp_path.glob("*.npy"))) >= limit[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(path, sweep, format, about)

    save = sweep_folder.save
    monkeypatch.setattr(sweep_folder, "save", tight)
    for n in range(1, 5):
        black.sweep(*judged(n))
    assert numbers(tmp_path) == [3, 4]
    assert logged == []
    limit[0] = 0
    for n in range(5, 8):
        black.sweep(*judged(n))
    assert numbers(tmp_path) == []
    limit[0] = 9
    for n in range(8, 10):
        black.sweep(*judged(n))
    assert numbers(tmp_path) == [8, 9]
    assert logged == [
        f"<4>black box: no sweep is kept: No space left on device; see to {tmp_path}",
        "black box: sweeps are kept again",
    ]


def test_another_error_removes_no_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logged: list[str]
):
    """If the disk fails although it is not full, existing sweeps are kept."""
    black = box(tmp_path)
    black.sweep(*judged(1))

    def broken(*args: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(sweep_folder, "save", broken)
    black.sweep(*judged(2))
    assert numbers(tmp_path) == [1]
    assert "Input/output error" in logged[0]


def test_a_folder_that_cannot_be_used_yet(tmp_path: Path, logged: list[str]):
    """With a file instead of the folder, or another program in it, the box starts and logs one
    line. Later the folder can be used."""
    (tmp_path / "b").write_text("in the way")
    black = box(tmp_path / "b")
    for n in (1, 2):
        black.sweep(*judged(n))
    (tmp_path / "b").unlink()
    other = box(tmp_path / "b")
    other.sweep(*judged(1))
    black.sweep(*judged(3))
    other.close()
    black.sweep(*judged(4))
    assert numbers(tmp_path / "b") == [1, 5]
    assert [line.split(": ", 2)[-1].split(";")[0] for line in logged] == [
        "File exists",
        "another program keeps sweeps there",
        "sweeps are kept again",
    ]


def test_its_folder_is_ready_before_the_first_sweep(tmp_path: Path):
    """Slow accesses to the disk come before the box runs, and the folder is released at the end."""
    black = box(tmp_path / "b")
    assert (tmp_path / "b").is_dir()
    black.close()
    box(tmp_path / "b").sweep(*judged(1))
    assert numbers(tmp_path / "b") == [1]


def test_on_the_whole_box_answers_go_out_first(rigged: Callable[..., Rigged], tmp_path: Path):
    """The sentence is sent before any access to the disk, and the sweep is stored."""
    simulated = devices.build(skin.FORMAT, script.tubes(1, 2), rig.VirtualClock(), "sim")
    made: Rigged
    black = BlackBox(tmp_path, skin.FORMAT, 1)
    heard_before: list[int] = []

    def listen(sweep: Sweep, verdict: Verdict) -> None:
        made.listen(0.05)
        heard_before.append(sum(",RES," in line for line in made.heard))

    made = rigged(simulated, observers=[OnSweep(listen), black])
    made.until(lambda: simulated.finished(made.box.answered))
    assert heard_before == [1, 2]
    assert numbers(tmp_path) == [2]
    black.close()
