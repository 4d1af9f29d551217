"""The reason of a failed end: noted, counted for the pause, removed after an order."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest

from palpate.cli import lower_outputs
from palpate.core.errors import AddressError, BundleError, LineError
from palpate.service import last_failure, status
from palpate.service.last_failure import PAUSES_S, Failure
from palpate.sim import gpio
from palpate.sim.rig import VirtualClock


def failed(folder: Path, clock: VirtualClock, error: Exception) -> Failure:
    """The note of one more end by this error."""
    with suppress(type(error)), last_failure.recorded(folder, clock):
        raise error
    found = last_failure.read(folder)
    assert found
    return found


def test_the_pause_grows_and_begins_anew(tmp_path):
    """Up to a limit; short after a minute's run or an order."""
    second = 1_000_000_000
    clock = VirtualClock()
    pauses = []
    for _ in range(len(PAUSES_S) + 2):
        pauses.append(failed(tmp_path, clock, LineError("no chip")).pause_s)
        clock.sleep_until(clock.now_ns() + 5 * second)
    assert pauses == [*PAUSES_S, PAUSES_S[-1], PAUSES_S[-1]]
    clock.sleep_until(clock.now_ns() + 100 * second)
    assert failed(tmp_path, clock, LineError("no chip")).failures == 1
    with last_failure.recorded(tmp_path, clock):
        pass
    assert last_failure.read(tmp_path) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"why": 3}', b"\xff" * 99])
def test_a_damaged_note_is_none(tmp_path, content):
    """Whatever is in the file, it is ignored and written anew."""
    (tmp_path / last_failure.FILE).write_bytes(content)
    assert last_failure.read(tmp_path) is None
    assert failed(tmp_path, VirtualClock(), LineError("no chip")).failures == 1


def test_status_says_which_end_a_person_must_mend(tmp_path):
    """Exit code 78 alone; a note that cannot be written changes no error."""
    for folder in (None, tmp_path / "not there"):
        with pytest.raises(LineError, match="chip"), last_failure.recorded(folder, VirtualClock()):
            raise LineError("no chip")
    clock = VirtualClock()
    failed(tmp_path, clock, BundleError("golden sweeps differ"))
    (line,) = status.lines(status.read(tmp_path / "status.json", 0), 0)
    assert "78" in line
    assert "stopped" in line
    failed(tmp_path, clock, LineError("no chip"))
    (line,) = status.lines(status.read(tmp_path / "status.json", 0), 0)
    assert "69" in line
    assert "started" in line
    failed(tmp_path, clock, KeyError("a fault of the program"))
    assert "KeyError" in status.read(tmp_path / "status.json", 0)["why"]


@pytest.mark.parametrize(
    ("error", "exit_status", "waits"),
    [
        (LineError("no chip"), "69", True),
        (BundleError("damaged"), "78", False),
        (LineError("no chip"), "KILL", False),
        (AddressError("in use"), "69", True),
    ],
)
def test_the_start_after_a_failure_waits(tmp_path, error, exit_status, waits):
    """ExecStopPost waits after failures that are started again, and not after others."""
    clock = VirtualClock()
    for _ in range(3):
        failed(tmp_path, clock, error)
    begun = clock.now_ns()
    lines = gpio.SimGpio(clock, {"/dev/gpiochip0": ["A"]})
    words = ["--set", f"store.runtime={tmp_path}"]
    assert lower_outputs.main(words, lines, clock, {"EXIT_STATUS": exit_status}) == 0
    assert (clock.now_ns() > begun) == waits
