"""All that can be attached to a box, at once and for long: `python -m tests.campaigns.full_load
--minutes 60 --page docs/faults.md`.

After these minutes, each fault is made several times. Writes docs/data/full-load.json and tables;
the exit code is 1 if a target was missed.

For each skin two boxes run side by side (`palpate run`, with emulators and boxes in processes of
their own, in real time). The full box has recording, black box, shadow, a feed with eight readers,
page and both bridges; the bare box has nothing. Frames, stop edges and sentences are counted in the
box, independently of its own counters (full_load_inside). Its sweeps are on a small file system of
their own, which is mounted from a file; mounting needs root.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core import storage
from palpate.core.provenance import commit
from palpate.deployment import shadow
from palpate_studies import marked_text
from tests.campaigns.feed_load import REAL_TIME
from tests.campaigns.full_load_judge import Phase, figures, missed, table
from tests.factories.bridges import bridge
from tests.factories.paths import ROOT
from tests.robots.attacked import said
from tests.robots.shared_line import SharedLine
from tests.robots.side_by_side import page_of
from tests.skins import load

SKINS = ("flexitac", "papillarray")
SETTLE_S, LOOK_S, WAIT_S = 20.0, 5.0, 0.1
"""Time before the measurement, time between two samples of the processes, and longest wait for a
line."""
AWAY_S, FULL_S, DEAF_S, REST_S = 2.0, 15.0, 25.0, 10.0
"""Durations of the faults: the processor is away, the disk is full, the port is blocked; and the
time after each for the box to recover."""
KEPT = 100
"""Sweeps in the black box."""
DISK_MB = 512
CHECKS = 5
"""Number of checks; a check listens for a second, and its results vary by a few percent."""
MEMORY = Path("/dev/shm")
"""Folder of logs and counts. Waiting for a busy disk would slow the bare box down, too."""
STATE_S = 0.05
"""Time between two STA; short, so that the line's buffers fill soon after the robot has stopped
reading."""


class SkinBox(SharedLine):
    """A box that reads an emulated skin."""

    def _note(self, at_s: float, line: str) -> None:
        """The reader of the line notes its sentences."""

    def send(self, number: signal.Signals) -> None:
        """Send its process a signal."""
        self._box.send_signal(number)


@dataclass
class LoadedSide:
    """One box and its robot. reading: share of a core that reading its skin takes, from `palpate
    check`. folder: its disk. heard: lines; results: of each sweep; kept: by outcome of REC. looks:
    (time, processor seconds, KiB resident). timed: time of each answer, with its milliseconds in
    the box. deaf: while it is set, nobody reads."""

    skin: str
    format: str
    full: bool
    box: SkinBox
    player: subprocess.Popen[str]
    reading: float
    counts: Path
    folder: Path
    heard: int = 0
    results: Counter[int] = field(default_factory=Counter)
    kept: Counter[str] = field(default_factory=Counter)
    timed: list[tuple[float, float]] = field(default_factory=list)
    looks: list[tuple[float, float, int]] = field(default_factory=list)
    deaf: threading.Event = field(default_factory=threading.Event)

    def note(self, at_s: float, line: str) -> None:
        """Handle a line from the box."""
        self.heard += 1
        if answer := Answer.read(line):
            self.results[answer.sweep] += 1
            self.timed.append((at_s, answer.latency_ms))
        elif line.startswith("$PPLP,REC,"):
            self.kept[line.split(",")[3]] += 1

    def listen(self, ended: threading.Event) -> None:
        """Read the line until `ended`, in a thread of high priority."""
        load.hurry(load.BOX)
        while not ended.is_set():
            if self.deaf.is_set():
                ended.wait(WAIT_S)
                continue
            for at_s, line in self.box.heard(WAIT_S):
                self.note(at_s, line)

    def look(self) -> None:
        """Note the resources that the process has used."""
        kib, _, cpu_s, _, _ = self.box.process()
        self.looks.append((time.monotonic(), cpu_s, kib))

    def result(self, phases: Sequence[Phase]) -> dict[str, Any]:
        """All figures, after box and emulator have ended."""
        agreed = shadow.read(self.folder / "shadow")
        return {
            "skin": self.skin,
            "full": self.full,
            "format": self.format,
            "reading": round(self.reading, 4),
            **figures(
                [*map(json.loads, self.counts.read_text().splitlines())],
                phases,
                self.timed,
                self.looks,
            ),
            "heard": self.heard,
            "results": len(self.results),
            "twice": self.results.total() - len(self.results),
            "kept": dict(self.kept),
            "recorded": len(list(self.folder.glob("sweeps/*.npy"))),
            "black_box": len(list(self.folder.glob("black-box/*.npy"))),
            "compared": agreed.compared if agreed else 0,
            **json.loads(self.player.communicate()[0]),
        }


@contextmanager
def disk(folder: Path) -> Iterator[Path]:
    """A small ext4 file system, like a card, mounted at `folder`."""
    image = folder.with_suffix(".ext4")
    folder.mkdir(parents=True, exist_ok=True)
    with image.open("wb") as file:
        file.truncate(DISK_MB << 20)
    subprocess.run(["mkfs.ext4", "-q", "-m", "0", image], check=True)
    done = subprocess.run(
        ["mount", "-o", "loop", image, folder], check=False, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(
            f"a file system of {DISK_MB} MB cannot be mounted: {done.stderr.strip()}; run as root"
        )
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)
        image.unlink()


def fill(path: Path) -> None:
    """Make the file `path` so large that its disk is full."""
    with path.open("wb") as file:
        for size in (1 << 20, 1 << 12):
            try:
                while True:
                    os.posix_fallocate(file.fileno(), file.seek(0, os.SEEK_END), size)
            except OSError as e:
                if e.errno != errno.ENOSPC:
                    raise


class FullLoad:
    """All boxes at work, each read by a thread. seen: by skin, the counts of the peers of its full
    box."""

    def __init__(
        self, stack: ExitStack, disks: Path, bundles: Mapping[str, Path], before: Sequence[str]
    ) -> None:
        self._attached = ExitStack()
        self._ended = threading.Event()
        self._before, self._disks = before, disks
        self._folder = Path(stack.enter_context(TemporaryDirectory()))
        self.seen: dict[str, Any] = {}
        self.sides = [
            self._side(stack, skin, path, full)
            for skin, path in bundles.items()
            for full in (False, True)
        ]
        threads = stack.enter_context(ThreadPoolExecutor(len(self.sides)))
        stack.callback(self._ended.set)
        stack.enter_context(self._attached)
        self._heard: list[Future[None]] = [
            threads.submit(side.listen, self._ended) for side in self.sides
        ]
        self.pass_time(LOOK_S)  # until the feeds exist
        self._peers = {side.skin: self._attach(side) for side in self.sides if side.full}

    def _side(self, stack: ExitStack, skin: str, path: Path, full: bool) -> LoadedSide:
        """Start one box."""
        name = f"{skin}-{'full' if full else 'bare'}"
        format, counts, link = (
            bundle.load(path).format,
            self._folder / f"{name}.jsonl",
            self._folder / f"{name}.tty",
        )
        folder = stack.enter_context(disk(self._disks / name)) if full else self._folder / name
        player = stack.enter_context(load.playing(skin, format.rate_hz, link))
        stack.callback(player.kill)
        reading = self._reading(load.sets(skin, format, link))
        chosen = [
            *load.sets(skin, format, link),
            f"classifier.bundle={path}",
            "classifier.allow_unsigned=true",
            f"store.folder={folder}",
            f"store.black_box={KEPT * full}",
            f"store.runtime={self._feed(skin).parent if full else ''}",
        ]
        inside = (
            sys.executable,
            "-m",
            "tests.campaigns.full_load_inside",
            counts,
            folder / "sweeps" if full else "",
            STATE_S,
        )
        box = SkinBox([*self._before, *map(str, inside)], chosen)
        stack.callback(box.close)
        if full:
            self._feed(skin).parent.mkdir()
        box.launch(*load.times(format), *(["--shadow", str(path)] if full else []))
        return LoadedSide(skin, str(format), full, box, player, reading, counts, folder)

    def _reading(self, chosen: Sequence[str]) -> float:
        """The share of a core that reading a skin takes, from `palpate check`, median of CHECKS."""
        command = [
            *self._before,
            sys.executable,
            "-m",
            "palpate",
            "check",
            *(f"--set={text}" for text in chosen),
        ]
        texts = [
            subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT).stdout
            for _ in range(CHECKS)
        ]
        return median(float(re.findall(r"([\d.]+) % of a core", text)[0]) / 100 for text in texts)

    def _feed(self, skin: str) -> Path:
        return self._folder / f"{skin}-run" / "feed.sock"

    def _attach(self, side: LoadedSide) -> subprocess.Popen[bytes]:
        """Start the bridges, the page and the peers."""
        enter, feed = self._attached.enter_context, self._feed(side.skin)
        ports = (
            enter(bridge("tcp", "--port", side.box.line))[1],
            enter(bridge("modbus", "--feed", feed))[1],
            enter(page_of(feed)),
        )
        command = [
            sys.executable,
            "-m",
            "tests.campaigns.full_load_peers",
            str(feed),
            *map(str, ports),
        ]
        peers = enter(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT)
        )
        self._attached.callback(peers.kill)
        return peers

    def pass_time(self, seconds: float) -> tuple[float, float]:
        """Let the boxes work; returns begin and end of this phase. Raises the error of a thread
        that reads them."""
        begin_s = time.monotonic()
        while (left_s := begin_s + seconds - time.monotonic()) > 0:
            for side in self.sides:
                side.look()
            for ended in wait(self._heard, min(left_s, LOOK_S), FIRST_COMPLETED).done:
                ended.result()
        return begin_s, time.monotonic()

    def processor_away(self) -> None:
        """No box runs for a while, but its skin continues."""
        for number in (signal.SIGSTOP, signal.SIGCONT):
            for side in self.sides:
                side.box.send(number)
            time.sleep(AWAY_S * (number is signal.SIGSTOP))

    def disk_full(self) -> None:
        """The disks of the full boxes are full."""
        files = [side.folder / "filler" for side in self.sides if side.full]
        for file in files:
            fill(file)
        self.pass_time(FULL_S)
        for file in files:
            file.unlink()

    def port_blocked(self) -> None:
        """No robot reads."""
        for side in self.sides:
            side.deaf.set()
        self.pass_time(DEAF_S)
        for side in self.sides:
            side.deaf.clear()

    def end(self) -> None:
        """End everything in order, and handle the last lines."""
        self.seen = {skin: said(peers) for skin, peers in self._peers.items()}
        self._ended.set()
        for heard in self._heard:
            heard.result()
        for side in self.sides:
            for at_s, line in side.box.stop():
                side.note(at_s, line)
            side.player.send_signal(signal.SIGTERM)
        self._attached.close()


FAULTS: dict[str, Callable[[FullLoad], None]] = {
    "processor away": FullLoad.processor_away,
    "disk full": FullLoad.disk_full,
    "port blocked": FullLoad.port_blocked,
}


def measure(
    bundles: Mapping[str, Path], minutes: float, rounds: int, before: Sequence[str], disks: Path
) -> dict[str, Any]:
    """The figures of all boxes, the counts of their peers, and a description of the machine."""
    with ExitStack() as stack:
        run = FullLoad(stack, disks, bundles, before)
        run.pass_time(SETTLE_S)
        phases: list[Phase] = [("calm", *run.pass_time(60 * minutes))]
        print("the time without faults is over", flush=True)
        for name, make in [*FAULTS.items()] * rounds:
            begin_s = time.monotonic()
            make(run)
            phases.append((name, begin_s, run.pass_time(REST_S)[1]))
        run.end()
        boxes = [side.result(phases) for side in run.sides]
        return {"machine": run.sides[0].box.about()["machine"], "peers": run.seen, "boxes": boxes}


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="without faults (%(default)g)")
    parser.add_argument(
        "--rounds", type=int, default=10, help="how often each fault is made then (%(default)s)"
    )
    parser.add_argument(
        "--bundles",
        type=Path,
        default=ROOT / "build" / "skins",
        help="as `python -m tests.campaigns skins way` leaves it",
    )
    parser.add_argument(
        "--disks",
        type=Path,
        default=ROOT / "build" / "disks",
        help="where the boxes' disks lie as files",
    )
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "data" / "full-load.json")
    parser.add_argument(
        "--page", type=Path, help="also put the tables there, between the markers named after --out"
    )
    parser.add_argument(
        "--draw", action="store_true", help="measure nothing: the tables of --out as it is"
    )
    args = parser.parse_args()
    if not args.draw:
        _measured(args, parser)
    content = json.loads(args.out.read_text())
    print(table(content))
    if args.page:
        text = marked_text.insert(
            args.page.read_text("utf-8"), args.out.stem, table(content), str(args.page)
        )
        args.page.write_text(text, "utf-8")
    for line in (bad := missed(content)):
        print(f"FAIL {line}")
    return 1 if bad else 0


def _measured(args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Measure, and write the figures to --out."""
    bundles = {skin: args.bundles / skin / "bundle" for skin in SKINS}
    for skin, path in bundles.items():
        if not path.is_dir():
            parser.error(
                f"{path} is no bundle; python -m tests.campaigns skins way {skin} makes it"
            )
    if MEMORY.is_dir():
        tempfile.tempdir = str(MEMORY)
    real_time = (
        subprocess.run([*REAL_TIME, "true"], check=False, capture_output=True).returncode == 0
    )
    ran, begin = commit(), round(os.getloadavg()[2], 1)
    found = measure(bundles, args.minutes, args.rounds, REAL_TIME if real_time else (), args.disks)
    about = {
        "commit": ran,
        "seed": load.SEED,
        "real_time": real_time,
        "load": [begin, round(os.getloadavg()[2], 1)],
    }
    storage.put(args.out, json.dumps({**about, **found}, indent=1).encode() + b"\n", parents=True)


if __name__ == "__main__":
    sys.exit(main())
