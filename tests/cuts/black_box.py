"""The black box, cut short: a program that keeps the last sweeps in service, and a judge of losses
beyond the sweep in progress.

`python -m tests.cuts.black_box FOLDER [thread]` is this program: it continues in the folder, and
reports each sweep that it has kept. thread: it writes beside the loop, as the box does.
"""

import re
import sys
from pathlib import Path

from palpate.core.disk_thread import AtOnce, DiskThread, DiskWork
from palpate.sweeps.black_box import BlackBox
from tests.cuts import recording
from tests.cuts.scene import CutScene, Found, SceneStep
from tests.factories import log_lines

MOST = 2
"""Number of sweeps that are kept, so small that each run removes old sweeps."""
KEPT = re.compile(r"^kept (\S+)$", re.MULTILINE)


def keep(folder: Path, disk: DiskWork) -> None:
    """Keep three sweeps."""
    with log_lines.collected() as logged:
        box = BlackBox(folder, recording.SHORT, MOST, disk)
        for number in (1, 2, 3):
            box.sweep(*recording.taken(number, recording.SHORT), {})
            disk.settle()
            if logged:
                sys.exit(logged[0])
            print(f"kept {max(folder.glob('*.npy')).stem}", flush=True)
        box.close()


def judge(found: Found) -> list[str]:
    """Faults of the sweeps that were found, and of the next run in their folder."""
    folder = found.folder / recording.KEPT
    wrong, there = recording.read(folder)
    last = sorted(there.keys() | KEPT.findall(found.heard))[-MOST:]
    wrong += [f"{name} was kept and is gone" for name in last if name not in there]
    return wrong or _goes_on(folder, max(there, default=""))


def _goes_on(folder: Path, last: str) -> list[str]:
    """Faults of the next run in the folder. last: the newest sweep there."""
    with log_lines.collected() as wrong:
        box = BlackBox(folder, recording.SHORT, MOST)
        for number in (1, 2):
            box.sweep(*recording.taken(number, recording.SHORT), {})
        box.close()
    broken, there = recording.read(folder)
    left = {path.stem for path in folder.iterdir()}
    if len(there) != MOST or left != there.keys() or min(there) <= last:
        wrong.append(f"the next run leaves {', '.join(sorted(left))} beyond {last or 'nothing'}")
    return wrong + broken


def scene(how: str = "") -> CutScene:
    """Two runs that keep sweeps in one folder. how: "thread" to write beside the loop."""
    program = [sys.executable, "-m", "tests.cuts.black_box"]

    def step(name: str) -> SceneStep:
        return SceneStep(name, lambda folder: [*program, folder / recording.KEPT, *how.split()])

    name = f"black-box-{how}" if how else "black-box"
    return CutScene(name, lambda folder: None, (step("first"), step("second")), judge)


if __name__ == "__main__":
    keep(Path(sys.argv[1]), DiskThread() if sys.argv[2:] else AtOnce())
