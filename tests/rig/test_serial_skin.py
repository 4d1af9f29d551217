"""A skin that people own, behind a USB serial adapter: matrix, through the kernel's ftdi_sio,
pulled and put back at any moment.

In: a guest whose settings name the profile and the adapter's port. Out: the answers of the service
that classifies, of one that records, and what `palpate check` says. The skin is played on the host
into a terminal, which is the adapter's line.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from palpate.io import skin_profile
from palpate.sim import rig, script, skin
from tests.factories.skins.devices import Reel
from tests.factories.skins.player import Player
from tests.factories.skins.wires import wire
from tests.rig.cell import SEEN_S, Cell
from tests.rig.emulated_machines import ROOT
from tests.rig.far_end import ADAPTER
from tests.rig.image import Image
from tests.rig.kept import checked, runs_with
from tests.rig.machine import START_S, Guest
from tests.rig.notes import Count, Note
from tests.rig.pulled import after, before, during
from tests.rig.shell import GuestFailed
from tests.rig.sound import check_recovers, known, not_wrong, state

SETTINGS = f"""
[skin]
profile = "matrix"
grid = "{skin.FORMAT.rows}x{skin.FORMAT.cols}"
rate_hz = {skin.FORMAT.rate_hz}
port = "{ADAPTER}"
"""
PROFILES = ROOT / "firmware_config" / "skins"
SWEEPS = "/var/lib/palpate/serial-skin"


class SerialCell(Cell):
    """A cell whose skin is a matrix on a serial line; tests pull its adapter."""

    def __init__(self, machine: Guest, folder: Path) -> None:
        super().__init__(machine, seed=5)
        self.acts = known(script.tubes(5))
        reel = Reel(rig.Film(self.hand, skin.FORMAT), skin_profile.load("matrix", [PROFILES]))
        self.player = Player(wire("matrix", skin.FORMAT.rate_hz), reel, self.clock, folder / "line")
        self._hold, self._ended, self._plugged = threading.Lock(), threading.Event(), False
        self._playing = threading.Thread(target=self._play, daemon=True)
        self._playing.start()

    def plug(self, board: rig.ReadoutBoard | None = None) -> rig.ReadoutBoard | None:
        """Plug the adapter in; one that is in is pulled, and the box sees it: FAULT."""
        if self._plugged:
            self.unplug()
            assert self.lines.wait("FAULT", True, SEEN_S)
        with self._hold:
            self.player.plug()
        line = {"type": "serial", "data": {"device": str(self.player.path)}}
        self.machine.qmp("chardev-add", id="adapter", backend=line)
        how = {"serial": "R1", "always-plugged": True}
        self.machine.qmp(
            "device_add", driver="usb-serial", id="adapter", chardev="adapter", bus="xhci.0", **how
        )
        self._plugged = True
        return board

    def unplug(self) -> None:
        """Pull the adapter, its line first: QEMU dies of late bytes for it."""
        with self._hold:
            self.player.unplug()
        self.machine.qmp("device_del", id="adapter")
        end = self.clock.now_s() + START_S
        while self.clock.now_s() < end:  # the adapter lets go of its line a moment later
            with suppress(GuestFailed):
                self.machine.qmp("chardev-remove", id="adapter")
                self._plugged = False
                return
            self.wait(0.01)
        raise AssertionError(f"qemu kept the adapter's line for {START_S} s")

    def end(self) -> None:
        """The skin ends."""
        self._ended.set()
        self._playing.join(START_S)
        self.player.close()

    def _play(self) -> None:
        while not self._ended.is_set():
            with self._hold:
                self.player.step()
                due_ns = self.player.due_ns()
            self.clock.sleep_until(due_ns)


@pytest.fixture(scope="module")
def shared(image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """A guest for this file, whose service runs with the profile."""
    folder = tmp_path_factory.mktemp("guest")
    with Guest(image, folder, snapshot=True) as machine:
        cell = SerialCell(machine, folder)
        settings = machine.get("/etc/palpate/palpate.toml").decode()
        machine.put("/etc/palpate/palpate.toml", (settings + SETTINGS).encode())
        machine.run("systemctl restart --no-block palpate", check=True)
        yield cell
        cell.end()


@pytest.mark.parametrize("when", [before, during, after])
def test_pulled_and_put_back(
    cell: Cell, count: Count, note: Note, when: Callable[[Cell, int], str]
):
    """At any moment of a sweep: one answer that says so, then READY and a right sweep."""
    check_recovers(cell)
    wanted = {
        before: {"not-ready"},
        during: {"sensor-lost"},
        after: {"sensor-lost", "ok", "gap", "unsure"},
    }[when]
    n, outcomes = count(1, 10), Counter[str]()
    for i in range(n):
        had = int(state(cell)["enumerations"])
        outcomes[when(cell, i)] += 1
        assert set(outcomes) <= wanted
        cell.plug()
        cell.until_ready()
        assert int(state(cell)["enumerations"]) > had
        check_recovers(cell)
    note(
        f"serial adapter of a skin unplugged and replugged {when.__name__} a sweep",
        f"{dict(outcomes)}; back",
        n,
    )


def test_check_finds_it_through_the_kernels_driver(cell: Cell):
    """`palpate check` as the service's user finds it on the port of ftdi_sio."""
    run = cell.machine.run
    assert (
        "/ftdi_sio" in run("readlink -f /sys/bus/usb-serial/devices/ttyUSB*/driver", check=True).out
    )
    assert run(f"readlink -f {ADAPTER}", check=True).out.startswith("/dev/ttyUSB")
    said = checked(cell)
    assert "FAIL" not in said
    assert "matrix R1, 4x4 uint8 at 750 Hz" in said
    assert "cannot be seen" in said


def test_recorded_through_a_replug(cell: Cell, note: Note):
    """sensor-lost, later sweeps are taken; last: it goes on recording."""
    runs_with(cell.machine, f"record --material cork --position a --out {SWEEPS}")
    cell.machine.run("systemctl restart --no-block palpate", check=True)
    assert cell.lines.wait("READY", False, SEEN_S)
    cell.until_ready(120)
    first = len(cell.serial.heard)
    recorded(cell)
    assert during(cell, 20) == "sensor-lost"
    cell.plug()
    cell.until_ready()
    recorded(cell)
    received = cell.answers(first)
    kept = cell.machine.run(f"ls {SWEEPS} | grep -c npy").out.strip()
    assert int(state(cell)["answered"]) == len(received)
    assert int(kept) == sum(answer.status == "recorded" for answer in received)
    unseen = cell.machine.run(
        f"grep -l '\"loss_known\": false' {SWEEPS}/*.json | wc -l"
    ).out.strip()
    assert unseen == kept, "sidecars say that lost frames cannot be seen"
    note(
        "serial adapter of a skin pulled while its sweeps are recorded",
        "sensor-lost; later ones are kept",
        1,
    )


def recorded(cell: Cell) -> None:
    """A sweep that is kept. Raises AssertionError where none is in six."""
    received = []
    for _ in range(6):
        cell.until_ready()
        received.append(not_wrong(*cell.sweep()))
        if received[-1] == "recorded":
            return
    raise AssertionError(f"6 sound sweeps were answered {received}; the box says: {cell.journal()}")
