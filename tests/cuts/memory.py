"""The file of verdicts, cut short: a program that writes verdicts, and a judge of losses beyond the
verdict in progress.

`python -m tests.cuts.memory FILE` is this program: it continues in the file, and reports each
verdict that it has written. The shared index beside the file is not on the disk in any sense:
SQLite makes it anew.
"""

import re
import sys
from pathlib import Path

from palpate.client.verdicts import VerdictFile, since
from palpate.core.errors import ApplianceError
from tests.cuts.scene import CutScene, Found, SceneStep
from tests.factories import log_lines

NAME = "verdicts.db"
COUNT = 4
WRITTEN = re.compile(r"^written (\d+)$", re.MULTILINE)


def write(path: Path) -> None:
    """Write some verdicts."""
    file = VerdictFile(path)
    for sweep in range(COUNT):
        file.add(float(sweep), {"sweep": sweep, "status": "ok", "label": "wood"})
        print(f"written {sweep}", flush=True)
    file.close()


def judge(found: Found) -> list[str]:
    """Faults of the verdicts that were found, and of the next program that writes there."""
    path = found.folder / NAME
    written = WRITTEN.findall(found.heard)
    with log_lines.collected() as wrong:  # such as a file that is moved aside
        try:
            VerdictFile(path).close()
            there = [str(row["sweep"]) for row in since(path, 0)]
            write_quietly(path)
        except ApplianceError as e:
            return [*wrong, str(e)]
        whole = len([*since(path, 0)])
    if there[: len(written)] != written:
        wrong.append(f"of {' '.join(written)} there is {' '.join(there)}")
    if whole != len(there) + COUNT:
        wrong.append(f"the next program wrote {whole - len(there)} of {COUNT}")
    return wrong


def write_quietly(path: Path) -> None:
    """Write some verdicts, and report none."""
    file = VerdictFile(path)
    for sweep in range(COUNT):
        file.add(float(sweep), {"sweep": sweep, "status": "ok", "label": "wood"})
    file.close()


def scene() -> CutScene:
    """Two programs that write one after the other."""
    program = [sys.executable, "-m", "tests.cuts.memory"]

    def step(name: str) -> SceneStep:
        return SceneStep(name, lambda folder: [*program, folder / NAME])

    apart = re.compile(r".*-shm$")
    return CutScene("memory", lambda folder: None, (step("first"), step("second")), judge, apart)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
