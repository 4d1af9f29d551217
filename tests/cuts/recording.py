"""Recording, cut short: the box's program that records sweeps, programs that are wrong on purpose,
and a judge of losses beyond the sweep in progress.

`python -m tests.cuts.recording WAY FOLDER SESSION` is such a program: it continues in the folder,
prints the sentences to the robot, and names the sweep that it is asked to discard and the material
that it is asked to forget.
"""

import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import numpy as np

from palpate.core import storage
from palpate.core.clock import SystemClock
from palpate.core.disk_thread import AtOnce, DiskThread, DiskWork
from palpate.core.errors import FormatError
from palpate.core.sentences import Reply
from palpate.core.sweep_file import load
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict
from palpate.sim import skin
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import taught
from tests.cuts.scene import CutScene, Found, SceneStep

SHORT = SweepFormat(4, 4, 750, 40, "uint8")
"""Format of the sweeps of all programs except the box's."""
THREAD = "in a thread"
"""The way of the box: it writes beside the loop."""
MATERIAL = "plastic rough"
"""The material of all sweeps."""
KEPT = "kept/sweeps"
"""Folder below that of the scene; it does not exist at first, so the program that makes it must
sync it too."""
HEARD = re.compile(
    r",REC,(?P<id>\d+),stored,(?:[^,]*,){3}(?P<session>[^,]*),(?P<name>sweep-\d+)|"
    r"^(?P<how>discard\w+) (?P<gone>\S+)|"
    r"^(?P<forgot>forgot)",
    re.MULTILINE,
)
RENAMED = "oak"
"""The later name of the material."""
Files = Mapping[Path, bytes]


def record(way: str, folder: Path, session: str) -> None:
    """Two sweeps, one discarded, a third, rename and forget. way: how files are written."""
    storage.put_all = lambda files, **how: WAYS[way](files)
    disk = DiskThread() if way == THREAD else AtOnce()
    running = recording(
        folder, SHORT, session, lambda line: print(line.decode().strip(), flush=True), disk
    )
    running.sweep(*taken(1, SHORT), {})
    running.sweep(*taken(2, SHORT), {})
    disk.settle()
    print(f"discarding {max(folder.glob('*.npy')).stem}", flush=True)
    print(f"discarded {_fields(running.commands['DISCARD'](''), disk)[-1]}", flush=True)
    running.sweep(*taken(3, SHORT), {})
    disk.settle()
    _fields(running.commands["RENAME"](f"{MATERIAL},{RENAMED}"), disk)
    print(f"renamed {session}", flush=True)
    _fields(running.forget(RENAMED), disk)
    print("forgot", flush=True)
    if running.stored != 2:
        sys.exit(f"{running.stored} sweeps are stored instead of 2")
    running.close()


def _fields(reply: Reply, disk: DiskWork) -> list[object]:
    """The fields of a reply, as soon as the box would send them."""
    if isinstance(reply, Future):
        disk.settle()
        return reply.result(0)
    return reply


def recording(
    folder: Path,
    format: SweepFormat,
    session: str,
    say: Callable[[bytes], None],
    disk: DiskWork | None = None,
) -> RecordingSession:
    """The observer of the box that records sweeps."""
    labels = Labels(MATERIAL, "1", session)
    return RecordingSession(folder, format, labels, SystemClock(), say, disk=disk)


def taken(number: int, format: SweepFormat) -> tuple[Sweep, Verdict]:
    """A sweep and its answer."""
    n = format.window
    digits = np.full((n, *format.shape), number, format.numpy_type)
    sweep = Sweep(number, 0, n, Status.OK, Frames(np.arange(n), np.arange(n), digits))
    return sweep, Verdict(
        number, n, Status.OK, "steel", 0.9, 0.8, np.array([0.9, 0.1]), 1, 0, 0, "0" * 8
    )


def _aside(
    files: Files, write: Callable[[Path, bytes], object], settle: Callable[[Path], object]
) -> None:
    """Write all files under temporary names, then rename them. settle: called after each."""
    for path, data in files.items():
        write(path.with_name(path.name + storage.PART), data)
    for path in files:
        path.with_name(path.name + storage.PART).replace(path)
        settle(path)


def _in_place(files: Files) -> None:
    for path, data in files.items():
        storage.write(path, data)
        storage.sync(path.parent)


