"""A box that keeps its sweeps is killed at random moments, and recovers with nothing lost.

`PALPATE_RIG=full python -m tests.campaigns test-rig` kills the program 200 times and cuts the power
50 times. Counts are kept in build/rig, so an interrupted campaign continues. A power cut also loses
the contents of QEMU's memory, the disk's tables of newly written clusters, which it writes when the
guest flushes. A cut therefore loses as much as a real disk's cache would.
"""

import random
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.core.sentences import sentence
from palpate.core.types import Frames, Status, Sweep
from palpate.sim import script, skin
from tests.rig.cell import Cell, Touch
from tests.rig.image import Image
from tests.rig.kept import ANSWERED, KEPT, CampaignLog, found, lost, owed, runs_with, sweeps, whole
from tests.rig.machine import Guest
from tests.rig.notes import HOW, Count, Note
from tests.rig.sound import known

START_S = 6
"""The service takes about so long from a kill to READY, by the guest's clock."""
BOOT_S = 12
"""The same from power-on."""
WORK_S = 15
"""Once it is READY it works for so long at most: three or four sweeps."""
BACK_S = 180
"""Not READY by then: it has not come back."""
BATCH = 24
EVERY = 8
PACKET = 24
"""Frames of a packet: fewer packets for an emulator that has to start programs, too."""


class EndlessRobot:
    """Sweeps whenever it may, without waiting for anything else."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.touches = cell, list[Touch]()

    def for_seconds(self, seconds: float) -> str:
        """Sweep for this long; returns the state of the box at the end."""
        clock = self.cell.clock
        end = clock.now_s() + seconds
        while (left := end - clock.now_s()) > 0:
            if self.cell.lines.levels["READY"] and not self._sweeping():
                self.touches.append(self.cell.touch())
            self.cell.wait(min(0.05, left))
        if self.touches and 0 < self.touches[-1].start_ns < clock.now_ns() and self._sweeping():
            return "sweeping"
        return "idle" if self.cell.lines.levels["READY"] else "starting"

    def _sweeping(self) -> bool:
        """A touch is on its way; its answer may take a while."""
        if not self.touches:
            return False
        touch = self.touches[-1]
        return not touch.played.is_set() or self.cell.clock.now_ns() < touch.stop_ns + 300_000_000

    def harmed(self, kills: list[int]) -> list[str]:
        """Answers in whose sweep the box was killed, with their times; kills: ns."""
        wrong = []
        for heard_ns, line in self.cell.serial.heard:
            touched = [t for t in self.touches if t.played.is_set() and t.stop_ns < heard_ns]
            if whole(line)[1:2] == ["RES"] and whole(line)[4] in ANSWERED and touched:
                begin, end = touched[-1].start_ns, touched[-1].stop_ns
                if at := [kill for kill in kills if begin < kill < end]:
                    wrong.append(f"{line} heard {heard_ns}, sweep {begin} to {end}, killed {at}")
        return wrong


def statuses(cell: Cell) -> Counter[str]:
    """How often each status was heard in a whole sentence."""
    fields = [whole(line) for _, line in cell.serial.heard]
    return Counter(f[4] for f in fields if f[1:2] == ["RES"])


def kill(cell: Cell) -> int:
    """SIGKILL once there is a program; when, in ns. READY falls by itself."""
    cell.machine.run(
        "until pid=$(systemctl show -P MainPID palpate) && [ $pid != 0 ]; do sleep .05; done; "
        "kill -KILL $pid",
        timeout_s=60,
        check=True,
    )
    killed_ns = cell.clock.now_ns()
    assert cell.lines.wait("READY", False, BACK_S), "READY stays high after the program was killed"
    return killed_ns


def killed(image: Image, folder: Path, ledger: CampaignLog, n: int, rng: random.Random) -> None:
    """Kill it `n` times: mostly at any moment, now and then once READY."""
    with Guest(image, folder, snapshot=True) as machine:
        cell = Cell(machine)
        cell.acts = known(script.tubes(rng.randrange(1 << 30)))
        cell.packet_frames = PACKET
        runs_with(machine, f"record --out {KEPT}", "RestartSec=100ms")
        machine.run("systemctl restart --no-block palpate", check=True)
        cell.plug()
        cell.until_ready(BACK_S)
        robot, kills = EndlessRobot(cell), list[int]()
        for i in range(n):
            if i % EVERY:
                doing = robot.for_seconds(rng.uniform(0, START_S))
            else:
                cell.until_ready(BACK_S)
                doing = robot.for_seconds(rng.uniform(0, WORK_S))
            kills.append(kill(cell))
            ledger.add(doing=doing, back=0, at=len(ledger.lines))
        cell.until_ready(BACK_S)
        robot.touches.append(cell.sweep(BACK_S)[0])
        cell.state()  # the box has written all sweeps that it must keep
        machine.cut()
    code, files = found(machine.disk, folder)
    parts = sum(path.suffix == ".part" for path in files)
    counts = lost(cell.serial.heard, sweeps(files)) | {"parts": parts, "fsck": code}
    harmed = robot.harmed(kills)
    ledger.add(doing="end", back=n, statuses=statuses(cell), harmed=harmed, **counts)
    assert {counts[name] for name in ("lost", "parts", "fsck")} == {0}
    assert not harmed


def check_outcome(ledger: CampaignLog) -> str:
    """The sums in words. Raises AssertionError if a sweep was lost or a file is not sound."""
    lost, owed = ledger.sum("lost"), ledger.sum("owed")
    assert lost == ledger.sum("parts") == ledger.sum("fsck") == 0 < owed
    doing = Counter(line["doing"] for line in ledger.lines if line["doing"] != "end")
    return f"{dict(doing)}; of {owed} sweeps that had to be kept {lost} were lost"


def test_killed(image: Image, tmp_path: Path, count: Count, note: Note):
    """READY again each time, and no kept sweep is lost."""
    ledger, rng = CampaignLog("kills", image.disk), random.Random()
    wanted = count(ledger.sum("back") + 1, 200)
    while (left := wanted - ledger.sum("back")) > 0:
        killed(image, tmp_path, ledger, min(left, BATCH), rng)
    assert not any(line.get("harmed") for line in ledger.lines)
    note("SIGKILL at a random moment", f"READY again; {check_outcome(ledger)}", ledger.sum("back"))


@pytest.fixture
def disk(image: Image, tmp_path: Path) -> Path:
    """A disk on top of the image's, on which the service keeps its sweeps."""
    made = tmp_path / "disk.qcow2"
    shutil.copy(image.disk, made)
    with Guest(image, tmp_path, snapshot=True, disk=made) as machine:
        runs_with(machine, f"record --out {KEPT}")
        machine.run("systemctl stop --no-block palpate; sync; sync", check=True)
    subprocess.run(["qemu-img", "snapshot", "-d", "ready", made], check=True, timeout=120)
    return made


