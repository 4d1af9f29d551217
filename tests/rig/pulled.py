"""The skin's cable pulled at a moment of a sweep; returns the only answer's status."""

from tests.rig.cell import Cell
from tests.rig.sound import begin, let_go, not_wrong, only_answer

SECOND = 1_000_000_000


def before(cell: Cell, i: int) -> str:
    """READY falls, FAULT rises; a start edge is answered, its stop edge is not."""
    cell.unplug()
    assert cell.lines.wait("FAULT", True, 20)
    assert cell.lines.wait("READY", False, 20)
    since = len(cell.serial.heard)
    cell.lines.set("START", True)
    cell.answer(since)
    for name, level in (("START", False), ("STOP", True), ("STOP", False)):
        cell.lines.set(name, level)
        cell.wait(0.2)
    return only_answer(cell, since).status


def during(cell: Cell, i: int) -> str:
    """Pulled while the finger slides: answered at once."""
    touch, since = begin(cell)
    cell.clock.sleep_until(touch.start_ns + (i * 37 % 25) * SECOND // 10)
    cell.unplug()
    let_go(cell)  # no stop edge comes that could cause the answer
    return not_wrong(touch, only_answer(cell, since))


def after(cell: Cell, i: int) -> str:
    """Pulled within 30 ms of the stop edge: the answer has been sent, or is sensor-lost."""
    touch, since = begin(cell)
    cell.clock.sleep_until(touch.stop_ns + i % 4 * SECOND // 100)
    cell.unplug()
    return not_wrong(touch, only_answer(cell, since))
