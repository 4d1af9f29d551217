"""Fixtures on the virtual box; PALPATE_RIG=quick or full, by `tests.campaigns test-rig`."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate.sim import script
from tests.rig import notes
from tests.rig.cell import Cell
from tests.rig.emulated_machines import Missing
from tests.rig.image import Image
from tests.rig.image import image as make_image
from tests.rig.machine import Guest
from tests.rig.notes import HOW, Count, Note
from tests.rig.sound import known


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that need a guest unless PALPATE_RIG is set."""
    for item in items:
        if not HOW and item.path.parent == Path(__file__).parent:
            item.add_marker(
                pytest.mark.skip(reason="needs the virtual box; python -m tests.campaigns test-rig")
            )


@pytest.fixture(scope="session")
def image() -> Image:
    """The box of this checkout."""
    try:
        return make_image()
    except Missing as e:
        pytest.fail(str(e))


@pytest.fixture(scope="session")
def count() -> Count:
    """Number of repetitions: count(quick, full)."""
    return lambda quick, full: full if HOW == "full" else quick


@pytest.fixture(scope="module")
def shared(image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """A guest for a file of tests, with known answers and large packets."""
    with Guest(image, tmp_path_factory.mktemp("guest"), snapshot=True) as machine:
        cell = Cell(machine)
        cell.acts, cell.packet_frames = known(script.tubes(2)), 18
        yield cell


@pytest.fixture
def cell(shared: Cell) -> Cell:
    """The guest of this file: working skin, quiet lines, a robot that reads, READY."""
    shared.restore()
    return shared


@pytest.fixture
def note(request: pytest.FixtureRequest) -> Note:
    """Records the outcome of a fault for the table of the report: note(fault, outcome, times)."""

    def write(fault: str, outcome: str, times: int) -> None:
        print(f"{fault}: {outcome}, {times} times")
        notes.write(request.node.nodeid, fault, outcome, times)

    return write
