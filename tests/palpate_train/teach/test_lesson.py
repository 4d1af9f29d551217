"""The sweeps that a box is taught from: omissions and completions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import Status, SweepFormat
from palpate.sim import skin
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.data.sets import Dataset
from palpate_train.teach.lesson import Lesson
from tests.factories import lessons
from tests.factories.recordings import FORMAT, record


def sweeps(folder: Path, *materials: str, first: int = 1, **more: object) -> None:
    """A recording of each material, numbered from `first`."""
    for number, material in enumerate(materials, first):
        record(folder / f"sweep-{number:06d}.npy", material, id=number, **more)


def test_sweeps_that_cannot_be_taught_are_left_out_and_counted(tmp_path: Path):
    """Damaged, unlabelled, faulty or of another format: the lesson goes on."""
    sweeps(tmp_path, "a", "b")
    sweeps(tmp_path, "", first=3)
    sweeps(tmp_path, "a", first=4, status=Status.GAP)
    (tmp_path / "sweep-000005.npy").write_bytes(b"half a file")
    record(tmp_path / "sweep-000006.npy", "a", format=SweepFormat(2, 3, 50.0, 9, "int16"), frames=9)
    sweeps(tmp_path, "b", first=7)
    lesson = Lesson.read(tmp_path)
    assert lesson.names == ("sweep-000001", "sweep-000002", "sweep-000007")
    assert dict(lesson.left_out) == {"no material": 1, "gap": 1, "damaged": 1, "another format": 1}


def test_what_can_be_taught_and_judged(tmp_path: Path):
    """A missing position is a place; one sweep is not judged; none is an error."""
    sweeps(tmp_path, "a", "b", position="1")
    sweeps(tmp_path, "a", "b", first=3)
    lesson = Lesson.read(tmp_path)
    assert len(set(lesson.sweeps.groups["position"].tolist())) == 2
    sweeps(tmp_path / "bare", "", "")
    with pytest.raises(FormatError, match=r"2 no material"):
        Lesson.read(tmp_path / "bare")
    with pytest.raises(FormatError, match="be read"):
        Lesson.read(tmp_path / "nowhere")
    sweeps(tmp_path, "a", "a", "b", "b", "c")
    lesson = Lesson.read(tmp_path).repeated()
    assert lesson.sweeps.materials == ("a", "b")
    assert lesson.sweeps.format == FORMAT
    sweeps(tmp_path / "one", "a", "a", "b")
    with pytest.raises(FormatError, match="1 of"):
        Lesson.read(tmp_path / "one").repeated()


def test_sweeps_of_something_else_are_no_material(tmp_path: Path):
    """They are kept beside the materials, and are not judged. One of another skin is counted."""
    sweeps(tmp_path, "a", NOT_THIS, "b", "a", "b", NOT_THIS)
    other = SweepFormat(2, 3, 50.0, 9, "int16")
    record(tmp_path / "sweep-000007.npy", NOT_THIS, format=other, frames=9)
    lesson = Lesson.read(tmp_path).repeated()
    assert dict(lesson.left_out) == {"another format": 1}
    assert lesson.sweeps.materials == ("a", "b")
    assert len(lesson.names) == 4
    assert lesson.strangers is not None
    assert lesson.strangers.shape == (2, *lesson.sweeps.samples.shape[1:])


def test_sweeps_without_a_slide_are_not_learnt_from_and_named(tmp_path: Path):
    """A finger at rest among slides is named by its number; so is a material without slides."""
    rng, place = np.random.default_rng(2), skin.placements("T-REAL", 1005)[0]
    windows = [skin.window(name, place, rng) for name in ("wood",) * 3 + ("foam",) * 3]
    rest = np.broadcast_to(windows[3].mean(axis=0).round(), windows[3].shape)
    windows[3] = (rest + rng.integers(0, 2, rest.shape)).astype(np.uint8)
    labels = np.repeat([0, 1], 3)
    format = skin.FORMAT
    sweeps = Dataset(np.stack(windows), labels, ("wood", "foam"), format.rate_hz, {}, "slides")
    lessons.write(tmp_path, sweeps)
    lesson = Lesson.read(tmp_path)
    assert np.bincount(lesson.sweeps.labels).tolist() == [2, 3]
    assert dict(lesson.left_out) == {"no slide": 1}
    (one,) = lesson.no_slides
    assert one.number == 4
    assert one.text.startswith("sweep 1 of foam")
    assert "no slide" in one.text
    only = tmp_path / "only"
    lessons.write(only, replace(sweeps.take(np.arange(4)), materials=("wood", "foam")))
    with pytest.raises(FormatError, match=r"1 of foam"):
        Lesson.read(only).repeated()
