"""The black box: the sweeps in it, and that its errors never stop the box."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.sweep_file import sidecar
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.sim import skin
from palpate.sweeps import sweep_folder
from palpate.sweeps.black_box import BlackBox
from tests.factories import toy_bundle
from tests.factories.simulated_box import OnSweep, Rigged, tubes


def box(folder: Path, most: int = 3) -> BlackBox:
    """A black box for the toy skin."""
    return BlackBox(folder, toy_bundle.FORMAT, most)


def put(black: BlackBox, *numbers: int, status: Status = Status.OK, window: bool = True) -> None:
    """Sweeps with these numbers are answered."""
    frames = toy_bundle.sweep(0, 0).frames if window else Frames.empty(toy_bundle.FORMAT)
    for number in numbers:
        sweep = Sweep(number, 0, 1, Status.OK if window else status, frames)
        verdict = Verdict(number, 5, status, "", 0.0, 0.0, np.empty(0), 0, 0, 1, "b")
        black.sweep(sweep, verdict, {"bundle": "b"})


def numbers(folder: Path) -> list[int]:
    """The numbers of the complete sweeps in a folder."""
    numbers = sorted(int(path.stem[6:]) for path in folder.glob("*.npy"))
    files = [f"sweep-{n:06d}.{kind}" for n in numbers for kind in ("json", "npy")]
    assert sorted(path.name for path in folder.iterdir()) == files
    return numbers


def failing(monkeypatch: pytest.MonkeyPatch, code: int, fails: Callable[[], bool]) -> None:
    """A disk that refuses sweeps with this error while `fails()`."""
    save = sweep_folder.save

    def tight(*given: Any) -> None:
        if fails():
            raise OSError(code, os.strerror(code))
        save(*given)

    monkeypatch.setattr(sweep_folder, "save", tight)


def test_the_last_sweeps_are_kept_over_restarts(tmp_path):
    """Each pushes out the oldest, except without a window."""
    folder = tmp_path / "b"
    first = box(folder)
    assert folder.is_dir()
    put(first, 1, 2, 3)
    put(first, 4, status=Status.STUCK_TAXEL)
    put(first, 5)
    put(first, 6, status=Status.SHORT, window=False)
    assert numbers(folder) == [3, 4, 5]
    assert sidecar(folder / "sweep-000004.npy")["verdict"]["status"] == "stuck-taxel"
    first.close()
    second = box(folder)
    put(second, 1)
    assert numbers(folder) == [4, 5, 6]
    second.close()
    put(box(folder, most=1), 1)
    assert numbers(folder) == [7]


def test_the_oldest_goes_once_the_newest_is_safe(tmp_path, monkeypatch):
    """A sweep is removed after the newest has its name."""
    black = box(tmp_path)
    put(black, 1, 2, 3)
    there: list[int] = []
    unlink = Path.unlink

    def noted(path: Path, missing_ok: bool = False) -> None:
        there.append(len(list(tmp_path.glob("*.npy"))))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", noted)
    put(black, 4)
    assert there == [4, 3]


def test_another_error_removes_no_sweep(tmp_path, monkeypatch, logged):
    """If the disk fails although it is not full, existing sweeps are kept."""
    black = box(tmp_path)
    put(black, 1)
    failing(monkeypatch, errno.EIO, lambda: True)
    put(black, 2)
    assert numbers(tmp_path) == [1]
    assert "Input/output" in logged[0]


def test_a_full_disk_drops_the_oldest_first(tmp_path, monkeypatch, logged):
    """Else one line, and another when it works again."""
    black, limit = box(tmp_path), [2]
    failing(monkeypatch, errno.ENOSPC, lambda: len(list(tmp_path.glob("*.npy"))) >= limit[0])
    put(black, 1, 2, 3, 4)
    assert (numbers(tmp_path), logged) == ([3, 4], [])
    limit[0] = 0
    put(black, 5, 6, 7)
    assert numbers(tmp_path) == []
    limit[0] = 9
    put(black, 8, 9)
    assert numbers(tmp_path) == [8, 9]
    trouble, end = logged
    assert trouble.startswith("<4>black box: ")
    assert "space" in trouble
    assert str(tmp_path) in trouble
    assert "again" in end


def test_a_folder_that_cannot_be_used_yet(tmp_path, logged):
    """The box starts with one line; later it can be used."""
    folder = tmp_path / "b"
    folder.write_text("in the way")
    black = box(folder)
    put(black, 1, 2)
    folder.unlink()
    other = box(folder)
    put(other, 1)
    put(black, 3)
    other.close()
    put(black, 4)
    assert numbers(folder) == [1, 5]
    told = ["File exists", "another program", "kept again"]
    assert [text in line for text, line in zip(told, logged, strict=True)] == [True] * 3


def test_on_the_whole_box_answers_go_out_first(rigged, tmp_path):
    """The sentence is sent before any access to the disk, and the sweep is stored."""
    simulated = tubes(1, 2)
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
