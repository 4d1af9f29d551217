"""A serial skin that a robot slides over materials, and `palpate teach` beside it as a process."""

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.clock import SystemClock
from tests.factories.paths import ROOT
from tests.factories.skins.player import Player, running
from tests.factories.skins.wires import wire

PITCHES = {"oak": 0.04, "cork": 0.1, "felt": 0.19, "slate": 0.33}
"""Materials, with the frequency of each in periods per frame."""
OTHER = 0.26
"""The frequency of anything else."""
RATE_HZ, WINDOW_S, SLIDE_S = 100.0, 0.64, 0.9
START_S = 60


class SlidSkin:
    """Frames of a skin of 4 x 4 taxels. material: which is slid over now, "" for none."""

    def __init__(self) -> None:
        self.material, self._phase = "", 0.0
        self._rng = np.random.default_rng(1)

    def frame(self, i: int, frame_ns: Callable[[int], int] = lambda i: 0) -> NDArray[Any]:
        """See FrameSource."""
        noise = self._rng.standard_normal((4, 4))
        if not self.material:
            return (20 + noise).round().astype(np.uint8)
        self._phase += 2 * np.pi * PITCHES.get(self.material, OTHER) * self._rng.uniform(0.9, 1.1)
        rows = np.arange(4)[:, None] * 0.4
        return (120 + 30 * np.sin(self._phase + rows) + 2 * noise).round().astype(np.uint8)


class TaughtBox:
    """The skin, the box's folders, and the process. address: of its page."""

    def __init__(self, folder: Path, player: Player, skin: SlidSkin) -> None:
        self.folder, self.player, self.skin = folder, player, skin
        self.process: subprocess.Popen[str] | None = None
        self.address, self.log = "", ""

    def options(self) -> list[str]:
        """The settings of the box."""
        sets = {
            "store.folder": self.folder / "store",
            "store.keys": self.folder,
            "store.runtime": self.folder / "run",
        }
        return [word for k, v in sets.items() for word in ("--set", f"{k}={v}")]

    def start(self, *more: str) -> None:
        """Start `palpate teach` with its page."""
        words = ["teach", *self.options(), "--skin", "matrix", "--port", str(self.player.path)]
        words += ["--set", "skin.grid=4x4", "--trigger", "serial", "--window", str(WINDOW_S)]
        words += ["--web", "0", *more]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "palpate", *words],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        threading.Thread(target=self._listen, args=(self.process,), daemon=True).start()
        end = time.monotonic() + START_S
        while not self.address:
            assert self.process.poll() is None, self.log
            assert time.monotonic() < end, self.log
            time.sleep(0.05)

    def stop(self, *, kill: bool = False) -> int:
        """End the process; its exit code."""
        assert self.process
        self.process.kill() if kill else self.process.terminate()
        self.address = ""
        return self.process.wait(30)

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr
        for line in process.stderr:
            self.log += line
            if "page: http" in line:
                self.address = line.split("page: ")[1].strip()


@contextmanager
def taught_box() -> Iterator[TaughtBox]:
    """A bench without a bundle for its skin, which is plugged in, and without a key."""
    skin = SlidSkin()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "store").mkdir()
        (folder / "run").mkdir()
        player = Player(wire("matrix", RATE_HZ), skin, SystemClock(), folder / "ttySkin")
        with running(player):
            box = TaughtBox(folder, player, skin)
            try:
                yield box
            finally:
                if box.process and box.process.poll() is None:
                    box.stop(kill=True)
