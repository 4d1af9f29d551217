"""Trigger and frames on one time line, on a real kernel: the middle of a window was recorded
between the edges.

The test measures how far the middle of each window lies from the truth, which the board outside
knows. The guest's kernel stamps edges with its own clock. The shortest of many round trips relates
this clock to the board's, so edges can be compared with the times of the frames.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from palpate.core.sweep_file import load
from palpate.core.types import EPOCH_BITS, Sweep
from palpate.sim import rig, script, skin
from tests.rig.cell import Cell
from tests.rig.kept import KEPT, runs_with
from tests.rig.machine import Guest
from tests.rig.notes import HOW, Note
from tests.rig.sound import LATE, known, not_wrong

pytestmark = pytest.mark.skipif(
    HOW != "full", reason="one of the full run's: the service is started anew"
)
FRAME_NS = skin.FORMAT.period_ns
TRIPS, SWEEPS, ATTEMPTS = 400, 5, 3
"""More than one attempt, since the shortest way through an emulator that is busy changes by
milliseconds in as many seconds, which looks as if the board's clock drifted.
"""
SLOPE_PPM, SPAN_S = 200, 20
"""What palpate.core.clock.DeviceClock takes for possible, and how far it looks back."""
LONGEST_WAY_NS = 5_000_000
"""From a frame to the program by the shortest way, in an emulator: the box cannot separate it from
the clock's offset."""
CASES = {
    "80 ppm fast, latency spikes": 80,
    "80 ppm slow, latency spikes": -80,
    "500 ppm fast, latency spikes": 500,
    "500 ppm slow, latency spikes": -500,
}
REPORT_TIME = """
import os, struct, time
port = os.open("/dev/virtio-ports/palpate.bench", os.O_RDWR)
while True:
    if os.read(port, 1):
        os.write(port, struct.pack("<q", time.monotonic_ns()))
    else:
        time.sleep(0.05)
"""
"""In the guest: its monotonic clock, for each byte that comes."""


@dataclass(frozen=True, slots=True)
class Offset:
    """The board's time minus that of the guest's kernel in ns, and by how much it may be wrong."""

    ns: int
    within_ns: int


class KernelClock:
    """The guest's kernel time; the offset lies within each trip's two ends."""

    def __init__(self, machine: Guest) -> None:
        machine.put("/run/report_time.py", REPORT_TIME.encode())
        machine.run("python3 /run/report_time.py < /dev/null > /dev/null 2>&1 &", check=True)
        self._port, self._clock = machine.bench(), machine.clock
        self._port.settimeout(60)

    def offset(self) -> Offset:
        """Raises AssertionError where trips contradict each other: the clocks do not go alike."""
        low, high = -(1 << 63), 1 << 63
        for _ in range(TRIPS):
            sent_ns = self._clock.now_ns()
            self._port.sendall(b".")
            (guest_ns,) = struct.unpack("<q", self._port.recv(8))
            low, high = max(low, sent_ns - guest_ns), min(high, self._clock.now_ns() - guest_ns)
        assert low <= high, (
            f"the guest's clock went {(low - high) / 1e6:.3f} ms away during {TRIPS} trips"
        )
        return Offset((low + high) // 2, (high - low) // 2)


@pytest.fixture(scope="module", autouse=True)
def clock(shared: Cell) -> KernelClock:
    """The service keeps its sweeps; sweeps whose answer is known."""
    shared.acts, shared.packet_frames = known(script.tubes(2)), 12
    runs_with(shared.machine, f"record --out {KEPT}")
    shared.plug()  # without a skin, a recording box ends and is started again
    shared.machine.run(
        "systemctl stop palpate; systemctl start --no-block palpate", check=True, timeout_s=60
    )
    shared.serial.wait_for("$PPLP,STA,", 120, len(shared.serial.heard))
    return KernelClock(shared.machine)


def kept(cell: Cell, number: int, folder: Path) -> Sweep:
    """A sweep that was answered; its file comes after its answer."""
    name = f"sweep-{number:06d}"
    there = f"for i in $(seq 300); do [ -e {KEPT}/{name}.npy ] && exit 0; sleep 0.1; done; exit 1"
    cell.machine.run(there, timeout_s=60, check=True)
    for file in (f"{name}.npy", f"{name}.json"):
        (folder / file).write_bytes(cell.machine.get(f"{KEPT}/{file}"))
    return load(folder / f"{name}.npy")[0]


def errors(sweep: Sweep, board: rig.ReadoutBoard, offset: Offset) -> tuple[float, float]:
    """(ns of the box's stamp after the truth, ns of that frame after the edges' middle)."""
    half = len(sweep.frames) // 2
    taken_ns = board.frame_ns(int(sweep.frames.seq[half]) & ((1 << EPOCH_BITS) - 1))
    middle_ns = (sweep.start_ns + sweep.stop_ns) / 2 + offset.ns
    return int(sweep.frames.t_ns[half]) + offset.ns - taken_ns, taken_ns - middle_ns


def spikes(seed: int) -> Callable[[], int]:
    """0.15 ms as a rule; one packet in a hundred comes 50 to 200 ms late."""
    rng = np.random.default_rng(seed)
    return lambda: 150_000 + int(rng.integers(50_000_000, 200_000_000)) * (rng.random() < 0.01)


def windows(cell: Cell, folder: Path, n: int) -> Iterator[Sweep]:
    """The windows of `n` sweeps not answered wrong. Raises AssertionError without."""
    for _ in range(3 * n):
        touch, answer = cell.sweep()
        if not_wrong(touch, answer) not in LATE - {"unsure", "unknown"}:
            yield kept(cell, answer.sweep, folder)
            n -= 1
        if not n:
            return
    raise AssertionError(f"too few windows; the box says: {cell.journal()}")


@pytest.mark.parametrize("what", CASES)
def test_windows_lie_in_the_middle(
    cell: Cell, clock: KernelClock, note: Note, tmp_path: Path, what: str
):
    """Within a frame at 80 ppm, beyond it within the uncertainty."""
    ppm, seen = CASES[what], []
    for _ in range(ATTEMPTS):
        board = cell.plug(cell.board(ppm=ppm, latency=spikes(abs(ppm))))
        cell.until_ready()
        cell.wait(SPAN_S)
        offset = clock.offset()
        found = [errors(sweep, board, offset) for sweep in windows(cell, tmp_path, SWEEPS)]
        later = clock.offset()
        assert abs(later.ns - offset.ns) <= offset.within_ns + later.within_ns, (
            "the clocks do not go alike"
        )
        way_ns, worst_ns = (
            min(stamp for stamp, _ in found),
            max((apart for _, apart in found), key=abs),
        )
        seen.append(
            f"at most {worst_ns / FRAME_NS:+.2f} frames beside the middle, {way_ns / 1e6:.2f} ms "
            "of them a transfer's way, "
            f"known to {offset.within_ns / 1e6:.2f} ms"
        )
        unsure_ns = offset.within_ns + max(0, abs(ppm) - SLOPE_PPM) * 1e-6 * SPAN_S * 1e9
        if -unsure_ns <= way_ns <= LONGEST_WAY_NS + unsure_ns and all(
            stamp - way_ns <= FRAME_NS + unsure_ns and abs(apart + way_ns) <= FRAME_NS + unsure_ns
            for stamp, apart in found
        ):
            note(what, "; before that: ".join(seen[::-1]), SWEEPS)
            return
    raise AssertionError(seen)