def _late(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
    storage.sync(path.parent)


WAYS: dict[str, Callable[[Files], None]] = {
    "right": storage.put_all,
    THREAD: storage.put_all,
    "no sync of the file": lambda files: _aside(
        files, Path.write_bytes, lambda path: storage.sync(path.parent)
    ),
    "no sync of the folder": lambda files: _aside(files, storage.write, lambda path: None),
    "sync after the rename": lambda files: _aside(files, Path.write_bytes, _late),
    "under its own name": _in_place,
    "description last": lambda files, put=storage.put_all: put(dict(reversed(files.items()))),
}
"""Ways to write files: all but the first two are wrong on purpose, and the judge must find that."""


def judge(format: SweepFormat, found: Found) -> list[str]:
    """Faults of the sweeps of this format that were found, and of the next run in their folder."""
    folder = found.folder / KEPT
    wrong, there = read(folder)
    owed, gone, forgotten = reported(found.heard)
    for name, which in owed.items():
        if there.get(name) != which:
            wrong.append(f"{name}, {which} was stored, and {there.get(name, 'nothing')} is there")
    wrong += [
        f"{name}, {which} was discarded and is there"
        for name, which in gone.items()
        if there.get(name) == which
    ]
    try:
        learnt = {one.path.stem for one in taught(folder, Counter())}
    except FormatError as e:
        return [*wrong, str(e)]
    wrong += [f"{name} was forgotten and is taught" for name in sorted(learnt & forgotten)]
    renamed = re.findall(r"^renamed (\S+)", found.heard, re.MULTILINE)
    wrong += [
        f"{name}, {which} was renamed and is still {MATERIAL}"
        for name, which in there.items()
        if which.split()[0] in renamed and load(folder / f"{name}.npy")[0].material != RENAMED
    ]
    return wrong or _goes_on(folder, format)


def read(folder: Path) -> tuple[list[str], dict[str, str]]:
    """Sweeps that cannot be read; session and number of each that can."""
    wrong, there = [], {}
    for path in sorted(folder.glob("*.npy")):
        try:
            sweep = load(path)[0]
        except FormatError as e:
            wrong.append(str(e).replace(f"{folder}/", ""))
        else:
            there[path.stem] = f"{sweep.session} {sweep.id}"
    return wrong, there


def reported(output: str) -> tuple[dict[str, str], dict[str, str], set[str]]:
    """Session and number of stored and of discarded sweeps; the forgotten ones."""
    owed: dict[str, str] = {}
    gone: dict[str, str] = {}
    forgotten: set[str] = set()
    leaving = ""
    for heard in HEARD.finditer(output):
        if heard["name"]:
            owed[heard["name"]] = f"{heard['session']} {heard['id']}"
        elif heard["forgot"]:
            forgotten |= owed.keys()
        elif heard["how"] == "discarding":
            leaving = owed.pop(heard["gone"])
        else:
            gone[heard["gone"]] = leaving
    return owed, gone, forgotten


def _goes_on(folder: Path, format: SweepFormat) -> list[str]:
    """Faults of the next run in the folder."""
    before = {path: path.read_bytes() for path in folder.glob("*.npy")}
    running = recording(folder, format, "later", lambda line: None)
    for number in (1, 2):
        running.sweep(*taken(number, format), {})
    running.close()
    wrong, there = read(folder)
    if not {"later 1", "later 2"} <= set(there.values()):
        wrong.append("the next run does not store its two sweeps")
    wrong += [f"the next run leaves {path.name}" for path in folder.glob(f"*{storage.PART}")]
    wrong += [
        f"the next run changes {path.name}"
        for path, data in before.items()
        if path.read_bytes() != data
    ]
    return wrong


def scene(way: str = "right") -> CutScene:
    """Two runs that record; the second continues in the folder of the first."""
    title = "recording-thread" if way == THREAD else "recording"
    return _sessions(title, SHORT, lambda kept, name: ["tests.cuts.recording", way, kept, name])


def palpate() -> CutScene:
    """The same with the box's command."""
    words = ("palpate", "record", "--sim", "skin", "--virtual", "--sweeps", "2", "--out")
    return _sessions(
        "palpate-record", skin.FORMAT, lambda kept, name: [*words, kept, "--session", name]
    )


def _sessions(
    title: str, format: SweepFormat, words: Callable[[Path, str], list[str | Path]]
) -> CutScene:
    def session(name: str) -> SceneStep:
        return SceneStep(name, lambda folder: [sys.executable, "-m", *words(folder / KEPT, name)])

    return CutScene(
        title, lambda folder: None, (session("first"), session("second")), partial(judge, format)
    )


if __name__ == "__main__":
    record(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
