"""Kept sweeps of unknown materials: how they are grouped."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.core.errors import ApplianceError
from palpate.inference.classifier import Classifier
from palpate.sim.rig import VirtualClock
from palpate.sweeps import unknown_sweeps
from palpate.sweeps.black_box import BlackBox
from tests.factories import toy_bundle

FELT = [(20, 20), (20.4, 19.7), (19.8, 20.5), (20.2, 20.1), (19.9, 19.6), (20.1, 20.4)]
CORK = [(-4, 30), (-4.3, 30.2)]


@pytest.fixture
def box(tmp_path: Path) -> Classifier:
    """A box with the toy bundle, from disk."""
    return Classifier(toy_bundle.load(tmp_path / "old"), VirtualClock())


def kept(folder: Path, box: Classifier, *places: tuple[float, float]) -> list[str]:
    """Answer sweeps at these places of the embedding and keep them; their details."""
    black_box, said = BlackBox(folder, box.bundle.format, 500), []
    for i, place in enumerate(places, 1):
        sweep = toy_bundle.sweep(*place, number=i, object=i)
        verdict = box(sweep)
        black_box.sweep(sweep, verdict, {"bundle": box.bundle.id})
        said.append(verdict.detail)
    black_box.close()
    return said


def numbers(folder: Path, box: Classifier) -> list[list[int]]:
    """The numbers of each group."""
    return [[*one.paths] for one in unknown_sweeps.groups(folder, box.bundle.id)]


def test_sweeps_of_a_material_that_comes_again_are_a_group(tmp_path, box):
    """None of one sweep, known or another bundle."""
    folder = tmp_path / "black-box"
    said = kept(folder, box, FELT[0], CORK[0], (0, 0), FELT[1], (60, -60), CORK[1], FELT[2])
    alike = [one.rpartition("; ")[2] for one in said if "; as" in one]
    assert alike == ["as sweep 1", "as sweep 2", "as sweep 1"]
    humming = folder / "sweep-000004.json"  # the detail goes on
    humming.write_text(humming.read_text().replace("as sweep 1", "as sweep 1; hum removed"))
    assert numbers(folder, box) == [[1, 4, 7], [2, 6]]
    again = Classifier(box.bundle, VirtualClock())
    kept(folder, again, *FELT)
    assert numbers(folder, box) == [[8, 9, 10, 11, 12, 13], [1, 4, 7], [2, 6]]
    assert unknown_sweeps.groups(folder, "another") == []
    assert unknown_sweeps.groups(tmp_path / "nowhere", box.bundle.id) == []


@pytest.mark.parametrize(
    "damage",
    [
        b"{",
        b"[]",
        b'{"verdict": 3}',
        b'{"verdict": {"status": "unknown", "bundle": "ID"}}',
        b'{"verdict": {"status": "unknown", "bundle": "ID", "detail": 3}, "id": 3}',
        b'{"verdict": {"status": "unknown", "bundle": "ID", "detail": ""}, "id": "x"}',
    ],
)
def test_a_damaged_sidecar_is_named_and_left_out(tmp_path, box, logged, damage):
    """The others are still offered."""
    kept(tmp_path, box, *FELT)
    path = tmp_path / "sweep-000003.json"
    path.write_bytes(damage.replace(b"ID", box.bundle.id.encode()))
    assert numbers(tmp_path, box)[0][:2] == [1, 2]
    assert len([line for line in logged if f"{path} is left out" in line]) == 1


def test_which_group_is_never_guessed(tmp_path, box):
    """Without a number there has to be one only; the message lists what there is."""
    with pytest.raises(ApplianceError, match=r"store\.black_box"):
        unknown_sweeps.chosen([], 0, tmp_path)
    kept(tmp_path, box, *FELT[:2])
    found = unknown_sweeps.groups(tmp_path, box.bundle.id)
    assert unknown_sweeps.chosen(found, 0, tmp_path) is found[0]
    with pytest.raises(ApplianceError, match=r"2 sweeps: 1, 2"):
        unknown_sweeps.chosen(found, 3, tmp_path)
    kept(tmp_path, Classifier(box.bundle, VirtualClock()), *CORK)
    found = unknown_sweeps.groups(tmp_path, box.bundle.id)
    with pytest.raises(ApplianceError, match="--unknown"):
        unknown_sweeps.chosen(found, 0, tmp_path)
    assert [*unknown_sweeps.chosen(found, 4, tmp_path).paths] == [3, 4]