def cut(
    image: Image,
    disk: Path,
    folder: Path,
    ledger: CampaignLog,
    rng: random.Random,
    *,
    booting: bool,
    had: int = 0,
) -> int:
    """One life of a box: power on, READY, sweeps, power off at a random moment, or already during
    the boot.

    had: number of sweeps that earlier lives have kept on this disk. Returns the number that is
    there now.
    """
    with Guest(image, folder, disk=disk) as machine:
        cell = Cell(machine)
        cell.acts = known(script.tubes(rng.randrange(1 << 30)))
        cell.packet_frames = PACKET
        cell.plug()
        robot, begun, ready_s, parts = EndlessRobot(cell), cell.clock.now_s(), None, 0
        if not booting:
            cell.until_ready(BACK_S)
            ready_s = round(cell.clock.now_s() - begun, 1)
            parts = int(machine.run(f"ls {KEPT} | grep -c part").out)
        doing = robot.for_seconds(rng.uniform(0, BOOT_S if booting else WORK_S))
        machine.cut()
    code, files = found(disk, folder)
    kept = sweeps(files)
    counts = lost(cell.serial.heard, kept) | {"parts": parts, "fsck": code}
    counts["lost"] += max(0, had - len(kept))
    counts |= {"back": int(not booting), "cut": 1}
    ledger.add(doing=doing, ready_s=ready_s, statuses=statuses(cell), **counts)
    assert {counts[name] for name in ("lost", "parts", "fsck")} == {0}
    return len(kept)


@pytest.mark.skipif(
    HOW != "full", reason="boots for each cut; PALPATE_RIG=full python -m tests.campaigns test-rig"
)
def test_power_cut(image: Image, disk: Path, tmp_path: Path, count: Count, note: Note):
    """The power goes at random moments, while booting, idle and sweeping: it boots again, the file
    system is sound, no kept sweep is lost."""
    ledger, rng = CampaignLog("cuts", image.disk), random.Random()
    wanted, kept = count(ledger.sum("cut") + 1, 50), 0
    while (n := ledger.sum("cut")) < wanted:
        # twice while it boots, then a life that has to get to READY; such a one is the last, too
        booting = n % 3 < 2 and n < wanted - 1
        kept = cut(image, disk, tmp_path, ledger, rng, booting=booting, had=kept)
    told = f"it boots again, file system clean; {check_outcome(ledger)}"
    note("power cut at a random moment", told, ledger.sum("cut"))


def test_what_is_owed():
    """An answer whose sweep was reported as stored is owed; others, and damaged lines, are not."""
    of_box = ("9f", "usb", "1.00", "")
    heard = [
        sentence("RES", 1, "5.021", "ok", "felt", "0.9", "0.8", 1, 0, "21.00", *of_box),
        sentence("REC", 1, "stored", 1, "felt", "", "", "sweep-000001"),
        sentence("STA", "6.0", "streaming", 0, 1, 1, 0, 0, 1, 0, "9f", "usb"),
        sentence("RES", 2, "9.021", "recorded", "", "0.0", "0.0", 1, 0, "21.00", *of_box),
        b"$PPLP,REC,2,sto",
        sentence("STA", "12.0", "streaming", 0, 0, 1, 0, 0, 1, 0, "9f", "usb"),
        sentence("RES", 1, "15.0", "gap", "", "0.0", "0.0", 0, 9, "1.00", *of_box),
        sentence("STA", "16.0", "streaming", 0, 1, 1, 0, 0, 1, 0, "9f", "usb"),
    ]
    lines = [(0, line.decode().strip()) for line in heard]
    assert [[h.sweep for h in part] for part in owed(lines)] == [[1], [2]]
    kept = Sweep(1, 0, 0, Status.OK, Frames.empty(skin.FORMAT), complete_ns=5_000_000_000)
    assert lost(lines, [kept]) == {"answered": 2, "owed": 1, "lost": 0, "unfinished": 1}
    assert lost(lines, [replace(kept, complete_ns=7_000_000_000)])["lost"] == 1
