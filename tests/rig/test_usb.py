"""The skin's cable pulled and plugged in at any moment, other boards, resets."""

import socket
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.rig.cell import Cell
from tests.rig.notes import HOW, Count, Note
from tests.rig.pulled import SECOND, after, before, during
from tests.rig.sound import (
    begin,
    check_recovers,
    let_go,
    not_wrong,
    only_answer,
    state,
    until_state,
)
from tests.rig.usbredir import UsbRedirPeer

HUB = "0409:55aa"
RESETS = {
    "reset of the device": "usbreset 1209:7ac7",
    "root hub turned off and on": "cd /sys/bus/usb/devices/usb1; echo 0 > authorized; "
    "echo 1 > authorized",
    "driver taken from the device and given back": "cd /sys/bus/usb/drivers/usb; "
    "echo 1-1 > unbind; "
    "echo 1-1 > bind",
}


@pytest.mark.parametrize("when", [before, during, after])
def test_pulled_and_put_back(
    cell: Cell, count: Count, note: Note, when: Callable[[Cell, int], str]
):
    """At any moment of a sweep: one answer, READY by itself, another enumeration."""
    wanted = {
        before: {"not-ready"},
        during: {"sensor-lost"},
        after: {"sensor-lost", "ok", "gap", "unsure"},
    }[when]
    n = count(1, 35 if when is during else 33)  # 101 in all
    outcomes = Counter[str]()
    for i in range(n):
        had = int(state(cell)["enumerations"])
        outcomes[when(cell, i)] += 1
        assert set(outcomes) <= wanted
        cell.plug()
        cell.until_ready()
        assert int(state(cell)["enumerations"]) > had
        if i % 5 == 4:
            check_recovers(cell)
    note(
        f"skin unplugged and replugged {when.__name__} a sweep",
        f"{dict(outcomes)}; back each time",
        n,
    )


def test_other_boards(cell: Cell, count: Count, note: Note):
    """Another serial number streams; another format or protocol is refused."""
    cell.plug(cell.board(serial="SIM0002"))
    cell.until_ready()
    assert " SIM0002 " in cell.serial.ask("$PPLP,ID")
    unfit = {
        "3x4": ("skin", {"rows": 3}),
        "protocol 0": ("identity", {"protocol": 0}),
        "int16": ("skin", {"dtype": "int16"}),
        "765 Hz": ("skin", {"rate_hz": 765.0}),
        "protocol 2": ("identity", {"protocol": 2}),
    }
    for hint, (part, change) in list(unfit.items())[: count(2, len(unfit))]:
        cell.unplug()
        until_state(cell, "absent")
        board = cell.board()
        setattr(board, part, replace(getattr(board, part), **change))
        cell.plug(board)
        until_state(cell, "mismatch")
        assert not cell.lines.levels["READY"]
        assert cell.lines.levels["FAULT"]
        assert hint in cell.journal(2)
    cell.plug()
    check_recovers(cell)
    note("skin of another serial number", "streams, reported by ID", 1)
    note(
        "skin of another format or protocol version",
        "mismatch; the next fitting one is taken up",
        count(2, len(unfit)),
    )


@pytest.mark.parametrize("what", RESETS if HOW == "full" else list(RESETS)[:1])
def test_resets(cell: Cell, count: Count, note: Note, what: str):
    """The kernel takes it away in mid sweep: that is lost, then it is taken up."""
    n, outcomes = count(1, 3), Counter[str]()
    for _ in range(n):
        touch, since = begin(cell)
        cell.machine.run(RESETS[what], check=True, timeout_s=60)
        landed = cell.clock.now_ns() < touch.stop_ns
        status = not_wrong(touch, cell.answer(since))
        assert status == "sensor-lost" or not landed, status
        cell.clock.sleep_until(touch.stop_ns + SECOND // 2)
        assert len(cell.answers(since)) == 1
        outcomes[status] += 1
        check_recovers(cell)
    note(what, f"{dict(outcomes)}; back each time", n)


@pytest.fixture
def behind_a_hub(cell: Cell, tmp_path: Path) -> Iterator[UsbRedirPeer]:
    """Another cable, behind a hub on another port; nothing hangs on the first one."""
    cell.unplug()
    assert cell.lines.wait("FAULT", True, 20)
    listener, qmp = socket.socket(socket.AF_UNIX), cell.machine.qmp
    listener.bind(str(tmp_path / "hub"))
    listener.listen(1)
    address = {"type": "unix", "data": {"path": str(tmp_path / "hub")}}
    qmp("device_add", driver="usb-hub", id="hub", bus="xhci.0", port="2")
    qmp(
        "chardev-add",
        id="far",
        backend={"type": "socket", "data": {"addr": address, "server": False}},
    )
    qmp("device_add", driver="usb-redir", id="behind", chardev="far", bus="xhci.0", port="2.1")
    listener.settimeout(20)
    peer = UsbRedirPeer(listener.accept()[0], cell.clock)
    yield peer
    peer.close()


@pytest.mark.skipif(HOW != "full", reason="one of the full run's")
def test_behind_a_hub(cell: Cell, behind_a_hub: UsbRedirPeer, count: Count, note: Note):
    """The hub is reset or pulled in mid sweep: that sweep is lost, no more."""
    behind_a_hub.plug(cell.board())
    check_recovers(cell)
    n = count(1, 3)
    for _ in range(n):
        touch, since = begin(cell)
        cell.machine.run(f"usbreset {HUB}", check=True, timeout_s=60)
        status = not_wrong(touch, only_answer(cell, since))
        assert status == "sensor-lost" or cell.clock.now_ns() > touch.stop_ns, status
        let_go(cell)
        cell.until_ready()
    note("reset of the hub", "sensor-lost; back each time", n)
    touch, since = begin(cell)
    cell.machine.qmp("device_del", id="hub")
    assert not_wrong(touch, only_answer(cell, since)) == "sensor-lost"
    let_go(cell)
    assert cell.lines.wait("FAULT", True, 20)
    cell.cable.plug(cell.board())
    check_recovers(cell)
    note("hub pulled out, skin plugged in elsewhere", "sensor-lost; taken up at the other port", 1)
