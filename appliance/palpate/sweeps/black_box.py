"""The black box: files of the last sweeps in service with their verdicts, for `palpate replay`.

Sweeps without a window are not kept. Their sentence has all information, and a robot that continues
without a skin would push out the sweeps that have a window.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core.disk_thread import AtOnce, DiskWork
from palpate.core.log import TroubleLog
from palpate.core.observer import Observer
from palpate.core.types import Sweep, SweepFormat, Verdict
from palpate.sweeps.recording import FULL
from palpate.sweeps.sweep_folder import SweepFolder


class BlackBox(Observer):
    """Keeps the last `most` sweeps in `folder`, also over restarts. The oldest sweep is removed
    after the new sweep was written, on a full disk before. disk: does that; a sweep that it refuses
    is not kept. path: the folder."""

    def __init__(
        self, folder: Path, format: SweepFormat, most: int, disk: DiskWork | None = None
    ) -> None:
        self.path, self._format, self._most = folder, format, most
        self._disk = disk or AtOnce()
        self._folder: SweepFolder | None = None
        end, advice = "black box: sweeps are kept again", f"see to {folder}"
        self._log = TroubleLog("black box: no sweep is kept", advice, end=end)
        self._with_folder(lambda folder: None)  # now, since it waits for the disk several times

    @property
    def run(self) -> int | None:
        """The number in the folder after which the sweeps of this run come; None without a folder
        that can be used."""
        return self._folder.run if self._folder else None

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Write the sweep if it has a window, and remove the oldest sweep beyond `most`."""
        if len(sweep.frames):
            put = partial(self._put, sweep=sweep, verdict=verdict, circumstances=circumstances)
            self._disk(lambda: self._with_folder(put))

    def close(self) -> None:
        self._disk.settle()
        if self._folder:
            self._folder.close()

    def _with_folder(self, act: Callable[[SweepFolder], None]) -> None:
        def attempt() -> None:
            # a folder that cannot be used at the start may be usable later, and must not stop the
            # box
            self._folder = self._folder or SweepFolder(self.path, self._format)
            act(self._folder)

        self._log.attempt(attempt)

    def _put(
        self, folder: SweepFolder, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]
    ) -> None:
        while True:
            try:
                folder.put(sweep, verdict, circumstances)
                break
            except OSError as e:
                if e.errno not in FULL or not folder.numbers:
                    raise
            folder.remove(folder.numbers[0])
        while len(folder.numbers) > self._most:
            folder.remove(folder.numbers[0])
